-- The rows between two right ascensions and two declinations, degrees, ends included.
-- Where the first right ascension is the larger one, the box goes through 0. As in cone,
-- of := names another table, and of a store only the files are read that the box may reach.
-- Example: SELECT designation, ra_deg, dec_deg, mag FROM box(350, 10, -20, 20) ORDER BY mag
CREATE MACRO box(ra_min, ra_max, dec_min, dec_max, of := 'stars') AS TABLE
SELECT * EXCLUDE (_place_file, _place_ra_deg, _place_dec_deg)
FROM query_table('{places}.' || of)
WHERE _place_dec_deg BETWEEN dec_min AND dec_max
    AND CASE
        WHEN ra_min <= ra_max THEN _place_ra_deg BETWEEN ra_min AND ra_max
        ELSE _place_ra_deg >= ra_min OR _place_ra_deg <= ra_max
    END
    AND {places}._may_be_between(
        _place_file, getvariable('{places}.' || lower(of)), ra_min, ra_max, dec_min, dec_max
    )
