-- Stars of the first target with those of the second near them, and the magnitude differences.
-- At the positions as the tables have them: give both the same epoch. A crossmatch of catalogs moves
-- stars to a common one and weighs ambiguous matches.
-- Targets: 2
-- radius_arcsec = 5.0: greatest separation, seconds of arc
WITH zoned AS (
    SELECT *, floor(dec_deg * 3600 / $radius_arcsec)::BIGINT AS zone
    FROM a.stars
),
spread AS (
    SELECT *, unnest([zone - 1, zone, zone + 1]) AS near_zone
    FROM (SELECT *, floor(dec_deg * 3600 / $radius_arcsec)::BIGINT AS zone FROM b.stars)
),
matched AS (
    SELECT
        zoned.star_id AS a_star_id,
        zoned.designation AS a_designation,
        spread.star_id AS b_star_id,
        spread.designation AS b_designation,
        3600 * separation(zoned.ra_deg, zoned.dec_deg, spread.ra_deg, spread.dec_deg)
            AS separation_arcsec,
        zoned.mag AS a_mag,
        spread.mag - zoned.mag AS delta_mag
    FROM zoned JOIN spread ON zoned.zone = spread.near_zone
    WHERE separation_arcsec <= $radius_arcsec
)
SELECT *, count(*) OVER (PARTITION BY a_star_id) AS candidates
FROM matched
ORDER BY a_star_id, separation_arcsec, b_star_id
