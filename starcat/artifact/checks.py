"""What must hold of a database: of each product's table, and of its group in the HDF5 file.

Each check is a generator of problems: it yields nothing for a sound table or file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.artifact.database import LAYOUT_VERSION, column_datasets, dataset_attributes
from starcat.artifact.writer import content_sha256
from starcat.errors import SchemaError
from starcat.geometry.sphere import directions_from_radec, separation
from starcat.products.index import row_offsets
from starcat.products.table import PRODUCTS
from starcat.storage.hdf5 import own_dataset
from starcat.storage.schema import ProductSchema

UNIT_TOLERANCE = 1e-14
"""The length of a direction and its components are off by less: a few roundings of float64."""

SEPARATION_TOLERANCE_RAD = 1e-12
"""Two ways to compute a separation differ by a few roundings; 1e-12 rad is 0.2 uas."""


@dataclass(frozen=True)
class HeldProduct:
    """A product as its Parquet file holds it, and what the manifest says of it."""

    table: pa.Table  # the product
    schema: ProductSchema  # its contract
    facts: Mapping[str, Any]  # its entry in the manifest
    # shape (N, 3): directions of the database's stars, ICRS; no rows where they are not known
    directions: NDArray[np.float64]
    stars: pa.Table | None = None  # the database's stars; None where they are not known


Check = Callable[[HeldProduct], Iterator[str]]


def columns_follow_the_schema(held: HeldProduct) -> Iterator[str]:
    """Yield the first column that differs from the schema."""
    try:
        held.schema.check(held.table)
    except SchemaError as error:
        yield str(error)


def content_is_the_manifests(held: HeldProduct) -> Iterator[str]:
    """Yield where row count and content digest differ from the manifest."""
    rows = held.facts["rows"]
    if len(held.table) != rows:
        yield f"{len(held.table)} rows; the manifest says {rows}"
    elif content_sha256(held.table, held.schema) != held.facts["content_sha256"]:
        yield "the values are not those of the manifest's content_sha256"


def rows_are_in_order(held: HeldProduct) -> Iterator[str]:
    """Yield the first row that does not come after the one before it, nulls last."""
    rows = max(len(held.table) - 1, 0)
    tied, wrong = np.ones(rows, dtype=bool), np.zeros(rows, dtype=bool)
    for name in held.schema.order:
        values, is_null = _with_nulls(held.table[name])
        known = ~is_null[:-1] & ~is_null[1:]
        rises = (known & (values[1:] > values[:-1])) | (~is_null[:-1] & is_null[1:])
        same = (known & (values[1:] == values[:-1])) | (is_null[:-1] & is_null[1:])
        wrong |= tied & ~rises & ~same
        tied &= same
        if not tied.any():
            break
    wrong |= tied
    if wrong.any():
        row = int(np.argmax(wrong))
        order = ", ".join(held.schema.order)
        yield (
            f"row {row + 1} does not come after row {row} in the order of {order} "
            f"({int(wrong.sum())} such rows)"
        )


def _with_nulls(column: pa.ChunkedArray) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    is_null = column.is_null().to_numpy()
    if column.null_count:
        column = pc.fill_null(column, "" if pa.types.is_string(column.type) else 0)
    return column.to_numpy(), is_null


def star_rows_exist(held: HeldProduct) -> Iterator[str]:
    """Yield the columns that refer to stars which the database does not have."""
    count = len(held.directions)
    for column in held.schema.columns:
        if column.refers_to != "stars":
            continue
        values = held.table[column.name]
        range_ = pc.min_max(pc.list_flatten(values) if column.is_list else values).as_py()
        if range_["min"] is not None and (range_["min"] < 0 or range_["max"] >= count):
            yield (
                f"{column.name} refers to rows {range_['min']} to {range_['max']} of stars, "
                f"which has {count}"
            )


def directions_are_units(held: HeldProduct) -> Iterator[str]:
    """Yield where x, y, z is no unit vector, or not the direction of ra_deg, dec_deg."""
    if not {"x", "y", "z"} <= set(held.table.column_names):
        return
    u = np.stack([held.table[name].to_numpy() for name in ("x", "y", "z")], axis=-1)
    length = np.sqrt(np.sum(u * u, axis=-1))
    for row in _first_above(np.abs(length - 1.0), UNIT_TOLERANCE):
        yield f"x, y, z of row {row} is not a unit vector"
    ra_deg, dec_deg = (held.table[name].to_numpy() for name in ("ra_deg", "dec_deg"))
    off = np.abs(u - directions_from_radec(ra_deg, dec_deg)).max(axis=-1, initial=0.0)
    for row in _first_above(off, UNIT_TOLERANCE):
        yield f"x, y, z of row {row} is not the direction of its ra_deg, dec_deg"


def _first_above(off: NDArray[np.float64], limit: float) -> NDArray[np.intp]:
    """Return the first row above a limit, NaN included, or nothing."""
    return np.flatnonzero(~(off <= limit))[:1]


def separations_are_those_of_the_stars(held: HeldProduct) -> Iterator[str]:
    """Yield where a separation is not that of the two stars in its row."""
    ends = [c.name for c in held.schema.columns if c.refers_to == "stars" and not c.is_list]
    if len(ends) != 2 or "separation_rad" not in held.table.column_names:
        return
    first, second = (held.table[name].to_numpy() for name in ends)
    found = held.table["separation_rad"].to_numpy()
    u = held.directions
    off = np.abs(found - separation(u[first], u[second]))
    for row in _first_above(off, SEPARATION_TOLERANCE_RAD):
        yield f"separation_rad of row {row} is not that of its stars"


def content_agrees_with_the_stars(held: HeldProduct) -> Iterator[str]:
    """Yield where a product contradicts itself or the stars, as its module says."""
    kind = PRODUCTS.get(held.schema.product)
    if kind is not None and kind.problems is not None and held.stars is not None:
        yield from kind.problems(held.table, held.stars)


TABLE_CHECKS: tuple[Check, ...] = (
    content_is_the_manifests,
    rows_are_in_order,
    directions_are_units,
)
"""The checks of every product whose columns follow its schema."""

REFERENCE_CHECKS: tuple[Check, ...] = (
    star_rows_exist,
    separations_are_those_of_the_stars,
    content_agrees_with_the_stars,
)
"""The checks where the stars are known; each needs what the one before it found sound."""


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
    kind = PRODUCTS.get(schema.product)
    for name in kind.layout.indices if kind else ():
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
