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
from starcat.catalog.stars import directions_of, floats_of
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
from starcat.storage.schema import ProductSchema, product_schema


@dataclass(frozen=True)
class ProductInputs:
    """What every recipe starts from."""

    directions: Array  # shape (N, 3): guide stars, ICRS
    fields: FieldStars  # the tiling of the sphere and the stars in each field
    spec: BuildSpec  # which products, and their parameters

    def radius_rad(self, radius_deg: float | None, factor: float = 1.0) -> float:
        """Return a product's radius."""
        if radius_deg is not None:
            return float(np.radians(radius_deg))
        return factor * float(np.radians(self.spec.camera.half_field_deg))


def _pairs(inputs: ProductInputs) -> Any:
    wanted = inputs.spec.products.pairs
    most = inputs.spec.camera.camera().diagonal_rad
    if wanted.max_separation_deg is not None:
        most = float(np.radians(wanted.max_separation_deg))
    return find_pairs(inputs.directions, float(np.radians(wanted.min_separation_deg)), most)


def _triangles(inputs: ProductInputs) -> Any:
    return find_triangles(inputs.fields, inputs.directions, inputs.spec.boresights.brightest)


def _neighbours(inputs: ProductInputs) -> Any:
    wanted = inputs.spec.products.neighbours
    return find_neighbours(
        inputs.directions,
        inputs.radius_rad(wanted.radius_deg),
        angle_bin_rad=float(np.radians(wanted.angle_bin_deg)),
        separation_bin_rad=float(np.radians(wanted.separation_bin_deg)),
    )


def _hausdorff_angular(inputs: ProductInputs) -> Any:
    radius_deg = inputs.spec.products.hausdorff_angular.radius_deg
    # S5: 4/3 of the field's radius.
    return angular_reference_sets(inputs.directions, inputs.radius_rad(radius_deg, 4.0 / 3.0))


def _hausdorff_l2(inputs: ProductInputs) -> Any:
    radius_deg = inputs.spec.products.hausdorff_l2.radius_deg
    return planar_reference_sets(inputs.directions, inputs.radius_rad(radius_deg))


def _grid(inputs: ProductInputs) -> Any:
    wanted = inputs.spec.products.grid
    return grid_patterns(
        inputs.directions,
        inputs.radius_rad(wanted.radius_deg),
        buffer_rad=float(np.radians(wanted.buffer_deg)),
        cells_per_side=wanted.cells_per_side,
    )


def _radial(inputs: ProductInputs) -> Any:
    wanted = inputs.spec.products.radial
    radius = inputs.radius_rad(wanted.radius_deg)
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
    ra_deg, dec_deg = radec_from_directions(fields.boresights)
    rows = np.arange(len(ra_deg), dtype=np.int32)
    x, y, z = np.ascontiguousarray(fields.boresights.T)
    result = SimpleNamespace(
        boresight=rows,
        ra_deg=ra_deg,
        dec_deg=dec_deg,
        x=x,
        y=y,
        z=z,
        star_count=fields.count.astype(np.int32),
        brightest=Ragged(*fields.brightest(brightest)),
    )
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
