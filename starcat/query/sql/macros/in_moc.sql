-- Whether a position, degrees, is in a MOC (Multi-Order Coverage map of the IVOA) that is written as
-- ASCII: an order from 0 to 29, a slash, then nested HEALPix cells or ranges of cells of this order.
-- A text that is not a MOC, or has more than 50,000 characters, is an error.
-- Example: SELECT designation, mag FROM stars WHERE in_moc(ra_deg, dec_deg, '0/3 1/16-18') ORDER BY mag
CREATE MACRO _moc_cells(part) AS list_transform(
    list_filter(string_split_regex(split_part(part, '/', 2), '[\s,]+'), lambda cell: cell <> ''),
    -- The first and the last of the cells of order 29 that a cell or a range holds.
    lambda cell: {
        'low': split_part(cell, '-', 1)::BIGINT << (58 - 2 * split_part(part, '/', 1)::INT),
        'high': ((split_part('-' || cell, '-', -1)::BIGINT + 1)
            << (58 - 2 * split_part(part, '/', 1)::INT)) - 1
    }
);
CREATE MACRO _checked_moc(moc) AS CASE
    WHEN length(moc) > 50000 THEN error('in_moc: the MOC has more than 50,000 characters')::VARCHAR
    WHEN NOT regexp_matches(moc, '^\s*\d+/') OR NOT regexp_full_match(
        moc || ' ', '\s*(([12]?\d/)?(\d{1,19}(-\d{1,19})?)?[\s,]+)+'
    )
        THEN error('in_moc: not a MOC in ASCII, such as 3/5-7 4/9: ' || left(moc, 40))::VARCHAR
    ELSE moc
END;
CREATE MACRO in_moc(ra, dec, moc) AS list_transform(
    [{
        'cell': healpix(29, ra, dec),
        'ranges': flatten(list_transform(
            list_filter(
                string_split(regexp_replace(_checked_moc(moc), '(\d+)\s*/', '|\1/', 'g'), '|'),
                lambda part: contains(part, '/')
            ),
            lambda part: _moc_cells(part)
        ))
    }],
    lambda here: len(list_filter(
        here.ranges, lambda range: here.cell BETWEEN range.low AND range.high
    )) > 0
)[1]
