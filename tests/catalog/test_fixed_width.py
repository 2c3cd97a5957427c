"""Fixed-width records: every decimal is read to the last bit, every wrong byte has a place."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from starcat.catalog.readers.fixed_width import parse_fixed_width
from starcat.catalog.readers.records import MalformedRecord, ParsedRecords
from starcat.catalog.source import RecordFile, SourceColumn


def layout(*columns: SourceColumn, size: int, literals: dict[str, str] | None = None) -> RecordFile:
    keys = {"name": "tiny", "file_names": ("tiny.dat",), "layout": "fixed_width"}
    return RecordFile(**keys, record_bytes=size, literals=literals or {}, columns=columns)


def parse_texts(texts: list[str], format_: str, **rest: object) -> ParsedRecords:
    width = len(texts[0])
    file = layout(SourceColumn(name="x", bytes=(1, width), format=format_, **rest), size=width)
    return parse_fixed_width("\n".join(texts).encode() + b"\n", file, ["x"])


NAMED = layout(
    SourceColumn(name="name", bytes=(1, 3), format="A3"),
    SourceColumn(name="count", bytes=(4, 6), format="I3", required=True),
    SourceColumn(name="mag", bytes=(8, 12), format="F5.2", null=("99.99",)),
    size=12,
    literals={"7": "|"},
)
GOOD = b"abc 12| 5.25"


def parse_named(data: bytes, first_line: int = 1) -> ParsedRecords:
    return parse_fixed_width(data, NAMED, ["name", "count", "mag"], first_line)


@st.composite
def fields(draw: st.DrawFn) -> tuple[str, list[str], list[str]]:
    """A format, texts of its width, and the same texts as ``float`` takes them."""
    decimals = draw(st.integers(0, 9))
    width = draw(st.integers(decimals + 2 if decimals else 1, 16))
    whole_width = width - decimals - 1 if decimals else width
    texts = []
    for _ in range(draw(st.integers(1, 8))):
        sign = draw(st.sampled_from(["", "-", "+"])) if whole_width > 1 else ""
        room = whole_width - len(sign)
        digits = draw(st.text("0123456789", min_size=1, max_size=room))
        text = (sign + digits).rjust(whole_width)
        if decimals:
            fraction = draw(st.text("0123456789", max_size=decimals))
            text += "." + fraction.ljust(decimals)
        texts.append(text)
    return (f"F{width}.{decimals}" if decimals else f"I{width}"), texts, [t.strip() for t in texts]


@given(fields())
def test_a_number_in_its_format_is_the_float_of_its_text(case):
    format_, texts, plain = case
    parsed = parse_texts(texts, format_)
    assert parsed.problems == []
    expected = np.array([float(text) for text in plain])
    np.testing.assert_array_equal(parsed["x"].view(np.int64), expected.view(np.int64))


@given(
    st.decimals(-99999, 99999, allow_nan=False, places=5),
    st.sampled_from(["F13.8", "F13.0", "F", "D13.2", "E13.1"]),
    st.booleans(),
)
def test_a_number_in_another_format_than_its_column_is_the_float_of_its_text(
    number, format_, is_left
):
    text = str(number)
    field = text.ljust(13) if is_left else text.rjust(13)
    parsed = parse_texts([field], format_)
    assert parsed["x"].view(np.int64) == np.array([float(text)]).view(np.int64)


@pytest.mark.parametrize(
    ("format_", "text", "expected"),
    [
        ("F5.2", " 5.25", 5.25), ("F5.2", "+5.25", 5.25), ("F5.2", "-5.25", -5.25),
        ("F5.2", " -.25", -0.25), ("F5.2", "  .25", 0.25), ("F5.2", " 5.2 ", 5.2),
        ("F5.2", " 5.  ", 5.0), ("F5.2", "5.250", 5.25), ("F5.2", "5.25 ", 5.25),
        ("F5.2", "  525", 525.0), ("F5.2", "1.5E2", 150.0), ("D6.1", "1.5D02", 150.0),
        ("I3", "007", 7.0), ("I3", " -7", -7.0), ("I3", "+7 ", 7.0), ("I3", "7. ", 7.0),
        ("F3.2", ".25", 0.25), ("I1", "7", 7.0), ("F20.17", " 0.10000000000000001", 0.1),
    ],
)  # fmt: skip
def test_ways_to_write_a_number(format_, text, expected):
    parsed = parse_texts([text], format_)
    assert parsed.problems == []
    assert parsed["x"].tolist() == [expected]


def test_minus_zero_keeps_its_sign():
    assert np.signbit(parse_texts(["-0.00", " 0.00"], "F5.2")["x"]).tolist() == [True, False]


@pytest.mark.parametrize("format_", ["F5.2", "I5", "F"])
def test_a_blank_field_is_nan(format_):
    parsed = parse_texts(["     ", "    1"], format_)
    assert np.isnan(parsed["x"]).tolist() == [True, False]
    assert parsed.problems == []


@pytest.mark.parametrize(
    ("format_", "null", "texts", "is_null"),
    [
        ("F4.1", ("99.9",), ["99.9", " 6.4"], [True, False]),
        ("F4.1", ("99.9",), ["99.8", "-9.9"], [False, False]),
        ("F5.1", ("99.9",), ["99.90", " 99.9"], [True, True]),
        ("F4.1", ("--",), ["--  ", " 6.4"], [True, False]),
        ("I4", ("-999",), ["-999", " 999"], [True, False]),
        ("I4", ("n/a",), [" n/a", "   1"], [True, False]),
        ("I4", ("99", "n/a"), ["  99", "n/a "], [True, True]),
    ],
)
def test_texts_that_mean_no_value(format_, null, texts, is_null):
    parsed = parse_texts(texts, format_, null=null)
    assert parsed.problems == []
    assert np.isnan(parsed["x"]).tolist() == is_null


@pytest.mark.parametrize(
    ("format_", "text"),
    [
        ("F5.2", " 5.x5"), ("F5.2", "abcde"), ("F5.2", "--5.0"), ("F5.2", "-+5.0"),
        ("F5.2", "1 2.5"), ("F5.2", "- 2.5"), ("F5.2", "  -  "), ("F5.2", "    ."),
        ("F5.2", "  -. "), ("F5.2", "1.2.3"), ("F5.2", "2.5 5"), ("F5.2", "1.-25"),
        ("F5.2", " 1. 5"), ("F5.2", "  nan"), ("F5.2", "  inf"), ("F5.2", "1E999"),
        ("F5.2", " 0x10"), ("F5.2", "1_2.5"), ("I5", "    -"), ("I5", "1 2 3"), ("I5", "--123"),
        ("I5", "12-34"),
    ],
)  # fmt: skip
def test_a_field_that_is_not_a_number_of_its_kind(format_, text):
    parsed = parse_texts(["    1", text, "    2"], format_)
    assert parsed["x"].tolist() == [1.0, 2.0]
    assert parsed.line.tolist() == [1, 3]
    assert parsed.problems == [
        MalformedRecord(2, "x", (1, 5), repr(text), f"a number like {format_}")
    ]


def test_bytes_beyond_ascii_are_reported_as_they_are():
    (problem,) = parse_named(GOOD + b"\nabc 12| 5\xb725\n").problems
    assert (problem.line, problem.byte_range, problem.found) == (2, (8, 12), "' 5·25'")


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (b"abc 12| 5.2", MalformedRecord(2, "record", None, "11 bytes", "12 bytes")),
        (b"abc 12| 5.250", MalformedRecord(2, "record", None, "13 bytes", "12 bytes")),
        (b"abc 12  5.25", MalformedRecord(2, "separator", (7, 7), "' '", "'|'")),
        (b"abc   | 5.25", MalformedRecord(2, "count", (4, 6), "a blank field", "a value")),
        (b"abc x2| 5.25", MalformedRecord(2, "count", (4, 6), "' x2'", "a number like I3")),
        (b"abc 12|5,250", MalformedRecord(2, "mag", (8, 12), "'5,250'", "a number like F5.2")),
        (b"abc x2  5,25", MalformedRecord(2, "separator", (7, 7), "' '", "'|'")),
    ],
)
@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
def test_a_bad_line_is_left_out_alone_and_has_one_problem(line, expected, end):
    parsed = parse_named(GOOD + end + line + end + GOOD + end)
    assert parsed.problems == [expected]
    assert parsed.line.tolist() == [1, 3]
    assert parsed["count"].tolist() == [12.0, 12.0]


@pytest.mark.parametrize(
    ("data", "lines"),
    [
        *((GOOD + end, [1]) for end in (b"", b"\n", b"\r\n")),
        (GOOD + b"\n" + GOOD, [1, 2]),
        (GOOD + b"\r\n" + GOOD, [1, 2]),
        (GOOD + b"\r\n" + GOOD + b"\n" + GOOD, [1, 2, 3]),
        (b"\n" + GOOD + b"\n\n" + GOOD + b"\n\n", [2, 4]),
        (GOOD + b"\r\n\r\n" + GOOD + b"\r\n", [1, 3]),
        (GOOD + b"\r\n" + GOOD + b"\n\n" + GOOD + b"\r\n", [1, 2, 4]),
        *((blank, []) for blank in (b"", b"\n", b"\r\n\n")),
    ],
)
def test_line_ends_and_empty_lines(data, lines):
    parsed = parse_named(data)
    assert parsed.problems == []
    assert parsed.line.tolist() == lines
    assert parsed["mag"].tolist() == [5.25] * len(lines)
    assert parsed["name"].tolist() == [b"abc"] * len(lines)


def test_problems_come_in_the_order_of_the_lines():
    bad = [b"abc   | 5.25", b"short", b"abc 12| 5.x5", b"abc 12  5.25", GOOD, b"abc y2| 5.25"]
    problems = parse_named(b"\n".join(bad)).problems
    assert [problem.line for problem in problems] == [1, 2, 3, 4, 6]


SOME_LINES = st.sampled_from(
    [GOOD, b"xyz  7|-1.5 ", b"short", b"", b"abc x2| 5.25", b"abc   |     ", b"q  999|     "]
)


@given(st.lists(SOME_LINES, min_size=1, max_size=12), st.data())
def test_blocks_do_not_matter(lines, data):
    cut = data.draw(st.integers(0, len(lines)))
    whole = parse_named(b"".join(line + b"\n" for line in lines))
    first = parse_named(b"".join(line + b"\n" for line in lines[:cut]))
    second = parse_named(b"".join(line + b"\n" for line in lines[cut:]), first_line=cut + 1)
    assert first.problems + second.problems == whole.problems
    assert [*first.line, *second.line] == whole.line.tolist()
    for name, values in whole.columns.items():
        np.testing.assert_array_equal(np.concatenate([first[name], second[name]]), values)


def test_only_the_columns_asked_for_are_parsed():
    line = b"abc 12| 5,25"
    assert list(parse_fixed_width(line, NAMED, ["count"]).columns) == ["count"]
    assert parse_fixed_width(line, NAMED, ["count"]).problems == []
    with pytest.raises(KeyError, match="nothing"):
        parse_fixed_width(line, NAMED, ["nothing"])


def test_text_is_kept_with_its_blanks():
    parsed = parse_named(b" a  12| 5.25\n    12| 5.25\n")
    assert parsed["name"].tolist() == [b" a ", b"   "]
    assert parsed.is_blank("name").tolist() == [False, True]
