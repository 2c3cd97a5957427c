-- Rejected records per reason, with the brightest.
SELECT reason, count(*) AS stars, min(mag) AS brightest_mag, arg_min(designation, mag) AS brightest
FROM rejected
GROUP BY reason
ORDER BY stars DESC, reason
