"""What must hold of a product's table, whatever the files around it say.

Each check is a generator of problems: it yields nothing for a sound table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.artifact.crossmatch_table import counterpart_problems
from starcat.artifact.motion_table import motion_problems
from starcat.artifact.writer import content_sha256
from starcat.errors import SchemaError
from starcat.geometry.sphere import directions_from_radec, separation
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
    # shape (N, 3): directions of the artifact's stars, ICRS; no rows where they are not known
    directions: NDArray[np.float64]
    stars: pa.Table | None = None  # the artifact's stars; None where they are not known


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
    """Yield the columns that refer to stars which the artifact does not have."""
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


def counterparts_are_those_of_the_stars(held: HeldProduct) -> Iterator[str]:
    """Yield where counterparts contradict each other or their stars."""
    if held.schema.product == "crossmatch" and held.stars is not None:
        yield from counterpart_problems(held.table, held.stars)


def motions_are_those_of_the_stars(held: HeldProduct) -> Iterator[str]:
    """Yield where what is said of motions contradicts itself or the stars."""
    if held.schema.product == "motions" and held.stars is not None:
        yield from motion_problems(held.table, held.stars)


TABLE_CHECKS: tuple[Check, ...] = (
    content_is_the_manifests,
    rows_are_in_order,
    directions_are_units,
)
"""The checks of every product whose columns follow its schema."""

REFERENCE_CHECKS: tuple[Check, ...] = (
    star_rows_exist,
    separations_are_those_of_the_stars,
    counterparts_are_those_of_the_stars,
    motions_are_those_of_the_stars,
)
"""The checks where the stars are known; each needs what the one before it found sound."""
