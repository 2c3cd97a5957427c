-- How many records are no guide stars, by reason, and the brightest of each.
SELECT reason, count(*) AS stars, min(mag) AS brightest_mag, arg_min(designation, mag) AS brightest
FROM rejected
GROUP BY reason
ORDER BY stars DESC, reason
