"""The HDF5 file of an artifact: contiguous little-endian datasets that a matcher maps.

A product is a group; each column is a dataset with its unit and meaning as attributes. A
list column ``name`` is two datasets: ``name_offsets`` (rows + 1) and ``name_values``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.kvector import KVector
from starcat.schema import ProductSchema, SchemaColumn

MATCHER_STAR_COLUMNS = ("star_id", "designation", "x", "y", "z", "mag")
"""Columns of ``stars`` that the HDF5 file has; all of them are in the Parquet file."""

LAYOUT_VERSION = "1.0.0"
"""Of the arrangement of groups, datasets and attributes described above."""


def write_root(file: h5py.File, facts: Mapping[str, str | float]) -> None:
    """Write the attributes that say what the database is.

    Parameters
    ----------
    file : h5py.File
        Open for writing.
    facts : mapping of str to str or float
        Name, version, frame, epoch, camera and spec.
    """
    file.attrs["layout_version"] = LAYOUT_VERSION
    for name in sorted(facts):
        file.attrs[name] = facts[name]


def write_product(
    file: h5py.File,
    table: pa.Table,
    schema: ProductSchema,
    kvector: KVector | None = None,
) -> None:
    """Write a product as a group of contiguous datasets.

    Parameters
    ----------
    file : h5py.File
        Open for writing.
    table : pyarrow.Table
        The product.
    schema : ProductSchema
        Its contract.
    kvector : KVector, optional
        The index over the product's sort key.
    """
    group = file.create_group(schema.product)
    group.attrs["schema"] = schema.name
    group.attrs["description"] = schema.description
    group.attrs["rows"] = len(table)
    for column in schema.columns:
        if schema.product == "stars" and column.name not in MATCHER_STAR_COLUMNS:
            continue
        _write_column(group, column, table[column.name].combine_chunks())
    if kvector is not None:
        group.attrs["kvector_intercept"] = kvector.intercept
        group.attrs["kvector_slope"] = kvector.slope
        dataset = group.create_dataset("kvector_counts", data=kvector.counts.astype("<i4"))
        dataset.attrs["description"] = "number of values on or below the K-vector's line"


def _write_column(group: h5py.Group, column: SchemaColumn, values: pa.Array) -> None:
    if column.is_list:
        lengths = pc.list_value_length(values).to_numpy()
        offsets = np.concatenate([[0], np.cumsum(lengths)]).astype("<i8")
        dataset = group.create_dataset(f"{column.name}_offsets", data=offsets)
        dataset.attrs["description"] = f"where the {column.name} of each row begin"
        data, name = _as_numpy(pc.list_flatten(values), column.item_dtype), f"{column.name}_values"
    else:
        data, name = _as_numpy(values, column.dtype), column.name
    dataset = group.create_dataset(name, data=data)
    dataset.attrs["description"] = column.description
    if column.unit:
        dataset.attrs["units"] = column.unit
    if column.ucd:
        dataset.attrs["ucd"] = column.ucd


def _as_numpy(values: pa.Array, dtype: str) -> NDArray[Any]:
    if dtype == "string":
        return np.array([text.encode() for text in values.to_pylist()], dtype=np.bytes_)
    if values.null_count:
        values = pc.fill_null(values, float("nan"))
    return np.asarray(values.to_numpy(zero_copy_only=False)).astype(
        np.dtype(dtype).newbyteorder("<")
    )


@contextmanager
def open_for_writing(path: Path) -> Iterator[h5py.File]:
    """Open a new HDF5 file whose bytes depend on its content alone, and close it afterwards.

    Parameters
    ----------
    path : Path
        Overwritten if it exists.

    Yields
    ------
    h5py.File
        Object times are never stored.

    Raises
    ------
    OSError
        If the file cannot be written, with the system's number for the reason.
    """
    file = h5py.File(path, "w", libver=("earliest", "v110"))
    try:
        yield file
        file.flush()
    except BaseException:
        with suppress(Exception):  # on a full disk closing fails as well; the first error counts
            file.close()
        raise
    file.close()
