-- The rows in the field of a camera, degrees: boresight, roll (north turns from up to the left),
-- full angles right and down. field_x_deg (right) and field_y_deg (down) are the angles from the
-- boresight, at most half the field. As in cone, of := names another table, and of a store only
-- the files are read that the field may reach.
-- Example: SELECT designation, mag, field_x_deg, field_y_deg FROM field(83.6, -5.4, 0, 12, 12)
CREATE MACRO field(ra, dec, roll, fov_x, fov_y, of := 'stars') AS TABLE
SELECT * EXCLUDE (_place_file, _place_ra_deg, _place_dec_deg, _east, _north, _ahead),
    degrees(atan2(-cosd(roll) * _east - sind(roll) * _north, _ahead)) AS field_x_deg,
    degrees(atan2(sind(roll) * _east - cosd(roll) * _north, _ahead)) AS field_y_deg
FROM (
    SELECT *,
        cosd(_place_dec_deg) * sind(_place_ra_deg - ra) AS _east,
        cosd(dec) * sind(_place_dec_deg)
            - sind(dec) * cosd(_place_dec_deg) * cosd(_place_ra_deg - ra) AS _north,
        sind(dec) * sind(_place_dec_deg)
            + cosd(dec) * cosd(_place_dec_deg) * cosd(_place_ra_deg - ra) AS _ahead
    FROM query_table('{places}.' || of)
    WHERE abs(_place_dec_deg - _declination(dec)) <= 1e-9 + _half_diagonal(fov_x, fov_y)
        AND {places}._may_be_near(
            _place_ra_deg, _place_file, getvariable('{places}.' || lower(of)),
            ra, dec, _half_diagonal(fov_x, fov_y)
        )
)
WHERE _ahead > 0
    AND abs(field_x_deg) <= fov_x / 2
    AND abs(field_y_deg) <= fov_y / 2
