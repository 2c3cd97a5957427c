"""The product ``radial``: the rings and the sectors that every star's neighbours occupy.

Rings do not change as the camera turns; sectors are counted from the nearest neighbour. A look-up
leads from a ring to the patterns that have it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from starcat.arrays import Directions
from starcat.database.products.counting import distinct_cells
from starcat.database.products.hausdorff_angular import AngularReferenceSets, angular_reference_sets
from starcat.database.products.index import Index, Ragged, inverted_lists
from starcat.database.products.kind import (
    HALF_FIELD,
    Extent,
    ProductInputs,
    ProductKind,
    ProductSection,
)
from starcat.database.products.neighbours import position_angles
from starcat.geometry.patterns import cyclic_shifts, ring_of, sector_of
from starcat.sections import SmallDeg


class Radial(ProductSection):
    """Ring and sector features of the radial and cyclic method."""

    radius_deg: SmallDeg | None = Field(
        None, description=f"how far a star of the pattern may be; {HALF_FIELD}"
    )
    rings: int = Field(60, ge=1, le=10_000, description="rings between the star and the radius")
    sectors: int = Field(16, ge=1, le=30, description="sectors of the full turn")


@dataclass(frozen=True)
class RadialPatterns:
    """The pattern of every star; a row is one star."""

    star: NDArray[np.int32]  # shape (N,): rows of the star table, ascending: all of them
    rings: Ragged  # occupied rings as `ring_of` numbers them, ascending, each once
    # shape (N,): a bit per occupied sector, the smallest of the cyclic shifts; 0 without neighbours
    sector_pattern: NDArray[np.int32]
    index: Index  # datasets ``ring_offsets`` and ``ring_rows``, like those of the cells


def radial_patterns(
    directions: Directions, radius_rad: float, *, rings: int, sectors: int
) -> RadialPatterns:
    """Find the radial and the cyclic pattern of every star.

    1 to 31 sectors; ValueError for a value that is out of range.

    Sectors are counted counter-clockwise from the nearest neighbour, the first of several equally
    near ones. A star at the same place is in ring 0 and, without a position angle, in no sector.

    Zhang, Wei and Jiang 2008, "Full-sky autonomous star identification based on radial and
    cyclic features of star pattern", Image and Vision Computing 26, 891.
    """
    if not radius_rad > 0.0:
        raise ValueError(f"radius_rad is {radius_rad}; expected more than 0")
    if rings < 1:
        raise ValueError(f"rings is {rings}; expected at least 1")
    if not 1 <= sectors <= 31:
        raise ValueError(f"sectors is {sectors}; expected 1 to 31")
    count = len(directions)
    sets = angular_reference_sets(directions, radius_rad)
    ring = ring_of(sets.separation_rad, radius_rad, rings)
    occupied_rings, lookup = inverted_lists("ring", sets.star.astype(np.int64), ring, count, rings)
    occupied = _sectors(directions, sets, sectors)
    return RadialPatterns(
        np.arange(count, dtype=np.int32),
        occupied_rings,
        cyclic_shifts(occupied, sectors).min(axis=0).astype(np.int32),
        Index(lookup, {"radius_rad": radius_rad, "rings": rings, "sectors": sectors}),
    )


def _sectors(directions: Directions, sets: AngularReferenceSets, sectors: int) -> NDArray[np.int64]:
    """Return the occupied sectors of every star, bit 0 from its nearest neighbour on."""
    apart = sets.separation_rad > 0.0
    star = sets.star[apart]
    _, first, row = np.unique(star, return_index=True, return_inverse=True)
    angle = position_angles(directions, star, sets.neighbour[apart])
    sector = sector_of(angle - angle[first][row], sectors)
    occupied = np.zeros((len(directions), sectors), dtype=np.bool_)
    occupied[star, sector] = True
    return np.asarray(occupied @ (1 << np.arange(sectors, dtype=np.int64)))


def _make(inputs: ProductInputs, section: Radial) -> RadialPatterns:
    radius = inputs.radius_rad(section.radius_deg)
    return radial_patterns(inputs.directions, radius, rings=section.rings, sectors=section.sectors)


def _count(inputs: ProductInputs, section: Radial) -> Extent:
    near, stars = inputs.neighbourhoods, len(inputs.directions)
    radius, rings = inputs.radius_rad(section.radius_deg), section.rings
    share = (2.0 * np.arange(rings) + 1.0) / rings**2
    occupied = float(distinct_cells(near.within(radius), share) * stars)
    return Extent(float(stars), {"rings": occupied}, rings, near.total(radius))


KIND = ProductKind(name="radial", make=_make, section=Radial, count=_count, parquet_factor=0.25)
