-- The rows within a radius of a position, degrees, ends included, with their separation_deg.
-- They are rows of stars; of := 'rejected' takes another table with ra_deg and dec_deg.
-- Example: SELECT designation, mag, separation_deg FROM cone(37.95, 89.26, 5) ORDER BY separation_deg
CREATE MACRO cone(ra, dec, radius, of := 'stars') AS TABLE
SELECT *, separation(ra, dec, ra_deg, dec_deg) AS separation_deg
FROM query_table('{schema}.' || of)
WHERE dec_deg BETWEEN dec - radius - 1e-9 AND dec + radius + 1e-9
    AND separation(ra, dec, ra_deg, dec_deg) <= radius
