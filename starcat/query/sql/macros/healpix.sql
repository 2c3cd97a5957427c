-- The HEALPix cell of a position, degrees: nested numbering of an order from 0 to 29 (Gorski et
-- al. 2005, section 4). Shifted right by 2 it is the cell of the order before.
-- Example: SELECT healpix(3, ra_deg, dec_deg) AS cell, count(*) AS stars FROM stars GROUP BY cell
CREATE MACRO _healpix_equator(side, turn, z) AS list_transform(
    [{
        'p': floor(side * (0.5 + turn - 0.75 * z))::BIGINT,
        'm': floor(side * (0.5 + turn + 0.75 * z))::BIGINT
    }],
    lambda j: {
        'face': CASE
            WHEN j.p // side = j.m // side THEN (j.p // side) | 4
            WHEN j.p // side < j.m // side THEN j.p // side
            ELSE j.m // side + 8
        END,
        'x': j.m & (side - 1),
        'y': side - 1 - (j.p & (side - 1))
    }
)[1];
CREATE MACRO _healpix_cap(side, turn, depth, is_north) AS list_transform(
    [{
        'quarter': least(3, floor(turn))::BIGINT,
        'p': least(side - 1, floor((turn - least(3, floor(turn))) * depth)::BIGINT),
        'm': least(side - 1, floor((1 - turn + least(3, floor(turn))) * depth)::BIGINT)
    }],
    lambda j: CASE
        WHEN is_north THEN {'face': j.quarter, 'x': side - 1 - j.m, 'y': side - 1 - j.p}
        ELSE {'face': j.quarter + 8, 'x': j.p, 'y': j.m}
    END
)[1];
CREATE MACRO _spread_bits(numbers) AS list_transform(list_transform(list_transform(list_transform(
    list_transform(numbers, lambda n: (n | (n << 16)) & 281470681808895),
    lambda n: (n | (n << 8)) & 71777214294589695),
    lambda n: (n | (n << 4)) & 1085102592571150095),
    lambda n: (n | (n << 2)) & 3689348814741910323),
    lambda n: (n | (n << 1)) & 6148914691236517205);
-- A position that is not known (null or NaN) is in no cell.
CREATE MACRO healpix(cell_order, ra, dec) AS CASE
    WHEN isfinite((ra + dec)::DOUBLE) THEN list_transform(
        list_transform(
            [{
                'side': 1::BIGINT << cell_order,
                'turn': ra / 90 - 4 * floor(ra / 360),
                'z': sind(dec),
                -- 1 - |z| with all its digits near the poles.
                'cap': 2 * power(sind((90 - abs(dec)) / 2), 2)
            }],
            lambda s: CASE
                WHEN s.cap * 3 >= 1 THEN _healpix_equator(s.side, s.turn, s.z)
                ELSE _healpix_cap(s.side, s.turn, s.side * sqrt(3 * s.cap), s.z > 0)
            END
        ),
        -- The bits of x at the even places, those of y at the odd ones: y counts twice.
        lambda cell: (
            (cell.face << (2 * cell_order)) + list_sum(_spread_bits([cell.x, cell.y, cell.y]))
        )::BIGINT
    )[1]
END
