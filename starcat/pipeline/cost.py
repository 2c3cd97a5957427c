"""What a build will cost, before it makes anything: rows, files, memory and time.

Rows are those of `starcat.pipeline.counts`, files those of `starcat.pipeline.sizes`. Nothing here
depends on the machine but the memory that it has left. Times are those of a processor of 2020 that
does nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import pyarrow as pa
import pyarrow.compute as pc

from starcat.artifact.writer import Product
from starcat.catalog.ingest import Ingested
from starcat.catalog.selection import Selected
from starcat.catalog.stars import directions_of, floats_of
from starcat.errors import BuildError
from starcat.pipeline.counts import Extent, LevelExtent, count_levels, count_products
from starcat.pipeline.log import available_memory_bytes
from starcat.pipeline.recipes import ProductInputs, boresight_product
from starcat.pipeline.sizes import (
    counterparts_bytes,
    database_bytes,
    other_bytes,
    product_files,
    table_bytes,
)
from starcat.products.boresights import FieldStars
from starcat.specs.build_spec import BuildSpec

GIB = 2**30

MB = 1e6


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

FRAME_SECONDS = 0.002
BASE_SECONDS = 3.0


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


@dataclass(frozen=True)
class EstimateInputs:
    """What is there when a build is estimated: some products, and guide stars for the others."""

    guide_stars: pa.Table  # as the schema ``stars`` has them
    fields: FieldStars  # their tiling
    spec: BuildSpec  # which products, and their parameters
    rejected_bytes: int  # size of the file of rejected records
    others: Sequence[Product] = ()  # products that are there too, such as ``motions``
    base_bytes: float = 0.0  # memory that is taken already

    @property
    def inputs(self) -> ProductInputs:
        """What products are made from."""
        return ProductInputs(directions_of(self.guide_stars), self.fields, self.spec)


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
    made = EstimateInputs(
        selected.guide_stars, fields, spec, table_bytes(rejected), others=others, base_bytes=base
    )
    return whole_cost(made)


def base_memory(catalog_bytes: float) -> float:
    """Return the memory that is taken when the guide stars are selected."""
    return BASE_BYTES + CATALOG_FACTOR * catalog_bytes


def whole_cost(made: EstimateInputs) -> Cost:
    """Estimate what a build will cost, its files included."""
    spec, stars = made.spec, made.guide_stars
    extents, levels = count_products(made.inputs), None
    if spec.products.levels.enabled:
        levels = count_levels(directions_of(stars), floats_of(stars, "mag"), spec)
    cost = _cost(made.inputs, extents, levels, made.base_bytes)
    boresights = boresight_product(made.fields, spec.boresights.brightest).table
    longest = pc.max(pc.binary_length(stars["designation"])).as_py() or 1
    listed = pc.sum(pc.list_value_length(boresights["brightest"])).as_py() or 0
    stored = {"boresights": Extent(float(len(boresights)), float(listed)), **extents}
    tables = {"stars": table_bytes(stars), "boresights": table_bytes(boresights)}
    tables |= product_files(extents, levels, len(stars), spec)
    tables |= {product.name: table_bytes(product.table) for product in made.others}
    tables["rejected"] = made.rejected_bytes
    rows = dict(cost.rows)
    wanted = spec.products.crossmatch
    if wanted.enabled:
        rows["crossmatch"] = len(stars) * len(wanted.catalogs)
        tables["crossmatch"] = counterparts_bytes(rows["crossmatch"])
    files = {f"{name}.parquet": count for name, count in tables.items()}
    files["database.h5"] = database_bytes(stored, levels, len(stars), spec, longest)
    files["report"] = other_bytes(len(boresights))
    return replace(cost, rows=rows, files=files)


def product_cost(inputs: ProductInputs, base_bytes: float) -> Cost:
    """Estimate what products that are made from guide stars alone will cost."""
    return _cost(inputs, count_products(inputs), None, base_bytes)


def _cost(
    inputs: ProductInputs,
    extents: Mapping[str, Extent],
    levels: LevelExtent | None,
    base_bytes: float,
) -> Cost:
    """Return what products of known size cost in memory and time."""
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
