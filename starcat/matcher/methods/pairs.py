"""Identification by star pairs (Zhang 2006) and by pyramids (Mortari et al. 2004).

For an observed triangle the pairs that fit two of its sides, found by the K-vector over the
separations, are joined at their common star; the third side and the handedness leave few
triangles of stars, each of which is a candidate. A pyramid is such a triangle with a fourth star
whose separations from all three agree. Both need the product ``pairs``.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from starcat.arrays import Rows
from starcat.geometry.sphere import separation
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.methods.triangle import select_triangles
from starcat.matcher.observation import Candidates, Observation
from starcat.matcher.settings import LOOKUP, MAX_TRIANGLES
from starcat.matcher.star_cells import rows_between

JOINED_A_STEP = 50
"""Number of pairs of stars that are joined with others in the time of a step."""


def pair_candidates(observation: Observation, database: MatcherDatabase) -> Iterator[Candidates]:
    """Propose triangles of stars, one batch per observed triangle.

    Zhang, Jiang et al. 2006, the improved triangle algorithm, a baseline of S2 and S4.
    """
    for number, triangle, stars in _triangles(observation, database):
        patterns = np.full(len(stars), number)
        yield Candidates(np.broadcast_to(triangle, stars.shape), stars, patterns, number)


def pyramid_candidates(observation: Observation, database: MatcherDatabase) -> Iterator[Candidates]:
    """Propose pyramids of four stars: a triangle and the first centroid that completes it.

    Mortari, Samaan, Bruccoleri and Junkins 2004, "The pyramid star identification technique",
    Navigation 51, 171.
    """
    for number, triangle, stars in _triangles(observation, database):
        centroids, pyramids = np.zeros(4, dtype=np.intp), np.zeros((0, 4), dtype=np.intp)
        others = np.setdiff1d(np.arange(len(observation)), triangle)
        for apex in others if len(stars) else ():
            centroids = np.append(triangle, apex)
            pyramids = _with_apex(stars, triangle, int(apex), observation, database)
            if len(pyramids):
                break
        patterns = np.full(len(pyramids), number)
        yield Candidates(np.broadcast_to(centroids, pyramids.shape), pyramids, patterns, number)


def _triangles(
    observation: Observation, database: MatcherDatabase
) -> Iterator[tuple[int, Rows, Rows]]:
    """Yield observed triangles, each with its number and the triangles of stars that it may be."""
    for number, triangle in enumerate(select_triangles(observation)[:MAX_TRIANGLES], 1):
        observation.budget.spend(LOOKUP)
        yield number, triangle, triangles_of_stars(triangle, observation, database)


def triangles_of_stars(triangle: Rows, observation: Observation, database: MatcherDatabase) -> Rows:
    """Return the triangles of stars that an observed triangle may be, shape (C, 3).

    Stars are in the order of the centroids, with the same handedness.
    """
    a, b, c = triangle
    apart, tolerance_rad = observation.separation_rad, observation.side_tolerance_rad
    first_b, star_b = directed_pairs(database, apart[a, b], tolerance_rad)
    first_c, star_c = directed_pairs(database, apart[a, c], tolerance_rad)
    order = np.argsort(first_c, kind="stable")
    first_c, star_c = first_c[order], star_c[order]
    row_b, row_c = _with_the_same_star(first_b, first_c, observation)
    v, w = database.directions[star_b[row_b]], database.directions[star_c[row_c]]
    fits = np.abs(separation(v, w) - apart[b, c]) <= tolerance_rad
    row_b, v, w = row_b[fits], v[fits], w[fits]
    u = database.directions[first_b[row_b]]
    handedness = np.einsum("ij,ij->i", np.cross(u, v), w)
    handed = handedness * np.linalg.det(observation.body[triangle]) > 0.0
    row_b, row_c = row_b[handed], row_c[fits][handed]
    return np.stack([first_b[row_b], star_b[row_b], star_c[row_c]], axis=-1).astype(np.intp)


def _with_the_same_star(
    stars: Rows, ascending: Rows, observation: Observation
) -> tuple[Rows, Rows]:
    """Return the places of each star in ``ascending`` rows; every place found costs steps."""
    low = np.searchsorted(ascending, stars, side="left")
    high = np.searchsorted(ascending, stars, side="right")
    joined = len(stars) + len(ascending) + int((high - low).sum())
    observation.budget.spend(joined // JOINED_A_STEP)
    return rows_between(low, high)


def directed_pairs(
    database: MatcherDatabase, separation_rad: float, tolerance_rad: float
) -> tuple[Rows, Rows]:
    """Return the first and second stars of pairs with about this separation, in both orders."""
    product = database.products["pairs"]
    index = product.kvector("separation_rad")
    rows = index.exact(separation_rad - tolerance_rad, separation_rad + tolerance_rad)
    i, j = product["i"][rows], product["j"][rows]
    return np.concatenate([i, j]), np.concatenate([j, i])


def _with_apex(
    stars: Rows, triangle: Rows, apex: int, observation: Observation, database: MatcherDatabase
) -> Rows:
    apex_rad = observation.separation_rad[triangle, apex]
    tolerance_rad = observation.side_tolerance_rad
    first, fourth = directed_pairs(database, float(apex_rad[0]), tolerance_rad)
    order = np.argsort(first, kind="stable")
    row, rank = _with_the_same_star(stars[:, 0], first[order], observation)
    pair = order[rank]
    u = database.directions
    fits = np.ones(len(row), dtype=bool)
    for corner in (1, 2):
        apart = separation(u[stars[row, corner]], u[fourth[pair]])
        fits &= np.abs(apart - apex_rad[corner]) <= tolerance_rad
    return np.column_stack([stars[row[fits]], fourth[pair[fits]]])
