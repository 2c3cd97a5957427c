-- Which files of a store a place may have rows in. known is a list of what is known of each file: a
-- circle and a box that hold its part of the sky. A query in the place of a number must not stand
-- within a lambda, so the numbers are a row of a list first. Circles meet where the cosine between
-- their centres is at least that of both radii together.
CREATE MACRO _files_near(known, ra, dec, radius) AS list_transform(
    [{
        'x': cosd(dec) * cosd(ra), 'y': cosd(dec) * sind(ra), 'z': sind(dec),
        'radius': radius, 'cosine': cosd(radius), 'sine': sind(radius)
    }],
    lambda c: list_filter(known, lambda p: c.radius + p.reach >= 180
        OR c.x * p.x + c.y * p.y + c.z * p.z >= c.cosine * p.cosine - c.sine * p.sine - 1e-12)
)[1];
-- Right ascensions are from 0 to 360; ra_to is larger than that where the file's box goes through 0.
CREATE MACRO _files_between(known, ra_min, ra_max, dec_min, dec_max) AS list_transform(
    [{'a': ra_min, 'b': ra_max, 'c': dec_min, 'd': dec_max}],
    lambda box: list_filter(known, lambda p: p.dec_from <= box.d AND p.dec_to >= box.c AND CASE
        WHEN box.a > box.b THEN p.ra_to >= 360 OR p.ra_to >= box.a OR p.ra_from <= box.b
        ELSE (p.ra_from <= box.b AND p.ra_to >= box.a)
            OR (p.ra_to >= 360 AND box.a <= p.ra_to - 360 AND box.b >= 0)
    END)
)[1];
-- Whether a file is wanted. DuckDB asks this of every file before it opens one: in a text that is
-- faster than in a list, and where all are wanted there is nothing to ask. Tables that are not spread
-- over the sky have the file '', which every text contains.
CREATE MACRO _is_wanted(file, wanted) AS coalesce(contains(
    list_transform(
        [wanted],
        lambda w: CASE
            WHEN len(w) = w[1].files THEN NULL
            ELSE array_to_string(list_transform(w, lambda p: p.file), ' ')
        END
    )[1],
    file
), true);
-- How far in right ascension a circle reaches; everywhere where a pole may be in it.
CREATE MACRO _half_width(dec, radius) AS CASE
    WHEN abs(dec) + radius >= 89.999 THEN 360
    ELSE 1e-5 + degrees(asin(greatest(0, least(1, sind(radius) / cosd(dec)))))
END;
-- Whether a right ascension is within a width of another, or beyond 0 and 360. The least and the
-- largest of a part of a file are enough to tell that none is. Right ascensions may be from 0 or
-- from -180 on.
CREATE MACRO _is_beside(found, ra, width) AS (
    found BETWEEN ra - width AND ra + width
    OR found >= ra + 360 - width OR found <= ra - 360 + width
);
-- Half of the diagonal of a camera's field.
CREATE MACRO _half_diagonal(fov_x, fov_y) AS degrees(atan(sqrt(
    power(tan(radians(fov_x / 2)), 2) + power(tan(radians(fov_y / 2)), 2)
)));
-- A declination, if it exists. Without this check, cone(83, -95, 5) would find no rows and say nothing.
CREATE MACRO _declination(dec) AS CASE
    WHEN dec BETWEEN -90 AND 90 THEN dec
    ELSE error('declination ' || dec || ' deg does not exist: give one from -90 to 90')
END;
-- A radius, if it is one; NaN is larger than all numbers.
CREATE MACRO _radius(radius) AS CASE
    WHEN radius >= 0 AND isfinite(radius::DOUBLE) THEN radius
    ELSE error('a radius of ' || radius || ' deg does not exist: give a number from 0 on')
END;
