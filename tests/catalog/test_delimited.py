"""Delimited records: a field that cannot be read costs its own line and no other."""

from __future__ import annotations

import numpy as np
import pytest
from genuine_records import PSC as RECORD
from hypothesis import given
from hypothesis import strategies as st

from starcat.catalog.readers import delimited
from starcat.catalog.readers.delimited import parse_delimited
from starcat.catalog.readers.records import MalformedRecord, ParsedRecords
from starcat.catalog.source import RecordFile, SourceColumn, data_source

PSC = data_source("2mass").files[0]
GCVS = data_source("gcvs").files[0]

TINY = RecordFile(
    name="tiny",
    file_names=("tiny.csv",),
    layout="delimited",
    delimiter=",",
    comment="#",
    columns=(
        SourceColumn(name="name", format="A3", required=True),
        SourceColumn(name="mag", format="F5.2", null=("none", "99.99")),
        SourceColumn(name="code", format="A1", null=("?",)),
    ),
)


def test_every_field_of_a_genuine_2mass_record():
    names = [column.name for column in PSC.columns]
    parsed = parse_delimited(RECORD, PSC, names)
    assert parsed.problems == []
    for column, text in zip(PSC.columns, RECORD.split(b"|"), strict=True):
        value = parsed[column.name][0]
        if column.is_text:
            assert value.strip() == text.strip().removeprefix(rb"\N"), column.name
        elif text == rb"\N":
            assert np.isnan(value), column.name
        else:
            assert value == float(text), column.name


@pytest.mark.parametrize(
    ("old", "new", "column"),
    [
        (b"|12.467|", rb"|\N|", "j_m"),
        (b"|12.467|", b"||", "j_m"),
        (b"|1101364107|", rb"|\N|", "pts_key"),
        (b"|2451809.7124|", rb"|\N|", "jdate"),
    ],
)
def test_no_value_is_nan(old, new, column):
    parsed = parse_delimited(RECORD + b"\n" + RECORD.replace(old, new), PSC, ["ra", column])
    assert parsed.problems == []
    assert np.isnan(parsed[column]).tolist() == [False, True]


@pytest.mark.parametrize("names", [["ra", "j_m"], ["j_m", "designation", "ra"]])
@pytest.mark.parametrize(
    "text", ["12.x67", "1_2", "12,4", "12 4", "--1", "-", "nan", "inf", "1e999"]
)
def test_letters_in_a_number_cost_only_that_line(names, text):
    bad = RECORD.replace(b"|12.467|", b"|" + text.encode() + b"|")
    parsed = parse_delimited(b"\n".join([RECORD, bad, RECORD]), PSC, names, first_line=50)
    assert parsed.problems == [MalformedRecord(51, "j_m", None, repr(text), "a number like F")]
    assert parsed.line.tolist() == [50, 52]
    assert parsed["j_m"].tolist() == [12.467, 12.467]
    assert parsed["ra"].tolist() == [1.119851, 1.119851]


def test_a_line_with_two_bad_numbers_has_one_problem():
    bad = RECORD.replace(b"|12.467|", b"|x|").replace(b"|12.131|", b"|y|")
    parsed = parse_delimited(RECORD + b"\n" + bad, PSC, ["h_m", "j_m"])
    assert [(problem.line, problem.field) for problem in parsed.problems] == [(2, "h_m")]


@pytest.mark.parametrize(
    ("line", "found"),
    [(RECORD + b"|1", "61 fields"), (RECORD.rpartition(b"|")[0], "59 fields"), (b"x", "1 fields")],
)
def test_wrong_number_of_fields(line, found):
    parsed = parse_delimited(line + b"\n" + RECORD, PSC, ["ra"], first_line=7)
    assert parsed.problems == [MalformedRecord(7, "record", None, found, "60 fields")]
    assert parsed.line.tolist() == [8]


@pytest.mark.parametrize(
    ("line", "column"),
    [
        (RECORD.replace(b"1.119851|", rb"\N|"), "ra"),
        (RECORD.replace(b"|-89.91861|", b"||"), "dec"),
        (RECORD.replace(b"|00042876-8955069 |", b"|                 |"), "designation"),
        (RECORD.replace(b"|00042876-8955069 |", rb"|\N|"), "designation"),
    ],
)
def test_a_required_field_that_is_blank(line, column):
    parsed = parse_delimited(line + b"\n" + RECORD, PSC, ["ra", "dec", "designation"])
    assert parsed.problems == [MalformedRecord(1, column, None, "a blank field", "a value")]
    assert parsed.line.tolist() == [2]


@pytest.mark.parametrize(
    ("data", "lines"),
    [
        (RECORD, [1]),
        (RECORD + b"\r\n" + RECORD + b"\r\n", [1, 2]),
        (b"\n" + RECORD + b"\n\r\n" + RECORD, [2, 4]),
        (b"", []),
        (b"\n\n", []),
    ],
)
def test_line_ends_and_empty_lines(data, lines):
    parsed = parse_delimited(data, PSC, ["ra", "coadd", "designation"])
    assert parsed.problems == []
    assert parsed.line.tolist() == lines
    assert parsed["coadd"].tolist() == [267.0] * len(lines)
    assert parsed["designation"].tolist() == [b"00042876-8955069 "] * len(lines)


def test_text_nulls_are_nan_and_comments_are_no_records():
    data = b"# heading\na,none,x\n#b,1,x\nc,99.99,x\nd,99.990,x\ne,9.99,x\n"
    parsed = parse_delimited(data, TINY, ["name", "mag"])
    assert parsed.problems == []
    assert parsed.line.tolist() == [2, 4, 5, 6]
    assert np.isnan(parsed["mag"]).tolist() == [True, True, True, False]


def test_nulls_hold_where_the_block_is_read_field_by_field():
    parsed = parse_delimited(b"a,none,x\nb,bad,x\nc,99.99,?\nd,7.5,x\n", TINY, ["mag", "code"])
    assert [problem.line for problem in parsed.problems] == [2]
    assert np.isnan(parsed["mag"]).tolist() == [True, True, False]
    assert parsed.is_blank("code").tolist() == [False, True, False]


def test_quotes_and_bytes_beyond_ascii_are_text():
    parsed = parse_delimited(b'"a,1,x\n\xb7b,2,"\n', TINY, ["name", "mag", "code"])
    assert parsed.problems == []
    assert parsed["name"].tolist() == [b'"a', b"\xb7b"]
    assert parsed["code"].tolist() == [b"x", b'"']


def test_a_genuine_gcvs_record_with_comments_around_it():
    record = (
        b"114484\tRT And\tEA/RS\t8.97\t0\t9.83\t9.28\tV\t51421.737\t0.6289216\t17\tF8V+K1\n"
        b"116287\tZ And\tZAND\t7.7\t0\t11.3\t\tV\t\t\t\tM2III+B1eq\n"
    )
    data = b"#   - HIP/Gaia3\n#\n" + record + b"# end"
    parsed = parse_delimited(data, GCVS, ["star_ref", "var_type", "mag_max", "mag_min2", "period"])
    assert parsed.problems == []
    assert parsed.line.tolist() == [3, 4]
    assert [ref.strip() for ref in parsed["star_ref"].tolist()] == [b"114484", b"116287"]
    assert [text.strip() for text in parsed["mag_max"].tolist()] == [b"8.97", b"7.7"]
    assert parsed["mag_min2"][0] == 9.28
    assert np.isnan(parsed["mag_min2"][1])
    assert parsed.is_blank("period").tolist() == [False, True]


FIELDS = st.sampled_from(
    [b"", b"a", b" b ", b"ccc", b"7.5", b"-1", b"99.99", b"none", b"?", b"#", b'"', b"\0", b"\xb7"]
)
LINES = st.one_of(
    st.lists(FIELDS, min_size=3, max_size=3),
    st.tuples(FIELDS, st.sampled_from([b"7.5", b"1e3", b"99.99"]), FIELDS),
    st.lists(FIELDS, min_size=0, max_size=5),
).map(b",".join)
ENDS = st.sampled_from([b"\n", b"\n", b"\n", b"\n", b"\r\n", b"\n\n", b"\n#", b"\r"])


def same(one: ParsedRecords, other: ParsedRecords) -> None:
    assert one.line.dtype == other.line.dtype
    assert one.line.tolist() == other.line.tolist()
    assert one.problems == other.problems
    for name, values in one.columns.items():
        assert values.dtype == other[name].dtype
        assert values.tobytes() == other[name].tobytes(), name


@given(st.lists(st.tuples(LINES, ENDS), max_size=6), st.booleans(), st.integers(1, 99))
def test_a_block_read_at_once_is_as_if_read_by_lines(parts, is_cut, first_line):
    data = b"".join(line + end for line, end in parts)
    data = data.removesuffix(b"\n") if is_cut else data
    chosen = list(TINY.columns)
    at_once = delimited._parse_regular(data, TINY, chosen, first_line)
    by_lines = delimited._parse_lines(data, TINY, chosen, first_line)
    if at_once is not None:
        same(at_once, by_lines)
    elif data and not by_lines.problems:
        # Only what must be gone through line by line is.
        assert b"\r" in data or b"\n\n" in data or data[:1] in b"\n#" or b"\n#" in data


def test_a_regular_block_is_read_at_once():
    data = (RECORD + b"\n") * 3
    names = [column.name for column in PSC.columns]
    at_once = delimited._parse_regular(data, PSC, [PSC.column(name) for name in names], 5)
    assert at_once is not None
    same(at_once, delimited._parse_lines(data, PSC, list(PSC.columns), 5))
    assert at_once.line.tolist() == [5, 6, 7]


def test_text_of_one_length_and_of_several_is_padded_as_fixed_width_text_is():
    even = parse_delimited(b"abc,1,x\ndef,2,y\n", TINY, ["name"])["name"]
    uneven = parse_delimited(b"abc,1,x\nd,2,?\n\xb7\xb7\xb7,3,\n", TINY, ["name", "code"])
    assert even.tobytes() == b"abcdef"
    assert uneven["name"].tobytes() == b"abcd  \xb7\xb7\xb7"
    assert uneven.is_blank("code").tolist() == [False, True, True]
