"""The order in which triangles of centroids are looked up, and the ones that are left out.

Three methods share this stage. Triangles of the brightest stars are first where magnitudes are
known, as in S3; otherwise the most compact ones are, which in a crowded frame are taken from all
over it. The order of S4, by the radius of the inscribed circle, can be chosen. Triangles with a
short side or a narrow angle are left out, because the two centroids of a double star, or three
centroids in a line, identify little.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.matcher.observation import Observation
from starcat.matcher.settings import TriangleOrder

LEAST_ANGLE_DEG = 4.0
"""Smallest angle of a triangle that is tried at all."""

NEIGHBOURS = 20
"""Number of the nearest centroids that a centroid makes triangles with in the order ``spread``."""

SPREAD_CENTROIDS = 400
"""Largest number of centroids of that order; more would take seconds to put in order."""


def select_triangles(observation: Observation) -> NDArray[np.intp]:
    """Return the triangles of a frame in the order in which they are to be looked up.

    Rows of the observation, shape (T, 3), ascending within a triangle.
    """
    selection = observation.settings.selection
    count = min(len(observation), selection.most_centroids)
    is_crowded = count < len(observation) and observation.mag is None
    if selection.order == "spread" or (selection.order == "auto" and is_crowded):
        return _spread(observation, selection)
    stars = _triples(count)
    a, b, c = _sides(observation.separation_rad, stars)
    side = selection.min_side_px / observation.camera.focal_length_px
    good = is_well_shaped(a, b, c, side, np.radians(selection.min_angle_deg))
    known = observation.mag is not None
    if selection.order == "brightness" or (selection.order == "auto" and known):
        order = np.arange(len(stars))
    elif selection.order == "inradius":
        order = np.argsort(-_squared_inradius(a, b, c), kind="stable")
    else:
        order = np.argsort(np.maximum(np.maximum(a, b), c), kind="stable")
    good = good[order]
    if count > selection.few_centroids:
        return np.asarray(stars[order[good]])
    poor = is_well_shaped(a, b, c, observation.tolerance_rad, np.radians(LEAST_ANGLE_DEG))[order]
    return np.asarray(stars[np.concatenate([order[good], order[poor & ~good]])])


def _spread(observation: Observation, selection: TriangleOrder) -> NDArray[np.intp]:
    """Return triangles of near centroids from all over a frame, a round of all centroids at a time.

    A database holds the triangles of the brightest stars of its fields. In a crowded frame most
    stars are fainter, and the compact triangles of one place are often of the same few stars: if
    one of these is faint, none of the triangles is held.
    """
    count = min(len(observation), SPREAD_CENTROIDS)
    apart = observation.separation_rad[:count, :count]
    most = min(NEIGHBOURS, count - 1)
    near = np.argsort(apart, axis=1, kind="stable")[:, 1 : most + 1]
    first, second = np.triu_indices(most, 1)
    owner = np.repeat(np.arange(count), len(first))
    stars = np.sort(
        np.stack([owner, near[:, first].ravel(), near[:, second].ravel()], axis=-1), axis=-1
    )
    i, j, k = stars.T
    _, fresh = np.unique((i * count + j) * count + k, return_index=True)
    owner, stars = owner[fresh], stars[fresh]
    a, b, c = _sides(apart, stars)
    side = selection.min_side_px / observation.camera.focal_length_px
    good = is_well_shaped(a, b, c, side, np.radians(selection.min_angle_deg))
    owner, stars = owner[good], stars[good]
    longest = np.maximum(np.maximum(a, b), c)[good]
    order = np.lexsort((longest, owner))
    own = owner[order]
    turn = np.arange(len(own)) - np.searchsorted(own, own)
    return np.asarray(stars[order][np.lexsort((longest[order], turn))])


def is_well_shaped(
    a: Array, b: Array, c: Array, min_side: float, min_angle_rad: float
) -> NDArray[np.bool_]:
    """Return which triangles have no short side and no narrow angle, shape (T,).

    Parameters
    ----------
    a, b, c : ndarray of float64, shape (T,)
        Sides, in the unit of ``min_side``.
    min_side : float
        Every side has to be longer.
    min_angle_rad : float
        Every angle has to be wider; below pi / 3. The narrowest is opposite the shortest side.

    Examples
    --------
    >>> is_well_shaped(*np.array([[3.0, 1.0], [4.0, 4.0], [5.0, 4.9]]), 2.0, 0.5)
    array([ True, False])
    """
    shortest = np.minimum(np.minimum(a, b), c)
    longest = np.maximum(np.maximum(a, b), c)
    middle = a + b + c - shortest - longest
    # The law of cosines for the angle opposite the shortest side.
    cosine = middle * middle + longest * longest - shortest * shortest
    wide = cosine < 2.0 * np.cos(min_angle_rad) * middle * longest
    return np.asarray((shortest > min_side) & wide)


def _sides(separation_rad: Array, stars: NDArray[np.intp]) -> tuple[Array, Array, Array]:
    """Return the sides opposite the first, second and third star of triangles."""
    i, j, k = stars.T
    return separation_rad[j, k], separation_rad[i, k], separation_rad[i, j]


def _squared_inradius(a: Array, b: Array, c: Array) -> Array:
    """Return the squared inradius (S4, eq. 7) of plane triangles."""
    half = 0.5 * (a + b + c)
    return (half - a) * (half - b) * (half - c) / half


@lru_cache(maxsize=64)
def _triples(count: int) -> NDArray[np.intp]:
    """Return all triples, those whose last member comes early first."""
    found = sorted(combinations(range(count), 3), key=lambda triple: triple[::-1])
    return np.array(found, dtype=np.intp).reshape(-1, 3)
