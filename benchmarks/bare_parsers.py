"""Bare parsers of the same files: bytes to arrays of numbers, nothing else.

No meaning, no flags, no neighbours, no checks, no output.
"""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import csv

from starcat.catalog.archives import sao, tycho2
from starcat.catalog.source import RecordFile, data_source

COLUMNS = {"sao": sao.COLUMNS, "tycho2": tycho2.COLUMNS}
"""The columns that starcat reads of an archive, by file."""

BLANKS = [" " * width for width in range(14)]


def numpy_slices(paths: list[Path], source: str) -> int:
    """Slice fixed-width records as bytes and let numpy convert each column."""
    layout = data_source(source).files[0]
    wanted = [layout.column(name) for name in COLUMNS[source][layout.name]]
    rows = 0
    for path in paths:
        data = np.frombuffer(read_bytes(path), dtype=np.uint8).reshape(-1, layout.record_bytes + 1)
        rows += len(data)
        for column in wanted:
            first, last = column.bytes
            field = np.ascontiguousarray(data[:, first - 1 : last])
            if not column.is_text:
                field[(field == 32).all(axis=1), :3] = [*b"nan"][: last - first + 1][:3]
            text = field.view(f"S{last - first + 1}")[:, 0]
            if not column.is_text and last - first >= 2:
                text.astype(np.float64)
    return rows


def pyarrow_csv(paths: list[Path], source: str) -> int:
    """Split delimited records with pyarrow and convert the fields that ingest uses."""
    layout = data_source(source).files[0]
    names, kinds = bar_fields(layout)
    rows = 0
    for path in paths:
        table = csv.read_csv(
            pa.BufferReader(read_bytes(path)),
            read_options=csv.ReadOptions(column_names=names),
            parse_options=csv.ParseOptions(delimiter="|", quote_char=False),
            convert_options=csv.ConvertOptions(
                column_types=kinds, null_values=BLANKS, include_columns=list(kinds)
            ),
        )
        rows += len(table)
    return rows


def bar_fields(layout: RecordFile) -> tuple[list[str], dict[str, pa.DataType]]:
    """Return the names of the fields between bars, and the types of those to convert.

    A field that holds several columns of the table (TYC1-3, HIP and CCDM) stays text.
    """
    wanted = set(COLUMNS["tycho2"][layout.name])
    ends = [*sorted(int(place) for place in layout.literals), layout.record_bytes + 1]
    names, kinds, start = [], {}, 1
    for number, end in enumerate(ends):
        inside = [c for c in layout.columns if start <= c.bytes[0] and c.bytes[1] < end]
        single = len(inside) == 1
        name = inside[0].name if single else f"field_{number}"
        names.append(name)
        if wanted & {column.name for column in inside}:
            is_number = single and not inside[0].is_text
            kinds[name] = pa.float64() if is_number else pa.string()
        start = end + 1
    return names, kinds


def read_bytes(path: Path) -> bytes:
    """Return the content of a plain or compressed file."""
    return gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
