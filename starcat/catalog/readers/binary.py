"""The reader of packed binary records, driven by a source's column table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from starcat.catalog.readers.records import Problem, Records, reject_impossible_numbers
from starcat.catalog.source import RecordFile


def parse_binary(
    data: bytes, layout: RecordFile, names: Sequence[str], first_line: int = 1
) -> Records:
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
    with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN like any other
        values = {
            name: table[name].astype(np.int64 if packed[name].kind == "i" else np.float64)
            for name in names
        }
    problems = []
    if rest:
        problems.append(
            Problem(first_line + count, "record", None, f"{rest} bytes", f"{size} bytes")
        )
    return reject_impossible_numbers(Records(layout.name, line, values, problems), layout)
