"""Make the products of a database from guide stars and a spec.

The module of a product defines it (`starcat.database.products.table`).
"""

from __future__ import annotations

from typing import Any

import pyarrow as pa

from starcat.arrays import Array, Directions
from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.database.products.index import Ragged
from starcat.database.products.kind import ProductInputs
from starcat.database.products.table import PRODUCTS
from starcat.database.products.tiling import (
    FieldSize,
    FieldStars,
    NominalField,
    spiral_points,
    stars_in_fields,
)
from starcat.database.writer import Product
from starcat.errors import BuildError
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.storage.schema import ProductSchema


def field_size(spec: BuildSpec) -> FieldSize:
    """Return the size of the tiling's fields."""
    camera, boresights = spec.camera.camera(), spec.boresights
    return NominalField(
        camera.fov_x_deg if boresights.fov_x_deg is None else boresights.fov_x_deg,
        camera.fov_y_deg if boresights.fov_y_deg is None else boresights.fov_y_deg,
    )


def boresights_of(spec: BuildSpec) -> Directions:
    """Return the boresights of a spec's tiling: points of the spiral that are in its region.

    Raises
    ------
    BuildError
        If no point is in the region.
    """
    count, part = spec.boresights.count, spec.selection.region.footprint
    points = spiral_points(count, part)
    if not len(points):
        raise BuildError(
            f"none of the fields of boresights.count = {count:,} has its boresight "
            "in [selection.region]; a larger boresights.count, or a larger region, has some",
            where=spec.name,
            key="boresights.count",
        )
    return points


def tile_guide_stars(guide_stars: pa.Table, spec: BuildSpec) -> FieldStars:
    """Tile the sphere, or the region of the spec, and find the guide stars in each field."""
    return tile_stars(directions_of(guide_stars), floats_of(guide_stars, "mag"), spec)


def tile_stars(directions: Directions, mag: Array, spec: BuildSpec) -> FieldStars:
    """Find the stars in each field of a spec's tiling."""
    size, shape = field_size(spec), spec.boresights.field
    return stars_in_fields(boresights_of(spec), directions, mag, size, shape)


def product_inputs(guide_stars: pa.Table, fields: FieldStars, spec: BuildSpec) -> ProductInputs:
    """Return the inputs for the products of a spec."""
    return ProductInputs(
        directions_of(guide_stars),
        floats_of(guide_stars, "mag"),
        fields,
        field_size(spec),
        boresights=spec.boresights.count,
        brightest=spec.boresights.brightest,
        half_field_deg=spec.camera.half_field_deg,
        diagonal_rad=spec.camera.camera().diagonal_rad,
        requested=spec.products.requested,
    )


def recipe_names(inputs: ProductInputs) -> tuple[str, ...]:
    """Return the requested products that are made from guide stars alone, in order."""
    return tuple(
        name
        for name, kind in PRODUCTS.items()
        if kind.make is not None and kind.is_requested(inputs)
    )


def make_product(name: str, inputs: ProductInputs) -> Product:
    """Make one product of `recipe_names`."""
    kind = PRODUCTS[name]
    assert kind.make is not None
    result = kind.make(inputs, inputs.requested.get(name))
    return Product(name, table_from_result(result, kind.schema), result.index)


def table_from_result(result: Any, schema: ProductSchema) -> pa.Table:
    """Return the result of a product as a table."""
    arrays = []
    for column in schema.columns:
        values, kind = getattr(result, column.name), column.arrow_field.type
        if isinstance(values, Ragged):
            offsets, items = pa.array(values.offsets, pa.int32()), pa.array(values.values)
            arrays.append(pa.ListArray.from_arrays(offsets, items).cast(kind))
        else:
            arrays.append(pa.array(values, kind))
    return pa.Table.from_arrays(arrays, schema=schema.arrow_schema)
