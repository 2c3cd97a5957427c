"""Radial and cyclic patterns: the rings and the sectors around every star with neighbours in.

Rings do not change as the camera turns. Sectors turn with it, so their bit pattern is brought
to the smallest of its cyclic shifts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.geometry.patterns import cyclic_shifts, ring_of, sector_of
from starcat.products.hausdorff_angular import AngularReferenceSets, angular_reference_sets
from starcat.products.index import Index, Ragged, row_offsets, sorted_unique, stable_order
from starcat.products.neighbours import position_angles


@dataclass(frozen=True)
class RadialPatterns:
    """The pattern of every star; a row is one star."""

    star: NDArray[np.int32]  # shape (N,): rows of the star table, ascending: all of them
    rings: Ragged  # occupied rings as `ring_of` numbers them, ascending, each once
    # shape (N,): a bit per occupied sector, the smallest of the cyclic shifts; 0 without neighbours
    sector_pattern: NDArray[np.int32]
    # datasets ``ring_offsets``, int64, shape (rings + 1,) and ``ring_rows``, int32: the rows with
    # ring r, ascending, are ``ring_rows[ring_offsets[r]:ring_offsets[r + 1]]``. Attributes
    # ``radius_rad``, ``rings``, ``sectors``.
    index: Index


def radial_patterns(
    directions: Array, radius_rad: float, *, rings: int, sectors: int
) -> RadialPatterns:
    """Find the radial and the cyclic pattern of every star.

    1 to 31 sectors; ValueError for what is out of range.

    Sectors are counted counter-clockwise from the nearest neighbour, of equally near ones the
    first. A star at the same place is in ring 0 and, having no position angle, in no sector.

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
    row, ring = np.divmod(sorted_unique(sets.star * np.int64(rings) + ring), rings)
    order = stable_order(ring, rings)
    lookup: dict[str, NDArray[Any]] = {
        "ring_offsets": row_offsets(ring[order], rings),
        "ring_rows": row[order].astype(np.int32),
    }
    occupied = _sectors(directions, sets, sectors)
    return RadialPatterns(
        np.arange(count, dtype=np.int32),
        Ragged(row_offsets(row, count), ring.astype(np.int32)),
        cyclic_shifts(occupied, sectors).min(axis=0).astype(np.int32),
        Index(lookup, {"radius_rad": radius_rad, "rings": rings, "sectors": sectors}),
    )


def _sectors(directions: Array, sets: AngularReferenceSets, sectors: int) -> NDArray[np.int64]:
    """Return the occupied sectors of every star, bit 0 from its nearest neighbour on."""
    apart = sets.separation_rad > 0.0
    star = sets.star[apart]
    _, first, row = np.unique(star, return_index=True, return_inverse=True)
    angle = position_angles(directions, star, sets.neighbour[apart])
    sector = sector_of(angle - angle[first][row], sectors)
    occupied = np.zeros((len(directions), sectors), dtype=np.bool_)
    occupied[star, sector] = True
    return np.asarray(occupied @ (1 << np.arange(sectors, dtype=np.int64)))
