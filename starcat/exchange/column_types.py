"""Columns of any query brought to the few types that files of other tools can hold.

Products have numbers, texts, truth values and lists of them. A query can give more: dates,
decimals, records. What can be said in a plainer type is; the rest is refused by name.
"""

from __future__ import annotations

from collections import Counter

import pyarrow as pa
import pyarrow.compute as pc

from starcat.errors import SchemaError

_CASTS = {
    "interval": "epoch(column) for seconds",
    "duration": "epoch(column) for seconds",
    "binary": "hex(column) for text",
    "map": "map_entries(column) for a list of records",
    "union": "one of its types",
}


def plain_schema(schema: pa.Schema) -> pa.Schema:
    """Return a schema without types that mean the same as a plainer one."""
    twice = [name for name, times in Counter(schema.names).items() if times > 1]
    if twice:
        raise SchemaError(
            f"column {twice[0]!r} is there twice; give one of them another name with AS",
            field=twice[0],
            found=schema.names,
        )
    return pa.schema([f.with_type(_plain(f.type, f.name)) for f in schema], schema.metadata)


def plain_batch(batch: pa.RecordBatch, schema: pa.Schema) -> pa.RecordBatch:
    """Return a batch with the types of a plain schema."""
    columns = [
        column if column.type == field.type else column.cast(field.type)
        for column, field in zip(batch.columns, schema, strict=True)
    ]
    return pa.RecordBatch.from_arrays(columns, schema=schema)


def is_list(kind: pa.DataType) -> bool:
    """Return whether a plain type is a list."""
    return bool(pa.types.is_list(kind))


def is_number(kind: pa.DataType) -> bool:
    """Return whether a type is an integer or a floating-point number."""
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


def time_texts(values: pa.Array) -> pa.Array:
    """Return dates and times as ISO 8601 text."""
    if pa.types.is_timestamp(values.type):
        if values.type.tz is not None:
            values = values.cast(pa.timestamp(values.type.unit, "UTC"))
        return pc.replace_substring(values.cast(pa.string()), " ", "T", max_replacements=1)
    return values.cast(pa.string())


def _plain(kind: pa.DataType, name: str) -> pa.DataType:
    if isinstance(kind, pa.BaseExtensionType):
        return _plain(kind.storage_type, name)
    if pa.types.is_dictionary(kind):
        return _plain(kind.value_type, name)
    if pa.types.is_null(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind):
        return pa.string()
    if pa.types.is_float16(kind):
        return pa.float32()
    if pa.types.is_struct(kind):
        return pa.struct([f.with_type(_plain(f.type, f"{name}.{f.name}")) for f in kind])
    if _is_any_list(kind):
        item = kind.value_field
        return pa.list_(item.with_type(_plain(item.type, name)))
    for word, way_out in _CASTS.items():
        if word in str(kind):
            raise SchemaError(
                f"column {name!r} is of type {kind}, which has no place in a file; "
                f"select {way_out.replace('column', name)}",
                field=name,
                found=str(kind),
            )
    return kind


def _is_any_list(kind: pa.DataType) -> bool:
    return bool(
        pa.types.is_list(kind)
        or pa.types.is_large_list(kind)
        or pa.types.is_fixed_size_list(kind)
        or pa.types.is_list_view(kind)
        or pa.types.is_large_list_view(kind)
    )
