"""Triangles of an unknown scale: looked up by shape, then by a range of areas.

The area over the squared circumradius is the same for similar triangles. The product
``triangles`` is in order of area; that of shape is made from it when it is first needed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.matcher.database import Database
from starcat.matcher.observation import Observation

Rows = NDArray[np.int64]

CURVATURE = 2.0 / 3.0
"""How much less than the focal length the angle theta off the axis scales, over theta squared:
``theta = atan(r / f)`` shrinks by ``sin(theta) cos(theta)`` of a relative change of f."""


AT_ONCE = 2**16
"""Triangles whose sides are worked out together."""

ANY_ORDER = 1.1
"""Tolerance of sides in order of their length, in units of that of the true order: the scale that
fits best differs a little between the two."""


@dataclass(frozen=True)
class Shapes:
    """Triangles of stars in order of their shape.

    Attributes
    ----------
    shape : ndarray of float64, shape (M,)
        Area over squared circumradius, ascending: 0 in a line, 1.299 with equal sides.
    area_rad2 : ndarray of float32, shape (M,)
        Their areas.
    sides_rad : ndarray of float32, shape (3, M)
        Their sides, the shortest first.
    rows : ndarray of int64, shape (M,)
        Rows of the product.
    """

    shape: Array
    area_rad2: NDArray[np.float32]
    sides_rad: NDArray[np.float32]
    rows: Rows


def sides_by_length(database: Database) -> NDArray[np.float32]:
    """Return the sides of all triangles of stars.

    Parameters
    ----------
    database : Database
        With the product ``triangles``.

    Returns
    -------
    ndarray of float32, shape (3, M)
        Radians, the shortest first, in the order of the product.
    """
    product = database.products["triangles"]
    found = np.empty((3, len(product["i"])), dtype=np.float32)
    for start in range(0, found.shape[1], AT_ONCE):
        part = slice(start, start + AT_ONCE)
        u, v, w = (database.directions[product[name][part]] for name in "ijk")
        chords = np.stack([np.linalg.norm(x - y, axis=1) for x, y in ((u, v), (v, w), (w, u))])
        found[:, part] = 2.0 * np.arcsin(0.5 * np.sort(chords, axis=0))
    return found


def shapes(database: Database) -> Shapes:
    """Return the triangles of a database in order of their shape.

    Parameters
    ----------
    database : Database
        With the product ``triangles``.

    Returns
    -------
    Shapes
        All of them.
    """
    product = database.products["triangles"]
    radius = product["circumradius_rad"].astype(np.float64)
    shape = product["area_rad2"] / (radius * radius)
    order = np.argsort(shape, kind="stable")
    sides = database.derived(sides_by_length)[:, order]
    return Shapes(shape[order], product["area_rad2"][order], sides, order)


def similar_triangles(
    sides: Array, tolerance_rad: float, observation: Observation, database: Database
) -> list[Rows]:
    """Return the triangles of stars that observed ones are similar to.

    Parameters
    ----------
    sides : ndarray of float64, shape (T, 3)
        Sides with the focal length that was given, radians.
    tolerance_rad : float
        Largest error of a side.
    observation : Observation
        The frame, whose focal lengths bound the areas.
    database : Database
        With the product ``triangles``.

    Returns
    -------
    list of ndarray of int64
        Rows of the product for each observed triangle.
    """
    known, scales, found = database.derived(shapes), observation.focal_range, []
    for a, b, c in sides.tolist():
        shape, shape_error, area, area_error = scale_free(a, b, c, tolerance_rad)
        first, last = np.searchsorted(known.shape, (shape - shape_error, shape + shape_error))
        part = known.area_rad2[first:last]
        smallest = (area - area_error) / scales.high**2
        largest = (area + area_error) / scales.low**2
        near = first + np.flatnonzero((part >= smallest) & (part <= largest))
        # The order in which both are by length fits best; what fails so, fails in every order.
        apart = known.sides_rad[:, near]
        close = are_similar(sorted((a, b, c)), apart, ANY_ORDER * tolerance_rad, observation)
        found.append(known.rows[near[close]])
    return found


def area_and_slopes(a: float, b: float, c: float) -> tuple[float, tuple[float, float, float]]:
    """Return the area of a plane triangle, and its derivatives by the sides.

    Parameters
    ----------
    a, b, c : float
        Sides of a triangle that is not flat.

    Returns
    -------
    area : float
        In the square of their unit.
    slopes : tuple of three float
        In their unit.

    Examples
    --------
    >>> area_and_slopes(3.0, 4.0, 5.0)
    (6.0, (2.0, 1.5, 0.0))
    """
    a2, b2, c2 = a * a, b * b, c * c
    u, v, w = b2 + c2 - a2, a2 + c2 - b2, a2 + b2 - c2
    area = 0.25 * math.sqrt(max(a2 * u + b2 * v + c2 * w, 1e-300))
    return area, (a * u / (8.0 * area), b * v / (8.0 * area), c * w / (8.0 * area))


def scale_free(
    a: float, b: float, c: float, tolerance_rad: float
) -> tuple[float, float, float, float]:
    """Return shape and area of a plane triangle and the errors that its sides cause.

    Parameters
    ----------
    a, b, c : float
        Sides, radians, of a triangle that is not flat.
    tolerance_rad : float
        Error of each side.

    Returns
    -------
    shape, shape_error, area_rad2, area_error_rad2 : float
        The errors treat those of the three sides as independent. That of the shape has a term
        of second order, since the shape is largest, and stationary, where the sides are equal.

    Examples
    --------
    >>> round(scale_free(1.0, 1.0, 1.0, 0.0)[0], 3)
    1.299
    """
    area, slopes = area_and_slopes(a, b, c)
    shape = 16.0 * area**3 / (a * b * c) ** 2
    turns = (3.0 * s / area - 2.0 / side for side, s in zip((a, b, c), slopes, strict=True))
    part = tolerance_rad / min(a, b, c)
    shape_error = shape * (tolerance_rad * math.hypot(*turns) + 3.0 * part * part)
    return shape, shape_error, area, tolerance_rad * math.hypot(*slopes)


def are_similar(
    sides: Sequence[Array | float],
    apart: Sequence[Array] | NDArray[Any],
    tolerance_rad: float,
    observation: Observation,
) -> NDArray[np.bool_]:
    """Return which sides of stars are those of observed triangles at some allowed scale.

    Parameters
    ----------
    sides : sequence of three ndarray of float64, shape (...), or float
        Observed sides, radians.
    apart : sequence of three ndarray, shape (...)
        Sides of stars, in the same order.
    tolerance_rad : float
        Largest error of an observed side.
    observation : Observation
        The frame, whose focal lengths bound the scale.

    Returns
    -------
    ndarray of bool, shape (...)
        The scale is that of least squares.
    """
    (a, b, c), (u, v, w) = sides, apart
    scale = (a * u + b * v + c * w) / (u * u + v * v + w * w)
    bend = CURVATURE * observation.fov_error * observation.camera.radius_rad**2
    allowed, slack = observation.focal_range, tolerance_rad / np.minimum(np.minimum(a, b), c)
    good = (scale >= allowed.low - slack) & (scale <= allowed.high + slack)
    for side, true in ((a, u), (b, v), (c, w)):
        good &= np.abs(true * scale - side) <= tolerance_rad + bend * side
    return np.asarray(good)
