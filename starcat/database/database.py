"""The HDF5 file of a database: contiguous little-endian datasets that a matcher maps to memory.

A product is a group; each column that its schema marks ``in_database`` is a dataset with its
unit and meaning as attributes. A list column ``name`` is two datasets: ``name_offsets`` (rows
+ 1) and ``name_values``. Columns with row numbers of stars are stored as uint16 if there are at
most 65,536 stars, else as int32. A product's group also contains its indices.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.database.products.index import Index
from starcat.database.products.table import PRODUCTS
from starcat.errors import SchemaError
from starcat.storage.schema import ProductSchema, SchemaColumn

LAYOUT_VERSION = "1.0.0"
"""The version of the arrangement of groups, datasets and attributes described above."""


def write_root(file: h5py.File, facts: Mapping[str, str | float]) -> None:
    """Write the attributes that describe the database."""
    file.attrs["layout_version"] = LAYOUT_VERSION
    for name in sorted(facts):
        file.attrs[name] = facts[name]


def write_product(
    file: h5py.File, table: pa.Table, schema: ProductSchema, index: Index, star_count: int
) -> None:
    """Write a product as a group of contiguous datasets."""
    expected = PRODUCTS[schema.product].layout.indices
    if set(index.datasets) != set(expected):
        raise SchemaError(
            f"indices {', '.join(index.datasets) or 'none'} found; expected "
            f"{', '.join(expected) or 'none'}",
            where=schema.product,
            product=schema.product,
            found=sorted(index.datasets),
            expected=sorted(expected),
        )
    group = file.create_group(schema.product)
    group.attrs["schema"] = schema.name
    group.attrs["description"] = schema.description
    group.attrs["rows"] = len(table)
    for column in schema.columns:
        if column.in_database:
            values = table[column.name].combine_chunks()
            for name, data in column_datasets(column, values, star_count).items():
                dataset = group.create_dataset(name, data=data)
                for key, text in dataset_attributes(column, name).items():
                    dataset.attrs[key] = text
    for name, data in index.datasets.items():
        group.create_dataset(name, data=data.astype(data.dtype.newbyteorder("<")))
    for name, value in index.attributes.items():
        group.attrs[name] = value


def stored_dtype(column: SchemaColumn, star_count: int) -> str:
    """Return the dtype of a column's values in the database."""
    if column.refers_to == "stars" and star_count <= 1 << 16:
        return "uint16"
    return column.item_dtype


def column_datasets(
    column: SchemaColumn, values: pa.Array, star_count: int
) -> dict[str, NDArray[Any]]:
    """Return the datasets for a column."""
    dtype = stored_dtype(column, star_count)
    if not column.is_list:
        return {column.name: _as_numpy(values, dtype)}
    lengths = pc.list_value_length(values).to_numpy()
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype("<i8")
    parts = offsets, _as_numpy(pc.list_flatten(values), dtype)
    return dict(zip(column.datasets, parts, strict=True))


def dataset_attributes(column: SchemaColumn, dataset: str) -> dict[str, str]:
    """Return the attributes of a column's dataset."""
    if column.is_list and dataset.endswith("_offsets"):
        return {"description": f"where the {column.name} of each row begin"}
    facts = {"description": column.description, "units": column.unit, "ucd": column.ucd}
    return {name: text for name, text in facts.items() if text}


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
    """Open a new HDF5 file whose bytes depend only on its content, and write it at the end.

    The content is in memory until then. HDF5 cannot close a file that it failed to write to disk,
    for example to a full one, and ends the process later; a write of bytes only raises an error.
    """
    # Align datasets, so that a matcher can map each as an array.
    with h5py.File(
        path,
        "w",
        driver="core",
        backing_store=False,
        libver=("earliest", "v110"),
        alignment_threshold=1,
        alignment_interval=8,
    ) as file:
        yield file
        file.flush()
        image = file.id.get_file_image()
    path.write_bytes(image)
