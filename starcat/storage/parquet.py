"""Parquet files: for SQL, analysis and archives; one a product."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from starcat.storage.atomic import whole_file
from starcat.storage.votable import astropy_metadata, votable_metadata

ROW_GROUP_ROWS = 1 << 17
"""Fixed, as the size of row groups is part of the bytes."""


def write_parquet(table: pa.Table, path: Path) -> None:
    """Write a table, the same bytes for the same table and library."""
    with _writer(table, path) as writer:
        writer.write_table(table.replace_schema_metadata(None), row_group_size=ROW_GROUP_ROWS)


def write_parts(parts: Iterable[pa.Table], example: pa.Table, path: Path) -> None:
    """Write a table that is there part by part, the same bytes however it is divided."""
    waiting = example.schema.empty_table()
    groups = 0
    with _writer(example, path) as writer:
        for part in parts:
            waiting = pa.concat_tables([waiting, part.cast(example.schema)])
            while len(waiting) >= ROW_GROUP_ROWS:
                _write_group(writer, waiting.slice(0, ROW_GROUP_ROWS))
                waiting = waiting.slice(ROW_GROUP_ROWS)
                groups += 1
        if len(waiting) or not groups:
            _write_group(writer, waiting)


def _write_group(writer: pq.ParquetWriter, rows: pa.Table) -> None:
    """Write a row group; where its pages end depends on nothing but its rows."""
    writer.write_table(rows.combine_chunks(), row_group_size=ROW_GROUP_ROWS)


def parquet_bytes(table: pa.Table) -> int:
    """Return how large the file of a table will be."""
    counted = pa.MockOutputStream()
    with _writer(table, counted) as writer:
        writer.write_table(table.replace_schema_metadata(None), row_group_size=ROW_GROUP_ROWS)
    return int(counted.size())


@contextmanager
def _writer(table: pa.Table, path: Path | pa.NativeFile) -> Iterator[pq.ParquetWriter]:
    """Open a file for the rows of a table, and describe its columns in the footer."""
    floating = [field.name for field in table.schema if pa.types.is_floating(field.type)]
    # Names differ in every row: a dictionary of them would be the column again.
    dictionary = [
        field.name
        for field in table.schema
        if pa.types.is_string(field.type) and field.name != "designation"
    ]
    known = {**(table.schema.metadata or {}), **astropy_metadata(table)}
    with pq.ParquetWriter(
        path,
        table.schema.with_metadata(known),
        compression="zstd",
        compression_level=1,
        use_dictionary=dictionary or False,
        column_encoding=dict.fromkeys(floating, "BYTE_STREAM_SPLIT") or None,
        write_statistics=True,
    ) as writer:
        yield writer
        writer.add_key_value_metadata(votable_metadata(table))


def read_parquet(path: Path) -> pa.Table:
    """Read a whole Parquet file."""
    with pq.ParquetFile(path) as file:
        return file.read()


def write_table(table: pa.Table, path: Path) -> None:
    """Write a table as a Parquet file."""
    with whole_file(path) as partial:
        write_parquet(table, partial)
