-- The fields of the tiling with fewest guide stars.
-- count = 10: how many fields
SELECT boresight, ra_deg, dec_deg, star_count
FROM boresights
ORDER BY star_count, boresight
LIMIT $count
