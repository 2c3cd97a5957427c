"""Thinning: which stars to keep so that they cover the sky evenly.

Rows are in order of preference, the brightest star first: of two stars that are worth the same, the
later one goes. A star's worth grows with its light, because a faint star that makes the sky even is
of no use where the sensor does not see it.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from starcat.arrays import Array, Directions
from starcat.database.products.tiling import FieldStars
from starcat.geometry.attitude import information_terms

BATCH = 0.1
"""Share of the stars, by the smallest cells, from which a round can drop stars."""

PRIOR = 1e-2
"""Information on each axis before any star, in units of a star's, so that a field without stars
has an error too: ten times the noise of a star."""

POWER = 4
"""Power of the variances that are added up. With this high power the sum nearly equals the variance
of the worst fields, and still distinguishes the others."""


def thin_by_cells(directions: Directions, mag: Array, count: int) -> NDArray[np.int64]:
    """Return the stars that stay when stars with small cells for their brightness are dropped.

    The cell of a star is the part of the sphere that is nearer to it than to any other. Each round
    computes the cells again and drops the stars with the smallest cell times light, but never two
    neighbours.

    Parameters
    ----------
    directions : ndarray of float64, shape (N, 3)
        Unit vectors, in order of preference.
    mag : ndarray of float64, shape (N,)
        Magnitudes.
    count : int
        Number of stars that stay.

    Returns
    -------
    ndarray of int64, shape (count,)
        Rows, ascending.

    References
    ----------
    Bauer 1998, "Distribution of points on a sphere with application to star catalogs".
    """
    rows = np.arange(len(directions))
    light = 10.0 ** (-0.4 * mag)
    while len(rows) > count:
        area, corners = cell_areas(directions[rows])
        # Equal worth goes by row: the later one is the smaller.
        rank = np.empty(len(rows), dtype=np.int64)
        rank[np.lexsort((-rows, area * light[rows]))] = np.arange(len(rows))
        least = rank.copy()
        for corner, next_corner in ((0, 1), (1, 2), (2, 0)):
            a, b = corners[:, corner], corners[:, next_corner]
            np.minimum.at(least, a, rank[b])
            np.minimum.at(least, b, rank[a])
        lowest = np.flatnonzero((least == rank) & (rank < max(1.0, BATCH * len(rows))))
        gone = lowest[np.argsort(rank[lowest])][: len(rows) - count]
        rows = np.delete(rows, gone)
    return rows


def cell_areas(directions: Directions) -> tuple[Array, NDArray[np.int64]]:
    """Return the areas of the cells of Voronoi's diagram, and the triangles of neighbours.

    The areas have shape (N,), the rows of the triangles' corners shape (T, 3). Of stars at the same
    place only one has a cell. If the directions span no volume, all have the same area and no
    neighbours.

    A facet of the convex hull is a triangle of neighbours, and its normal the corner that their
    cells share. It makes an isosceles triangle with each side, whose halves belong to the ends.
    """
    areas = np.zeros(len(directions))
    try:
        hull = scipy.spatial.ConvexHull(directions)
    except scipy.spatial.QhullError:
        return np.full(len(directions), 4.0 * np.pi / len(directions)), np.empty((0, 3), np.int64)
    centre, corners = hull.equations[:, :3], hull.simplices.astype(np.int64)
    ends = [directions[corners[:, k]] for k in range(3)]
    normal = np.cross(ends[1] - ends[0], ends[2] - ends[0])
    turn = np.sign(np.einsum("ij,ij->i", normal, centre))
    for k in range(3):
        a, b = ends[k], ends[(k + 1) % 3]
        volume = turn * np.einsum("ij,ij->i", np.cross(a, b), centre)
        dots = [np.einsum("ij,ij->i", p, q) for p, q in ((a, b), (b, centre), (centre, a))]
        half = np.arctan2(volume, 1.0 + sum(dots))
        areas += np.bincount(corners[:, k], half, len(areas))
        areas += np.bincount(corners[:, (k + 1) % 3], half, len(areas))
    # No cell is larger than half of the sphere; the angles of wide triangles lack whole turns.
    areas += 2.0 * np.pi * ((areas < -1e-6).astype(np.float64) - (areas > 2.0 * np.pi + 1e-6))
    return areas, corners


def thin_by_information(
    fields: FieldStars, directions: Directions, mag: Array, reach_rad: float, count: int
) -> NDArray[np.int64]:
    """Return the stars that stay when stars are dropped whose loss harms the worst fields least.

    The harm is the growth of the sum, over all fields, of the fourth power of the variance across
    the boresight, times the star's light. Stars are dropped one at a time.

    Parameters
    ----------
    fields : FieldStars
        Fields and the stars in each.
    directions : ndarray of float64, shape (N, 3)
        Unit vectors, in order of preference.
    mag : ndarray of float64, shape (N,)
        Magnitudes.
    reach_rad : float
        How far from its boresight a field reaches.
    count : int
        Number of stars that stay.

    Returns
    -------
    ndarray of int64, shape (count,)
        Rows, ascending.
    """
    precision = _Precision.of(fields, directions, reach_rad)
    light = (10.0 ** (-0.4 * (mag - mag.min()))).tolist()
    # The later star comes first among equals.
    heap = [(precision.harm(star) * light[star], -star) for star in range(len(directions))]
    heapq.heapify(heap)
    kept = np.ones(len(directions), dtype=bool)
    for _ in range(len(directions) - count):
        # Harm grows while other stars are dropped: compute it again only for the first star.
        while (worth := precision.harm(-heap[0][1]) * light[-heap[0][1]]) > heap[0][0]:
            heapq.heapreplace(heap, (worth, heap[0][1]))
        _, gone = heapq.heappop(heap)
        precision.drop(-gone)
        kept[-gone] = False
    return np.flatnonzero(kept)


@dataclass(frozen=True, eq=False)
class _Precision:
    """Information that the remaining stars give on the attitude of each field."""

    total: Array  # (F, 6): entries of the information matrix as `information_terms` has them
    cost: Array  # (F,): fourth power of the variance across the boresight
    term: Array  # (M, 6): what one star adds to one field, by star
    field: NDArray[np.int64]  # (M,)
    first: list[int]  # (N + 1,): where the fields of each star begin

    @classmethod
    def of(cls, fields: FieldStars, directions: Directions, reach_rad: float) -> _Precision:
        """Return the precision with all stars."""
        by_star = np.argsort(fields.star_index, kind="stable")
        entries = information_terms(fields.seen(directions)).items()
        # The turn about the boresight counts in units of the reach: no entry is small in a narrow
        # field, and the error across the boresight is the same.
        unit = (1.0, 1.0, 1.0 / float(np.sin(min(reach_rad, 0.5 * np.pi))))
        term = np.stack([entry * unit[i] * unit[j] for (i, j), entry in entries], axis=-1)
        count, field = len(fields.boresights), fields.field
        total: Array = np.stack(
            [np.bincount(field, component, count) for component in term.T], axis=-1
        )
        total = total + np.array(3 * [PRIOR] + 3 * [0.0])
        fields_per_star = np.bincount(fields.star_index, minlength=len(directions))
        first = np.concatenate([[0], np.cumsum(fields_per_star)])
        return cls(total, _cost(total), term[by_star], field[by_star], first.tolist())

    def harm(self, star: int) -> float:
        """Return how much the costs of all fields grow without a star."""
        of_star = slice(self.first[star], self.first[star + 1])
        field = self.field[of_star]
        return float((_cost(self.total[field] - self.term[of_star]) - self.cost[field]).sum())

    def drop(self, star: int) -> None:
        """Take a star out of its fields."""
        of_star = slice(self.first[star], self.first[star + 1])
        field = self.field[of_star]
        self.total[field] -= self.term[of_star]
        self.cost[field] = _cost(self.total[field])


def _cost(total: Array) -> Array:
    xx, yy, zz, xy, xz, yz = total.T
    of_x, of_y = yy * zz - yz * yz, xx * zz - xz * xz
    determinant = xx * of_x - xy * (xy * zz - xz * yz) + xz * (xy * yz - yy * xz)
    variance = (of_x + of_y) / (2.0 * determinant)
    return np.asarray(variance**POWER)
