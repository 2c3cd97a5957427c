-- Stars of the first target with those of the second near them, and the magnitude differences.
-- Stars with a proper motion are compared at one epoch; a crossmatch of catalogs weighs ambiguous ones.
-- Targets: 2
-- radius_arcsec = 5.0: greatest separation, seconds of arc
-- epoch_jyear = 2000.0: Julian year at which positions are compared
SELECT a_star_id, a_designation, b_star_id, b_designation, separation_arcsec, a_mag,
    b_mag - a_mag AS delta_mag, count(*) OVER (PARTITION BY a_star_id) AS candidates
FROM crossmatch('a', 'b', $radius_arcsec, epoch := $epoch_jyear)
ORDER BY a_star_id, separation_arcsec, b_star_id
