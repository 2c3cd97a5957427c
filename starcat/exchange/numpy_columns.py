"""Arrow columns as numpy arrays with masks and offsets, which VOTable, FITS, ECSV and npz need."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.arrays import Mask
from starcat.errors import SchemaError
from starcat.exchange.columns import (
    column_error,
    field_facts,
    is_list,
    is_number,
    plain_schema,
    time_texts,
)
from starcat.exchange.text import json_texts

_WIDER = {
    pa.int8(): pa.int16(),
    pa.uint16(): pa.int32(),
    pa.uint32(): pa.int64(),
    pa.uint64(): pa.int64(),
}
"""What VOTable and FITS have instead of the integers that they lack."""


@dataclass(frozen=True)
class NumpyColumn:
    """One column of N rows as numpy holds it."""

    name: str
    # Numbers, truth values, or texts as objects; of a ragged column all items one after the other.
    # Null is NaN, 0, False or an empty text.
    values: NDArray[Any]
    is_null: Mask
    # Shape (N + 1,): where the list of each row begins and ends; None where rows are no lists.
    offsets: NDArray[np.int64] | None
    facts: dict[str, str]  # unit, description and ucd where the column has them

    @property
    def is_text(self) -> bool:
        """Whether the values are texts."""
        return self.values.dtype == np.object_

    def lists(self) -> list[NDArray[Any]]:
        """Return the items of each row of a ragged column."""
        if self.offsets is None:
            raise ValueError(f"{self.name}: its rows are no lists")
        return np.split(self.values, self.offsets[1:-1]) if len(self.is_null) else []


def numpy_columns(table: pa.Table, *, signed: bool) -> list[NumpyColumn]:
    """Return the columns of a table as numpy arrays.

    With `signed`, integers are of the types that FITS and VOTable have: bytes without a sign, and
    16, 32 and 64 bits with one.
    """
    table = table.cast(plain_schema(table.schema))
    return [
        _numpy_column(field, table[field.name].combine_chunks(), signed=signed)
        for field in table.schema
    ]


def _numpy_column(field: pa.Field, values: pa.Array, *, signed: bool) -> NumpyColumn:
    is_null = values.is_null().to_numpy(zero_copy_only=False)
    offsets = None
    if is_list(values.type) and is_number(values.type.value_type):
        offsets, values = list_items(field.name, values)
    plain = plain_values(field.name, values, signed=signed)
    return NumpyColumn(field.name, _to_numpy(plain), is_null, offsets, field_facts(field))


def list_items(name: str, values: pa.Array) -> tuple[NDArray[np.int64], pa.Array]:
    """Return where the list of each row begins and ends, and the items of all rows."""
    lengths = pc.fill_null(values.value_lengths(), 0).to_numpy(zero_copy_only=False)
    offsets = np.concatenate(([0], np.cumsum(lengths, dtype=np.int64)))
    items = values.flatten()
    if items.null_count and pa.types.is_integer(items.type):
        raise column_error(
            name,
            ": a list of integers has a missing item, which only CSV, "
            "JSON and Parquet can hold; cast the items to DOUBLE",
            str(values.type),
        )
    return offsets, items


def plain_values(name: str, values: pa.Array, *, signed: bool) -> pa.Array:
    """Return values as numbers, truth values or texts."""
    kind = values.type
    if pa.types.is_decimal(kind):
        return _narrowed(name, values, pa.float64() if kind.scale else pa.int64())
    if signed and kind in _WIDER:
        return _narrowed(name, values, _WIDER[kind])
    if pa.types.is_temporal(kind):
        return time_texts(values)
    if is_list(kind) or pa.types.is_struct(kind):
        return pc.if_else(values.is_valid(), json_texts(values), None)
    return values


def _narrowed(name: str, values: pa.Array, kind: pa.DataType) -> pa.Array:
    try:
        return values.cast(kind)
    except pa.ArrowInvalid as error:
        raise SchemaError(
            f"column {name!r} of type {values.type} has a value that does not fit {kind}, the "
            "widest integer of this format; cast it to VARCHAR or DOUBLE",
            field=name,
            found=str(values.type),
            expected=str(kind),
        ) from error


def _to_numpy(values: pa.Array) -> NDArray[Any]:
    """Return values with null as NaN, 0, False or an empty text."""
    if pa.types.is_string(values.type):
        return np.array(pc.fill_null(values, "").to_pylist(), dtype=np.object_)
    if pa.types.is_floating(values.type):
        return np.asarray(values.to_numpy(zero_copy_only=False))
    nothing = False if pa.types.is_boolean(values.type) else 0
    return np.asarray(pc.fill_null(values, nothing).to_numpy(zero_copy_only=False))
