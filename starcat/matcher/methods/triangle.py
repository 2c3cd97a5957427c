"""Identification by triangles (S4): area in the K-vector, circumradius as the filter.

The method needs the product ``triangles``. The first batches of observed triangles are small,
because the first few triangles decide most frames; later batches are larger.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.geometry.kvector import KVector
from starcat.matcher.budget import LOOKUP
from starcat.matcher.database import Database, ProductArrays
from starcat.matcher.methods.candidates import Candidates
from starcat.matcher.methods.pairs import side_tolerance_rad
from starcat.matcher.methods.triangle_order import DEFAULT, TriangleOrder, select_triangles
from starcat.matcher.methods.triangle_shape import (
    are_similar,
    area_and_slopes,
    sides_by_length,
    similar_triangles,
)
from starcat.matcher.observation import Observation

PRODUCTS = ("triangles",)

BATCHES = (2, 8, 32)
"""Sizes of the first batches of observed triangles; all later batches have the last size."""

MANY = 200
"""With more triangles of stars than this, their sides are compared by length before they are put
into the order of the observed ones."""

ROUNDING_RAD = 1e-7
"""More than the sides of all triangles lose where they are kept as 32 bits, radians."""

_ORDERS = np.array(list(permutations(range(3))), dtype=np.intp)


def candidates(
    observation: Observation, database: Database, selection: TriangleOrder = DEFAULT
) -> Iterator[Candidates]:
    """Propose the triangles of stars that observed triangles may be.

    Parameters
    ----------
    observation : Observation
        The frame.
    database : Database
        With the product ``triangles``.
    selection : TriangleOrder
        Order and limits of the observed triangles.

    Yields
    ------
    Candidates
        Three stars each, of the same handedness as the centroids.

    References
    ----------
    Liao and Zhang 2024 (S4), sections 2 and 3.
    """
    triangles = select_triangles(observation, selection)
    product = database.products["triangles"]
    done = step = 0
    while done < len(triangles):
        size = BATCHES[min(step, len(BATCHES) - 1)]
        observation.budget.spend(LOOKUP * size)
        found = _look_up(triangles[done : done + size], observation, database, product)
        if len(found):
            yield found
        done, step = done + size, step + 1


def _look_up(
    triangles: NDArray[np.intp],
    observation: Observation,
    database: Database,
    product: ProductArrays,
) -> Candidates:
    """Return the triangles of stars with the area and circumradius of observed ones."""
    i, j, k = triangles.T
    apart = observation.separation_rad
    sides = np.stack([apart[j, k], apart[i, k], apart[i, j]], axis=-1)
    tolerance_rad = side_tolerance_rad(observation)
    if observation.fov_error:
        found = similar_triangles(sides, tolerance_rad, observation, database)
    else:
        found = _same_triangles(sides, tolerance_rad, product)
    observed = np.repeat(np.arange(len(triangles)), [len(rows) for rows in found])
    rows = np.concatenate(found)
    if len(rows) > MANY and not observation.fov_error:
        rows, observed = _with_sides(rows, observed, sides, tolerance_rad, database)
    stars = np.stack([product["i"][rows], product["j"][rows], product["k"][rows]], axis=-1)
    return _in_order(
        triangles[observed], stars, sides[observed], tolerance_rad, observation, database
    )


def _same_triangles(
    sides: Array, tolerance_rad: float, product: ProductArrays
) -> list[NDArray[np.intp]]:
    """Return the rows of the triangles with the area and circumradius of observed ones."""
    by_area = KVector(
        product["area_rad2"],
        product["kvector_counts"],
        product.numbers["kvector_intercept"],
        product.numbers["kvector_slope"],
    )
    radii, found = product["circumradius_rad"], []
    for a, b, c in sides.tolist():
        area, area_error, radius, radius_error = features(a, b, c, tolerance_rad)
        near = by_area.range(area - area_error, area + area_error)
        fits = np.abs(radii[near] - radius) <= radius_error
        found.append(fits.nonzero()[0] + near.start)
    return found


def _with_sides(
    rows: NDArray[np.intp],
    observed: NDArray[np.intp],
    sides: Array,
    tolerance_rad: float,
    database: Database,
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the triangles of stars whose sides, by length, are as long as those observed.

    Where they are not by length, they are not in any other order.
    """
    known, seen = database.derived(sides_by_length), np.sort(sides, axis=1).T
    for length in (2, 1, 0):
        error = np.abs(known[length, rows] - seen[length, observed])
        close = np.flatnonzero(error <= tolerance_rad + ROUNDING_RAD)
        rows, observed = rows[close], observed[close]
    return rows, observed


def features(
    a: float, b: float, c: float, tolerance_rad: float
) -> tuple[float, float, float, float]:
    """Return area and circumradius of a plane triangle and the errors that its sides cause.

    Parameters
    ----------
    a, b, c : float
        Sides, radians, of a triangle that is not flat.
    tolerance_rad : float
        Error of each side.

    Returns
    -------
    area_rad2, area_error_rad2, circumradius_rad, circumradius_error_rad : float
        The errors are of first order and treat those of the three sides as independent.
    """
    area, slopes = area_and_slopes(a, b, c)
    radius = a * b * c / (4.0 * area)
    area_error = tolerance_rad * math.hypot(*slopes)
    turns = (1.0 / side - slope / area for side, slope in zip((a, b, c), slopes, strict=True))
    return area, area_error, radius, tolerance_rad * radius * math.hypot(*turns)


def _in_order(
    centroids: NDArray[np.intp],
    stars: NDArray[np.integer[Any]],
    sides: Array,
    tolerance_rad: float,
    observation: Observation,
    database: Database,
) -> Candidates:
    """Return the stars in the order of the centroids, where sides and handedness agree."""
    u = database.directions[stars]
    chord = u[:, [1, 0, 0]] - u[:, [2, 2, 1]]
    apart = 2.0 * np.arcsin(0.5 * np.sqrt(np.einsum("ijk,ijk->ij", chord, chord)))
    if observation.fov_error:
        observed = np.moveaxis(sides[:, None], -1, 0)
        ordered = np.moveaxis(apart[:, _ORDERS], -1, 0)
        fits = are_similar(list(observed), ordered, tolerance_rad, observation)
    else:
        side = np.abs(apart[:, :, None] - sides[:, None, :]) <= tolerance_rad
        first, second, third = _ORDERS.T
        fits = side[:, first, 0] & side[:, second, 1] & side[:, third, 2]
    row, order = np.nonzero(fits)
    centroids, stars = centroids[row], stars[row[:, None], _ORDERS[order]]
    # The determinant of the product is the product of the two triangles' handedness.
    turned = database.directions[stars] @ np.swapaxes(observation.body[centroids], 1, 2)
    handed = np.linalg.det(turned) > 0.0
    return Candidates(centroids[handed], stars[handed])
