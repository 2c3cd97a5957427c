"""The readers of records of fixed length, text or packed; they use a source's column table.

Numbers are read column by column for all records of a block: digits are weighted and
summed as integers and divided once by a power of ten, which rounds exactly like a decimal
parser. A field that does not have the column's format (point elsewhere, letters) is read
individually, so nothing is guessed and every error has a position.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Mask
from starcat.catalog.readers.records import (
    MalformedRecord,
    ParsedRecords,
    apply_nulls,
    check_record_fields,
    read_fields,
)
from starcat.catalog.source import RecordFile, SourceColumn
from starcat.errors import quoted

_NEWLINE, _RETURN, _SPACE, _PLUS, _MINUS, _POINT = b"\n\r +-."


def parse_fixed_width(
    data: bytes, layout: RecordFile, names: Sequence[str], first_line: int = 1
) -> ParsedRecords:
    """Parse a block of fixed-width lines."""
    chars, line, problems = _split_lines(data, layout, first_line)
    columns: dict[str, NDArray[Any]] = {}
    bad = np.zeros(len(chars), dtype=bool)
    problems += _check_literals(chars, line, layout, bad)
    for name in names:
        column = layout.column(name)
        first, last = _byte_range(column)
        field = chars[:, first - 1 : last]
        if column.is_text:
            columns[name] = np.ascontiguousarray(field).view(f"S{last - first + 1}")[:, 0]
        else:
            values, odd = _fixed_point(np.ascontiguousarray(field.T), column.decimals)
            texts = ((i, field[i].tobytes()) for i in np.flatnonzero(odd).tolist())
            problems += read_fields(values, texts, column, line, bad)
            apply_nulls(values, column)
            columns[name] = values
    records = ParsedRecords(layout.name, line, columns).without(bad, problems)
    return check_record_fields(records, layout)


def parse_binary(
    data: bytes, layout: RecordFile, names: Sequence[str], first_line: int = 1
) -> ParsedRecords:
    """Parse a block of packed little-endian records."""
    size = layout.record_bytes or 1
    columns = [layout.column(name) for name in names]
    packed = np.dtype(
        {
            "names": list(names),
            "formats": [column.format for column in columns],
            "offsets": [column.bytes[0] - 1 if column.bytes else 0 for column in columns],
            "itemsize": size,
        }
    )
    count, rest = divmod(len(data), size)
    table = np.frombuffer(data, dtype=packed, count=count)
    line = np.arange(first_line, first_line + count, dtype=np.int64)
    with np.errstate(invalid="ignore"):  # treat a signalling NaN like any NaN
        values = {
            name: table[name].astype(np.int64 if packed[name].kind == "i" else np.float64)
            for name in names
        }
    problems = []
    if rest:
        problems.append(
            MalformedRecord(first_line + count, "record", None, f"{rest} bytes", f"{size} bytes")
        )
    return check_record_fields(ParsedRecords(layout.name, line, values, problems), layout)


def _byte_range(column: SourceColumn) -> tuple[int, int]:
    if column.bytes is None:  # never true: the model of a source refuses such a column; for mypy
        raise ValueError(f"column {column.name} has no byte range")
    return column.bytes


def _split_lines(
    data: bytes, layout: RecordFile, first_line: int
) -> tuple[NDArray[np.uint8], NDArray[np.int64], list[MalformedRecord]]:
    """Return the lines of the right length as a matrix, with their numbers."""
    length = layout.record_bytes or 0
    if not data.endswith(b"\n"):
        data += b"\n"
    raw = np.frombuffer(data, dtype=np.uint8)
    stride = length + 2 if data[length : length + 1] == b"\r" else length + 1
    if len(raw) % stride == 0:
        matrix = raw.reshape(-1, stride)
        ends = matrix[:, length:]
        regular = bool((ends[:, -1] == _NEWLINE).all()) and bool((ends[:, 0] == ends[0, 0]).all())
        if regular and not (matrix[:, :length] == _NEWLINE).any():
            line = np.arange(first_line, first_line + len(matrix), dtype=np.int64)
            return matrix[:, :length], line, []
    return _split_uneven(raw, length, first_line)


def _split_uneven(
    raw: NDArray[np.uint8], length: int, first_line: int
) -> tuple[NDArray[np.uint8], NDArray[np.int64], list[MalformedRecord]]:
    end = np.flatnonzero(raw == _NEWLINE)
    start = np.concatenate([[0], end[:-1] + 1])
    size = end - start
    size -= (size > 0) & (raw[end - 1] == _RETURN)
    line = np.arange(first_line, first_line + len(end), dtype=np.int64)
    wrong = (size != length) & (size > 0)
    problems = [
        MalformedRecord(int(line[i]), "record", None, f"{size[i]} bytes", f"{length} bytes")
        for i in np.flatnonzero(wrong)
    ]
    good = size == length
    if not good.any():
        return np.empty((0, length), dtype=np.uint8), line[good], problems
    index = start[good][:, None] + np.arange(length)
    return raw[index], line[good], problems


def _check_literals(
    chars: NDArray[np.uint8], line: NDArray[np.int64], layout: RecordFile, bad: Mask
) -> list[MalformedRecord]:
    """Mark the records that lack a separator of the layout."""
    problems: list[MalformedRecord] = []
    places = np.array([int(position) - 1 for position in layout.literals], dtype=np.intp)
    texts = np.array([ord(text) for text in layout.literals.values()], dtype=np.uint8)
    if bool((chars[:, places] == texts).all()):
        return problems
    for position, text in layout.literals.items():
        byte = int(position)
        wrong = (chars[:, byte - 1] != ord(text)) & ~bad
        for i in np.flatnonzero(wrong):
            actual = quoted(chars[i, byte - 1].tobytes())
            problems.append(
                MalformedRecord(int(line[i]), "separator", (byte, byte), actual, repr(text))
            )
        bad |= wrong
    return problems


def _fixed_point(chars: NDArray[np.uint8], decimals: int | None) -> tuple[Array, Mask]:
    """Read fields whose decimal point, if any, is at its position in the format.

    Return the values (NaN if blank), and the mask of fields to be read one by one.
    """
    width, count = chars.shape
    point = width - decimals - 1 if decimals else width
    if decimals is None or point < 0 or width > 16:
        return np.full(count, np.nan), np.ones(count, dtype=bool)
    digit = chars - np.uint8(48)
    is_digit = digit < 10
    space = chars == _SPACE
    blank = space.all(axis=0)
    good = _integer_part_is_regular(chars, is_digit, space, point)
    if point < width:
        good &= (chars[point] == _POINT) & _fraction_is_regular(is_digit, space, point)
        good &= is_digit[point + 1] | (is_digit[point - 1] if point else False)
    else:
        good &= is_digit[-1]
    digit *= is_digit
    places = [k for k in range(width) if k != point]
    mantissa: NDArray[Any] = np.zeros(count, dtype=np.int64 if len(places) > 9 else np.int32)
    for k in places:
        mantissa *= 10
        mantissa += digit[k]
    values = mantissa / 10.0 ** (width - point - 1) if point < width else mantissa.astype(float)
    negative = (chars[:point] == _MINUS).any(axis=0)
    np.negative(values, out=values, where=negative)
    values[blank] = np.nan
    return values, ~(good | blank)


def _integer_part_is_regular(
    chars: NDArray[np.uint8], is_digit: Mask, space: Mask, point: int
) -> Mask:
    """Return the mask of fields with spaces, then at most one sign, then digits to the point."""
    good = np.ones(chars.shape[1], dtype=bool)
    for k in range(point):
        sign = (chars[k] == _PLUS) | (chars[k] == _MINUS)
        if k + 1 < point:
            good &= ~is_digit[k] | is_digit[k + 1]
            sign &= is_digit[k + 1]
        good &= is_digit[k] | space[k] | sign
    return good


def _fraction_is_regular(is_digit: Mask, space: Mask, point: int) -> Mask:
    """Return the mask of fields with digits after the point, then blanks for missing decimals."""
    good = np.ones(is_digit.shape[1], dtype=bool)
    for k in range(point + 1, len(is_digit)):
        good &= is_digit[k] | space[k]
        if k > point + 1:
            good &= is_digit[k - 1] | ~is_digit[k]
    return good
