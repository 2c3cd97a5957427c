-- The great-circle separation of two positions, degrees in and out. Exact at all angles.
-- Example: SELECT separation(37.9546, 89.2641, 0, 90) AS separation_deg
CREATE MACRO separation(ra1, dec1, ra2, dec2) AS degrees(atan2(
    sqrt(
        power(cosd(dec2) * sind(ra2 - ra1), 2)
        + power(cosd(dec1) * sind(dec2) - sind(dec1) * cosd(dec2) * cosd(ra2 - ra1), 2)
    ),
    sind(dec1) * sind(dec2) + cosd(dec1) * cosd(dec2) * cosd(ra2 - ra1)
))
