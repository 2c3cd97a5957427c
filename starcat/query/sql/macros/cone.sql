-- The rows within a radius of a position, degrees, ends included, with their separation_deg.
-- They are rows of stars; of := 'rejected' takes another table with ra_deg and dec_deg. Of a store
-- only the files are read that the circle may reach: EXPLAIN shows "Scanning Files".
-- Example: SELECT designation, mag, separation_deg FROM cone(37.95, 89.26, 5) ORDER BY separation_deg
CREATE MACRO cone(ra, dec, radius, of := 'stars') AS TABLE
SELECT * EXCLUDE (_place_file, _place_ra_deg, _place_dec_deg, _apart),
    _apart AS separation_deg
FROM (
    SELECT *, separation(ra, dec, _place_ra_deg, _place_dec_deg) AS _apart
    FROM query_table('{places}.' || of)
    -- What prunes even where the numbers come from another table stands first.
    WHERE _place_dec_deg BETWEEN _declination(dec) - _radius(radius) - 1e-9
        AND _declination(dec) + _radius(radius) + 1e-9
)
WHERE _apart <= radius
    AND {places}._may_be_near(
        _place_ra_deg, _place_file, getvariable('{places}.' || lower(of)),
        ra, _declination(dec), _radius(radius)
    )
