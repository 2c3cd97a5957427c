"""Tables as Parquet, batch by batch, with the same footer as the products of an artifact."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from starcat.exchange.columns import Label, is_list, plain_batch, plain_schema
from starcat.storage.parquet import (
    ARROW_DATATYPES,
    ROW_GROUP_ROWS,
    astropy_metadata,
    votable_metadata,
)


def write_parquet_stream(batches: pa.RecordBatchReader, path: Path, label: Label) -> int:
    """Write a table as a Parquet file, which has no place for a label; return its rows."""
    schema = plain_schema(batches.schema)
    texts = [field.name for field in schema if pa.types.is_string(field.type)]
    floating = [field.name for field in schema if pa.types.is_floating(field.type)]
    longest: dict[str, str] = {}
    rows = 0
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
            rows += table.num_rows
            for name in texts:
                longest[name] = max(longest.get(name, ""), _longest(table[name]), key=len)
        writer.add_key_value_metadata(_footer(schema, longest))
    return rows


def _row_groups(batches: pa.RecordBatchReader, schema: pa.Schema) -> Iterator[pa.Table]:
    """Yield the rows in steps of a row group, whatever the size of the batches."""
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
    """Return what describes the columns; nothing for types that the standard has no words for."""
    kinds = {field.type.value_type if is_list(field.type) else field.type for field in schema}
    if not kinds <= set(ARROW_DATATYPES):
        return {}
    # A row with the longest text of each column stands in for the table.
    row = [pa.array([longest.get(field.name)], field.type) for field in schema]
    table = pa.Table.from_arrays(row, schema=schema)
    return {**astropy_metadata(table), **votable_metadata(table)}
