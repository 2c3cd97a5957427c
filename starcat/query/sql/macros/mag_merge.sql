-- The magnitude of two stars seen as one: their light added.
-- Example: SELECT mag_merge(4.0, 4.0) AS mag
CREATE MACRO mag_merge(mag1, mag2) AS -2.5 * log10(power(10, -0.4 * mag1) + power(10, -0.4 * mag2))
