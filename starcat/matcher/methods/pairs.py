"""Identification by star pairs: the improved triangle method (Zhang 2006).

For an observed triangle the pairs that fit two of its sides, found by the K-vector over the
separations, are joined at their common star; the third side and the handedness leave few
triangles of stars, each of which is a candidate. The method needs the product ``pairs``.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from starcat.arrays import Rows
from starcat.geometry.kvector import KVector
from starcat.geometry.sphere import separation
from starcat.matcher.budget import LOOKUP
from starcat.matcher.database import Database
from starcat.matcher.methods.candidates import Candidates
from starcat.matcher.methods.triangle_order import TriangleOrder, select_triangles
from starcat.matcher.observation import Observation

PRODUCTS = ("pairs",)


def candidates(
    observation: Observation, database: Database, selection: TriangleOrder
) -> Iterator[Candidates]:
    """Propose the triangles of stars that observed triangles may be.

    Parameters
    ----------
    observation : Observation
        The frame.
    database : Database
        With the product ``pairs``.
    selection : TriangleOrder
        Order and limits of the observed triangles.

    Yields
    ------
    Candidates
        Three stars each, one batch an observed triangle.

    References
    ----------
    Zhang, Jiang et al. 2006, the improved triangle algorithm, a baseline of S2 and S4.
    """
    for triangle in select_triangles(observation, selection):
        observation.budget.spend(LOOKUP)
        stars = triangles_of_stars(triangle, observation, database)
        if len(stars):
            yield Candidates(np.broadcast_to(triangle, stars.shape), stars)


def triangles_of_stars(triangle: Rows, observation: Observation, database: Database) -> Rows:
    """Return the triangles of stars that an observed triangle may be.

    Parameters
    ----------
    triangle : ndarray of int, shape (3,)
        Rows of the observation.
    observation : Observation
        The frame.
    database : Database
        With the product ``pairs``.

    Returns
    -------
    ndarray of int, shape (C, 3)
        Rows of the stars, in the order of ``triangle``; the same handedness.
    """
    a, b, c = triangle
    apart, tolerance_rad = observation.separation_rad, side_tolerance_rad(observation)
    first_b, star_b = directed_pairs(database, apart[a, b], tolerance_rad)
    first_c, star_c = directed_pairs(database, apart[a, c], tolerance_rad)
    order = np.argsort(first_c, kind="stable")
    first_c, star_c = first_c[order], star_c[order]
    low = np.searchsorted(first_c, first_b, side="left")
    count = np.searchsorted(first_c, first_b, side="right") - low
    left = np.repeat(np.arange(len(first_b)), count)
    right = np.arange(len(left)) + np.repeat(low - np.cumsum(count) + count, count)
    v, w = database.directions[star_b[left]], database.directions[star_c[right]]
    fits = np.abs(separation(v, w) - apart[b, c]) <= tolerance_rad
    left, v, w = left[fits], v[fits], w[fits]
    u = database.directions[first_b[left]]
    handedness = np.einsum("ij,ij->i", np.cross(u, v), w)
    handed = handedness * np.linalg.det(observation.body[triangle]) > 0.0
    left, right = left[handed], right[fits][handed]
    return np.stack([first_b[left], star_b[left], star_c[right]], axis=-1).astype(np.intp)


def side_tolerance_rad(observation: Observation) -> float:
    """Return the largest error of a separation.

    Parameters
    ----------
    observation : Observation
        The frame.

    Returns
    -------
    float
        Radians. It is less than twice the error of a centroid, because both ends rarely err by
        the most and in opposite directions.
    """
    return 1.5 * observation.tolerance_rad


def directed_pairs(
    database: Database, separation_rad: float, tolerance_rad: float
) -> tuple[Rows, Rows]:
    """Return the pairs of about a separation, each in both directions.

    Parameters
    ----------
    database : Database
        With the product ``pairs``.
    separation_rad, tolerance_rad : float
        Radians.

    Returns
    -------
    first, second : ndarray of int, shape (P,)
        Rows of the stars.
    """
    product = database.products["pairs"]
    index = KVector(
        product["separation_rad"],
        product["kvector_counts"],
        product.numbers["kvector_intercept"],
        product.numbers["kvector_slope"],
    )
    rows = index.exact(separation_rad - tolerance_rad, separation_rad + tolerance_rad)
    i, j = product["i"][rows], product["j"][rows]
    return np.concatenate([i, j]), np.concatenate([j, i])
