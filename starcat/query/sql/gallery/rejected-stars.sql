-- The stars that were rejected for one reason, the brightest first: rejected-by-reason lists the
-- reasons.
-- reason = 'double': such as double, blended, variable, drifts, distrusted
SELECT designation, mag, band, ra_deg, dec_deg, reason, amplitude_mag, detail, star_id
FROM rejected
WHERE reason = $reason
ORDER BY mag, star_id
