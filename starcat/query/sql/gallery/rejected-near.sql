-- Rejected stars near a direction, with the reason.
-- ra_deg = 37.95: right ascension, degrees
-- dec_deg = 89.26: declination, degrees
-- radius_deg = 3.0: radius, degrees
SELECT designation, separation_deg, mag, band, reason, amplitude_mag
FROM cone($ra_deg, $dec_deg, $radius_deg, of := 'rejected')
ORDER BY separation_deg, star_id
