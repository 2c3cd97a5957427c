"""How large the files of a build will be, from the rows of its products.

The database stores numbers as they are, so its size is a sum. Parquet files are compressed, and
what a value then takes was measured: on skies of 200 to 170,000 stars, fields of 2 to 25 deg. The
size of a table that is there already is found by writing it, or a part of it, to nowhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np
import pyarrow as pa

from starcat.artifact.database import stored_dtype
from starcat.pipeline.counts import Extent, LevelExtent
from starcat.specs.build_spec import BuildSpec
from starcat.storage.parquet import ROW_GROUP_ROWS, parquet_bytes
from starcat.storage.product_table import indices_of
from starcat.storage.schema import product_schema

Curve = tuple[tuple[float, ...], tuple[float, ...]]
"""Bytes of a value, second, by a number that they depend on; between them along its logarithm."""

STAR_ROW: Curve = (
    (16, 64, 256, 512, 1e3, 2e3, 4e3, 8e3, 1.6e4, 3.2e4, 6.55e4, 1e5, 2e5, 5e5, 1e6, 1e7),
    (0.8, 1.15, 1.35, 1.55, 1.73, 1.9, 2.05, 2.2, 2.33, 2.42, 2.48, 2.65, 2.8, 3.0, 3.14, 3.4),
)
"""A row of the star table in no order, by the number of stars."""

STAR_ROWS_IN_ORDER: Curve = (
    (64, 256, 1e3, 4e3, 8e3, 1.6e4, 6.55e4, 1e5, 2e5),
    (2.86, 1.9, 1.96, 2.19, 2.28, 2.38, 2.41, 2.5, 2.56),
)
"""A row of the star table, ascending and each once, by the number of stars."""

SORTED_FLOAT64: Curve = (
    (300, 1e3, 2.3e3, 1e4, 2.3e4, 5.7e4, 1.4e5, 2.3e5, 5.3e5, 1.3e6, 2.4e6, 1e7, 1e8),
    (6.7, 6.3, 6.13, 5.9, 5.68, 5.42, 5.2, 5.15, 5.08, 4.99, 4.84, 4.42, 4.0),
)
"""A separation of a table that is sorted by it, by its rows."""

SORTED_FLOAT32: Curve = (
    (300, 1e3, 3.6e3, 1.3e4, 4e4, 8.4e4, 2e5, 2.8e5, 3.7e5, 4.7e5, 9.4e5, 3e6, 1e7),
    (3.3, 3.0, 2.54, 2.18, 2.09, 2.05, 1.93, 1.78, 1.65, 1.57, 1.4, 1.2, 1.07),
)
"""An area of a table that is sorted by it, by its rows."""

NEIGHBOUR_BY_ANGLE: Curve = (
    (3.4, 5.3, 7.0, 9.5, 12.4, 20.8, 29.0, 46.0),
    (1.37, 1.3, 1.24, 1.23, 1.13, 1.09, 1.07, 1.06),
)
"""A neighbour of a star, in order of its position angle, by the neighbours of a star."""

SEPARATION_BY_STAR: Curve = (
    (7.0, 12.0, 22.0, 36.0, 51.0, 81.0, 300.0),
    (6.88, 6.86, 6.76, 6.68, 6.57, 6.45, 5.9),
)
"""A separation, ascending within each star, by the neighbours of a star."""

RATIO_BY_STAR: Curve = (
    (1.0, 4.2, 5.3, 7.0, 11.0, 20.0, 29.0, 46.0, 200.0),
    (5.0, 6.24, 6.5, 6.8, 6.88, 6.95, 6.86, 6.73, 6.1),
)
"""A ratio of distances, ascending within each star, by the neighbours of a star."""

TIMES_SEEN: Curve = (
    (1.0, 1.27, 1.35, 1.74, 2.3, 3.1, 7.5, 13.5, 100.0),
    (0.1, 0.26, 0.28, 0.38, 0.57, 0.67, 0.91, 0.98, 1.3),
)
"""How many fields have a triangle, by their mean number."""

CELL_OF_FEW: Curve = ((3.7, 5.0, 10.0, 20.0, 45.0, 200.0), (1.0, 0.985, 0.945, 0.915, 0.875, 0.7))
"""The share of `STAR_ROW` that a cell of a pattern takes, by the cells of a pattern."""

RING_OF_SHARE: Curve = (
    (1e-4, 0.0012, 0.0118, 0.057, 0.075, 0.107, 0.177, 0.27, 0.35, 0.47, 0.78, 1.0),
    (3.0, 2.2, 1.66, 1.33, 1.17, 1.14, 0.99, 0.9, 0.83, 0.71, 0.39, 0.1),
)
"""An occupied ring, by the share of all rings that a pattern occupies."""

TRIANGLE_OF_LEVEL: Curve = (
    (1.0, 3.3, 5.7, 8.8, 17.0, 22.0, 30.0, 45.0, 80.0, 300.0),
    (3.0, 2.15, 2.0, 1.67, 1.34, 1.28, 1.15, 1.05, 0.9, 0.65),
)
"""The three stars of a triangle in order of these, by the triangles of a star."""

FOOTER: Mapping[str, tuple[float, float]] = {
    "pairs": (2706.0, 271.0),
    "triangles": (5453.0, 577.0),
    "neighbours": (5748.0, 498.0),
    "hausdorff_angular": (2762.0, 281.0),
    "hausdorff_l2": (2822.0, 274.0),
    "grid": (3273.0, 293.0),
    "radial": (4315.0, 293.0),
    "levels": (6480.0, 500.0),
}
"""Bytes at the end of a Parquet file: its columns' meanings, and more for each further group."""

DATASET_BYTES = 835.0
"""A dataset of the database, beside its values: its name, place and attributes."""

REPORT_BYTES: Curve = ((200.0, 3e3, 1e4, 3e4), (610e3, 754e3, 1.09e6, 1.78e6))
"""The report, its page, pictures and list of fields, by the number of these."""

REPORT_BYTES_PER_FIELD = 34.5
"""A line of that list, which is all that grows beyond."""

MANIFEST_BYTES = 9.5e3

COUNTERPART_BYTES = 75.0
"""A row of the product ``crossmatch``."""

PART_ROWS, PARTS = 8192, 3
"""Of a larger table than these make, some parts are written."""


def table_bytes(table: pa.Table, rows: int | None = None) -> int:
    """Return about how large the Parquet file of a table will be."""
    count = len(table) if rows is None else rows
    if len(table) <= PART_ROWS * PARTS and count == len(table):
        return parquet_bytes(table)
    one = parquet_bytes(table.slice(0, 1))
    starts = np.linspace(0, max(0, len(table) - PART_ROWS), PARTS).astype(int).tolist()
    parts = [table.slice(start, PART_ROWS) for start in dict.fromkeys(starts)]
    some = sum(parquet_bytes(part) - one for part in parts)
    return round(one + some * max(0, count - 1) / max(1, sum(len(part) - 1 for part in parts)))


def product_files(
    extents: Mapping[str, Extent], levels: LevelExtent | None, stars: int, spec: BuildSpec
) -> dict[str, int]:
    """Return how large the Parquet files of products will be."""
    found = {}
    for name, extent in extents.items():
        base, more = FOOTER[name]
        groups = max(0, int(np.ceil(extent.rows / ROW_GROUP_ROWS)) - 1)
        found[name] = round(base + more * groups + _values_bytes(name, extent, stars, spec))
    if levels is not None:
        each = _at(TRIANGLE_OF_LEVEL, levels.triangles / max(1, levels.stars))
        listed = levels.stars * _at(STAR_ROWS_IN_ORDER, levels.stars / max(1, levels.levels))
        found["levels"] = round(FOOTER["levels"][0] + 250.0 + listed + each * levels.triangles)
    return found


def _values_bytes(name: str, extent: Extent, stars: int, spec: BuildSpec) -> float:
    """Return what the columns of a product take, compressed."""
    rows, a_star = extent.rows, _at(STAR_ROW, stars)
    around = extent.rows / max(1, stars)
    # Rows of a star are side by side: its number is written about once.
    of_star = min(2.1 * stars, 2.0 * rows)
    in_order = _at(STAR_ROWS_IN_ORDER, stars) * rows
    if name == "pairs":
        return rows * (2.0 * a_star + _at(SORTED_FLOAT64, rows))
    if name == "triangles":
        seen = _at(TIMES_SEEN, extent.records / max(1.0, rows))
        shape = 3.25 + 3.1 + _at(SORTED_FLOAT32, rows)
        return rows * (3.0 * 0.97 * a_star + shape + seen)
    if name == "neighbours":
        return of_star + rows * (_at(NEIGHBOUR_BY_ANGLE, around) + 7.07 + 7.02 + 6.88)
    if name == "hausdorff_angular":
        return of_star + rows * (1.38 + _at(SEPARATION_BY_STAR, around))
    if name == "hausdorff_l2":
        return of_star + rows * (1.38 + _at(RATIO_BY_STAR, around))
    listed = extent.values / max(1.0, rows)
    if name == "grid":
        cells = spec.products.grid.cells_per_side**2
        cell = _at(STAR_ROW, cells) * _at(CELL_OF_FEW, listed)
        return in_order + rows * 1.85 + extent.values * cell
    ring = _at(RING_OF_SHARE, listed / spec.products.radial.rings)
    return in_order + rows * 1.95 + extent.values * ring


def _at(curve: Curve, x: float) -> float:
    return float(np.interp(np.log(max(x, 1e-9)), np.log(curve[0]), curve[1]))


def database_bytes(
    extents: Mapping[str, Extent],
    levels: LevelExtent | None,
    stars: int,
    spec: BuildSpec,
    designation_bytes: int = 28,
) -> int:
    """Return how large the HDF5 file of a build will be."""
    total, datasets = 0.0, 0
    every = {"stars": Extent(float(stars)), **extents}
    if levels is not None:
        every["levels"] = Extent(float(levels.levels), levels.triangles)
    for name, extent in every.items():
        for column in product_schema(name).columns:
            if not column.in_database:
                continue
            is_name = column.item_dtype == "string"
            dtype = stored_dtype(column, stars)
            width = designation_bytes if is_name else np.dtype(dtype).itemsize
            values = extent.values
            if name == "levels" and column.name == "stars" and levels is not None:
                values = float(levels.stars)
            total += extent.rows * (8.0 if column.is_list else width)
            total += values * width if column.is_list else 0.0
            datasets += 2 if column.is_list else 1
        total += _index_bytes(name, extent, stars, spec)
        datasets += len(indices_of(name))
    return round(total + DATASET_BYTES * datasets)


def _index_bytes(name: str, extent: Extent, stars: int, spec: BuildSpec) -> float:
    """Return what stands beside the columns of a product in the database."""
    if name in ("pairs", "triangles"):
        return 4.0 * extent.rows
    if name == "neighbours":
        return 8.0 * stars + 8.0 * _bins(spec) + 4.0 * extent.rows
    if name == "grid":
        return 8.0 * spec.products.grid.cells_per_side**2 + 4.0 * extent.values
    if name == "radial":
        return 8.0 * spec.products.radial.rings + 4.0 * extent.values
    return {"hausdorff_angular": 8.0, "hausdorff_l2": 16.0}.get(name, 0.0) * stars


def _bins(spec: BuildSpec) -> float:
    """Return the bins of the look-up table of neighbours."""
    wanted = spec.products.neighbours
    radius_deg = wanted.radius_deg or spec.camera.half_field_deg
    return float(
        np.ceil(360.0 / wanted.angle_bin_deg) * np.ceil(radius_deg / wanted.separation_bin_deg)
    )


@cache
def _no_counterparts() -> int:
    return parquet_bytes(product_schema("crossmatch").arrow_schema.empty_table())


def counterparts_bytes(rows: float) -> int:
    """Return about how large the file of counterparts will be."""
    return round(_no_counterparts() + COUNTERPART_BYTES * rows)


def other_bytes(fields: int) -> int:
    """Return about how large the report and the manifest of a build will be."""
    beyond = max(0.0, fields - REPORT_BYTES[0][-1])
    return round(_at(REPORT_BYTES, fields) + REPORT_BYTES_PER_FIELD * beyond + MANIFEST_BYTES)
