"""Tables in the formats that other tools read: one table in, one file out.

CSV, JSON, Parquet and VOTable are written batch by batch; FITS, ECSV and npz hold the table in
memory. Units, meanings and UCDs come from the field metadata of the table. The same table gives
the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import pyarrow as pa

from starcat.errors import ConfigError, OutputError
from starcat.exchange.ecsv_file import write_ecsv
from starcat.exchange.fits_file import write_fits
from starcat.exchange.label import UNLABELLED, Label
from starcat.exchange.npz_file import write_npz
from starcat.exchange.numpy_columns import check_names, numpy_columns
from starcat.exchange.parquet_stream import write_parquet_stream
from starcat.exchange.text import csv_chunks, json_chunks
from starcat.exchange.votable_file import write_votable
from starcat.storage.atomic import whole_file

SUFFIXES = {
    "csv": (".csv",),
    "json": (".json",),
    "parquet": (".parquet",),
    "votable": (".vot", ".xml"),
    "fits": (".fits",),
    "ecsv": (".ecsv",),
    "npz": (".npz",),
}
"""The names of files by format, the usual one first."""

FORMATS = tuple(SUFFIXES)
TEXT_FORMATS = ("csv", "json")
_CHUNKS: dict[str, Callable[[pa.RecordBatchReader], Iterator[tuple[bytes, int]]]] = {
    "csv": csv_chunks,
    "json": json_chunks,
}


def format_of(path: str | Path) -> str:
    """Return the format that the name of a file asks for.

    Examples
    --------
    >>> format_of("stars.vot")
    'votable'
    """
    suffix = Path(path).suffix.lower()
    for file_format, suffixes in SUFFIXES.items():
        if suffix in suffixes:
            return file_format
    choices = ", ".join(suffix for suffixes in SUFFIXES.values() for suffix in suffixes)
    raise ConfigError(
        f"{path}: the name says no format that starcat writes; end it with one of {choices}",
        value=str(path),
    )


def write_batches(
    batches: pa.RecordBatchReader, target: Path, file_format: str, label: Label = UNLABELLED
) -> int:
    """Write a table to a file, which appears at its name when it is whole.

    Notes
    -----
    What goes wrong with reading the batches is raised as it comes.
    """
    _check(file_format, FORMATS)
    failures: list[Exception] = []
    watched = pa.RecordBatchReader.from_batches(batches.schema, _watched(batches, failures))
    try:
        with whole_file(target) as partial:
            return _write(watched, partial, file_format, label)
    except OutputError:
        if failures:  # DuckDB's errors come as those of files do, but it was no writing that failed
            raise failures[0] from None
        raise


def write_text_batches(batches: pa.RecordBatchReader, stream: IO[str], file_format: str) -> int:
    """Write a table as text, for instance to the standard output."""
    _check(file_format, TEXT_FORMATS)
    rows = 0
    for text, more in _CHUNKS[file_format](batches):
        stream.write(text.decode())
        rows += more
    return rows


def _watched(batches: pa.RecordBatchReader, failures: list[Exception]) -> Iterator[pa.RecordBatch]:
    """Yield the batches, and remember what goes wrong with reading them."""
    try:
        yield from batches
    except Exception as error:
        failures.append(error)
        raise


def _write(batches: pa.RecordBatchReader, path: Path, file_format: str, label: Label) -> int:
    if file_format in TEXT_FORMATS:
        rows = 0
        with path.open("wb") as stream:
            for text, more in _CHUNKS[file_format](batches):
                stream.write(text)
                rows += more
        return rows
    if file_format == "parquet":
        return write_parquet_stream(batches, path)
    if file_format == "votable":
        return write_votable(batches, path, label)
    return _write_table(batches.read_all(), path, file_format, label)


def _write_table(table: pa.Table, path: Path, file_format: str, label: Label) -> int:
    columns = numpy_columns(table, signed=file_format == "fits")
    check_names(table.column_names, file_format)
    if file_format == "fits":
        write_fits(columns, len(table), path, label)
    elif file_format == "ecsv":
        write_ecsv(columns, path, label)
    else:
        write_npz(columns, path)
    return len(table)


def _check(file_format: str, choices: tuple[str, ...]) -> None:
    if file_format not in choices:
        raise ConfigError(
            f"format {file_format!r} is unknown here; choose one of {', '.join(choices)}",
            value=file_format,
        )
