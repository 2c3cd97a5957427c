"""The product ``hausdorff_angular``: every star's neighbours by separation.

Separations do not change as the camera turns. Each row holds a neighbour of a star.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from starcat.arrays import Array, Directions
from starcat.database.products.index import Index, row_offsets, stable_order
from starcat.database.products.kind import (
    ProductInputs,
    ProductKind,
    ProductSection,
    neighbour_extent,
)
from starcat.geometry.proximity import pairs_within
from starcat.sections import SmallDeg

STARS_AT_ONCE = 4096
"""Number of stars whose rows are sorted together, few enough for the processor's cache."""


class HausdorffAngular(ProductSection):
    """Separations around each star (S5)."""

    radius_deg: SmallDeg | None = Field(
        None,
        description="how far a star of the set may be; default: 4/3 of half of the narrower field",
    )

    def reach_rad(self, inputs: ProductInputs) -> float:
        """Return the largest separation of the set; S5 uses 4/3 of the field's radius."""
        return inputs.radius_rad(self.radius_deg, 4.0 / 3.0)


@dataclass(frozen=True)
class AngularReferenceSets:
    """Every star's neighbours by separation; a row is one neighbour of one star."""

    star: NDArray[np.int32]  # shape (M,): rows of the star table, ascending
    neighbour: NDArray[np.int32]  # shape (M,): rows of the star table
    # shape (M,): great-circle separations of the two, radians, ascending within a star
    separation_rad: Array
    index: Index  # dataset ``star_offsets``: the `row_offsets` of the stars; ``radius_rad``


def angular_reference_sets(directions: Directions, radius_rad: float) -> AngularReferenceSets:
    """Find the neighbours of every star within a radius, nearest first.

    Sorted by (star, separation, neighbour); the radius is included.

    Every pair of stars makes two rows, one from either end. Stars at the same place are
    neighbours at separation 0. The star itself is not in its set.

    Rotation-invariant feature with modified Hausdorff distance (S5), the feature of a star.

    >>> found = angular_reference_sets(np.eye(3)[:2], 2.0)
    >>> found.star, found.neighbour, found.separation_rad
    (array([0, 1], dtype=int32), array([1, 0], dtype=int32), array([1.570..., 1.570...]))
    """
    pairs, angle = pairs_within(directions, radius_rad)
    i, j = pairs.astype(np.int32).T
    star, neighbour = np.concatenate([i, j]), np.concatenate([j, i])
    both = np.concatenate([angle, angle])
    order = stable_order(star, len(directions))
    star, neighbour, both = star[order], neighbour[order], both[order]
    offsets = row_offsets(star, len(directions))
    for first in range(0, len(directions), STARS_AT_ONCE):
        last = min(first + STARS_AT_ONCE, len(directions))
        rows = slice(int(offsets[first]), int(offsets[last]))
        nearest = _nearest_first(star[rows] - first, neighbour[rows], both[rows])
        neighbour[rows], both[rows] = neighbour[rows][nearest], both[rows][nearest]
    index = Index({"star_offsets": offsets}, {"radius_rad": radius_rad})
    return AngularReferenceSets(star, neighbour, both, index)


def _nearest_first(
    star: NDArray[np.int32], neighbour: NDArray[np.int32], separation_rad: Array
) -> NDArray[np.int64]:
    """Return the order of (star, separation, neighbour); the stars ascend already."""
    order = np.argsort(separation_rad)
    order = order[stable_order(star[order], STARS_AT_ONCE)]
    same = np.diff(separation_rad[order]) == 0.0
    if bool(np.any(same & (np.diff(star[order]) == 0))):
        order = np.lexsort((neighbour, separation_rad, star))
    return order


KIND = ProductKind(
    name="hausdorff_angular",
    make=lambda inputs, section: angular_reference_sets(
        inputs.directions, section.reach_rad(inputs)
    ),
    section=HausdorffAngular,
    count=lambda inputs, section: neighbour_extent(inputs, section.reach_rad(inputs)),
)
