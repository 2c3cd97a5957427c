-- How many stars each HEALPix cell has: the emptiest cells first, those without a star too.
-- cell_order = 2: order of the cells; 12 * 4^order of them
-- count = 20: how many cells
SELECT cell, coalesce(stars, 0) AS stars, brightest_mag
FROM range(12 << (2 * $cell_order)) AS cells(cell)
LEFT JOIN (
    SELECT healpix($cell_order, ra_deg, dec_deg) AS cell, count(*) AS stars,
        min(mag) AS brightest_mag
    FROM stars
    GROUP BY ALL
) USING (cell)
ORDER BY stars, cell
LIMIT $count
