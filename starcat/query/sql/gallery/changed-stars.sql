-- Guide stars that were added, removed or moved between two versions, or changed magnitude.
-- Targets: 2
-- moved_mas = 1.0: least change of a position to tell, milliseconds of arc
WITH pair AS (
    SELECT old.star_id AS old_id, new.star_id AS new_id,
        coalesce(new.designation, old.designation) AS designation,
        old.mag AS old_mag,
        new.mag AS new_mag,
        3600e3 * separation(old.ra_deg, old.dec_deg, new.ra_deg, new.dec_deg) AS moved_mas
    FROM a.stars AS old FULL JOIN b.stars AS new
        ON old.star_id = new.star_id AND old.catalog = new.catalog
)
SELECT
    CASE
        WHEN old_id IS NULL THEN 'came'
        WHEN new_id IS NULL THEN 'went'
        WHEN old_mag IS DISTINCT FROM new_mag THEN 'magnitude'
        ELSE 'moved'
    END AS change,
    designation, old_mag, new_mag, moved_mas
FROM pair
WHERE old_id IS NULL OR new_id IS NULL OR old_mag IS DISTINCT FROM new_mag
    OR moved_mas >= $moved_mas
ORDER BY change, coalesce(new_id, old_id)
