-- The guide stars whose place is known worst at the end of the span of epoch_jyear, and how far each
-- drifts in it. Errors are those of positions and proper motions.
-- count = 20: how many
SELECT designation, mag, position_error_begin_arcsec, position_error_end_arcsec, drift_arcsec,
    ra_deg, dec_deg
FROM stars
WHERE position_error_end_arcsec IS NOT NULL
ORDER BY position_error_end_arcsec DESC, star_id
LIMIT $count
