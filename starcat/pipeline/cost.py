"""What a build will cost, before it makes anything: rows, files, memory and time.

Rows are those of `starcat.pipeline.counts`. The database stores numbers as they are, so its size
is a sum. Parquet files are compressed: what a value then takes was measured on skies of 200 to
170,000 stars and fields of 2 to 25 deg, and is right within a fifth. The size of a table at hand
is found by writing it, or a part of it, to nowhere. Nothing depends on the machine but the memory
that it has left. Times are those of a processor of 2020 that does nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from starcat.artifact.database import stored_dtype
from starcat.artifact.writer import Product
from starcat.catalog.ingest import Ingested
from starcat.errors import BuildError
from starcat.pipeline.counts import Extent, LevelExtent, count_levels, count_products
from starcat.pipeline.log import available_memory_bytes
from starcat.pipeline.recipes import ProductInputs, boresight_product
from starcat.products.boresights import FieldStars
from starcat.selection.selecting import Selected
from starcat.specs.build_spec import BuildSpec
from starcat.stars.star_table import directions_of, floats_of
from starcat.storage.parquet import ROW_GROUP_ROWS, parquet_bytes
from starcat.storage.product_table import indices_of
from starcat.storage.schema import product_schema

GIB, MB = 2**30, 1e6


@dataclass(frozen=True)
class Row:
    """What a row of a product costs."""

    held_bytes: float  # while the other products are made and written
    working_bytes: float  # beside that, while it is made itself
    micros: float  # microseconds to make, write and check it


ROWS: Mapping[str, Row] = {
    "pairs": Row(28.0, 110.0, 1.3),
    "triangles": Row(34.0, 50.0, 2.6),
    "neighbours": Row(44.0, 50.0, 2.4),
    "hausdorff_angular": Row(24.0, 40.0, 0.9),
    "hausdorff_l2": Row(24.0, 60.0, 1.2),
    "grid": Row(16.0, 60.0, 1.2),
    "radial": Row(12.0, 60.0, 1.2),
    "levels": Row(24.0, 60.0, 0.6),
}
"""Measured with numpy 2 on products of 0.5 to 6 million rows: of patterns a neighbour is one, of
levels a triangle."""

RECORD = Row(0.0, 32.0, 0.15)
"""A triangle of one field, before those that several fields have are made one."""

FIELD_STAR = Row(8.0, 60.0, 0.6)
"""A star in a field of the tiling."""

FIELD = Row(300.0, 1200.0, 40.0)
"""A field of the tiling, with its line and its dot in the report."""

BASE_BYTES = 320.0e6
"""The program and its libraries."""

CATALOG_FACTOR = 2.0
"""Bytes in memory over those of the star table."""

FRAME_SECONDS, BASE_SECONDS = 0.002, 3.0

ROW_GROUP_BYTES = 350.0
"""What each row group but the first adds to the end of a Parquet file."""

STAR_ROW_IN_ORDER = 2.3
"""Bytes of a row of the star table, ascending and each once."""

PAIR_SEPARATION = 5.2
"""Bytes of a float64 of a table that is sorted by it."""

TRIANGLE_SHAPE = 9.0
"""Bytes of a triangle beside its stars: area, sides, angles and how many fields have it."""

NEIGHBOUR = 22.1
"""Bytes of a neighbour with its angle and separations."""

SEPARATION_OF_STAR = 8.1
"""Bytes of a neighbour with one separation or ratio, ascending within each star."""

COUNTERPART = 75.0
"""Bytes of a row of the product ``crossmatch``."""

DATASET_BYTES = 835.0
"""A dataset of the database, beside its values: its name, place and attributes."""

REPORT_BYTES, REPORT_BYTES_PER_FIELD = 1.03e6, 98.0
"""The report with its page and pictures and the manifest, and what each field adds to them."""

PART_ROWS, PARTS = 8192, 3
"""Of a larger table than these make, some parts are written."""


@dataclass(frozen=True)
class Cost:
    """What a build will cost."""

    stars: int  # guide stars
    fields: int  # boresights
    rows: Mapping[str, int]  # rows of each product that will be made
    bytes: Mapping[str, int]  # memory that leaving out each product would save
    memory_bytes: int  # most memory that the build will hold
    seconds: float  # time from here on
    # bytes of each file as it will be written; those of the folder ``report`` and of the manifest
    # together as ``report``
    files: Mapping[str, int] = field(default_factory=dict)

    @property
    def in_words(self) -> str:
        """One line for people."""
        named = [f"{_rounded(count)} {name}" for name, count in self.rows.items()]
        written = f"{sum(self.files.values()) / MB:,.1f} MB of files, " if self.files else ""
        return (
            f"estimate: {self.stars:,} guide stars in {self.fields:,} fields; "
            f"{', '.join(named) or 'no products'}; {written}{self.memory_bytes / GIB:.1f} GiB of "
            f"memory, {max(1, round(self.seconds)):,} s"
        )


def estimate_cost(
    catalog: Ingested,
    selected: Selected,
    fields: FieldStars,
    spec: BuildSpec,
    others: Sequence[Product] = (),
) -> Cost:
    """Estimate what the products of a build will cost."""
    rejected = pa.concat_tables([catalog.rejected, selected.rejected])
    base = base_memory(catalog.stars.nbytes + catalog.rejected.nbytes)
    return whole_cost(selected.guide_stars, fields, spec, table_bytes(rejected), base, others)


def base_memory(catalog_bytes: float) -> float:
    """Return the memory that is taken when the guide stars are selected."""
    return BASE_BYTES + CATALOG_FACTOR * catalog_bytes


def whole_cost(
    stars: pa.Table,
    fields: FieldStars,
    spec: BuildSpec,
    rejected_bytes: int,
    base_bytes: float,
    others: Sequence[Product] = (),
) -> Cost:
    """Estimate what a build will cost, its files included, once the guide stars are chosen.

    ``rejected_bytes`` is the size of the file of rejected records, ``base_bytes`` memory that is
    taken already, ``others`` are products at hand, such as ``motions``.
    """
    inputs = ProductInputs(directions_of(stars), fields, spec)
    extents, levels = count_products(inputs), None
    if spec.products.levels.enabled:
        levels = count_levels(inputs.directions, floats_of(stars, "mag"), spec)
    cost = product_cost(inputs, base_bytes, extents, levels)
    boresights = boresight_product(fields, spec.boresights.brightest).table
    longest = pc.max(pc.binary_length(stars["designation"])).as_py() or 1
    listed = pc.sum(pc.list_value_length(boresights["brightest"])).as_py() or 0
    stored = {"boresights": Extent(float(len(boresights)), float(listed)), **extents}
    tables = {"stars": table_bytes(stars), "boresights": table_bytes(boresights)}
    tables |= product_files(extents, levels, len(stars), spec)
    tables |= {product.name: table_bytes(product.table) for product in others}
    tables["rejected"] = rejected_bytes
    rows = dict(cost.rows)
    wanted = spec.products.crossmatch
    if wanted.enabled:
        rows["crossmatch"] = len(stars) * len(wanted.catalogs)
        tables["crossmatch"] = round(_empty_file("crossmatch") + COUNTERPART * rows["crossmatch"])
    files = {f"{name}.parquet": count for name, count in tables.items()}
    files["database.h5"] = database_bytes(stored, levels, len(stars), spec, longest)
    files["report"] = round(REPORT_BYTES + REPORT_BYTES_PER_FIELD * len(boresights))
    return replace(cost, rows=rows, files=files)


def product_cost(
    inputs: ProductInputs,
    base_bytes: float,
    extents: Mapping[str, Extent] | None = None,
    levels: LevelExtent | None = None,
) -> Cost:
    """Estimate what products cost in memory and time; without extents they are counted."""
    extents = count_products(inputs) if extents is None else extents
    spec, fields = inputs.spec, inputs.fields
    rows = {name: extent.rows for name, extent in extents.items()}
    work = {name: extent.reached for name, extent in extents.items()}
    records = sum(extent.records for extent in extents.values())
    if levels is not None:
        rows["levels"], work["levels"] = float(levels.levels), levels.triangles
        records += levels.records
    parts = [(ROWS[name], count) for name, count in work.items()]
    parts += [
        (FIELD, float(len(fields.count))),
        (FIELD_STAR, float(len(fields.star_index))),
        (RECORD, records),
    ]
    held = {name: count * ROWS[name].held_bytes for name, count in work.items()}
    working = max((row.working_bytes * count for row, count in parts), default=0.0)
    memory = base_bytes + working + sum(row.held_bytes * count for row, count in parts)
    seconds = 1e-6 * sum(row.micros * count for row, count in parts)
    seconds += BASE_SECONDS + 3.0 * FRAME_SECONDS * spec.self_test.frames
    saved = {name: held[name] + work[name] * ROWS[name].working_bytes for name in work}
    return Cost(
        len(inputs.directions),
        len(fields.count),
        {name: round(count) for name, count in rows.items()},
        {name: round(count) for name, count in saved.items()},
        round(memory),
        seconds,
    )


def check_memory(cost: Cost, spec: BuildSpec, max_memory_bytes: int | None = None) -> None:
    """Check that a build fits into the memory."""
    limit, whose = max_memory_bytes, "the limit that was given"
    if limit is None:
        limit, whose = available_memory_bytes(), "what this machine has left"
    if limit is None or cost.memory_bytes <= limit:
        return
    largest = max(cost.bytes, key=lambda name: cost.bytes[name], default="")
    key = f"products.{largest}.enabled = false"
    if largest in ("", "triangles"):
        key = f"a smaller boresights.brightest than {spec.boresights.brightest}"
    raise BuildError(
        f"{spec.name}: the build would take about {cost.memory_bytes / GIB:.1f} GiB of memory, "
        f"more than {whose}, {limit / GIB:.1f} GiB; {key} saves most, and fewer stars "
        "(selection.max_stars_per_field, a brighter faint_limit_mag) save some of everything"
    )


def _rounded(count: int) -> str:
    """Return a number in two digits, as an estimate is known."""
    digits = max(0, len(str(count)) - 2)
    return f"{round(count, -digits):,}"


def table_bytes(table: pa.Table, rows: int | None = None) -> int:
    """Return about how large the Parquet file of a table will be; exactly, of a small one.

    ``rows`` are those of the whole product, where the table is a part of it.
    """
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
    """Return about how large the Parquet files of products will be."""
    found = {}
    for name, extent in extents.items():
        groups = max(0.0, np.ceil(extent.rows / ROW_GROUP_ROWS) - 1.0)
        values = _values_bytes(name, extent, stars, spec)
        found[name] = round(_empty_file(name) + ROW_GROUP_BYTES * groups + values)
    if levels is not None:
        # Triangles go by their stars, so that many of a star take less each.
        each = 3.0 * max(1.0, levels.triangles / max(1, levels.stars)) ** -0.27
        listed = STAR_ROW_IN_ORDER * levels.stars
        found["levels"] = round(_empty_file("levels") + listed + each * levels.triangles)
    return found


@cache
def _empty_file(product: str) -> int:
    return parquet_bytes(product_schema(product).arrow_schema.empty_table())


def _star_row(stars: float) -> float:
    """Return the bytes of a row of the star table in no order."""
    return float(1.3 * np.log2(max(stars, 2.0)) / 8.0)


def _values_bytes(name: str, extent: Extent, stars: int, spec: BuildSpec) -> float:
    """Return what the columns of a product take, compressed."""
    rows = extent.rows
    if name == "pairs":
        return rows * (2.0 * _star_row(stars) + PAIR_SEPARATION)
    if name == "triangles":
        return rows * (3.0 * _star_row(stars) + TRIANGLE_SHAPE)
    if name in ("neighbours", "hausdorff_angular", "hausdorff_l2"):
        # Rows of a star are side by side: its number is written about once.
        each = NEIGHBOUR if name == "neighbours" else SEPARATION_OF_STAR
        return min(2.1 * stars, 2.0 * rows) + rows * each
    pattern = rows * (STAR_ROW_IN_ORDER + 1.9)
    if name == "grid":
        return pattern + 0.92 * extent.values * _star_row(spec.products.grid.cells_per_side**2)
    share = extent.values / max(1.0, rows) / spec.products.radial.rings
    return pattern + extent.values * (1.3 - 1.2 * min(share, 1.0))


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
        wanted = spec.products.neighbours
        radius_deg = wanted.radius_deg or spec.camera.half_field_deg
        rings = np.ceil(radius_deg / wanted.separation_bin_deg)
        bins = float(np.ceil(360.0 / wanted.angle_bin_deg) * rings)
        return 8.0 * stars + 8.0 * bins + 4.0 * extent.rows
    if name == "grid":
        return 8.0 * spec.products.grid.cells_per_side**2 + 4.0 * extent.values
    if name == "radial":
        return 8.0 * spec.products.radial.rings + 4.0 * extent.values
    return {"hausdorff_angular": 8.0, "hausdorff_l2": 16.0}.get(name, 0.0) * stars
