-- The triangles seen by the most fields of the tiling.
-- count = 10: how many
SELECT first.designation AS star, second.designation AS second_star, third.designation AS third_star,
    times_seen, area_rad2, circumradius_rad
FROM (FROM triangles ORDER BY times_seen DESC, i, j, k LIMIT $count) AS triangle
JOIN stars AS first ON first.row = i
JOIN stars AS second ON second.row = j
JOIN stars AS third ON third.row = k
ORDER BY times_seen DESC, i, j, k
