"""Tables as VOTable 1.4, rows as text: exact for every number, and readable by every tool."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa

from starcat.exchange.column_types import plain_schema
from starcat.exchange.label import UNLABELLED, Label
from starcat.exchange.votable_columns import votable_columns
from starcat.exchange.votable_header import EPOCH_PLACE, foot, head
from starcat.exchange.votable_stream import epoch_attribute, epochs_of, has_epoch, row_chunks

_EPOCH_ROOM = 32
"""Letters that are left for the epoch, which is known when all rows are written."""


def write_votable(batches: pa.RecordBatchReader, path: Path, label: Label = UNLABELLED) -> int:
    """Write batches as a VOTable."""
    schema = plain_schema(batches.schema)
    columns = votable_columns(schema)
    with_epoch = has_epoch(schema, columns)
    epochs: set[float] = set()
    count = 0

    def watched() -> Iterator[pa.RecordBatch]:
        nonlocal count, epochs
        for batch in batches:
            count += batch.num_rows
            if with_epoch and len(epochs) < 2:
                epochs |= epochs_of([batch])
            yield batch

    top = head(columns, "tabledata", label, {}, " " * _EPOCH_ROOM if with_epoch else "").encode()
    with path.open("wb") as stream:
        stream.write(top)
        for chunk in row_chunks(watched(), schema, columns, "tabledata"):
            stream.write(chunk)
        stream.write(foot("tabledata").encode())
        if with_epoch:
            stream.seek(top.index(EPOCH_PLACE) + len(EPOCH_PLACE))
            stream.write(epoch_attribute(epochs).encode())
    return count
