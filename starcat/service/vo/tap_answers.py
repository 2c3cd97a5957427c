"""The answer to a question as bytes: each format of TAP, no more rows than were asked for."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from starcat.exchange.formats import write_batches
from starcat.exchange.label import Label
from starcat.exchange.text import csv_chunks
from starcat.exchange.votable_stream import votable_chunks
from starcat.vo.formats import Format

if TYPE_CHECKING:
    import pyarrow as pa

_FILE_BYTES = 1 << 18

_LABEL = Label("result")


def chunks(
    batches: pa.RecordBatchReader, form: Format, max_rows: int, scratch: Path
) -> Iterator[bytes]:
    """Yield an answer in a format.

    Parameters
    ----------
    batches : pyarrow.RecordBatchReader
        The rows; one more than `max_rows` where there are more.
    form : Format
        How to write them.
    max_rows : int
        Rows to give at most; VOTable says where there were more.
    scratch : Path
        Folder for what has to be a file before it can be sent.

    Yields
    ------
    bytes
        In order.

    Raises
    ------
    SchemaError
        If a column cannot be said in the format.
    QueryLimitError
        If the query takes too long; also while reading.
    """
    if form.name == "votable":
        yield from votable_chunks(batches, serialization="binary2", label=_LABEL, maxrec=max_rows)
    elif form.name == "votable/td":
        yield from votable_chunks(batches, serialization="tabledata", label=_LABEL, maxrec=max_rows)
    elif form.name == "csv":
        for text, _ in csv_chunks(_cut(batches, max_rows)):
            yield text
    else:
        path = scratch / f"answer-{secrets.token_hex(8)}.{form.suffix}"
        try:
            write_batches(_cut(batches, max_rows), path, form.name, _LABEL)
            with path.open("rb") as stream:
                while part := stream.read(_FILE_BYTES):
                    yield part
        finally:
            path.unlink(missing_ok=True)


def _cut(batches: pa.RecordBatchReader, rows: int) -> pa.RecordBatchReader:
    import pyarrow as pa

    def first() -> Iterator[pa.RecordBatch]:
        left = rows
        for batch in batches:
            if left <= 0:
                return
            yield batch.slice(0, left)
            left -= batch.num_rows

    return pa.RecordBatchReader.from_batches(batches.schema, first())
