-- How many stars each magnitude has, and how many are as bright or brighter.
-- step_mag = 0.5: width of a bin
SELECT $step_mag * floor(mag / $step_mag) AS from_mag, count(*) AS stars,
    sum(count(*)) OVER (ORDER BY from_mag)::BIGINT AS so_far
FROM stars
WHERE mag IS NOT NULL
GROUP BY from_mag
ORDER BY from_mag
