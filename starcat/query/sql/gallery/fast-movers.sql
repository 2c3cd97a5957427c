-- The stars with the largest proper motion.
-- count = 10: how many
SELECT designation, mag, pm_ra_cosdec_mas_yr, pm_dec_mas_yr,
    sqrt(power(pm_ra_cosdec_mas_yr, 2) + power(pm_dec_mas_yr, 2)) AS total_mas_yr
FROM stars
WHERE total_mas_yr IS NOT NULL
ORDER BY total_mas_yr DESC, star_id
LIMIT $count
