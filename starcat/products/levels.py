"""Levels: stars and triangles for fields wider than the camera's, each level thinned by itself.

A frame shows its brightest stars best, and which these are depends on how wide it is. A database
for fields of 5 to 30 deg therefore has one set of stars and triangles for each of some widths
between the two: the wider the field, the brighter and the fewer the stars.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Directions
from starcat.products.boresights import FieldSize, FieldStars, NominalField, tile_sphere
from starcat.products.index import Index, Ragged
from starcat.products.pairs_and_triangles import distinct_triangles

Rows = NDArray[np.int32]

# Boresights of a level, at the least: wide fields need few, and may have more for nothing.
FEWEST_BORESIGHTS = 1000


@dataclass(frozen=True)
class Levels:
    """Stars and triangles of each level, the narrowest first."""

    level: Rows  # shape (L,): 1 to L; level 0 is the camera's own field
    fov_x_deg: Array
    fov_y_deg: Array
    stars: Ragged  # rows of the star table, ascending
    # i, j, k: triangles: rows of the star table, i < j < k, in order
    i: Ragged
    j: Ragged
    k: Ragged
    index: Index


def level_fields(
    narrowest: FieldSize, widest_fov_x_deg: float, max_ratio: float
) -> tuple[NominalField, ...]:
    """Return the fields of the levels.

    The narrowest first, without level 0, the camera's own field, whose proportions all have.
    The focal lengths of neighbours have the same ratio, ``max_ratio`` at most, and the widest
    frames are wider than the last level's by that ratio too.

    A level serves frames that are as wide as its fields, or wider, up to those of the next level.
    Such a frame holds fields of the level whole, so that their triangles are in it. In a frame
    that is narrower than these by a sixth there may be no triangle at all.

    >>> fields = level_fields(NominalField(10.0, 7.5), 30.0, 1.5)
    >>> [round(field.fov_x_deg, 2) for field in fields]
    [14.48, 20.91]
    """
    across, down = (
        math.tan(math.radians(0.5 * angle)) for angle in (narrowest.fov_x_deg, narrowest.fov_y_deg)
    )
    whole = math.tan(math.radians(0.5 * widest_fov_x_deg)) / across
    # A range of exactly so many ratios has no level more because of rounding.
    steps = max(2, math.ceil(math.log(whole) / math.log(max_ratio) - 1e-9))
    factors = [whole ** (step / steps) for step in range(1, steps)]
    return tuple(
        NominalField(
            2.0 * math.degrees(math.atan(across * factor)),
            2.0 * math.degrees(math.atan(down * factor)),
        )
        for factor in factors
    )


def find_levels(
    directions: Directions,
    mag: Array,
    narrowest: FieldSize,
    fields: Sequence[FieldSize],
    *,
    boresights: int,
    stars_per_field: int,
    brightest: int,
) -> Levels:
    """Find the stars and the triangles of each level.

    ``boresights`` tile the sphere for the camera's field, fewer for a level. A star is kept
    that is among the brightest ``stars_per_field`` of some field; the ``brightest`` of a field
    make its triangles. Each level is thinned from the one before.
    """
    stars, triangles = [], []
    for level in thin_levels(directions, mag, narrowest, fields, boresights, stars_per_field):
        found, _ = distinct_triangles(level.tiled, len(level.before), brightest)
        triangles.append(level.before[found])
        stars.append(level.rows)
    i, j, k = (_ragged([found[:, n] for found in triangles]) for n in range(3))
    return Levels(
        np.arange(1, len(fields) + 1, dtype=np.int32),
        np.array([field.fov_x_deg for field in fields]),
        np.array([field.fov_y_deg for field in fields]),
        _ragged(stars),
        i,
        j,
        k,
        Index(),
    )


@dataclass(frozen=True)
class Level:
    """The stars of a level."""

    before: Rows  # shape (M,): rows of the star table that the level is chosen from
    tiled: FieldStars  # these in the fields of the level; its star numbers are places in ``before``
    rows: Rows  # shape (K,): rows of the star table that are left, ascending


def thin_levels(
    directions: Directions,
    mag: Array,
    narrowest: FieldSize,
    fields: Sequence[FieldSize],
    boresights: int,
    stars_per_field: int,
) -> Iterator[Level]:
    """Thin stars to those of each level, the narrowest first, each from those of the one before."""
    rows = np.arange(len(directions), dtype=np.int32)
    for field in fields:
        count = boresights_of_level(boresights, narrowest, field)
        tiled = tile_sphere(count, directions[rows], mag[rows], field)
        left = rows[np.unique(tiled.brightest(stars_per_field)[1])]
        yield Level(rows, tiled, left)
        rows = left


def boresights_of_level(boresights: int, narrowest: FieldSize, field: FieldSize) -> int:
    """Return how many boresights tile the sphere for a level: the wider its field, the fewer."""
    area, larger = (one.fov_x_deg * one.fov_y_deg for one in (narrowest, field))
    return max(FEWEST_BORESIGHTS, round(boresights * (area / larger)))


def _ragged(lists: Sequence[Rows]) -> Ragged:
    offsets = np.cumsum([0, *(len(one) for one in lists)]).astype(np.int64)
    return Ragged(offsets, np.concatenate([np.empty(0, dtype=np.int32), *lists]))
