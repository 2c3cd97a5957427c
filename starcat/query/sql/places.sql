-- Which files of a table a place may have rows in. places is a list of what is known of each file:
-- a circle and a box that hold its part of the sky, in degrees. A query in the place of a number
-- must not stand within a lambda, so the numbers are a row of a list first.
CREATE MACRO _files_near(places, ra, dec, radius) AS list_transform(
    [{'ra': ra, 'dec': dec, 'radius': radius}],
    lambda c: list_transform(
        list_filter(places, lambda p: separation(p.ra, p.dec, c.ra, c.dec) <= c.radius + p.reach),
        lambda p: p.file
    )
)[1];
-- Right ascensions are from 0 to 360; ra_to is larger than that where the file's box goes through 0.
CREATE MACRO _files_between(places, ra_min, ra_max, dec_min, dec_max) AS list_transform(
    [{'a': ra_min, 'b': ra_max, 'c': dec_min, 'd': dec_max}],
    lambda box: list_transform(
        list_filter(places, lambda p: p.dec_from <= box.d AND p.dec_to >= box.c AND CASE
            WHEN box.a > box.b THEN p.ra_to >= 360 OR p.ra_to >= box.a OR p.ra_from <= box.b
            ELSE (p.ra_from <= box.b AND p.ra_to >= box.a)
                OR (p.ra_to >= 360 AND box.a <= p.ra_to - 360 AND box.b >= 0)
        END),
        lambda p: p.file
    )
)[1];
-- How far in right ascension a circle reaches; everywhere where a pole may be in it.
CREATE MACRO _half_width(dec, radius) AS CASE
    WHEN abs(dec) + radius >= 89.999 THEN 360
    ELSE 1e-5 + degrees(asin(greatest(0, least(1, sind(radius) / cosd(dec)))))
END;
CREATE MACRO _is_beside(found, ra, width) AS (
    found BETWEEN ra - width AND ra + width
    OR found >= ra + 360 - width OR found <= ra - 360 + width
);
-- Whether a right ascension may be that of a place within a radius of another. The least and the
-- largest of a part of a file are enough to tell that none is. Right ascensions may be from 0 or
-- from -180 on.
CREATE MACRO _may_be_near(found, ra, dec, radius) AS _is_beside(
    found, ra - 360 * floor(ra / 360), _half_width(dec, radius)
);
-- Half of the diagonal of a camera's field.
CREATE MACRO _half_diagonal(fov_x, fov_y) AS degrees(atan(sqrt(
    power(tan(radians(fov_x / 2)), 2) + power(tan(radians(fov_y / 2)), 2)
)));
