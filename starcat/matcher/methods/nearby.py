"""Candidates near a prior attitude: triangles of stars, each near where the prior predicts it.

Nothing is looked up. A centroid may be the stars around its predicted direction, so that the
separations between those of three centroids tell which triangle they are.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.geometry.attitude import determinant
from starcat.matcher.budget import LOOKUP
from starcat.matcher.chance import MIN_STARS
from starcat.matcher.database import Database
from starcat.matcher.methods.candidates import Candidates
from starcat.matcher.methods.pairs import side_tolerance_rad
from starcat.matcher.observation import Observation
from starcat.matcher.ways import compatible_pairs

Rows = NDArray[np.int64]

MOST_CENTROIDS = 12
"""Centroids that triangles are made of; of more, some are left out, evenly in their order."""

MOST_TRIANGLES = 40
"""Triangles of centroids that are compared with stars."""

MOST_PAIRS = 250
"""Pairs of a centroid and a star near its predicted direction that are compared with each other."""

ROUNDING = 1e-20
"""Square of a difference of two cosines that is due to their rounding, and much more."""

MOST_STARS = 1500
"""Stars around a prior attitude; where there are more, looking up patterns is quicker."""

USED_AGAIN = 0.3
"""What the area of a triangle counts, once for every triangle before that it shares a centroid
with."""


def candidates(
    observation: Observation, database: Database, predicted: Array, near: Rows, reach_rad: float
) -> Iterator[Candidates]:
    """Propose the triangles of stars that are near their predicted places.

    Parameters
    ----------
    observation : Observation
        The frame.
    database : Database
        The stars.
    predicted : ndarray of float64, shape (N, 3)
        ICRS directions of the centroids with the prior attitude.
    near : ndarray of int64, shape (M,)
        Rows of the stars that may be in the frame.
    reach_rad : float
        Largest separation of a star from the predicted direction of its centroid.

    Yields
    ------
    Candidates
        All stars first that agree with one, where few come into question. Then three stars each,
        of the same handedness as the centroids. Large triangles come first,
        and those whose centroids were in none before: a false spot spoils one of them only.
    """
    stars = database.directions[near]
    may_be = predicted @ stars.T >= math.cos(min(math.pi, reach_rad))
    if observation.mag is not None and observation.noise_mag is not None:
        may_be &= compatible_pairs(observation.mag, database.mag[near], observation.noise_mag)
    tolerance_rad = side_tolerance_rad(observation)
    centroid, star = may_be.nonzero()
    if len(centroid) <= MOST_PAIRS:
        observation.budget.spend(len(centroid))
        rigid = _largest_rigid(observation.body[centroid], stars[star], tolerance_rad)
        if len(rigid) >= MIN_STARS:
            yield Candidates(centroid[rigid][None], near[star[rigid]][None])
    count = len(observation)
    chosen = np.arange(min(count, MOST_CENTROIDS))
    if count > MOST_CENTROIDS:
        chosen = chosen * (count - 1) // (MOST_CENTROIDS - 1)
    for triangle in _disjoint_first(chosen, observation.body):
        rows = [may_be[n].nonzero()[0] for n in triangle]
        observation.budget.spend(LOOKUP)
        found = _same_triangles(
            observation.body[triangle],
            [stars[row] for row in rows],
            tolerance_rad,
        )
        if found:
            columns = [near[row[place]] for row, place in zip(rows, found, strict=True)]
            centroids = np.array([triangle] * len(columns[0]))
            yield Candidates(centroids, np.array(columns).T)


def _largest_rigid(body: Array, stars: Array, tolerance_rad: float) -> Rows:
    """Return the pairs of a centroid and a star that are as far from one of them as their stars.

    Of all pairs that one is taken which the most others agree with.
    """
    seen, true = body @ body.T, stars @ stars.T
    # The cosine of a separation changes by its sine. A centroid is as far as nothing from itself,
    # so that of its stars there is one.
    true -= seen
    true *= true
    seen *= seen
    agrees = true <= tolerance_rad**2 * (1.0 - seen) + ROUNDING
    if not len(agrees):
        return np.empty(0, dtype=np.int64)
    best = agrees[int(agrees.sum(axis=1).argmax())]
    return np.asarray(best.nonzero()[0])


def _disjoint_first(chosen: Rows, body: Array) -> Iterator[list[int]]:
    """Return triangles of centroids, the largest first, and those without a common centroid."""
    triples = chosen[_triples(len(chosen))]
    corners = body[triples]
    sides = corners[:, 1:] - corners[:, :1]
    # The square of twice the area, by the determinant of Gram.
    along = np.einsum("nij,nkj->nik", sides, sides)
    weight = along[:, 0, 0] * along[:, 1, 1] - along[:, 0, 1] ** 2
    for _ in range(min(len(triples), MOST_TRIANGLES)):
        best = int(weight.argmax())
        triangle = triples[best].tolist()
        yield triangle
        is_used = np.zeros(len(body), dtype=bool)
        is_used[triangle] = True
        weight[is_used[triples].any(axis=1)] *= USED_AGAIN**2
        weight[best] = -1.0


@lru_cache(maxsize=MOST_CENTROIDS)
def _triples(count: int) -> Rows:
    return np.array(list(combinations(range(count), 3)))


def _same_triangles(body: Array, stars: list[Array], tolerance_rad: float) -> list[Rows]:
    """Return the triangles with the sides of an observed one, as places in the lists of stars.

    One array a corner; none where there is no such triangle.
    """
    a, b, c = stars
    first, second = np.nonzero(_is_apart(a @ b.T, body[0], body[1], tolerance_rad))
    fits = _is_apart(a @ c.T, body[0], body[2], tolerance_rad)[first]
    fits &= _is_apart(b @ c.T, body[1], body[2], tolerance_rad)[second]
    pair, third = np.nonzero(fits)
    first, second = first[pair], second[pair]
    if not len(pair):
        return []
    corners = np.array([a[first], b[second], c[third]])
    same = np.linalg.det(corners.transpose(1, 0, 2)) * determinant(body) > 0.0
    return [first[same], second[same], third[same]] if same.any() else []


def _is_apart(cosines: Array, one: Array, other: Array, tolerance_rad: float) -> NDArray[np.bool_]:
    """Return which pairs of stars are as far apart as two centroids."""
    chord = one - other
    apart = 2.0 * math.asin(min(1.0, 0.5 * math.sqrt(float(chord @ chord))))
    low, high = max(0.0, apart - tolerance_rad), min(math.pi, apart + tolerance_rad)
    return np.asarray((cosines <= math.cos(low)) & (cosines >= math.cos(high)))
