-- The rows in the field of a camera, degrees: boresight, roll (north turns from up to the left),
-- full angles right and down. field_x_deg (right) and field_y_deg (down) are the angles from the
-- boresight, at most half the field. As in cone, of := names another table.
-- Example: SELECT designation, mag, field_x_deg, field_y_deg FROM field(83.6, -5.4, 0, 12, 12)
CREATE MACRO field(ra, dec, roll, fov_x, fov_y, of := 'stars') AS TABLE
SELECT * EXCLUDE (_east, _north, _ahead),
    degrees(atan2(-cosd(roll) * _east - sind(roll) * _north, _ahead)) AS field_x_deg,
    degrees(atan2(sind(roll) * _east - cosd(roll) * _north, _ahead)) AS field_y_deg
FROM (
    SELECT *,
        cosd(dec_deg) * sind(ra_deg - ra) AS _east,
        cosd(dec) * sind(dec_deg) - sind(dec) * cosd(dec_deg) * cosd(ra_deg - ra) AS _north,
        sind(dec) * sind(dec_deg) + cosd(dec) * cosd(dec_deg) * cosd(ra_deg - ra) AS _ahead
    FROM query_table('{schema}.' || of)
    WHERE abs(dec_deg - dec) <= 1e-9 + degrees(atan(sqrt(
        power(tan(radians(fov_x / 2)), 2) + power(tan(radians(fov_y / 2)), 2)
    )))
)
WHERE _ahead > 0
    AND abs(field_x_deg) <= fov_x / 2
    AND abs(field_y_deg) <= fov_y / 2
