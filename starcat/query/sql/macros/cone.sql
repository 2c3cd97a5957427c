-- The rows within a radius of a position, degrees, ends included, with their separation_deg.
-- They are rows of stars; of := 'rejected' takes another table with ra_deg and dec_deg. Of a store
-- only the files are read that the circle may reach: EXPLAIN shows "Scanning Files".
-- Example: SELECT designation, mag, separation_deg FROM cone(37.95, 89.26, 5) ORDER BY separation_deg
CREATE MACRO cone(ra, dec, radius, of := 'stars') AS TABLE
SELECT * EXCLUDE (_place_file, _place_ra_deg, _place_dec_deg),
    separation(ra, dec, _place_ra_deg, _place_dec_deg) AS separation_deg
FROM query_table('{places}.' || of)
-- What a query in the place of a number can use stands first.
WHERE _place_dec_deg BETWEEN dec - radius - 1e-9 AND dec + radius + 1e-9
    AND separation(ra, dec, _place_ra_deg, _place_dec_deg) <= radius
    AND (_place_file = '' OR list_contains(
        _files_near(getvariable('{places}.' || lower(of)), ra, dec, radius), _place_file
    ))
