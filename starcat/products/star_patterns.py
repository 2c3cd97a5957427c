"""Patterns of every star's neighbours: the cells of a grid, or the rings and sectors, they occupy.

For a grid the neighbours are projected onto the plane that touches the sphere at the star and
turned so that a chosen one, the alignment star, lies on the +x axis. Rings do not change as the
camera turns; sectors are counted from the nearest neighbour. A look-up leads from a cell or ring
to the patterns that have it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Directions
from starcat.geometry.patterns import cell_of, cyclic_shifts, ring_of, sector_of
from starcat.products.index import Index, Ragged, row_offsets, sorted_unique, stable_order
from starcat.products.neighbours import (
    AngularReferenceSets,
    angular_reference_sets,
    position_angles,
)


@dataclass(frozen=True)
class GridPatterns:
    """The pattern of every star that has an alignment star; a row is one star."""

    star: NDArray[np.int32]  # shape (M,): rows of the star table, ascending
    # shape (M,): the nearest neighbour outside the buffer; of equally near ones the first
    alignment_star: NDArray[np.int32]
    cells: Ragged  # occupied cells as `cell_of` numbers them, ascending, each once
    # datasets ``cell_offsets``, int64, shape (cells + 1,) and ``cell_rows``, int32: the rows whose
    # pattern has cell c, ascending, are ``cell_rows[cell_offsets[c]:cell_offsets[c + 1]]``
    index: Index


def grid_patterns(
    directions: Directions, radius_rad: float, *, buffer_rad: float, cells_per_side: int
) -> GridPatterns:
    """Find the grid pattern of every star.

    Neighbours within the buffer, itself included, are passed over. A star without a neighbour
    between buffer and radius (below pi / 2) has no row.

    The alignment star lies exactly on the +x axis, which in a grid of an even number of cells
    is the lower edge of its row: an observed pattern has to put it at y = 0, not near it.

    Padgett and Kreutz-Delgado 1997, "A grid algorithm for autonomous star identification",
    IEEE Transactions on Aerospace and Electronic Systems 33, 202.
    """
    _check(radius_rad, buffer_rad, cells_per_side)
    sets = angular_reference_sets(directions, radius_rad)
    beyond = sets.separation_rad > buffer_rad
    star, neighbour = sets.star[beyond], sets.neighbour[beyond]
    # The nearest comes first.
    is_first = np.ones(len(star), dtype=bool)
    np.not_equal(star[1:], star[:-1], out=is_first[1:])
    first = np.flatnonzero(is_first)
    row = np.cumsum(is_first) - 1
    angle = position_angles(directions, star, neighbour)
    turn = angle - angle[first][row]
    distance = np.tan(sets.separation_rad[beyond])
    cell = cell_of(distance * np.cos(turn), distance * np.sin(turn), radius_rad, cells_per_side)
    cells, lookup = _tables("cell", row, cell, len(first), cells_per_side**2)
    parameters = {
        "radius_rad": radius_rad,
        "buffer_rad": buffer_rad,
        "cells_per_side": cells_per_side,
    }
    return GridPatterns(star[first], neighbour[first], cells, Index(lookup, parameters))


def _tables(
    name: str, row: NDArray[np.int64], cell: NDArray[np.int64], rows: int, count: int
) -> tuple[Ragged, dict[str, NDArray[Any]]]:
    """Return the occupied cells (or rings) of each row, and the rows of each of ``count`` cells."""
    row, cell = np.divmod(sorted_unique(row * count + cell), count)
    order = stable_order(cell, count)
    lookup: dict[str, NDArray[Any]] = {
        f"{name}_offsets": row_offsets(cell[order], count),
        f"{name}_rows": row[order].astype(np.int32),
    }
    return Ragged(row_offsets(row, rows), cell.astype(np.int32)), lookup


def _check(radius_rad: float, buffer_rad: float, cells_per_side: int) -> None:
    if not 0.0 < radius_rad < 0.5 * np.pi:
        raise ValueError(f"radius_rad is {radius_rad}; expected between 0 and pi / 2")
    if not buffer_rad >= 0.0:
        raise ValueError(f"buffer_rad is {buffer_rad}; expected 0 or more")
    if not 1 <= cells_per_side <= 46_340:
        raise ValueError(f"cells_per_side is {cells_per_side}; expected 1 to 46340")


@dataclass(frozen=True)
class RadialPatterns:
    """The pattern of every star; a row is one star."""

    star: NDArray[np.int32]  # shape (N,): rows of the star table, ascending: all of them
    rings: Ragged  # occupied rings as `ring_of` numbers them, ascending, each once
    # shape (N,): a bit per occupied sector, the smallest of the cyclic shifts; 0 without neighbours
    sector_pattern: NDArray[np.int32]
    index: Index  # datasets ``ring_offsets`` and ``ring_rows``, as those of the cells


def radial_patterns(
    directions: Directions, radius_rad: float, *, rings: int, sectors: int
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
    occupied_rings, lookup = _tables("ring", sets.star.astype(np.int64), ring, count, rings)
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
