-- All columns of one star, kept or rejected (records beyond read_limit_mag are not listed).
-- designation = 'SAO 308': its name, as the table has it
SELECT 'guide star' AS verdict, COLUMNS(* EXCLUDE (x, y, z)) FROM stars
WHERE designation = $designation
UNION ALL BY NAME
SELECT reason AS verdict, COLUMNS(* EXCLUDE (reason)) FROM rejected
WHERE designation = $designation
