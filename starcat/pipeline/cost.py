"""The size of a build before it starts: rows, bytes of files, and memory.

Each product counts its rows (`starcat.database.products.kind`). Files are rows times the width of
the schema's columns times a factor, measured on databases of 2,400 to 36,000 stars. Only the free
memory depends on the machine. There is no model of time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np

from starcat.database.database import stored_dtype
from starcat.database.products.kind import Extent, ProductInputs
from starcat.database.products.table import PRODUCTS
from starcat.errors import BuildError
from starcat.pipeline.log import available_memory_bytes
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.storage.parquet import parquet_bytes
from starcat.storage.schema import product_schema

GIB, MB = 2**30, 1e6

DATABASE_FACTOR = 1.27
"""Bytes of the HDF5 file, with look-up tables, per byte of the stored columns."""

REPORT_BYTES, REPORT_BYTES_PER_FIELD = 1.03e6, 98.0
"""Bytes of the report (page and pictures) and the manifest, and additional bytes per field."""

COLUMN_FACTOR, WORKING_BYTES = 2.0, 64.0
"""Memory of a product, as a multiple of its columns, and more for each row that is gone through
while it is made."""

FIELD_BYTES = 1500.0
"""Memory of a field of the tiling, with its stars, its line and its dot in the report."""

BASE_BYTES, CATALOG_FACTOR = 320.0e6, 2.0
"""Memory of the program, and memory for reading as a multiple of the star table's size."""


@dataclass(frozen=True)
class Cost:
    """The estimated size of a build."""

    stars: int  # guide stars
    fields: int  # boresights
    rows: Mapping[str, int]  # rows of each product of the spec
    bytes: Mapping[str, int]  # memory saved if a product is left out, by product
    memory_bytes: int  # peak memory of the build
    # bytes of each file; ``report`` is the sum of the folder ``report`` and the manifest
    files: Mapping[str, int]

    @property
    def in_words(self) -> str:
        """A one-line summary for people."""
        named = [f"{_rounded(count)} {name}" for name, count in self.rows.items()]
        return (
            f"estimate: {self.stars:,} guide stars in {self.fields:,} fields; "
            f"{', '.join(named) or 'no products'}; {sum(self.files.values()) / MB:,.1f} MB of "
            f"files, {self.memory_bytes / GIB:.1f} GiB of memory"
        )


def _rounded(count: int) -> str:
    """Return a number with two significant digits, the precision of an estimate."""
    digits = max(0, len(str(count)) - 2)
    return f"{round(count, -digits):,}"


def base_memory(catalog_bytes: float) -> float:
    """Return the memory in use when the guide stars are selected."""
    return BASE_BYTES + CATALOG_FACTOR * catalog_bytes


def count_products(inputs: ProductInputs) -> dict[str, Extent]:
    """Count the rows of the products that can be counted from guide stars."""
    return {
        name: kind.count(inputs, inputs.requested.get(name))
        for name, kind in PRODUCTS.items()
        if kind.count is not None and kind.is_requested(inputs)
    }


def product_cost(
    inputs: ProductInputs,
    base_bytes: float,
    extents: Mapping[str, Extent] | None = None,
    others: Mapping[str, int] | None = None,
) -> Cost:
    """Estimate the size of a build after its guide stars are chosen.

    ``base_bytes`` is the memory already in use, ``extents`` are the products as counted, and
    ``others`` are rows of products that are not counted, such as ``rejected``.
    """
    extents = count_products(inputs) if extents is None else extents
    stars, fields = len(inputs.directions), len(inputs.fields.count)
    every = {**extents, **{name: Extent(float(rows)) for name, rows in (others or {}).items()}}
    files = {
        f"{name}.parquet": _empty_file(name)
        + PRODUCTS[name].parquet_factor * column_bytes(name, extent)
        for name, extent in every.items()
    }
    files["database.h5"] = DATABASE_FACTOR * sum(
        column_bytes(name, extent, stars) + 8.0 * extent.bins
        for name, extent in extents.items()
        if PRODUCTS[name].in_database
    )
    files["report"] = REPORT_BYTES + REPORT_BYTES_PER_FIELD * fields
    column_memory = {
        name: COLUMN_FACTOR * column_bytes(name, extents[name]) for name in inputs.requested
    }
    working = {name: WORKING_BYTES * extents[name].worked for name in inputs.requested}
    memory = base_bytes + sum(column_memory.values()) + max(working.values(), default=0.0)
    return Cost(
        stars,
        fields,
        {name: round(extents[name].rows) for name in inputs.requested},
        {name: round(column_memory[name] + working[name]) for name in inputs.requested},
        round(memory + FIELD_BYTES * fields),
        {file: round(size) for file, size in files.items()},
    )


def column_bytes(name: str, extent: Extent, stars: int | None = None) -> float:
    """Return the bytes of a product's columns without texts: of its schema, or as stored.

    The database, which has ``stars`` stars, stores rows of stars in as few bytes as possible.
    """
    total = 0.0
    for column in product_schema(name).columns:
        if column.item_dtype != "string" and (stars is None or column.in_database):
            dtype = column.item_dtype if stars is None else stored_dtype(column, stars)
            total += np.dtype(dtype).itemsize * extent.lists.get(column.name, extent.rows)
    return total


@cache
def _empty_file(product: str) -> int:
    return parquet_bytes(product_schema(product).arrow_schema.empty_table())


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
