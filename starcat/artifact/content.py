"""Digests: of files as they are, and of tables as they mean.

A content digest covers the values of a table's columns in a fixed little-endian layout, so
it does not change with the version of the library that wrote the file.
"""

from __future__ import annotations

import hashlib

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from starcat.storage.schema import ProductSchema


def content_sha256(table: pa.Table, schema: ProductSchema) -> str:
    """Return the content digest of a product."""
    digest = hashlib.sha256(f"{schema.name} {len(table)}\n".encode())
    for column in schema.columns:
        digest.update(f"{column.name} {column.dtype} {column.unit}\n".encode())
        values = table[column.name].combine_chunks()
        is_null = values.is_null().to_numpy(zero_copy_only=False)
        digest.update(np.packbits(is_null).tobytes())
        if column.is_list:
            lengths = pc.fill_null(pc.list_value_length(values), 0)
            digest.update(lengths.to_numpy().astype("<i8").tobytes())
            values = pc.list_flatten(values)
        digest.update(_value_bytes(values, column.item_dtype))
    return digest.hexdigest()


def _value_bytes(values: pa.Array, dtype: str) -> bytes:
    if dtype == "string":
        filled = pc.fill_null(values, "")
        lengths = pc.binary_length(filled).to_numpy().astype("<i8")
        _, offsets, letters = filled.buffers()
        if not lengths.sum():
            return bytes(lengths.tobytes())
        # The texts lie one behind the other already, in a part of the buffer.
        ends = np.frombuffer(offsets, dtype=np.int32)[filled.offset :][[0, len(filled)]]
        return bytes(lengths.tobytes() + memoryview(letters)[ends[0] : ends[1]])
    if dtype == "bool":
        return bytes(np.packbits(np.array(pc.fill_null(values, False))).tobytes())
    filled = pc.fill_null(values, 0) if values.null_count else values
    return bytes(filled.to_numpy().astype(np.dtype(dtype).newbyteorder("<")).tobytes())
