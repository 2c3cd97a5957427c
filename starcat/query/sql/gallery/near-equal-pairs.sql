-- Pairs of guide stars whose separations are nearly those of other pairs: what a matcher confuses.
-- difference_arcsec = 0.01: greatest difference to the next pair, seconds of arc
-- count = 20: how many
SELECT
    first.designation AS star,
    second.designation AS other_star,
    degrees(separation_rad) AS separation_deg,
    difference_arcsec
FROM (
    SELECT i, j, separation_rad,
        3600 * degrees(lead(separation_rad) OVER (ORDER BY separation_rad) - separation_rad)
            AS difference_arcsec
    FROM pairs
) AS pair
JOIN stars AS first ON first.row = pair.i
JOIN stars AS second ON second.row = pair.j
WHERE difference_arcsec <= $difference_arcsec
ORDER BY difference_arcsec, separation_rad, i, j
LIMIT $count
