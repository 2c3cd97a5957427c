"""Identification by star pairs: three observed separations, looked up in the K-vector.

For an observed triangle the pairs that fit two of its sides are joined at their common star;
the third side and the handedness leave few triangles of stars, each of which is a candidate.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from starcat.matcher.database import Database, PairIndex
from starcat.sphere import separation

Array = NDArray[np.float64]
Triangle = tuple[int, int, int]


def candidate_triangles(
    body: Array, triangle: Triangle, database: Database, tolerance_rad: float
) -> NDArray[np.int64]:
    """Return the triangles of stars that an observed triangle may be.

    Parameters
    ----------
    body : ndarray of float64, shape (N, 3)
        Directions of the centroids in the camera frame.
    triangle : tuple of int
        Three rows of ``body``.
    database : Database
        The stars and their pairs.
    tolerance_rad : float
        Largest difference of a separation, radians.

    Returns
    -------
    ndarray of int64, shape (C, 3)
        Rows of the stars, in the order of ``triangle``; the same handedness.
    """
    a, b, c = (body[k] for k in triangle)
    ab, ac, bc = (float(separation(u, v)) for u, v in ((a, b), (a, c), (b, c)))
    first_b, star_b = _directed(database.pairs, ab, tolerance_rad)
    first_c, star_c = _directed(database.pairs, ac, tolerance_rad)
    order = np.argsort(first_c, kind="stable")
    low = np.searchsorted(first_c[order], first_b, side="left")
    high = np.searchsorted(first_c[order], first_b, side="right")
    count = high - low
    left = np.repeat(np.arange(len(first_b)), count)
    step = np.arange(len(left)) - np.repeat(np.cumsum(count) - count, count)
    right = order[np.repeat(low, count) + step]
    stars = np.stack([first_b[left], star_b[left], star_c[right]], axis=-1)
    u, v, w = (database.directions[stars[:, k]] for k in range(3))
    fits = np.abs(separation(v, w) - bc) <= tolerance_rad
    handed = np.einsum("ij,ij->i", np.cross(u, v), w) * float(np.cross(a, b) @ c) > 0.0
    return np.asarray(stars[fits & handed], dtype=np.int64)


def _directed(
    pairs: PairIndex, separation_rad: float, tolerance_rad: float
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the pairs of about a separation, each in both directions."""
    rows = pairs.kvector.exact(separation_rad - tolerance_rad, separation_rad + tolerance_rad)
    i, j = pairs.i[rows], pairs.j[rows]
    return np.concatenate([i, j]), np.concatenate([j, i])


def observed_triangles(body: Array, most: int) -> Iterator[Triangle]:
    """Return triangles of centroids, those that are least alike first.

    Parameters
    ----------
    body : ndarray of float64, shape (N, 3)
        Directions of the centroids, N >= 3.
    most : int
        How many triangles at the most.

    Yields
    ------
    tuple of int
        Rows of ``body``. Neighbouring triangles in the list share few centroids, so a false
        star spoils few of them.
    """
    count = len(body)
    made = 0
    for wide in range(1, count - 1):
        for narrow in range(1, count - wide):
            for first in range(count - wide - narrow):
                yield first, first + narrow, first + narrow + wide
                made += 1
                if made >= most:
                    return
