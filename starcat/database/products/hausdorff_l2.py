"""The product ``hausdorff_l2``: each star's neighbours by planar distance over the smallest one.

These ratios do not even depend on the camera's focal length. Each row holds a neighbour of a star.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from starcat.arrays import Array, Directions
from starcat.database.products.hausdorff_angular import angular_reference_sets
from starcat.database.products.index import Index, row_offsets
from starcat.database.products.kind import HALF_FIELD, ProductKind, ProductSection, neighbour_extent
from starcat.sections import PlanarDeg


class HausdorffL2(ProductSection):
    """Planar distances around each star over the smallest one (S1)."""

    radius_deg: PlanarDeg | None = Field(
        None, description=f"how far a star of the set may be; {HALF_FIELD}"
    )


@dataclass(frozen=True)
class PlanarReferenceSets:
    """Every star's neighbours by planar distance; a row is one neighbour of one star."""

    star: NDArray[np.int32]  # shape (M,): rows of the star table, ascending
    neighbour: NDArray[np.int32]  # shape (M,): rows of the star table
    # shape (M,): gnomonic distance over the star's smallest one, 1 or more, ascending within a star
    ratio: Array
    # datasets ``star_offsets`` as above, and ``smallest_distance``, float64, shape (N,): the
    # divisor, in units of the focal length, NaN for a star without rows; ``radius_rad``
    index: Index


def planar_reference_sets(directions: Directions, radius_rad: float) -> PlanarReferenceSets:
    """Find the ratios of the gnomonic distances around every star.

    Sorted by (star, ratio, neighbour); the radius is below pi / 2, where the tangent plane
    ends.

    On the plane that touches the sphere at the star, a neighbour lies at the tangent of its
    separation. Stars at the same place have distance 0 and are left out: the method divides by
    the smallest distance that is not 0. The star itself, the method's leading 0, has no row.

    Wang et al. 2020 (S1), eqs. 6, 9 and 12.
    """
    if not radius_rad < 0.5 * np.pi:
        raise ValueError(f"radius_rad is {radius_rad}; expected less than pi / 2")
    sets = angular_reference_sets(directions, radius_rad)
    apart = sets.separation_rad > 0.0
    star, neighbour = sets.star[apart], sets.neighbour[apart]
    distance = np.tan(sets.separation_rad[apart])
    offsets = row_offsets(star, len(directions))
    smallest = np.full(len(directions), np.nan)
    # The nearest comes first.
    smallest[np.diff(offsets) > 0] = distance[offsets[:-1][np.diff(offsets) > 0]]
    ratio = distance / smallest[star]
    # Ratios that differed may be equal after rounding, and equal ratios are in order of neighbour.
    order = np.lexsort((neighbour, ratio, star))
    index = Index(
        {"star_offsets": offsets, "smallest_distance": smallest}, {"radius_rad": radius_rad}
    )
    return PlanarReferenceSets(star, neighbour[order], ratio[order], index)


KIND = ProductKind(
    name="hausdorff_l2",
    make=lambda inputs, section: planar_reference_sets(
        inputs.directions, inputs.radius_rad(section.radius_deg)
    ),
    section=HausdorffL2,
    count=lambda inputs, section: neighbour_extent(inputs, inputs.radius_rad(section.radius_deg)),
)
