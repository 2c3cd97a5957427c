-- The brightest guide stars in a camera's field, with their positions in it.
-- ra_deg = 83.6: right ascension of the boresight, degrees
-- dec_deg = -5.4: its declination, degrees
-- roll_deg = 0.0: roll, degrees
-- fov_deg = 12.0: full angle of the field, degrees
-- count = 10: how many
SELECT designation, mag, field_x_deg, field_y_deg
FROM field($ra_deg, $dec_deg, $roll_deg, $fov_deg, $fov_deg)
ORDER BY mag, star_id
LIMIT $count
