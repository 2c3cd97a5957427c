-- The pairs of rows of two tables within a radius, arcseconds, ends included: the columns of one as
-- a_..., of the other as b_..., and their separation_arcsec. A table is 'a' (the stars of the first
-- target), 'gaia.rejected' or, of one target, 'stars'. Rows with a proper motion and an epoch_jyear
-- are moved to the epoch; epoch := NULL compares all rows where they are. nearest := true leaves to
-- each row of the first table its nearest one (all of them where several are as near).
-- Example: SELECT a_designation, b_designation, separation_arcsec
-- FROM crossmatch('stars', 'stars', 600) WHERE a_star_id < b_star_id
CREATE MACRO _cells_of(zone, height) AS greatest(
    1, floor(cosd((zone + 0.5) * height) * 360 / height)::BIGINT
);
-- A cell is numbered within its zone, around which steps go.
CREATE MACRO _cell(zone, step, cells) AS 1000000 * zone + ((step % cells) + cells) % cells;
CREATE MACRO _at_epoch(name, jyear) AS TABLE
SELECT * EXCLUDE (_at_length),
    degrees(atan2(_at_y, _at_x)) AS _at_ra,
    degrees(atan2(_at_z, sqrt(_at_x * _at_x + _at_y * _at_y))) AS _at_dec
FROM (
    SELECT * REPLACE (
        _at_x / _at_length AS _at_x, _at_y / _at_length AS _at_y, _at_z / _at_length AS _at_z
    )
    FROM (
        SELECT *, sqrt(_at_x * _at_x + _at_y * _at_y + _at_z * _at_z) AS _at_length
        FROM (
            SELECT * EXCLUDE (_at_vx, _at_vy, _at_vz, _at_jyear) REPLACE (
                _at_x + _at_vx * coalesce(jyear - _at_jyear, 0) AS _at_x,
                _at_y + _at_vy * coalesce(jyear - _at_jyear, 0) AS _at_y,
                _at_z + _at_vz * coalesce(jyear - _at_jyear, 0) AS _at_z
            )
            FROM query_table('_moving."' || lower(name) || '"')
        )
    )
)
WHERE isfinite(_at_length);
-- A zone of declination is at least 16 radii high, and is divided into cells about as wide. A row of
-- the first table is in one cell, a row of the second in all that its circle reaches, also beyond a
-- pole and right ascension 0: no pair is missed, and none is found twice.
CREATE MACRO crossmatch(first, second, radius_arcsec, epoch := 2000.0, nearest := false) AS TABLE
WITH first_rows AS NOT MATERIALIZED (
    SELECT *, _cell(_at_zone, floor(_at_ra / 360 * _at_cells)::BIGINT, _at_cells) AS _at_key
    FROM (
        SELECT *, _cells_of(_at_zone, greatest(16 * radius_arcsec, 20) / 3600) AS _at_cells
        FROM (
            SELECT *,
                floor(_at_dec / (greatest(16 * radius_arcsec, 20) / 3600))::BIGINT AS _at_zone
            FROM _at_epoch(first, epoch)
        )
    )
),
second_rows AS NOT MATERIALIZED (
    SELECT * EXCLUDE (_at_zone, _at_cells, _at_step),
        _cell(_at_zone, unnest(range(
            _at_step,
            least(_at_step + _at_cells, 1 + floor((_at_ra + _at_width) / 360 * _at_cells)::BIGINT)
        )), _at_cells) AS _at_key
    FROM (
        SELECT *, floor((_at_ra - _at_width) / 360 * _at_cells)::BIGINT AS _at_step
        FROM (
            SELECT *,
                _half_width(_at_dec, radius_arcsec / 3600) AS _at_width,
                _cells_of(_at_zone, greatest(16 * radius_arcsec, 20) / 3600) AS _at_cells
            FROM (
                SELECT *, unnest(range(
                    floor((_at_dec - radius_arcsec / 3600 - 1e-9)
                        / (greatest(16 * radius_arcsec, 20) / 3600))::BIGINT,
                    1 + floor((_at_dec + radius_arcsec / 3600 + 1e-9)
                        / (greatest(16 * radius_arcsec, 20) / 3600))::BIGINT
                )) AS _at_zone
                FROM _at_epoch(second, epoch)
            )
        )
    )
),
pairs AS NOT MATERIALIZED (
    SELECT COLUMNS(f.*) AS 'a_\0', COLUMNS(s.*) AS 'b_\0',
        3600 * degrees(2 * atan2(
            sqrt(power(f._at_x - s._at_x, 2) + power(f._at_y - s._at_y, 2)
                + power(f._at_z - s._at_z, 2)),
            sqrt(power(f._at_x + s._at_x, 2) + power(f._at_y + s._at_y, 2)
                + power(f._at_z + s._at_z, 2))
        )) AS separation_arcsec
    FROM first_rows AS f JOIN second_rows AS s USING (_at_key)
),
near AS NOT MATERIALIZED (FROM pairs WHERE separation_arcsec <= radius_arcsec)
SELECT COLUMNS(lambda name: NOT starts_with(name, 'a__at_') AND NOT starts_with(name, 'b__at_'))
FROM (
    FROM near WHERE NOT nearest
    UNION ALL
    FROM (
        FROM near
        QUALIFY rank() OVER (PARTITION BY a__at_x, a__at_y, a__at_z ORDER BY separation_arcsec) = 1
    )
    WHERE nearest
)
