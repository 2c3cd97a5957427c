"""Write tables in the formats of `starcat.ship.exchange.formats` to a file, a terminal or a client.

Text, Parquet and VOTable are written batch by batch; for FITS, ECSV and npz the whole table is in
memory. Units, meanings and UCDs come from the field metadata of the table. The same table gives
the same bytes.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import IO

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from starcat.errors import ConfigError, OutputError
from starcat.ship.exchange.array_files import write_ecsv, write_fits, write_npz
from starcat.ship.exchange.columns import (
    UNLABELLED,
    FirstRows,
    Label,
    begun,
    is_list,
    plain_batch,
    plain_schema,
)
from starcat.ship.exchange.formats import FILE_FORMATS, FORMATS, TEXT_FORMATS, Format
from starcat.ship.exchange.text import csv_chunks, json_chunks, tsv_chunks
from starcat.ship.exchange.votable import Serialization, votable_chunks, write_votable
from starcat.storage.atomic import whole_file
from starcat.storage.parquet import (
    ARROW_DATATYPES,
    ROW_GROUP_ROWS,
    astropy_metadata,
    votable_metadata,
)

_CHUNK_BYTES = 1 << 18
_TEXTS: dict[str, Callable[[pa.RecordBatchReader], Iterator[bytes]]] = {
    "csv": csv_chunks,
    "tsv": tsv_chunks,
    "json": json_chunks,
}


def write_batches(
    batches: pa.RecordBatchReader, target: Path, file_format: str, label: Label = UNLABELLED
) -> int:
    """Write a table to a file, which gets its name when it is complete; return the row count.

    Errors in reading the batches are raised unchanged. SchemaError advises a cast for a column
    that the format cannot store. The label is for VOTable, FITS and ECSV.
    """
    _check(file_format, FILE_FORMATS)
    watched = _Watched(batches)
    try:
        with whole_file(target) as partial:
            if file_format in _FILES:
                _FILES[file_format](watched.reader, partial, label)
            else:
                with partial.open("wb") as stream:
                    stream.writelines(_TEXTS[file_format](watched.reader))
    except OutputError:
        if watched.failure:  # reading failed: DuckDB's errors look like errors of writing
            raise watched.failure from None
        raise
    return watched.rows


def write_text_batches(batches: pa.RecordBatchReader, stream: IO[str], file_format: str) -> int:
    """Write a table as text, for instance to the standard output; return the row count."""
    _check(file_format, TEXT_FORMATS)
    watched = _Watched(batches)
    stream.writelines(text.decode() for text in _TEXTS[file_format](watched.reader))
    return watched.rows


def result_chunks(
    batches: pa.RecordBatchReader,
    form: Format,
    scratch: Path,
    *,
    label: Label = UNLABELLED,
    maxrec: int | None = None,
) -> Iterator[bytes]:
    """Begin an answer of the service; an error in the first rows is raised here.

    A VOTable states at its end if rows beyond `maxrec` were left out. Formats that cannot be
    streamed are first written to a file in the folder `scratch`.
    """
    chunks: Iterator[bytes]
    if form.is_votable:
        serialization: Serialization = "tabledata" if form.name == "votable/td" else "binary2"
        chunks = votable_chunks(batches, serialization=serialization, label=label, maxrec=maxrec)
    else:
        rows = begun(FirstRows(batches, maxrec).reader())
        if form.name in _TEXTS:
            chunks = _TEXTS[form.name](rows)
        else:
            chunks = _through_file(rows, form.name, scratch, label)
    return _primed(next(chunks), chunks)


class _Watched:
    """Batches on their way to a file, with the number of rows and any error of reading."""

    def __init__(self, batches: pa.RecordBatchReader) -> None:
        self._batches = batches
        self.rows = 0
        self.failure: Exception | None = None

    @property
    def reader(self) -> pa.RecordBatchReader:
        return pa.RecordBatchReader.from_batches(self._batches.schema, self._watched())

    def _watched(self) -> Iterator[pa.RecordBatch]:
        try:
            for batch in self._batches:
                self.rows += batch.num_rows
                yield batch
        except Exception as error:
            self.failure = error
            raise


def _primed(first: bytes, rest: Iterator[bytes]) -> Iterator[bytes]:
    yield first
    yield from rest


def _through_file(
    batches: pa.RecordBatchReader, file_format: str, scratch: Path, label: Label
) -> Iterator[bytes]:
    with tempfile.TemporaryDirectory(dir=scratch, prefix="result-") as folder:
        path = Path(folder) / f"table{FORMATS[file_format].suffix}"
        write_batches(batches, path, file_format, label)
        with path.open("rb") as file:
            while chunk := file.read(_CHUNK_BYTES):
                yield chunk


def _check(file_format: str, choices: Collection[str]) -> None:
    if file_format not in choices:
        raise ConfigError(
            f"format {file_format!r} is unknown here",
            value=file_format,
            hint=f"choose one of {', '.join(choices)}",
        )


def _write_parquet(batches: pa.RecordBatchReader, path: Path, label: Label) -> None:
    """Write a table as a Parquet file, which cannot store a label."""
    schema = plain_schema(batches.schema)
    texts = [field.name for field in schema if pa.types.is_string(field.type)]
    floating = [field.name for field in schema if pa.types.is_floating(field.type)]
    longest: dict[str, str] = {}
    with pq.ParquetWriter(
        path,
        schema,
        compression="zstd",
        compression_level=1,
        use_dictionary=[name for name in texts if name != "designation"] or False,
        column_encoding=dict.fromkeys(floating, "BYTE_STREAM_SPLIT") or None,
    ) as writer:
        for table in _row_groups(batches, schema):
            writer.write_table(table, row_group_size=ROW_GROUP_ROWS)
            for name in texts:
                longest[name] = max(longest.get(name, ""), _longest(table[name]), key=len)
        writer.add_key_value_metadata(_footer(schema, longest))


def _row_groups(batches: pa.RecordBatchReader, schema: pa.Schema) -> Iterator[pa.Table]:
    """Yield the rows in tables of a row group's size, for batches of any size."""
    waiting = schema.empty_table()
    for batch in batches:
        table = pa.Table.from_batches([plain_batch(batch, schema)], schema)
        waiting = pa.concat_tables([waiting, table])
        while waiting.num_rows >= ROW_GROUP_ROWS:
            yield waiting.slice(0, ROW_GROUP_ROWS)
            waiting = waiting.slice(ROW_GROUP_ROWS)
    if waiting.num_rows:
        yield waiting


def _longest(texts: pa.ChunkedArray) -> str:
    lengths = pc.fill_null(pc.utf8_length(texts), 0)
    return texts[pc.index(lengths, pc.max(lengths)).as_py()].as_py() or ""


def _footer(schema: pa.Schema, longest: dict[str, str]) -> dict[str, str]:
    """Return metadata that describes the columns; empty for types without a name in VOTable."""
    kinds = {field.type.value_type if is_list(field.type) else field.type for field in schema}
    if not kinds <= set(ARROW_DATATYPES):
        return {}
    # Describe a table of one row with the longest text of each column.
    row = [pa.array([longest.get(field.name)], field.type) for field in schema]
    table = pa.Table.from_arrays(row, schema=schema)
    return {**astropy_metadata(table), **votable_metadata(table)}


_FILES: dict[str, Callable[[pa.RecordBatchReader, Path, Label], None]] = {
    "parquet": _write_parquet,
    "votable": write_votable,
    "fits": write_fits,
    "ecsv": write_ecsv,
    "npz": write_npz,
}
