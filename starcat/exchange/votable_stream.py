"""Tables as VOTable 1.4, batch by batch: what a service sends, and what files are made of.

Two threads make batches into bytes, which are given in order; never more than a few batches are
held. With a status, as services have it, the document says at its end that rows were left out or
that reading failed; without one, what fails is raised.
"""

from __future__ import annotations

from binascii import b2a_base64
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Literal

import pyarrow as pa
import pyarrow.compute as pc

from starcat.errors import StarcatError
from starcat.exchange.columns import UNLABELLED, FirstRows, Label, plain_batch, plain_schema, steps
from starcat.exchange.votable_fields import (
    EPOCH_PLACE,
    VotableColumn,
    foot,
    has_places,
    head,
    info_element,
    votable_cells,
    votable_columns,
)
from starcat.exchange.votable_rows import binary2_rows, tabledata_rows
from starcat.threads import map_in_order

Serialization = Literal["binary2", "tabledata"]

_EPOCH = "epoch_jyear"
_EPOCH_ROOM = 32
"""Letters that a file leaves for the epoch, which is known when all rows are written."""

_BASE64_BYTES = 3  # what base64 makes four letters of; only the end of a stream may be shorter


def votable_chunks(
    batches: pa.RecordBatchReader,
    *,
    serialization: Serialization = "binary2",
    label: Label = UNLABELLED,
    maxrec: int | None = None,
    infos: Mapping[str, str] | None = None,
) -> Iterator[bytes]:
    """Yield a table as a VOTable with a status, as DALI 1.1, section 4.4 has services answer.

    With `maxrec` no more rows are given; one row more has to be among the batches for it to be
    known that some were left out. What goes wrong with the first rows is raised before anything is
    given. What goes wrong later ends the document with ``QUERY_STATUS`` ``ERROR``.
    """
    schema = plain_schema(batches.schema)
    columns = votable_columns(schema)
    cut = FirstRows(batches, maxrec)
    read = iter(cut)
    epoch = ""
    if _has_epoch(schema, columns):
        begun = list(islice(read, 2))
        read = chain(begun, read)
        # The document begins before the rest is known, so it says the epoch of short tables only.
        epoch = _epoch_attribute(_epochs_of(begun)) if len(begun) < 2 else ""
    told = {"QUERY_STATUS": "OK", **(infos or {})}
    rows = _row_chunks(read, schema, columns, serialization)
    first = next(rows, b"")
    yield head(columns, serialization, label, told, epoch).encode()
    yield first
    last = []
    try:
        yield from rows
        if cut.were_more:
            last = [info_element("QUERY_STATUS", "OVERFLOW")]
    except StarcatError as error:
        last = [info_element("QUERY_STATUS", "ERROR", text=str(error))]
    except (OSError, pa.ArrowException):
        last = [info_element("QUERY_STATUS", "ERROR", text="the rest of the rows cannot be read")]
    yield foot(serialization, last).encode()


def write_votable(batches: pa.RecordBatchReader, path: Path, label: Label) -> None:
    """Write a table as a VOTable file with rows as text."""
    schema = plain_schema(batches.schema)
    columns = votable_columns(schema)
    with_epoch = _has_epoch(schema, columns)
    epochs: set[float] = set()

    def watched() -> Iterator[pa.RecordBatch]:
        for batch in batches:
            if with_epoch and len(epochs) < 2:
                epochs.update(_epochs_of([batch]))
            yield batch

    top = head(columns, "tabledata", label, {}, " " * _EPOCH_ROOM if with_epoch else "").encode()
    with path.open("wb") as stream:
        stream.write(top)
        for chunk in _row_chunks(watched(), schema, columns, "tabledata"):
            stream.write(chunk)
        stream.write(foot("tabledata").encode())
        if with_epoch:
            stream.seek(top.index(EPOCH_PLACE) + len(EPOCH_PLACE))
            stream.write(_epoch_attribute(epochs).encode())


def _row_chunks(
    batches: Iterable[pa.RecordBatch],
    schema: pa.Schema,
    columns: Sequence[VotableColumn],
    serialization: Serialization,
) -> Iterator[bytes]:
    rows = binary2_rows if serialization == "binary2" else tabledata_rows

    def encode(batch: pa.RecordBatch) -> bytes:
        plain = plain_batch(batch, schema)
        cells = [
            votable_cells(column, values) for column, values in zip(columns, plain, strict=True)
        ]
        return rows(columns, cells, plain.num_rows) if columns else b""

    texts = map_in_order(encode, steps(batches))
    if serialization == "tabledata":
        yield from texts
        return
    left = b""
    failure = None
    try:
        for content in texts:
            content = left + content
            whole = len(content) - len(content) % _BASE64_BYTES
            left = content[whole:]
            yield b2a_base64(memoryview(content)[:whole])
    except Exception as error:
        failure = error
    if left:
        yield b2a_base64(left)
    if failure is not None:
        raise failure


def _has_epoch(schema: pa.Schema, columns: Sequence[VotableColumn]) -> bool:
    place = schema.get_field_index(_EPOCH)
    return place >= 0 and pa.types.is_floating(schema.field(place).type) and has_places(columns)


def _epochs_of(batches: Iterable[pa.RecordBatch]) -> set[float]:
    """Return at most two epochs of each batch; more than one means none in common."""
    found: set[float] = set()
    for batch in batches:
        extremes = pc.min_max(batch.column(_EPOCH)).as_py()
        found |= {epoch for epoch in extremes.values() if epoch is not None}
    return found


def _epoch_attribute(epochs: set[float]) -> str:
    if len(epochs) != 1:
        return ""
    [epoch] = epochs
    return f' epoch="J{str(epoch).removesuffix(".0")}"'
