"""Answers in the formats of `starcat.vo.formats`, as streams of bytes.

Formats that are written from their end are written into a file first.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path

import pyarrow as pa

from starcat.exchange.first_rows import FirstRows
from starcat.exchange.formats import SUFFIXES, write_batches
from starcat.exchange.label import UNLABELLED, Label
from starcat.exchange.text import csv_chunks, json_chunks, tsv_chunks
from starcat.exchange.votable_stream import Serialization, votable_chunks
from starcat.vo.formats import Format

_CHUNK_BYTES = 1 << 18
_TEXTS: dict[str, Callable[[pa.RecordBatchReader], Iterator[tuple[bytes, int]]]] = {
    "csv": csv_chunks,
    "tsv": tsv_chunks,
    "json": json_chunks,
}


def result_chunks(
    batches: pa.RecordBatchReader,
    form: Format,
    folder: Path,
    *,
    label: Label = UNLABELLED,
    maxrec: int | None = None,
) -> Iterator[bytes]:
    """Begin an answer."""
    chunks: Iterator[bytes]
    if form.is_votable:
        serialization: Serialization = "tabledata" if form.name == "votable/td" else "binary2"
        chunks = votable_chunks(batches, serialization=serialization, label=label, maxrec=maxrec)
    else:
        rows = _begun(FirstRows(batches, maxrec).reader())
        if form.name in _TEXTS:
            chunks = (text for text, _ in _TEXTS[form.name](rows))
        else:
            chunks = _through_file(rows, form.name, folder, label)
    return _primed(next(chunks), chunks)


def _begun(batches: pa.RecordBatchReader) -> pa.RecordBatchReader:
    """Return a reader whose first batch was read."""
    first = next(iter(batches), None)
    begun = [] if first is None else [first]
    return pa.RecordBatchReader.from_batches(batches.schema, chain(begun, batches))


def _through_file(
    batches: pa.RecordBatchReader, file_format: str, folder: Path, label: Label
) -> Iterator[bytes]:
    """Write a file, and yield what is in it."""
    with tempfile.TemporaryDirectory(dir=folder, prefix="result-") as place:
        path = Path(place) / f"table{SUFFIXES[file_format][0]}"
        write_batches(batches, path, file_format, label)
        with path.open("rb") as file:
            while chunk := file.read(_CHUNK_BYTES):
                yield chunk


def _primed(first: bytes, rest: Iterator[bytes]) -> Iterator[bytes]:
    yield first
    yield from rest
