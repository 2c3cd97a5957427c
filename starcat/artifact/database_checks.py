"""What must hold of an artifact's HDF5 file: the values of the Parquet files, and sound indices.

Each check is a generator of problems: it yields nothing for a sound file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from starcat.artifact.database import LAYOUT_VERSION, column_datasets, dataset_attributes
from starcat.products.index import row_offsets
from starcat.storage.hdf5 import own_dataset
from starcat.storage.product_table import indices_of
from starcat.storage.schema import ProductSchema


def root_problems(file: h5py.File, manifest: Mapping[str, Any]) -> Iterator[str]:
    """Yield where the database as a whole is not that of the manifest."""
    facts = {name: manifest[name] for name in ("name", "version", "frame", "epoch_jyear")}
    yield from _attribute_problems(file, {"layout_version": LAYOUT_VERSION, **facts})
    expected = {name for name, facts in manifest["products"].items() if facts["in_database"]}
    for name in sorted(expected ^ set(file)):
        yield f"group {name} is {'missing' if name in expected else 'not in the manifest'}"


def group_problems(
    group: h5py.Group, table: pa.Table, schema: ProductSchema, star_count: int
) -> Iterator[str]:
    """Yield where a product's group differs from its Parquet file or its schema."""
    facts = {"schema": schema.name, "description": schema.description, "rows": len(table)}
    yield from _attribute_problems(group, facts)
    for column in schema.columns:
        if not column.in_database:
            continue
        values = table[column.name].combine_chunks()
        for name, expected in column_datasets(column, values, star_count).items():
            if name not in group:
                yield f"{group.name}/{name} is missing"
                continue
            stored = _dataset(group, name)
            if (stored.dtype, stored.shape) != (expected.dtype, expected.shape):
                yield (
                    f"{stored.name} holds {stored.shape} {stored.dtype}; expected "
                    f"{expected.shape} {expected.dtype}"
                )
            elif stored[()].tobytes() != expected.tobytes():
                yield f"{stored.name} differs from the Parquet file"
            yield from _attribute_problems(stored, dataset_attributes(column, name))


def _dataset(group: h5py.Group, name: str) -> h5py.Dataset:
    return own_dataset(group, name, group.file.id.get_filesize())


def _attribute_problems(place: Any, expected: Mapping[str, object]) -> Iterator[str]:
    for name, value in expected.items():
        found = place.attrs.get(name)
        if found != value:
            yield f"{place.name}: attribute {name} is {_plain(found)!r}; expected {value!r}"


def _plain(value: object) -> object:
    return value.item() if isinstance(value, np.generic) else value


def index_problems(
    group: h5py.Group, table: pa.Table, schema: ProductSchema, star_count: int
) -> Iterator[str]:
    """Yield where the indices of a product do not fit its rows."""
    for name in indices_of(schema.product):
        if name not in group:
            yield f"{group.name}/{name} is missing"
        elif name == "kvector_counts":
            yield from _kvector_problems(group, table[schema.order[0]].to_numpy())
        elif name == "star_offsets":
            if not np.array_equal(
                _dataset(group, name), row_offsets(table["star"].to_numpy(), star_count)
            ):
                yield f"{group.name}/{name} does not say where the rows of each star are"
        elif name.endswith("_offsets"):
            yield from _bin_problems(group, name.removesuffix("_offsets"), len(table))


def _kvector_problems(group: h5py.Group, values: NDArray[Any]) -> Iterator[str]:
    counts, place = _dataset(group, "kvector_counts")[()], f"{group.name}/kvector_counts"
    line = [float(group.attrs[f"kvector_{name}"]) for name in ("intercept", "slope")]
    n = len(values)
    if len(counts) != n:
        yield f"{place} has {len(counts)} entries for {n} rows"
        return
    if np.any(counts[1:] < counts[:-1]):
        yield f"{place} is not ascending"
    if n and counts[-1] != n:
        yield f"{place} ends with {counts[-1]}; expected {n}"
    steps = line[0] + line[1] * np.arange(n)
    expected = np.searchsorted(values.astype(np.float64), steps, side="right")
    if n > 1 and not np.array_equal(counts, expected):
        entry = int(np.argmax(counts != expected))
        yield (
            f"{place}[{entry}] is {counts[entry]}, but {expected[entry]} values lie on or below "
            f"the line there"
        )


def _bin_problems(group: h5py.Group, stem: str, row_count: int) -> Iterator[str]:
    """Yield where a look-up of rows by bin is not one: its ends, its order, its rows."""
    place = f"{group.name}/{stem}"
    if f"{stem}_rows" not in group:
        return  # its absence is a problem of its own
    offsets, rows = (_dataset(group, f"{stem}_{part}")[()] for part in ("offsets", "rows"))
    ends = (offsets[0], offsets[-1]) if len(offsets) else (-1, -1)
    if ends != (0, len(rows)) or np.any(offsets[1:] < offsets[:-1]):
        yield f"{place}_offsets does not ascend from 0 to the {len(rows)} of {stem}_rows"
        return
    if len(rows) and (rows.min() < 0 or rows.max() >= row_count):
        yield f"{place}_rows has rows {rows.min()} to {rows.max()}; the product has {row_count}"
    falls = np.flatnonzero(rows[1:] <= rows[:-1]) + 1
    inside = falls[~np.isin(falls, offsets)]
    if len(inside):
        yield f"{place}_rows[{inside[0]}] does not ascend within its bin"
