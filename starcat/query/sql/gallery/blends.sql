-- The guide stars whose centroid other stars in its window move most. Only builds with
-- [selection.neighbours] know it.
-- count = 20: how many
SELECT designation, mag, centroid_offset_arcsec, contamination, blend_mag, ra_deg, dec_deg
FROM stars
WHERE centroid_offset_arcsec IS NOT NULL
ORDER BY centroid_offset_arcsec DESC, star_id
LIMIT $count
