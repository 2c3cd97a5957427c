-- The sine of an angle in degrees.
-- Example: SELECT sind(30) AS sine
CREATE MACRO sind(angle) AS sin(radians(angle))
