"""Delimited records: a field that cannot be read costs its own line and no other."""

from __future__ import annotations

import numpy as np
import pytest
from genuine_records import PSC as RECORD
from hypothesis import given
from hypothesis import strategies as st

from starcat.catalog.readers import delimited
from starcat.catalog.readers.delimited import parse_delimited
from starcat.catalog.readers.records import MalformedRecord
from starcat.catalog.source import RecordFile, SourceColumn, data_source

PSC = data_source("2mass").files[0]

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


FIELDS = st.sampled_from(
    [b"", b"a", b" b ", b"ccc", b"7.5", b"-1", b"99.99", b"none", b"?", b"#", b'"', b"\0", b"\xb7"]
)
LINES = st.one_of(
    st.lists(FIELDS, min_size=3, max_size=3),
    st.tuples(FIELDS, st.sampled_from([b"7.5", b"1e3", b"99.99"]), FIELDS),
    st.lists(FIELDS, min_size=0, max_size=5),
).map(b",".join)
ENDS = st.sampled_from([b"\n", b"\n", b"\n", b"\n", b"\r\n", b"\n\n", b"\n#", b"\r"])


@given(st.lists(st.tuples(LINES, ENDS), max_size=6), st.booleans(), st.integers(1, 99))
def test_a_block_read_at_once_is_as_if_read_by_lines(parts, is_cut, first_line):
    data = b"".join(line + end for line, end in parts)
    data = data.removesuffix(b"\n") if is_cut else data
    chosen = list(TINY.columns)
    at_once = delimited._parse_regular(data, TINY, chosen, first_line)
    by_lines = delimited._parse_lines(data, TINY, chosen, first_line)
    if at_once is not None:
        assert at_once.line.dtype == by_lines.line.dtype
        assert at_once.line.tolist() == by_lines.line.tolist()
        assert at_once.problems == by_lines.problems
        for name, values in at_once.columns.items():
            assert values.dtype == by_lines[name].dtype
            assert values.tobytes() == by_lines[name].tobytes(), name
    elif data and not by_lines.problems:
        # Only what must be gone through line by line is.
        assert b"\r" in data or b"\n\n" in data or data[:1] in b"\n#" or b"\n#" in data


def test_text_of_one_length_and_of_several_is_padded_as_fixed_width_text_is():
    even = parse_delimited(b"abc,1,x\ndef,2,y\n", TINY, ["name"])["name"]
    uneven = parse_delimited(b"abc,1,x\nd,2,?\n\xb7\xb7\xb7,3,\n", TINY, ["name", "code"])
    assert even.tobytes() == b"abcdef"
    assert uneven["name"].tobytes() == b"abcd  \xb7\xb7\xb7"
    assert uneven.is_blank("code").tolist() == [False, True, True]
