"""The star table: one row per catalog record, with the columns of ``schemas/stars-*.json``.

A catalog module fills in the columns that its archive has; this module adds the rest, moves
positions to the epoch of the build and separates the rejected records from the stars.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.catalog.stars.proper_motion import Motion, propagate_in_space
from starcat.catalog.stars.verdict import Quality, Verdicts
from starcat.geometry.proximity import nearest_neighbours
from starcat.geometry.sphere import directions_from_radec
from starcat.storage.schema import product_schema

Values: TypeAlias = NDArray[Any] | pa.Array | str | float | int | bool
"""An array of shape (N,) or one value for all; NaN means null."""

Columns: TypeAlias = dict[str, Values]
"""Star-table columns of some records; one that the archive does not have is left out."""


STAR_KEY = ("star_id", "catalog")
"""Columns that identify a star: two catalogs of a merged table can have equal numbers."""


def move_to_epoch(columns: Mapping[str, Values], epoch_jyear: float | None) -> Columns:
    """Return the columns with positions at an epoch, and their directions.

    A star without proper motion keeps the position and epoch of its archive, and its quality flags
    show this. If the epoch is None, every star stays.
    """
    ra = np.asarray(columns["ra_deg"], dtype=np.float64)
    dec = np.asarray(columns["dec_deg"], dtype=np.float64)
    blank = np.full(len(ra), np.nan)
    pm_ra = np.asarray(columns.get("pm_ra_cosdec_mas_yr", blank), dtype=np.float64)
    pm_dec = np.asarray(columns.get("pm_dec_mas_yr", blank), dtype=np.float64)
    unknown = np.isnan(pm_ra) | np.isnan(pm_dec)
    epoch = np.broadcast_to(np.asarray(columns["epoch_jyear"], dtype=np.float64), len(ra))
    motion = Motion(ra, dec, pm_ra, pm_dec)
    if epoch_jyear is None:
        u = directions_from_radec(ra, dec)
    else:
        parallax, velocity = (
            np.asarray(columns.get(name, blank), dtype=np.float64)
            for name in ("parallax_mas", "radial_velocity_km_s")
        )
        target = np.full(len(ra), epoch_jyear)
        motion, u = propagate_in_space(motion, parallax, velocity, epoch, target)
        epoch = np.where(unknown, epoch, epoch_jyear)
    flags = np.where(unknown, np.int32(Quality.NO_PROPER_MOTION), np.int32(0))
    return {
        **columns,
        "ra_deg": motion.ra_deg,
        "dec_deg": motion.dec_deg,
        "epoch_jyear": epoch,
        "x": u[:, 0],
        "y": u[:, 1],
        "z": u[:, 2],
        "pm_ra_cosdec_mas_yr": motion.pm_ra_cosdec_mas_yr,
        "pm_dec_mas_yr": motion.pm_dec_mas_yr,
        "quality_flags": np.asarray(columns.get("quality_flags", 0), dtype=np.int32) | flags,
    }


def table_from_columns(product: str, columns: Mapping[str, Values], count: int) -> pa.Table:
    """Return columns as a table of a product's schema; columns that are not given are null."""
    schema = product_schema(product).arrow_schema
    unknown = set(columns) - set(schema.names)
    if unknown:
        raise KeyError(f"{product} has no column {', '.join(sorted(unknown))}")
    arrays = []
    for field in schema:
        value = columns.get(field.name)
        if value is None:
            is_flag = field.type == pa.bool_() and not field.nullable
            value = False if is_flag else nulls(count, field.type)
        arrays.append(_as_array(value, field.type, count))
    return pa.Table.from_arrays(arrays, schema=schema)


@lru_cache(maxsize=8)
def nulls(count: int, kind: pa.DataType) -> pa.Array:
    """Return a column without values; most archives lack many columns of the same type."""
    return pa.nulls(count, kind)


def with_columns(stars: pa.Table, columns: Mapping[str, Values]) -> pa.Table:
    """Return a table with some of its columns replaced."""
    for name, values in columns.items():
        index = stars.schema.get_field_index(name)
        field = stars.schema.field(index)
        stars = stars.set_column(index, field, _as_array(values, field.type, len(stars)))
    return stars


def _as_array(value: Values, kind: pa.DataType, count: int) -> pa.Array:
    if isinstance(value, pa.Array | pa.ChunkedArray):
        return value if value.type == kind else value.cast(kind)
    if isinstance(value, str | float | int | bool):
        return pa.repeat(pa.scalar(value, kind), count)
    array = np.asarray(value)
    if array.dtype.kind == "f":
        blank = np.isnan(array)
        if pa.types.is_integer(kind):
            array = np.where(blank, 0, array).astype(np.int64)
        return pa.array(array, mask=blank if blank.any() else None).cast(kind)
    return pa.array(array).cast(kind)


def reject_rows(stars: pa.Table, reasons: pa.Array, details: pa.Array | None = None) -> pa.Table:
    """Return rows of a star table as rows of a rejected table, each with its reason."""
    schema = product_schema("rejected").arrow_schema
    if details is None:
        details = pa.nulls(len(stars), pa.string())
    verdict = {"reason": reasons, "detail": details}
    columns = [verdict[name] if name in verdict else stars[name] for name in schema.names]
    return pa.Table.from_arrays(columns, schema=schema)


def split_by_verdict(stars: pa.Table, verdicts: Verdicts) -> tuple[pa.Table, pa.Table]:
    """Return the rows of a star table that are kept, and the others as a rejected table."""
    is_kept = verdicts.is_kept
    if is_kept.all():
        return stars, product_schema("rejected").arrow_schema.empty_table()
    rejected = reject_rows(_rows_where(stars, ~is_kept), verdicts.reasons, verdicts.details)
    return _rows_where(stars, is_kept), rejected


def _rows_where(stars: pa.Table, is_wanted: NDArray[np.bool_]) -> pa.Table:
    """Return some rows of a star table; columns that the archive lacks are not searched."""
    mask, count = pa.array(is_wanted), int(np.count_nonzero(is_wanted))
    columns = [
        nulls(count, column.type) if column.null_count == len(stars) else column.filter(mask)
        for column in stars.columns
    ]
    return pa.Table.from_arrays(columns, schema=stars.schema)


def add_nearest_neighbours(stars: pa.Table, workers: int = 2) -> pa.Table:
    """Return a star table with the columns of the nearest neighbour filled in."""
    if len(stars) < 2:
        return stars
    angle, index = nearest_neighbours(directions_of(stars), workers)
    mag = floats_of(stars, "mag")
    columns: Columns = {
        "nearest_separation_arcsec": np.degrees(angle) * 3600.0,
        "nearest_delta_mag": mag[index] - mag,
    }
    return with_columns(stars, columns)


def text_column(values: NDArray[Any]) -> pa.Array:
    """Return fixed-width bytes as trimmed text, null where blank."""
    try:
        text = pa.array(values).cast(pa.string())
    except pa.ArrowInvalid:  # archives are ASCII, and a damaged byte is read as some letter
        text = pa.array(np.char.decode(values, "latin-1"))
    trimmed = pc.utf8_trim_whitespace(text)
    return pc.if_else(pc.equal(trimmed, ""), pa.scalar(None, pa.string()), trimmed)


def join_flags(parts: Mapping[str, tuple[NDArray[np.bool_], NDArray[Any] | None]]) -> pa.Array:
    """Return the archive's codes as one text per star, such as ``Rem=1;m_HD=2``; null without any.

    Each label has a mask of the stars with its code, and the text of the code (None: no text).
    """
    is_flagged = np.logical_or.reduce([where for where, _ in parts.values()])
    rows = np.flatnonzero(is_flagged)
    joined = pa.nulls(len(rows), pa.string())
    for label, (where, values) in parts.items():
        if not where.any():
            continue
        text: Any = pa.scalar(label)
        if values is not None:
            text = pc.binary_join_element_wise(label, text_column(values[rows]), "=")
        text = pc.if_else(pa.array(where[rows]), text, pa.scalar(None, pa.string()))
        both = pc.binary_join_element_wise(joined, text, ";")
        joined = pc.coalesce(both, joined, text)
    # Few stars are flagged: texts are made for their rows only.
    return joined.take(pa.array(np.cumsum(is_flagged) - 1, mask=~is_flagged))


def known_errors(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return standard errors with NaN in place of 0, which in archives means unknown."""
    return np.where(errors > 0.0, errors, np.nan)


def where_known(values: NDArray[np.float64], text: str) -> pa.Array:
    """Return a text for every value that is known, such as its source."""
    return pc.if_else(pa.array(np.isnan(values)), pa.scalar(None, pa.string()), text)


def numbered(prefix: str, number: NDArray[np.int64]) -> pa.Array:
    """Return designations made of a prefix and a number."""
    return pc.binary_join_element_wise(prefix, pa.array(number).cast(pa.string()), " ")


def directions_of(stars: pa.Table) -> NDArray[np.float64]:
    """Return the ICRS directions of a star table, contiguous, shape (N, 3)."""
    return np.stack([stars[name].to_numpy() for name in ("x", "y", "z")], axis=-1)


def floats_of(stars: pa.Table, name: str) -> NDArray[np.float64]:
    """Return a copy of a numeric column with NaN for null."""
    column = stars[name]
    if column.null_count:
        column = pc.fill_null(column.cast(pa.float64()), float("nan"))
    return np.array(column.to_numpy(), dtype=np.float64)


def rows_of_stars(stars: pa.Table, among: pa.Table) -> NDArray[np.int64]:
    """Return the row of each star in another table, by catalog and number; -1 if it is missing."""
    names = pc.unique(pa.chunked_array([*among["catalog"].chunks, *stars["catalog"].chunks]))
    code, its_code = (
        pc.index_in(table["catalog"], names).to_numpy().astype(np.int64) for table in (among, stars)
    )
    number, its_number = (table["star_id"].to_numpy() for table in (among, stars))
    if not len(number):
        return np.full(len(stars), -1, dtype=np.int64)
    numbers, index = np.unique(number, return_inverse=True)
    its_index = np.minimum(np.searchsorted(numbers, its_number), len(numbers) - 1)
    key, its_key = index * len(names) + code, its_index * len(names) + its_code
    order = np.argsort(key, kind="stable")
    row = order[np.minimum(np.searchsorted(key[order], its_key), len(order) - 1)]
    is_same = (number[row] == its_number) & (code[row] == its_code)
    return np.asarray(np.where(is_same, row, -1), dtype=np.int64)


def sort_rejected(rejected: pa.Table) -> pa.Table:
    """Sort rejected rows by their schema; records with equal numbers by their catalogs."""
    return sort_rows(rejected, (*product_schema("rejected").order, "catalog"))


def sort_rows(table: pa.Table, keys: Sequence[str]) -> pa.Table:
    """Sort a table by columns, nulls last; a sorted table is returned as it is."""
    first = table[keys[0]]
    if not first.null_count:
        values = first.to_numpy()
        if bool(np.all(values[1:] > values[:-1])):
            return table
    order = pc.sort_indices(table, [(key, "ascending") for key in keys])
    return table.take(order)
