-- The cosine of an angle in degrees.
-- Example: SELECT cosd(60) AS cosine
CREATE MACRO cosd(angle) AS cos(radians(angle))
