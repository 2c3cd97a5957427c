"""Convert values to text, and tables to CSV, TSV and JSON, batch by batch.

CSV: null is an empty cell, an empty text is ``""`` (with a single column both are ``""``). NaN and
infinity are ``nan`` and ``inf``; lists and records are JSON in the cell. A JSON file is an array
with one object per line. It has neither NaN nor infinity, so both are null. Integers have all
their digits in both formats.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pcsv
from numpy.typing import NDArray

from starcat.arrays import Mask
from starcat.errors import SchemaError
from starcat.ship.exchange.columns import (
    column_error,
    is_list,
    is_numeric_column,
    plain_batch,
    plain_schema,
    steps,
    time_texts,
)

_BREAKS = "[\\t\\r\\n]"

_WIDER = {
    pa.int8(): pa.int16(),
    pa.uint16(): pa.int32(),
    pa.uint32(): pa.int64(),
    pa.uint64(): pa.int64(),
}
"""Integer types of VOTable and FITS for integer types that they lack."""


def csv_chunks(batches: pa.RecordBatchReader) -> Iterator[bytes]:
    """Yield a table as CSV."""
    schema = plain_schema(batches.schema)
    yield _csv(schema.empty_table().to_batches(), schema, header=True)
    for batch in _plain_steps(batches, schema):
        yield _csv([batch], schema, header=False)


def tsv_chunks(batches: pa.RecordBatchReader) -> Iterator[bytes]:
    """Yield a table as text with tabs between the cells, without quotes."""
    schema = plain_schema(batches.schema)
    names = pc.replace_substring_regex(pa.array(schema.names, pa.string()), _BREAKS, " ")
    yield ("\t".join(names.to_pylist()) + "\n").encode()
    for batch in _plain_steps(batches, schema):
        cells = [_cells(column).cast(pa.string()) for column in batch.columns]
        texts = [
            pc.replace_substring_regex(text, _BREAKS, " ")
            if pa.types.is_string(field.type) or pa.types.is_nested(field.type)
            else text
            for field, text in zip(schema, cells, strict=True)
        ]
        rows = pc.binary_join_element_wise(
            *texts, "\t", null_handling="replace", null_replacement=""
        )
        yield ("\n".join(rows.to_pylist()) + "\n").encode()


def json_chunks(batches: pa.RecordBatchReader) -> Iterator[bytes]:
    """Yield a table as a JSON array of objects."""
    schema = plain_schema(batches.schema)
    before = "[\n"
    for batch in _plain_steps(batches, schema):
        texts = json_texts(batch.to_struct_array())
        yield (before + ",\n".join(texts.to_pylist())).encode()
        before = ",\n"
    yield ("[]\n" if before == "[\n" else "\n]\n").encode()


def json_texts(values: pa.Array) -> pa.Array:
    """Return each value as JSON."""
    kind = values.type
    if is_list(kind):
        texts = _list_texts(values)
    elif pa.types.is_struct(kind):
        texts = _record_texts(values)
    elif pa.types.is_floating(kind):
        finite = pc.fill_null(pc.is_finite(values), False)
        return pc.if_else(finite, values.cast(pa.string()), "null")
    elif pa.types.is_temporal(kind):
        texts = _quoted(time_texts(values))
    elif pa.types.is_string(kind):
        texts = _quoted(values)
    else:
        texts = values.cast(pa.string())
    return pc.fill_null(texts, "null")


@dataclass(frozen=True)
class Cells:
    """The cells of a column in a batch of N rows, as arrays for files."""

    values: pa.Array  # numbers, truth values or texts: one per row, or all items of the lists
    is_null: Mask | None  # None if every row has a value
    # Shape (N + 1,): start and end of the list of each row; None if rows are not lists.
    offsets: NDArray[np.int64] | None


def cells_of(name: str, values: pa.Array, *, signed: bool) -> Cells:
    """Return the cells of a column in a batch; SchemaError if a value does not fit.

    With `signed`, integers have the types of FITS and VOTable: unsigned bytes, and signed integers
    of 16, 32 and 64 bits.
    """
    is_null = values.is_null().to_numpy(zero_copy_only=False) if values.null_count else None
    offsets = None
    if is_list(values.type) and is_numeric_column(values.type.value_type):
        offsets, items = _list_offsets(values), values.flatten()
        if items.null_count and pa.types.is_integer(items.type):
            raise column_error(
                name,
                ": a list of integers has a missing item, which only CSV, "
                "JSON and Parquet can hold; cast the items to DOUBLE",
                str(values.type),
            )
        values = items
    return Cells(plain_values(name, values, signed=signed), is_null, offsets)


def _list_offsets(values: pa.Array) -> NDArray[np.int64]:
    lengths = pc.fill_null(values.value_lengths(), 0).to_numpy(zero_copy_only=False)
    return np.concatenate(([0], np.cumsum(lengths, dtype=np.int64)))


def plain_values(name: str, values: pa.Array, *, signed: bool) -> pa.Array:
    """Return values as numbers, truth values or texts."""
    kind = values.type
    if pa.types.is_decimal(kind):
        return _narrowed(name, values, pa.float64() if kind.scale else pa.int64())
    if signed and kind in _WIDER:
        return _narrowed(name, values, _WIDER[kind])
    if pa.types.is_temporal(kind):
        return time_texts(values)
    if pa.types.is_nested(kind):
        return pc.if_else(values.is_valid(), json_texts(values), None)
    return values


def _narrowed(name: str, values: pa.Array, kind: pa.DataType) -> pa.Array:
    try:
        return values.cast(kind)
    except pa.ArrowInvalid as error:
        raise SchemaError(
            f"column {name!r} of type {values.type} has a value that does not fit {kind}, the "
            "widest integer of this format",
            field=name,
            found=str(values.type),
            expected=str(kind),
            hint="cast it to VARCHAR or DOUBLE",
        ) from error


def _plain_steps(batches: pa.RecordBatchReader, schema: pa.Schema) -> Iterator[pa.RecordBatch]:
    return (plain_batch(step, schema) for step in steps(batches))


def _csv(batches: list[pa.RecordBatch], schema: pa.Schema, *, header: bool) -> bytes:
    """Return batches as CSV; lists, records and times become texts."""
    table = pa.Table.from_batches(batches, schema)
    columns = [_cells(column.combine_chunks()) for column in table.columns]
    if len(columns) == 1 and columns[0].null_count:
        # With a single column a null would be an empty line, which readers skip.
        columns = [pc.fill_null(columns[0].cast(pa.string()), "")]
    target = io.BytesIO()
    pcsv.write_csv(
        pa.table(columns, names=schema.names), target, pcsv.WriteOptions(include_header=header)
    )
    return target.getvalue()


def _cells(values: pa.Array) -> pa.Array:
    if pa.types.is_nested(values.type):
        return pc.if_else(values.is_valid(), json_texts(values), None)
    return time_texts(values) if pa.types.is_temporal(values.type) else values


def _quoted(texts: pa.Array) -> pa.Array:
    """Return texts as JSON strings; equal texts are converted only once."""
    codes = texts.dictionary_encode()
    quoted = [json.dumps(text, ensure_ascii=False) for text in codes.dictionary.to_pylist()]
    return pa.array(quoted, pa.string()).take(codes.indices)


def _list_texts(values: pa.Array) -> pa.Array:
    items = json_texts(values.flatten())
    offsets = _list_offsets(values).astype(np.int32)
    joined = pc.binary_join(pa.ListArray.from_arrays(offsets, items), ",")
    texts = pc.binary_join_element_wise("[", joined, "]", "")
    return pc.if_else(values.is_valid(), texts, None)


def _record_texts(values: pa.Array) -> pa.Array:
    parts: list[pa.Array | str] = []
    for field, items in zip(values.type, values.flatten(), strict=True):
        comma = ", " if parts else ""
        parts += [f"{comma}{json.dumps(field.name, ensure_ascii=False)}: ", json_texts(items)]
    texts = pc.binary_join_element_wise("{", *parts, "}", "")
    return pc.if_else(values.is_valid(), texts, None)
