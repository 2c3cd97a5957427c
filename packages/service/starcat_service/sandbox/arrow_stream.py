"""Rows as Arrow streams of bytes, written by a process that the reader does not trust.

`starcat_service.sandbox.query_worker` writes them, the server reads them. Reading checks all that
pyarrow does not check by itself: that offsets and texts are valid, that nothing is compressed, and
that the rows do not have far more values than the stream has bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from starcat.query import BATCH_ROWS
from starcat_service.sandbox.messages import malformed

BATCH_BYTES = 8 << 20
"""About how large a batch is sent at most; a single row may be larger."""

MAX_DICTIONARY_BYTES = 1 << 30
"""Largest size of the values of a dictionary when they are written out for every row."""

_PLAIN_TYPES = {
    pa.lib.Type_NA, pa.lib.Type_BOOL, pa.lib.Type_INT8, pa.lib.Type_UINT8, pa.lib.Type_INT16,
    pa.lib.Type_UINT16, pa.lib.Type_INT32, pa.lib.Type_UINT32, pa.lib.Type_INT64,
    pa.lib.Type_UINT64, pa.lib.Type_HALF_FLOAT, pa.lib.Type_FLOAT, pa.lib.Type_DOUBLE,
    pa.lib.Type_DECIMAL128, pa.lib.Type_DECIMAL256, pa.lib.Type_STRING, pa.lib.Type_LARGE_STRING,
    pa.lib.Type_BINARY, pa.lib.Type_LARGE_BINARY, pa.lib.Type_FIXED_SIZE_BINARY,
    pa.lib.Type_DATE32, pa.lib.Type_DATE64, pa.lib.Type_TIME32, pa.lib.Type_TIME64,
    pa.lib.Type_TIMESTAMP, pa.lib.Type_DURATION, pa.lib.Type_INTERVAL_MONTH_DAY_NANO,
}  # fmt: skip
"""Types without parts. Views and run-end encodings are none: a few bytes can be many values."""

_COMPRESSION = 3
"""Number of the field in the table of a record batch, from Arrow's Message.fbs."""


class RowTooLarge(Exception):  # noqa: N818 - the name reads as the fact
    """The stream of a single row is larger than allowed."""


def stream_of(schema: pa.Schema, batch: pa.RecordBatch | None = None) -> bytes:
    """Return a schema, or a batch with its schema, as a stream."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, schema) as stream:
        if batch is not None:
            stream.write_batch(batch)
    return bytes(sink.getvalue())


def streams_of(batch: pa.RecordBatch, max_bytes: int) -> Iterator[bytes]:
    """Give the rows of a batch as streams of about `BATCH_BYTES`, never more than ``max_bytes``."""
    parts = -(-batch.nbytes // BATCH_BYTES)
    rows = max(1, batch.num_rows // max(1, parts))
    for start in range(0, batch.num_rows, rows):
        part = batch.slice(start, rows)
        stream = stream_of(batch.schema, part)
        if len(stream) <= max_bytes:
            yield stream
        elif part.num_rows == 1:
            raise RowTooLarge
        else:
            half = part.num_rows // 2
            yield from streams_of(part.slice(0, half), max_bytes)
            yield from streams_of(part.slice(half), max_bytes)


def schema_of(content: bytes | bytearray) -> pa.Schema:
    """Return the schema of a stream; MalformedMessage if it is not one."""
    try:
        schema: pa.Schema = pa.ipc.open_stream(content).schema
        for field in schema:
            _check_type(field.type)
    except Exception as error:  # whatever wrong bytes lead to
        raise malformed(error) from error
    return schema


def batches_of(content: bytes | bytearray, schema: pa.Schema) -> list[pa.RecordBatch]:
    """Return the batches of a stream with a known schema; MalformedMessage if it has others."""
    try:
        _check_messages(content)
        reader = pa.ipc.open_stream(content)
        if not reader.schema.equals(schema):
            raise ValueError("another schema")
        batches = list(reader)
        for batch in batches:
            batch.validate()
            for column in batch.columns:
                _check_values(column, max(8 * len(content), 2 * BATCH_ROWS))
    except Exception as error:  # whatever wrong bytes lead to
        raise malformed(error) from error
    return batches


def _check_type(kind: pa.DataType) -> None:
    if isinstance(kind, pa.BaseExtensionType):
        _check_type(kind.storage_type)
    elif pa.types.is_dictionary(kind):
        _check_type(kind.value_type)
    elif (
        pa.types.is_list(kind)
        or pa.types.is_large_list(kind)
        or pa.types.is_fixed_size_list(kind)
        or pa.types.is_struct(kind)
        or pa.types.is_map(kind)
        or (pa.types.is_union(kind) and kind.mode == "sparse")
    ):
        for number in range(kind.num_fields):
            _check_type(kind.field(number).type)
    elif kind.id not in _PLAIN_TYPES:
        raise ValueError(f"the type {kind} is not one of a query's")


def _check_values(values: pa.Array, most: int) -> None:
    """Refuse values that are not valid, or far more than their bytes, as nulls can be.

    A HUGEINT is sent as a decimal and may have 39 digits, and a time may be 24:00:00. pyarrow reads
    both but does not call them valid. The parts of a type with such values are therefore checked
    one by one.
    """
    kind = values.type
    if len(values) > most:
        raise ValueError("more values than bytes")
    values.validate(full=not _has_wide_values(kind))
    if isinstance(kind, pa.BaseExtensionType):
        _check_values(values.storage, most)
    elif pa.types.is_dictionary(kind):
        dictionary = values.dictionary
        _check_values(dictionary, most)
        longest = 0
        if len(dictionary):
            is_text = pa.types.is_string(dictionary.type) or pa.types.is_binary(dictionary.type)
            longest = (
                (pc.max(pc.binary_length(dictionary)).as_py() or 0)
                if is_text
                else dictionary.nbytes
            )
        if longest * len(values) > MAX_DICTIONARY_BYTES:
            raise ValueError("values of a dictionary are too long")
    elif pa.types.is_map(kind):
        _check_offsets(values, len(values.keys))
        _check_values(values.keys, most)
        _check_values(values.items, most)
    elif pa.types.is_struct(kind) or pa.types.is_union(kind):
        if pa.types.is_union(kind) and not set(values.type_codes.to_pylist()) <= set(
            kind.type_codes
        ):
            raise ValueError("a union of no known type")
        for number in range(kind.num_fields):
            _check_values(values.field(number), most)
    elif kind.num_fields:
        if not pa.types.is_fixed_size_list(kind):
            _check_offsets(values, len(values.values))
        _check_values(values.values, most)


def _check_offsets(values: pa.Array, count: int) -> None:
    offsets = values.offsets.to_numpy()
    if len(offsets) and (offsets[0] < 0 or offsets[-1] > count or np.any(np.diff(offsets) < 0)):
        raise ValueError("lists with wrong offsets")


def _has_wide_values(kind: pa.DataType) -> bool:
    if isinstance(kind, pa.BaseExtensionType):
        return _has_wide_values(kind.storage_type)
    if pa.types.is_dictionary(kind):
        return _has_wide_values(kind.value_type)
    parts = (kind.field(number).type for number in range(kind.num_fields))
    is_wide = pa.types.is_decimal(kind) or pa.types.is_time(kind)
    return is_wide or any(map(_has_wide_values, parts))


def _check_messages(content: bytes | bytearray) -> None:
    """Refuse compressed rows: a few bytes could become gigabytes."""
    for message in pa.ipc.MessageReader.open_stream(content):
        table = message.metadata.to_pybytes()
        if message.type == "dictionary":
            batch = _table(table, _table(table, 0, 2), 1)
        elif message.type == "record batch":
            batch = _table(table, 0, 2)
        else:
            continue
        if _field(table, batch, _COMPRESSION):
            raise ValueError("compressed rows")


def _table(data: bytes, at: int, number: int) -> int:
    """Return the start of a table that is a field of another table, in a FlatBuffer."""
    if at == 0:
        [at] = struct.unpack_from("<I", data, 0)
    offset = _field(data, at, number)
    if not offset:
        raise ValueError("a message lacks a field")
    return offset + int(struct.unpack_from("<I", data, offset)[0])


def _field(data: bytes, at: int, number: int) -> int:
    """Return the offset of a field of a table, 0 if the table does not have it."""
    fields = at - struct.unpack_from("<i", data, at)[0]
    if fields < 0:
        raise ValueError("a message has a wrong table")
    [size] = struct.unpack_from("<H", data, fields)
    slot = 4 + 2 * number
    if slot >= size:
        return 0
    [offset] = struct.unpack_from("<H", data, fields + slot)
    return int(at + offset) if offset else 0
