"""The product table: how each product is made from guide stars and a spec.

A new product is a pure function in ``products``, a schema, a section of the spec and one line
in `RECIPES`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa

from starcat.arrays import Array
from starcat.artifact.writer import Product
from starcat.geometry.sphere import radec_from_directions
from starcat.products.boresights import FieldSize, FieldStars, NominalField, tile_sphere
from starcat.products.index import Index, Ragged
from starcat.products.levels import find_levels, level_fields
from starcat.products.neighbours import (
    angular_reference_sets,
    find_neighbours,
    planar_reference_sets,
)
from starcat.products.pairs_and_triangles import find_pairs, find_triangles
from starcat.products.star_patterns import grid_patterns, radial_patterns
from starcat.specs.build_spec import BuildSpec
from starcat.stars.star_table import directions_of, floats_of
from starcat.storage.schema import ProductSchema, product_schema


@dataclass(frozen=True)
class ProductInputs:
    """What every recipe starts from."""

    directions: Array  # shape (N, 3): guide stars, ICRS
    fields: FieldStars  # the tiling of the sphere and the stars in each field
    spec: BuildSpec  # which products, and their parameters

    def reach_rad(self, product: str) -> float:
        """Return how far apart two stars of a row of a product may be."""
        wanted = getattr(self.spec.products, product)
        if product == "pairs" and wanted.max_separation_deg is None:
            return self.spec.camera.camera().diagonal_rad
        reach_deg = wanted.max_separation_deg if product == "pairs" else wanted.radius_deg
        if reach_deg is not None:
            return float(np.radians(reach_deg))
        # S5: 4/3 of the field's radius.
        factor = 4.0 / 3.0 if product == "hausdorff_angular" else 1.0
        return factor * float(np.radians(self.spec.camera.half_field_deg))


def _pairs(inputs: ProductInputs) -> Any:
    least = float(np.radians(inputs.spec.products.pairs.min_separation_deg))
    return find_pairs(inputs.directions, least, inputs.reach_rad("pairs"))


def _triangles(inputs: ProductInputs) -> Any:
    return find_triangles(inputs.fields, inputs.directions, inputs.spec.boresights.brightest)


def _neighbours(inputs: ProductInputs) -> Any:
    wanted = inputs.spec.products.neighbours
    return find_neighbours(
        inputs.directions,
        inputs.reach_rad("neighbours"),
        angle_bin_rad=float(np.radians(wanted.angle_bin_deg)),
        separation_bin_rad=float(np.radians(wanted.separation_bin_deg)),
    )


def _hausdorff_angular(inputs: ProductInputs) -> Any:
    return angular_reference_sets(inputs.directions, inputs.reach_rad("hausdorff_angular"))


def _hausdorff_l2(inputs: ProductInputs) -> Any:
    return planar_reference_sets(inputs.directions, inputs.reach_rad("hausdorff_l2"))


def _grid(inputs: ProductInputs) -> Any:
    wanted = inputs.spec.products.grid
    return grid_patterns(
        inputs.directions,
        inputs.reach_rad("grid"),
        buffer_rad=float(np.radians(wanted.buffer_deg)),
        cells_per_side=wanted.cells_per_side,
    )


def _radial(inputs: ProductInputs) -> Any:
    wanted, radius = inputs.spec.products.radial, inputs.reach_rad("radial")
    return radial_patterns(inputs.directions, radius, rings=wanted.rings, sectors=wanted.sectors)


RECIPES: dict[str, Callable[[ProductInputs], Any]] = {
    "pairs": _pairs,
    "triangles": _triangles,
    "neighbours": _neighbours,
    "hausdorff_angular": _hausdorff_angular,
    "hausdorff_l2": _hausdorff_l2,
    "grid": _grid,
    "radial": _radial,
}
"""Every product that is made from guide stars alone, in the order of the database."""


def field_size(spec: BuildSpec) -> FieldSize:
    """Return the size of the tiling's fields."""
    camera, wanted = spec.camera.camera(), spec.boresights
    return NominalField(
        camera.fov_x_deg if wanted.fov_x_deg is None else wanted.fov_x_deg,
        camera.fov_y_deg if wanted.fov_y_deg is None else wanted.fov_y_deg,
    )


def tile_guide_stars(guide_stars: pa.Table, spec: BuildSpec) -> FieldStars:
    """Tile the sphere and find the guide stars in each field."""
    return tile_sphere(
        spec.boresights.count,
        directions_of(guide_stars),
        floats_of(guide_stars, "mag"),
        field_size(spec),
        spec.boresights.field,
    )


def make_product(name: str, inputs: ProductInputs) -> Product:
    """Make one product."""
    made = RECIPES[name](inputs)
    return Product(name, table_from_result(made, product_schema(name)), made.index)


def table_from_result(result: Any, schema: ProductSchema) -> pa.Table:
    """Return the columns of a product's result as a table."""
    arrays = []
    for column in schema.columns:
        values, kind = getattr(result, column.name), column.arrow_field.type
        if isinstance(values, Ragged):
            offsets, items = pa.array(values.offsets, pa.int32()), pa.array(values.values)
            arrays.append(pa.ListArray.from_arrays(offsets, items).cast(kind))
        else:
            arrays.append(pa.array(values, kind))
    return pa.Table.from_arrays(arrays, schema=schema.arrow_schema)


def boresight_product(fields: FieldStars, brightest: int) -> Product:
    """Return the boresights as a product."""
    result = SimpleNamespace(
        boresight=np.arange(len(fields.count), dtype=np.int32),
        star_count=fields.count.astype(np.int32),
        brightest=Ragged(*fields.brightest(brightest)),
    )
    result.ra_deg, result.dec_deg = radec_from_directions(fields.boresights)
    result.x, result.y, result.z = np.ascontiguousarray(fields.boresights.T)
    return Product("boresights", table_from_result(result, product_schema("boresights")), Index())


def level_product(guide_stars: pa.Table, spec: BuildSpec) -> Product:
    """Return the levels of a range of fields as a product."""
    wanted, own = spec.products.levels, field_size(spec)
    result = find_levels(
        directions_of(guide_stars),
        floats_of(guide_stars, "mag"),
        own,
        level_fields(own, wanted.widest_fov_x_deg, wanted.max_ratio),
        boresights=spec.boresights.count,
        stars_per_field=wanted.stars_per_field,
        brightest=spec.boresights.brightest,
    )
    return Product("levels", table_from_result(result, product_schema("levels")), result.index)
