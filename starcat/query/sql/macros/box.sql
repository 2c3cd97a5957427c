-- The rows between two right ascensions and two declinations, degrees, ends included.
-- Where the first right ascension is the larger one, the box goes through 0. As in cone,
-- of := names another table.
-- Example: SELECT designation, ra_deg, dec_deg, mag FROM box(350, 10, -20, 20) ORDER BY mag
CREATE MACRO box(ra_min, ra_max, dec_min, dec_max, of := 'stars') AS TABLE
SELECT *
FROM query_table('{schema}.' || of)
WHERE dec_deg BETWEEN dec_min AND dec_max
    AND CASE
        WHEN ra_min <= ra_max THEN ra_deg BETWEEN ra_min AND ra_max
        ELSE ra_deg >= ra_min OR ra_deg <= ra_max
    END
