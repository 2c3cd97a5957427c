-- The guide stars that stand closest together.
-- count = 10: how many pairs
SELECT first.designation AS star, first.mag AS mag, second.designation AS other_star,
    second.mag AS other_mag, degrees(separation_rad) AS separation_deg
FROM (FROM pairs ORDER BY separation_rad, i, j LIMIT $count) AS pair
JOIN stars AS first ON first.row = pair.i
JOIN stars AS second ON second.row = pair.j
ORDER BY separation_rad, i, j
