"""How many rows the products of a build will have, counted around some of the stars.

Neighbours are counted, not found, and the triangles that several fields share are known from some
of the triangles; so this takes a moment where making the products takes minutes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from starcat.arrays import Array
from starcat.geometry.sphere import chord_from_separation
from starcat.pipeline.recipes import RECIPES, ProductInputs, field_size
from starcat.products.boresights import FieldStars
from starcat.products.levels import level_fields, thin_levels
from starcat.specs.build_spec import BuildSpec

SAMPLE = 2000
"""Stars around which neighbours are counted, and triangles whose fields are."""

MOST_IN_TREE, MOST_MET = 500_000, 20_000_000
"""Of more stars than these, and more neighbours of all that are looked at, only some are searched
for neighbours; so many lose little."""

QUANTILES = 64
"""Numbers of neighbours that stand for those of all stars, where a pattern's cells are counted."""


@dataclass(frozen=True)
class Extent:
    """How large a product will be."""

    rows: float  # rows of its table
    values: float = 0.0  # entries of its lists, all rows together; 0 where it has none
    # neighbours that are gone through to make it; its rows where these are what it lists
    reached: float = 0.0
    records: float = 0.0  # triangles over all fields, repeats included; 0 for other products


def count_products(inputs: ProductInputs) -> dict[str, Extent]:
    """Count the rows of the products that are made from guide stars alone."""
    spec, stars = inputs.spec, len(inputs.directions)
    wanted = [name for name in RECIPES if getattr(spec.products, name).enabled]
    reach = {name: inputs.reach_rad(name) for name in wanted if name != "triangles"}
    inner = {name: _inner_rad(name, spec) for name in reach}
    near = _neighbours_within(inputs.directions, {*reach.values(), *inner.values()})
    found: dict[str, Extent] = {}
    for name in wanted:
        if name == "triangles":
            records, distinct = count_triangles(inputs.fields, stars, spec.boresights.brightest)
            found[name] = Extent(distinct, reached=distinct, records=records)
            continue
        around = near[reach[name]] - (near[inner[name]] if inner[name] > 0.0 else 0.0)
        reached = float(stars * near[reach[name]].mean())
        if name == "grid":
            side = spec.products.grid.cells_per_side
            cells = float(_distinct(around, np.full(1, 4.0 / (np.pi * side**2))) * stars)
            found[name] = Extent(float(stars * (around > 0.0).mean()), cells, reached)
        elif name == "radial":
            rings = spec.products.radial.rings
            share = (2.0 * np.arange(rings) + 1.0) / rings**2
            found[name] = Extent(float(stars), float(_distinct(around, share) * stars), reached)
        else:
            both_ways = 0.5 if name == "pairs" else 1.0
            rows = float(both_ways * stars * around.mean())
            found[name] = Extent(rows, reached=both_ways * reached)
    return found


@dataclass(frozen=True)
class LevelExtent:
    """How large the product ``levels`` will be."""

    levels: int
    stars: int  # stars of all levels
    triangles: float  # triangles of all levels
    records: float  # the same over all fields, repeats included


def count_levels(directions: Array, mag: Array, spec: BuildSpec) -> LevelExtent:
    """Count the stars and the triangles of a range of fields."""
    wanted, own = spec.products.levels, field_size(spec)
    fields = level_fields(own, wanted.widest_fov_x_deg, wanted.max_ratio)
    stars, triangles, records = 0, 0.0, 0.0
    for level in thin_levels(
        directions, mag, own, fields, spec.boresights.count, wanted.stars_per_field
    ):
        all_of_them, distinct = count_triangles(
            level.tiled, len(level.before), spec.boresights.brightest
        )
        stars, triangles = stars + len(level.rows), triangles + distinct
        records += all_of_them
    return LevelExtent(len(fields), stars, triangles, records)


def _inner_rad(name: str, spec: BuildSpec) -> float:
    """Return how far apart two stars of a row of a product have to be."""
    products = spec.products
    nearest_deg = {"pairs": products.pairs.min_separation_deg, "grid": products.grid.buffer_deg}
    return float(np.radians(nearest_deg.get(name, 0.0)))


def _neighbours_within(directions: Array, radii_rad: set[float]) -> Mapping[float, Array]:
    """Return the number of neighbours within each radius of some of the stars."""
    some = directions[:: -(-len(directions) // SAMPLE)]
    found: dict[float, Array] = {}
    trees: dict[int, scipy.spatial.cKDTree] = {}
    for radius in radii_rad:
        # Wide circles hold so many stars that some of these tell of all.
        share = 0.5 * (1.0 - np.cos(min(radius, np.pi)))
        thinning = 1 + int(len(directions) * max(share * len(some) / MOST_MET, 1.0 / MOST_IN_TREE))
        if thinning not in trees:
            trees[thinning] = scipy.spatial.cKDTree(directions[::thinning])
        near = trees[thinning].query_ball_point(some, _chord(radius), return_length=True)
        # Every star finds itself, in a tree of all of them.
        found[radius] = np.maximum(thinning * near - 1.0, 0.0)
    return found


def _chord(radius_rad: float) -> float:
    return float(chord_from_separation(min(radius_rad, np.pi)))


def _distinct(around: Array, share: Array) -> float:
    """Return how many cells the neighbours of a star occupy in the mean.

    ``share`` is the part of all neighbours that is in each cell; one number stands for as many
    equal cells as make a whole.
    """
    middle = (np.arange(QUANTILES) + 0.5) / QUANTILES
    count = np.quantile(around, middle)[:, None]
    weight = np.round(1.0 / share) if len(share) == 1 else 1.0
    with np.errstate(divide="ignore"):
        occupied = -np.expm1(count * np.log1p(-np.minimum(share, 1.0)))
    return float((weight * np.where(count > 0.0, occupied, 0.0)).sum(axis=1).mean())


def count_triangles(fields: FieldStars, stars: int, brightest: int) -> tuple[float, float]:
    """Return the triangles of all fields, and about how many of them are distinct.

    One that t fields have is counted t times, so the distinct ones are all times the mean of 1/t.
    """
    offsets, star = fields.brightest(brightest)
    size = np.diff(offsets)
    each = size * (size - 1) * (size - 2) // 6
    records = int(each.sum())
    if not records:
        return 0.0, 0.0
    held = np.ones(len(star), dtype=np.int32)
    of_field = scipy.sparse.csr_array((held, star, offsets), shape=(len(size), stars))
    of_star = of_field.T.tocsr()
    generator = np.random.default_rng(0)
    field = generator.choice(len(size), SAMPLE, p=each / records)
    drawn = generator.random((SAMPLE, size.max()))
    drawn[np.arange(size.max()) >= size[field, None]] = 2.0  # no star of the field
    members = np.argsort(drawn, axis=1)[:, :3]
    i, j, k = star[offsets[field][:, None] + members].T
    shared = of_star[i].multiply(of_star[j]).multiply(of_star[k]).sum(axis=1)
    return float(records), float(records * np.mean(1.0 / np.asarray(shared).ravel()))
