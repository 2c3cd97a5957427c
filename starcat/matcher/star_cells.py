"""Stars of a database near directions: in a cap, and by cells of the sky.

Most of the many candidates of a frame are wrong. With the cells it is quick to count the centroids
that each candidate explains. They are made when a database first needs them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Directions, Mask, Rows
from starcat.geometry.sphere import Zones, zones_of
from starcat.matcher.database import MatcherDatabase

MIN_SIDE = 0.02
"""Smallest side of a cell, in units of the sphere's radius: 1.1 degrees."""

SMALLEST_REACH = 0.25 * MIN_SIDE
"""Cells of the smallest side serve all reaches up to this."""

MANY_STARS = 15_000
"""Number of stars from which zones are searched; a product with all stars is faster for fewer."""


def stars_in_cap(database: MatcherDatabase, axis: Array, radius_rad: float) -> Rows:
    """Return the rows of the stars up to an angle from a direction, ascending."""
    if len(database.mag) >= MANY_STARS:
        return database.cached(_zones).near(axis, radius_rad)
    return (database.directions @ axis >= math.cos(radius_rad)).nonzero()[0]


def _zones(database: MatcherDatabase) -> Zones:
    return zones_of(database.directions)


@dataclass(frozen=True)
class StarCells:
    """Stars by the cells of a cubic grid that they lie in or near."""

    directions: Array  # unit vectors of the stars; shape (N, 3)
    side: float  # side of a cell, in units of the sphere's radius
    margin: float  # a star is listed in every cell that it is this near to
    keys: NDArray[np.int64]  # cells with stars, ascending; shape (C,)
    # The stars of cell c are ``rows[offsets[c]:offsets[c + 1]]``; shape (C + 1,).
    offsets: NDArray[np.int64]
    rows: NDArray[np.int64]

    def has_star(self, directions: Directions, reach_rad: float) -> Mask:
        """Return which directions have a star within reach."""
        is_near = np.zeros(len(directions), dtype=bool)
        is_near[self.near(directions, reach_rad)[0]] = True
        return is_near

    def near(self, directions: Directions, reach_rad: float) -> tuple[Rows, Rows]:
        """Return each pair of a direction and a star within reach, as rows of both.

        The reach is a chord: in units of the sphere's radius.
        """
        if reach_rad > self.margin:
            raise ValueError(f"reach_rad is {reach_rad}; these cells allow {self.margin}")
        key = _keys(directions, self.side)
        cell = np.minimum(np.searchsorted(self.keys, key), len(self.keys) - 1)
        there = np.flatnonzero(self.keys[cell] == key)
        run, row = rows_between(self.offsets[cell[there]], self.offsets[cell[there] + 1])
        query, star = there[run], self.rows[row]
        offset = directions[query] - self.directions[star]
        near = np.einsum("ij,ij->i", offset, offset) <= reach_rad * reach_rad
        return query[near], star[near]


def cells_for(database: MatcherDatabase, reach_rad: float) -> StarCells:
    """Return the cells of a database's stars for a reach, which are made once."""
    margin_rad = max(SMALLEST_REACH, 2.0 ** math.ceil(math.log2(reach_rad)))
    return database.cached(_of_database, margin_rad)


def _of_database(database: MatcherDatabase, reach_rad: float) -> StarCells:
    return star_cells(database.directions, reach_rad)


def star_cells(directions: Directions, reach_rad: float) -> StarCells:
    """Sort stars into cells."""
    side = max(MIN_SIDE, 4.0 * reach_rad)
    margin = 0.25 * side
    corners = np.array(list(product((-margin, margin), repeat=3)))
    count = len(directions)
    pairs = [_keys(directions + corner, side) * count + np.arange(count) for corner in corners]
    cell, rows = np.divmod(np.unique(np.concatenate(pairs)), count)
    keys, first = np.unique(cell, return_index=True)
    offsets = np.append(first, len(cell)).astype(np.int64)
    return StarCells(directions, side, margin, keys, offsets, rows)


def _keys(directions: Array, side: float) -> NDArray[np.int64]:
    """Return the cells of points, in the cube that holds the sphere and its margin."""
    across = int(2.0 / side) + 3
    x, y, z = np.floor((directions + 1.0) / side).astype(np.int64).T + 1
    return np.asarray((x * across + y) * across + z)


def rows_between(
    start: NDArray[np.integer[Any]], stop: NDArray[np.integer[Any]]
) -> tuple[Rows, Rows]:
    """Return run and row of each entry of several runs of rows, given their starts and stops."""
    count = stop - start
    run = np.repeat(np.arange(len(count)), count)
    return run, np.arange(len(run)) + np.repeat(start - np.cumsum(count) + count, count)
