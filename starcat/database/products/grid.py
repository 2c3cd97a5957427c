"""The product ``grid``: the cells of a grid that every star's neighbours occupy.

The neighbours are projected onto the plane that touches the sphere at the star and turned so that
a chosen one, the alignment star, lies on the +x axis. A look-up leads from a cell to the patterns
that have it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from starcat.arrays import Directions
from starcat.database.products.counting import distinct_cells
from starcat.database.products.hausdorff_angular import angular_reference_sets
from starcat.database.products.index import Index, Ragged, inverted_lists
from starcat.database.products.kind import (
    HALF_FIELD,
    Extent,
    ProductInputs,
    ProductKind,
    ProductSection,
)
from starcat.database.products.neighbours import position_angles
from starcat.geometry.patterns import cell_of
from starcat.sections import PlanarDeg


class Grid(ProductSection):
    """Bit patterns of the grid method."""

    radius_deg: PlanarDeg | None = Field(
        None, description=f"half the side of the pattern; {HALF_FIELD}"
    )
    buffer_deg: float = Field(
        0.3, ge=0.0, le=80.0, description="the star that turns the pattern is not nearer than this"
    )
    cells_per_side: int = Field(40, ge=2, le=1000, description="cells along one side")


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
    cells, lookup = inverted_lists("cell", row, cell, len(first), cells_per_side**2)
    parameters = {
        "radius_rad": radius_rad,
        "buffer_rad": buffer_rad,
        "cells_per_side": cells_per_side,
    }
    return GridPatterns(star[first], neighbour[first], cells, Index(lookup, parameters))


def _check(radius_rad: float, buffer_rad: float, cells_per_side: int) -> None:
    if not 0.0 < radius_rad < 0.5 * np.pi:
        raise ValueError(f"radius_rad is {radius_rad}; expected between 0 and pi / 2")
    if not buffer_rad >= 0.0:
        raise ValueError(f"buffer_rad is {buffer_rad}; expected 0 or more")
    if not 1 <= cells_per_side <= 46_340:
        raise ValueError(f"cells_per_side is {cells_per_side}; expected 1 to 46340")


def _count(inputs: ProductInputs, section: Grid) -> Extent:
    near, stars = inputs.neighbourhoods, len(inputs.directions)
    radius, cells = inputs.radius_rad(section.radius_deg), section.cells_per_side**2
    around = near.within(radius) - near.within(float(np.radians(section.buffer_deg)))
    # The circle of the neighbours does not fill the square.
    occupied = distinct_cells(around, np.full(1, 4.0 / (np.pi * cells))) * stars
    rows = float(stars * (around > 0.0).mean())
    return Extent(rows, {"cells": float(occupied)}, cells, near.total(radius))


KIND = ProductKind(
    name="grid",
    make=lambda inputs, section: grid_patterns(
        inputs.directions,
        inputs.radius_rad(section.radius_deg),
        buffer_rad=float(np.radians(section.buffer_deg)),
        cells_per_side=section.cells_per_side,
    ),
    section=Grid,
    count=_count,
)
