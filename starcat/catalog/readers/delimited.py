"""The reader of delimited records; it uses a source's column table.

pyarrow's CSV reader parses whole blocks. A block with comments, empty lines or malformed lines is
first read line by line. A block with a field of the wrong type is read as text, to find the line
and to keep the other records.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pyarrow import csv

from starcat.catalog.readers.records import (
    MalformedRecord,
    ParsedRecords,
    apply_nulls,
    check_record_fields,
    line_ends,
    read_fields,
)
from starcat.catalog.source import RecordFile, SourceColumn

_CACHED_BYTES = 1 << 20
"""Bytes of text to split at a time: small enough that the parts stay in the processor's cache."""


def parse_delimited(
    data: bytes, layout: RecordFile, names: Sequence[str], first_line: int = 1
) -> ParsedRecords:
    """Parse a block of delimited lines."""
    selected = [layout.column(name) for name in names]
    records = _parse_regular(data, layout, selected, first_line)
    if records is None:
        records = _parse_lines(data, layout, selected, first_line)
    return check_record_fields(records, layout)


def _parse_regular(
    data: bytes, layout: RecordFile, selected: Sequence[SourceColumn], first_line: int
) -> ParsedRecords | None:
    """Parse a block in which every line is a good record; return None for any other block."""
    comment = layout.comment.encode()
    has_comment = comment and (data.startswith(comment) or b"\n" + comment in data)
    if not data or has_comment or b"\r" in data:
        return None
    try:
        table = _read_csv(data, layout, selected, block_bytes=_CACHED_BYTES)
        if len(table) != line_ends(data) + (not data.endswith(b"\n")):
            return None  # pyarrow skips empty lines
        columns = {column.name: _array(table[column.name], column) for column in selected}
    except (pa.ArrowInvalid, pa.ArrowKeyError):
        return None
    line = np.arange(first_line, first_line + len(table), dtype=np.int64)
    return ParsedRecords(layout.name, line, columns)


def _parse_lines(
    data: bytes, layout: RecordFile, selected: Sequence[SourceColumn], first_line: int
) -> ParsedRecords:
    """Parse a block line by line, and list the malformed lines."""
    delimiter, comment = layout.delimiter.encode(), layout.comment.encode()
    number, kept, problems = [], [], []
    for offset, text in enumerate(data.splitlines()):
        if not text or (comment and text.startswith(comment)):
            continue
        fields = text.count(delimiter) + 1
        if fields == len(layout.columns):
            number.append(first_line + offset)
            kept.append(text)
        else:
            expected = f"{len(layout.columns)} fields"
            problems.append(
                MalformedRecord(first_line + offset, "record", None, f"{fields} fields", expected)
            )
    line = np.array(number, dtype=np.int64)
    if not kept:
        empty: dict[str, NDArray[Any]] = {
            column.name: np.empty(0, "S1" if column.is_text else float) for column in selected
        }
        return ParsedRecords(layout.name, line, empty, problems)
    clean = b"\n".join(kept)
    bad = np.zeros(len(line), dtype=bool)
    try:
        table = _read_csv(clean, layout, selected)
        columns = {column.name: _array(table[column.name], column) for column in selected}
    except (pa.ArrowInvalid, pa.ArrowKeyError):
        table = _read_csv(clean, layout, selected, as_text=True)
        columns = {c.name: _array_by_field(table[c.name], c, line, bad, problems) for c in selected}
    return ParsedRecords(layout.name, line, columns).without(bad, problems)


def _read_csv(
    data: bytes,
    layout: RecordFile,
    selected: Sequence[SourceColumn],
    *,
    as_text: bool = False,
    block_bytes: int = 1 << 30,
) -> pa.Table:
    nulls = sorted({"", *(text for column in selected for text in column.null)})
    kinds = {c.name: pa.binary() if as_text or c.is_text else pa.float64() for c in selected}
    return csv.read_csv(
        pa.BufferReader(data),
        read_options=csv.ReadOptions(
            column_names=[column.name for column in layout.columns],
            use_threads=False,
            block_size=block_bytes,
        ),
        parse_options=csv.ParseOptions(delimiter=layout.delimiter, quote_char=False),
        convert_options=csv.ConvertOptions(
            include_columns=[column.name for column in selected],
            column_types=kinds,
            null_values=nulls,
            strings_can_be_null=True,
            check_utf8=False,
        ),
    )


def _array(values: pa.ChunkedArray, column: SourceColumn) -> NDArray[Any]:
    if column.is_text:
        return _text_array(values)
    if not pc.all(pc.is_finite(values), min_count=0).as_py():
        raise pa.ArrowInvalid("nan or inf")  # pyarrow reads these words as numbers
    numbers: NDArray[np.float64] = pc.fill_null(values, float("nan")).to_numpy().copy()
    apply_nulls(numbers, column)
    return numbers


def _text_array(values: pa.ChunkedArray) -> NDArray[Any]:
    """Return text as fixed-width bytes padded with blanks, like the fixed-width reader."""
    filled = pc.fill_null(values.combine_chunks(), b"")
    width = max(1, pc.max(pc.binary_length(filled)).as_py() or 1)
    # The kernel pads any bytes; the view as string does not validate them.
    padded = pc.ascii_rpad(filled.view(pa.string()), width)
    _, offsets, content = padded.buffers()
    first = int(np.frombuffer(offsets, dtype=np.int32, count=padded.offset + 1)[padded.offset])
    return np.frombuffer(content, dtype=f"S{width}", count=len(padded), offset=first)


def _array_by_field(
    values: pa.ChunkedArray,
    column: SourceColumn,
    line: NDArray[np.int64],
    bad: NDArray[np.bool_],
    problems: list[MalformedRecord],
) -> NDArray[Any]:
    """Parse one column field by field; mark and report the records that cannot be read."""
    if column.is_text:
        return _text_array(values)
    numbers = np.full(len(values), np.nan)
    texts = enumerate(text or b"" for text in values.to_pylist())
    problems += read_fields(numbers, texts, column, line, bad)
    apply_nulls(numbers, column)
    return numbers
