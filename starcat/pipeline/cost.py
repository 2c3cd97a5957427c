"""The cost of a build, estimated before it starts: rows, files, memory and time.

Each product counts its rows and states their cost (`starcat.products.kind`). The database is not
compressed, so its size is a sum. Parquet files are compressed: their bytes per value were measured
for skies of 200 to 170,000 stars and fields of 2 to 25 deg, and are right within a fifth. If a
table exists, its size is found by writing it, or a part of it, to memory. Only the free memory
depends on the machine. Times are for an otherwise idle processor of 2020.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from starcat.artifact.database import stored_dtype
from starcat.artifact.writer import Product
from starcat.errors import BuildError
from starcat.pipeline.log import available_memory_bytes
from starcat.pipeline.recipes import make_product, product_inputs, recipe_names
from starcat.products.kind import Extent, ProductInputs, RowCost
from starcat.products.table import PRODUCTS
from starcat.products.tiling import FieldStars
from starcat.specs.build_spec import BuildSpec
from starcat.storage.parquet import ROW_GROUP_ROWS, parquet_bytes
from starcat.storage.schema import product_schema

GIB, MB = 2**30, 1e6

RECORD = RowCost(0.0, 32.0, 0.15)
"""Cost of a triangle of one field, before duplicates between fields are removed."""

FIELD_STAR = RowCost(8.0, 60.0, 0.6)
"""Cost of a star in a field of the tiling."""

FIELD = RowCost(300.0, 1200.0, 40.0)
"""Cost of a field of the tiling, with its line and its dot in the report."""

BASE_BYTES = 320.0e6
"""Memory of the program and its libraries."""

CATALOG_FACTOR = 2.0
"""Memory for reading, as a multiple of the star table's size."""

FRAME_SECONDS, BASE_SECONDS = 0.002, 3.0

ROW_GROUP_BYTES = 350.0
"""Bytes that each row group except the first adds to the end of a Parquet file."""

DATASET_BYTES = 835.0
"""Bytes of a dataset of the database in addition to its values: name, place and attributes."""

REPORT_BYTES, REPORT_BYTES_PER_FIELD = 1.03e6, 98.0
"""Bytes of the report (page and pictures) and the manifest, and additional bytes per field."""

PART_ROWS, PARTS = 8192, 3
"""If a table is larger than this, only some parts are written to find its size."""


@dataclass(frozen=True)
class Cost:
    """The estimated cost of a build."""

    stars: int  # guide stars
    fields: int  # boresights
    rows: Mapping[str, int]  # rows of each product
    bytes: Mapping[str, int]  # memory saved if a product is left out, by product
    memory_bytes: int  # peak memory of the build
    seconds: float  # time from now to the end
    # bytes of each file; ``report`` is the sum of the folder ``report`` and the manifest
    files: Mapping[str, int] = field(default_factory=dict)

    @property
    def in_words(self) -> str:
        """A one-line summary for people."""
        named = [f"{_rounded(count)} {name}" for name, count in self.rows.items()]
        written = f"{sum(self.files.values()) / MB:,.1f} MB of files, " if self.files else ""
        return (
            f"estimate: {self.stars:,} guide stars in {self.fields:,} fields; "
            f"{', '.join(named) or 'no products'}; {written}{self.memory_bytes / GIB:.1f} GiB of "
            f"memory, {max(1, round(self.seconds)):,} s"
        )


def base_memory(catalog_bytes: float) -> float:
    """Return the memory in use when the guide stars are selected."""
    return BASE_BYTES + CATALOG_FACTOR * catalog_bytes


def whole_cost(
    stars: pa.Table,
    fields: FieldStars,
    spec: BuildSpec,
    rejected_bytes: int,
    base_bytes: float,
    others: Sequence[Product] = (),
) -> Cost:
    """Estimate the cost of a build with its files, after the guide stars are chosen.

    ``rejected_bytes`` is the size of the file of rejected records, ``base_bytes`` the memory
    already in use, ``others`` are existing products, such as ``motions``.
    """
    inputs = product_inputs(stars, fields, spec)
    extents = count_products(inputs)
    tables = {"stars": table_bytes(stars)}
    for name in recipe_names(inputs):
        if PRODUCTS[name].section is None:
            tables[name] = table_bytes(make_product(name, inputs).table)
    tables |= product_files(inputs, extents)
    tables |= {product.name: table_bytes(product.table) for product in others}
    tables["rejected"] = rejected_bytes
    files = {f"{name}.parquet": count for name, count in tables.items()}
    longest = pc.max(pc.binary_length(stars["designation"])).as_py() or 1
    files["database.h5"] = database_bytes(extents, len(stars), longest)
    files["report"] = round(REPORT_BYTES + REPORT_BYTES_PER_FIELD * len(fields.count))
    return replace(product_cost(inputs, spec, base_bytes, extents), files=files)


def count_products(inputs: ProductInputs) -> dict[str, Extent]:
    """Count the rows of the requested products that can be counted from guide stars."""
    return {
        name: kind.count(inputs, inputs.wanted.get(name))
        for name, kind in PRODUCTS.items()
        if kind.count is not None and kind.is_wanted(inputs)
    }


def product_cost(
    inputs: ProductInputs,
    spec: BuildSpec,
    base_bytes: float,
    extents: Mapping[str, Extent] | None = None,
) -> Cost:
    """Estimate the memory and time of products; by default their rows are counted."""
    extents = count_products(inputs) if extents is None else extents
    fields = inputs.fields
    costs = {name: cost for name in extents if (cost := PRODUCTS[name].cost) is not None}
    parts = [(row, extents[name].reached) for name, row in costs.items()]
    parts += [
        (FIELD, float(len(fields.count))),
        (FIELD_STAR, float(len(fields.star_index))),
        (RECORD, sum(extent.records for extent in extents.values())),
    ]
    working = max((row.working_bytes * count for row, count in parts), default=0.0)
    memory = base_bytes + working + sum(row.held_bytes * count for row, count in parts)
    seconds = 1e-6 * sum(row.micros * count for row, count in parts)
    seconds += BASE_SECONDS + 3.0 * FRAME_SECONDS * spec.self_test.frames
    saved = {
        name: extents[name].reached * (row.held_bytes + row.working_bytes)
        for name, row in costs.items()
    }
    return Cost(
        len(inputs.directions),
        len(fields.count),
        {name: round(extents[name].rows) for name in inputs.wanted},
        {name: round(count) for name, count in saved.items()},
        round(memory),
        seconds,
    )


def check_memory(
    cost: Cost, spec: BuildSpec, remedy: Callable[[float], str], max_memory_bytes: int | None = None
) -> None:
    """Check that a build fits into the memory.

    ``remedy`` returns what to change in the spec, for the memory in bytes that there is.
    """
    limit, whose = max_memory_bytes, "the limit that was given"
    if limit is None:
        limit, whose = available_memory_bytes(), "what this machine has left"
    if limit is None or cost.memory_bytes <= limit:
        return
    too_much = (
        f"{spec.name}: the build would take about {cost.memory_bytes / GIB:.1f} GiB of memory, "
        f"more than {whose}, {limit / GIB:.1f} GiB"
    )
    saved = sum(cost.bytes.values())
    if cost.memory_bytes - saved > limit:
        raise BuildError(
            f"{too_much}; all products together take {saved / GIB:.1f} GiB of it, the rest is the "
            "program and the catalog",
            key="catalog.read_limit_mag",
            hint="Allow more memory, or read fewer stars (catalog.read_limit_mag)",
        )
    raise BuildError(too_much, key="selection.max_stars_per_field", hint=remedy(limit))


def _rounded(count: int) -> str:
    """Return a number with two significant digits, the precision of an estimate."""
    digits = max(0, len(str(count)) - 2)
    return f"{round(count, -digits):,}"


def table_bytes(table: pa.Table, rows: int | None = None) -> int:
    """Return the approximate size of a table's Parquet file; for a small table it is exact.

    ``rows`` is the number of rows of the whole product, if the table is a part of it.
    """
    count = len(table) if rows is None else rows
    if len(table) <= PART_ROWS * PARTS and count == len(table):
        return parquet_bytes(table)
    one = parquet_bytes(table.slice(0, 1))
    starts = np.linspace(0, max(0, len(table) - PART_ROWS), PARTS).astype(int).tolist()
    parts = [table.slice(start, PART_ROWS) for start in dict.fromkeys(starts)]
    some = sum(parquet_bytes(part) - one for part in parts)
    return round(one + some * max(0, count - 1) / max(1, sum(len(part) - 1 for part in parts)))


def product_files(inputs: ProductInputs, extents: Mapping[str, Extent]) -> dict[str, int]:
    """Return the approximate sizes of the Parquet files of products with a section."""
    found = {}
    for name, section in inputs.wanted.items():
        extent = extents[name]
        groups = max(0.0, np.ceil(extent.rows / ROW_GROUP_ROWS) - 1.0)
        values = PRODUCTS[name].values_bytes(extent, len(inputs.directions), section)
        found[name] = round(_empty_file(name) + ROW_GROUP_BYTES * groups + values)
    return found


@cache
def _empty_file(product: str) -> int:
    return parquet_bytes(product_schema(product).arrow_schema.empty_table())


def database_bytes(extents: Mapping[str, Extent], stars: int, designation_bytes: int) -> int:
    """Return the size of the HDF5 file of a build."""
    total, datasets = 0.0, 0
    for name, extent in extents.items():
        kind = PRODUCTS[name]
        if not kind.in_database:
            continue
        for column in kind.schema.columns:
            if not column.in_database:
                continue
            is_name = column.item_dtype == "string"
            dtype = stored_dtype(column, stars)
            width = designation_bytes if is_name else np.dtype(dtype).itemsize
            total += extent.rows * (8.0 if column.is_list else width)
            total += extent.lists[column.name] * width if column.is_list else 0.0
            datasets += 2 if column.is_list else 1
        total += kind.index_bytes(extent, stars)
        datasets += len(kind.layout.indices)
    return round(total + DATASET_BYTES * datasets)
