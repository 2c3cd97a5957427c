-- The triangles seen by the most fields of the tiling.
-- count = 10: how many
SELECT first.designation AS star, second.designation AS second_star, third.designation AS third_star,
    times_seen, area_rad2, circumradius_rad
FROM (FROM triangles ORDER BY times_seen DESC, i, j, k LIMIT $count) AS triangle
JOIN (SELECT designation, row_number() OVER () - 1 AS row FROM stars) AS first ON first.row = i
JOIN (SELECT designation, row_number() OVER () - 1 AS row FROM stars) AS second ON second.row = j
JOIN (SELECT designation, row_number() OVER () - 1 AS row FROM stars) AS third ON third.row = k
ORDER BY times_seen DESC, i, j, k
