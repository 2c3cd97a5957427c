"""Identification by triangles (S4): area in the K-vector, circumradius as the filter.

The order in which triangles of centroids are looked up follows three methods. If magnitudes are
known, triangles of the brightest stars come first, as in S3; otherwise the most compact triangles
do, which in a crowded frame are taken from all over it. The order of S4, by the radius of the
inscribed circle, can be chosen. Triangles with a short side or a narrow angle are left out, because
the two centroids of a double star, or three centroids in a line, identify little.

If the focal length is not known, triangles are looked up by shape, the area over the squared
circumradius, which is the same for similar triangles, and then by a range of areas. The method
needs the product ``triangles``, in order of area; the order by shape is made when first needed. The
first batches of observed triangles are small, because the first few triangles decide most frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations, permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Mask, Rows
from starcat.matcher.database import MatcherDatabase, ProductArrays
from starcat.matcher.observation import Candidates, Observation
from starcat.matcher.pose import linear_shapes
from starcat.matcher.settings import LOOKUP, MAX_TRIANGLES, TriangleOrder

MIN_ANGLE_DEG = 4.0
"""Smallest angle of a triangle that is tried at all."""

NEIGHBOURS = 20
"""Number of the nearest centroids that a centroid makes triangles with in the order ``spread``."""

SPREAD_CENTROIDS = 400
"""Largest number of centroids of that order; sorting more would take seconds."""


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
    has_mag = observation.mag is not None
    if selection.order == "brightness" or (selection.order == "auto" and has_mag):
        order = np.arange(len(stars))
    elif selection.order == "inradius":
        order = np.argsort(-_squared_inradius(a, b, c), kind="stable")
    else:
        order = np.argsort(np.maximum(np.maximum(a, b), c), kind="stable")
    good = good[order]
    if count > selection.few_centroids:
        return np.asarray(stars[order[good]])
    poor = is_well_shaped(a, b, c, observation.tolerance_rad, np.radians(MIN_ANGLE_DEG))[order]
    return np.asarray(stars[np.concatenate([order[good], order[poor & ~good]])])


def _spread(observation: Observation, selection: TriangleOrder) -> NDArray[np.intp]:
    """Return triangles of near centroids from all over a frame.

    Every centroid's two nearest neighbours come first, then its first and third nearest, its
    second and third, and so on; each triangle occurs once.

    A database holds the triangles of the brightest stars of its fields. In a crowded frame most
    stars are fainter, and the compact triangles of one place are often of the same few stars: if
    one of these is faint, none of the triangles is held.
    """
    count = min(len(observation), SPREAD_CENTROIDS)
    apart = observation.separation_rad[:count, :count]
    most = min(NEIGHBOURS, count - 1)
    near = np.argsort(apart, axis=1, kind="stable")[:, 1 : most + 1]
    second, first = np.tril_indices(most, -1)
    owner = np.tile(np.arange(count), len(first))
    others = near[:, first].T.ravel(), near[:, second].T.ravel()
    i, j, k = stars = np.sort(np.stack([owner, *others]), axis=0)
    _, fresh = np.unique((i * count + j) * count + k, return_index=True)
    stars = stars.T[np.sort(fresh)]
    side = selection.min_side_px / observation.camera.focal_length_px
    good = is_well_shaped(*_sides(apart, stars), side, np.radians(selection.min_angle_deg))
    return np.asarray(stars[good])


def is_well_shaped(
    a: Array, b: Array, c: Array, min_side: float, min_angle_rad: float
) -> NDArray[np.bool_]:
    """Return which triangles have longer sides and wider angles than these, shape (T,).

    Sides of shape (T,), in the unit of ``min_side``; the least angle is below pi / 3.
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
    triples = sorted(combinations(range(count), 3), key=lambda triple: triple[::-1])
    return np.array(triples, dtype=np.intp).reshape(-1, 3)


BATCHES = (2, 8, 32)
"""Sizes of the first batches of observed triangles; all later batches have the last size."""

MANY = 200
"""With more triangles of stars than this, their sides are compared by length before they are put
into the order of the observed ones."""

ROUNDING_RAD = 1e-7
"""Radians. More than the sides of all triangles lose if they are stored in 32 bits."""

CURVATURE = 2.0 / 3.0
"""How much less than the focal length the angle theta off the axis scales, over theta squared:
``theta = atan(r / f)`` shrinks by ``sin(theta) cos(theta)`` of a relative change of f."""

AT_ONCE = 2**16
"""Number of triangles whose sides are computed together."""

ANY_ORDER = 1.1
"""Tolerance of sides in order of their length, in units of the tolerance in their true order: the
scale that fits best differs a little between the two orders."""

SIDE_CHANGE = 0.06
"""Largest relative change of a side by the shape of a frame for which stars are looked up."""

_ORDERS = np.array(list(permutations(range(3))), dtype=np.intp)


def candidates(observation: Observation, database: MatcherDatabase) -> Iterator[Candidates]:
    """Propose triangles of stars of the same handedness as the centroids.

    Liao and Zhang 2024 (S4), sections 2 and 3.
    """
    triangles = select_triangles(observation)[:MAX_TRIANGLES]
    done = step = 0
    while done < len(triangles):
        size = BATCHES[min(step, len(BATCHES) - 1)]
        observation.budget.spend(LOOKUP * size)
        batch = _look_up(
            triangles, range(len(triangles))[done : done + size], observation, database
        )
        yield batch
        done, step = done + size, step + 1


def _look_up(
    all_triangles: Rows, part: range, observation: Observation, database: MatcherDatabase
) -> Candidates:
    """Return the triangles of stars with the area and circumradius of some observed ones."""
    product = database.products["triangles"]
    triangles = all_triangles[part.start : part.stop]
    sides = np.stack(_sides(observation.separation_rad, triangles), axis=-1)
    tolerance_rad = observation.side_tolerance_rad
    if observation.fov_error:
        matches = similar_triangles(sides, tolerance_rad, observation, database)
    else:
        matches = _same_triangles(sides, tolerance_rad, product)
    observed = np.repeat(np.arange(len(triangles)), [len(rows) for rows in matches])
    rows = np.concatenate(matches)
    if len(rows) > MANY and not observation.fov_error:
        rows, observed = _with_sides(rows, observed, sides, tolerance_rad, database)
    stars = np.stack([product["i"][rows], product["j"][rows], product["k"][rows]], axis=-1)
    row, stars = _in_order(
        triangles[observed], stars, sides[observed], tolerance_rad, observation, database
    )
    patterns = part.start + observed[row] + 1
    return Candidates(triangles[observed[row]], stars, patterns, part.stop)


def shaped_candidates(observation: Observation, database: MatcherDatabase) -> Iterator[Candidates]:
    """Propose triangles of stars that a shape of the frame turns into triangles of centroids.

    Three stars determine an attitude and the scale, the stretch and the shear of a frame; those of
    a candidate are within their ranges. The most compact triangles come first, because the stars
    have the fewest triangles of their size.
    """
    selection = replace(observation.settings.selection, order="compact", few_centroids=0)
    settings = replace(observation.settings, selection=selection)
    plain = replace(observation, settings=settings, fov_error=0.0)
    product, half = database.products["triangles"], observation.widest_ranges[[0, 2, 3]]
    for done, triangle in enumerate(select_triangles(plain)[:MAX_TRIANGLES, None], 1):
        observation.budget.spend(LOOKUP)
        sides = np.stack(_sides(observation.separation_rad, triangle), axis=-1)
        tolerance_rad = observation.side_tolerance_rad + SIDE_CHANGE * sides[0]
        # A shape changes the three sides together: their errors add up.
        [rows] = _same_triangles(sides, math.sqrt(3.0) * tolerance_rad, product)
        rows, observed = _with_sides(rows, 0 * rows, sides, tolerance_rad, database)
        stars = np.stack([product["i"][rows], product["j"][rows], product["k"][rows]], axis=-1)
        row, stars = _in_order(
            triangle[observed], stars, sides[observed], tolerance_rad, plain, database
        )
        centroids = triangle[0 * row]
        terms = linear_shapes(centroids, database.directions[stars], observation)
        good = (np.abs(terms) <= half).all(axis=1)
        good &= observation.are_compatible(centroids, database.mag[stars]).all(axis=1)
        yield Candidates(centroids[good], stars[good], np.full(np.count_nonzero(good), done), done)


def _same_triangles(
    sides: Array, tolerance_rad: float | Array, product: ProductArrays
) -> list[Rows]:
    by_area, radii, matches = product.kvector("area_rad2"), product["circumradius_rad"], []
    errors = np.broadcast_to(tolerance_rad, 3).tolist()
    for a, b, c in sides.tolist():
        area, area_error, radius, radius_error = features(a, b, c, *errors)
        near = by_area.exact(area - area_error, area + area_error)
        fits = np.abs(radii[near] - radius) <= radius_error
        matches.append(fits.nonzero()[0] + near.start)
    return matches


def _with_sides(
    rows: Rows,
    observed: Rows,
    sides: Array,
    tolerance_rad: float | Array,
    database: MatcherDatabase,
) -> tuple[Rows, Rows]:
    """Return the triangles of stars whose sides, by length, are as long as those observed.

    Triangles whose sides do not agree in order of length do not agree in any other order either.
    """
    lengths, seen = database.cached(sides_by_length), np.sort(sides, axis=1).T
    errors = np.sort(np.broadcast_to(tolerance_rad, 3)) + ROUNDING_RAD
    for length in (2, 1, 0):
        error = np.abs(lengths[length, rows] - seen[length, observed])
        close = np.flatnonzero(error <= errors[length])
        rows, observed = rows[close], observed[close]
    return rows, observed


def _in_order(
    centroids: Rows,
    stars: NDArray[np.integer[Any]],
    sides: Array,
    tolerance_rad: Any,
    observation: Observation,
    database: MatcherDatabase,
) -> tuple[Rows, NDArray[np.integer[Any]]]:
    """Return rows, and their stars in the order of centroids, where sides and handedness agree."""
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
    return row[handed], stars[handed]


def features(a: float, b: float, c: float, *errors_rad: float) -> tuple[float, float, float, float]:
    """Return area, its error, circumradius and its error of a plane triangle that is not flat.

    Sides and their errors in radians. The results are of first order and treat the errors of
    the three sides as independent.
    """
    area, slopes = area_and_slopes(a, b, c)
    radius = a * b * c / (4.0 * area)
    each = list(zip(errors_rad, slopes, (a, b, c), strict=True))
    area_error = math.hypot(*(error * slope for error, slope, _ in each))
    turns = (error * (1.0 / side - slope / area) for error, slope, side in each)
    return area, area_error, radius, radius * math.hypot(*turns)


def area_and_slopes(a: float, b: float, c: float) -> tuple[float, tuple[float, float, float]]:
    """Return the area of a plane triangle that is not flat, and its derivatives by the sides.

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
    """Return shape, its error, area and its error of a plane triangle that is not flat.

    Sides and their common error in radians. The errors of the three sides are treated as
    independent. The error of the shape has a term of second order, since the shape is largest,
    and stationary, where the sides are equal.
    """
    area, slopes = area_and_slopes(a, b, c)
    shape = 16.0 * area**3 / (a * b * c) ** 2
    turns = (3.0 * s / area - 2.0 / side for side, s in zip((a, b, c), slopes, strict=True))
    part = tolerance_rad / min(a, b, c)
    shape_error = shape * (tolerance_rad * math.hypot(*turns) + 3.0 * part * part)
    return shape, shape_error, area, tolerance_rad * math.hypot(*slopes)


@dataclass(frozen=True)
class Shapes:
    """Triangles of stars in order of their shape."""

    shape: Array  # area over squared circumradius, ascending: 0 in a line, 1.299 with equal sides
    area_rad2: NDArray[np.float32]
    sides_rad: NDArray[np.float32]  # the shortest first, shape (3, M)
    rows: Rows  # rows of the product


def sides_by_length(database: MatcherDatabase) -> NDArray[np.float32]:
    """Return the sides of all triangles of stars, the shortest first, shape (3, M), radians."""
    product = database.products["triangles"]
    lengths = np.empty((3, len(product["i"])), dtype=np.float32)
    for start in range(0, lengths.shape[1], AT_ONCE):
        part = slice(start, start + AT_ONCE)
        u, v, w = (database.directions[product[name][part]] for name in "ijk")
        chords = np.stack([np.linalg.norm(x - y, axis=1) for x, y in ((u, v), (v, w), (w, u))])
        lengths[:, part] = 2.0 * np.arcsin(0.5 * np.sort(chords, axis=0))
    return lengths


def shapes(database: MatcherDatabase) -> Shapes:
    """Return the triangles of a database in order of their shape."""
    product = database.products["triangles"]
    radius = product["circumradius_rad"].astype(np.float64)
    shape = product["area_rad2"] / (radius * radius)
    order = np.argsort(shape, kind="stable")
    sides = database.cached(sides_by_length)[:, order]
    return Shapes(shape[order], product["area_rad2"][order], sides, order)


def similar_triangles(
    sides: Array, tolerance_rad: float, observation: Observation, database: MatcherDatabase
) -> list[Rows]:
    """Return the triangles of stars, as rows of the product, that each observed one is similar to.

    ``sides``, shape (T, 3), are in radians, with the focal length that was given.
    """
    table, (shortest, longest), matches = database.cached(shapes), observation.focal_range, []
    for a, b, c in sides.tolist():
        shape, shape_error, area, area_error = scale_free(a, b, c, tolerance_rad)
        first, last = np.searchsorted(table.shape, (shape - shape_error, shape + shape_error))
        part = table.area_rad2[first:last]
        smallest = (area - area_error) / longest**2
        largest = (area + area_error) / shortest**2
        near = first + np.flatnonzero((part >= smallest) & (part <= largest))
        # Sides in order of length fit best; triangles that fail so fail in every other order.
        apart = table.sides_rad[:, near]
        close = are_similar(sorted((a, b, c)), apart, ANY_ORDER * tolerance_rad, observation)
        matches.append(np.sort(table.rows[near[close]]))
    return matches


def are_similar(
    sides: Sequence[Array | float],
    apart: Sequence[Array] | NDArray[Any],
    tolerance_rad: float,
    observation: Observation,
) -> Mask:
    """Return which sides of stars equal the sides of observed triangles at some allowed scale.

    Three arrays each, of any shape, or observed numbers; the scale is the least-squares scale.
    """
    (a, b, c), (u, v, w) = sides, apart
    scale = (a * u + b * v + c * w) / (u * u + v * v + w * w)
    bend = CURVATURE * observation.fov_error * observation.camera.radius_rad**2
    shortest, longest = observation.focal_range
    slack = tolerance_rad / np.minimum(np.minimum(a, b), c)
    good = (scale >= shortest - slack) & (scale <= longest + slack)
    for side, true in ((a, u), (b, v), (c, w)):
        good &= np.abs(true * scale - side) <= tolerance_rad + bend * side
    return np.asarray(good)
