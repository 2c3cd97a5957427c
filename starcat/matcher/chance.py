"""The probability that chance alone agrees with a frame as well as an attitude does.

It is bounded by an expected number: the number of attitudes, over the whole sky, that put as many
stars as near to centroids at random places on the detector. This number does not depend on how
many candidates a method has tried.

There are ``C(N, n) M! / (M - n)!`` ways to assign n of N centroids to n of M stars. In each
of them, the frames whose squared residuals sum to less than Q in some attitude fill the
volume ``8 pi^2 f^3 sqrt(det H)`` times the volume of a ball of radius sqrt(Q) in the 2n - 3
dimensions that the fit leaves free, out of A^n for all frames. The first factor is the volume
of all attitudes, in pixels; H is the sum, over the n places, of the squared derivatives by the
three angles. The product is the expected number. Its sum over the N - 3 possible values of
n bounds the probability. M is counted around the field, so the bound is higher in a crowded
field, and if most of the field is left unexplained.

Focal length. If it is fitted, the frames that agree form a manifold with a fourth dimension:
the volume is ``8 pi^2 f^3 L sqrt(det H)`` times the volume of a ball in 2n - 4 dimensions, L
being the logarithm of the range and H having a fourth row for the derivatives by the logarithm
of f. The two ends of the range add the expected number of a known focal length once.

Magnitudes. Assignments of centroids to stars that they are not compatible with are never
agreements, so they are not counted (`log_compatible_assignments`). The hypothesis is that the
places of the centroids are random; it makes no assumption about their magnitudes. So the
expected number is the number for random places with the magnitudes of the frame, whatever they
are. It also holds if false spots have the same magnitudes as stars, and if the stated error is
wrong (then true frames can be missed).

Noise. If no noise is stated, each of the N - 3 values of n is allotted the same share of
the probability: the expected number is divided by 1 / (N - 3). Any other shares are valid
too, if they add up to 1 at every attitude and do not depend on where the centroids are. A
stated noise shows, before any residual is seen, which n will matter: with one star fewer than
n* an agreement of true stars is typically not certain, with one more it is far beyond certain.
So n* has the largest share, and every further n has a tenth of the previous share (`_log_share`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from starcat.arrays import Array, Mask
from starcat.geometry.attitude import determinant
from starcat.geometry.camera import Camera

_ALL_ATTITUDES = 8.0 * math.pi**2
"""Volume of the rotations, cubic radians."""

MIN_STARS = 4
"""Smallest number of matched stars: three determine an attitude, a fourth confirms it."""

NEARLY_CERTAIN = 1e-7
"""Largest expected number of agreements of true stars that are likely to be answers."""

NEXT_SHARE = 0.1
"""Share of a number of stars over the share of the next number towards the typical one."""


def false_match_probability(
    square_px: float,
    body: Array,
    n_centroids: int,
    stars_in_frame: int,
    camera: Camera,
    *,
    noise_px: float | None = None,
    compatible: Mask | None = None,
    log_scales: float = 0.0,
) -> float:
    """Bound the probability that random centroids agree as well with any attitude.

    ``square_px`` is the sum of the squared residuals, ``body`` the directions of the centroids that
    agree; with ``log_scales``, the logarithm of a range of focal lengths, that was fitted too.
    """
    n, stars = len(body), max(len(body), stars_in_frame)
    sums = _sums(body)
    gram = _gram(sums)
    information = determinant(gram)
    if not information > 0.0 or (noise_px is not None and n < MIN_STARS):
        return 1.0
    most = n if noise_px is None else min(n_centroids, stars)
    assignments: Callable[[int], float] = partial(
        log_assignments, n_centroids=n_centroids, stars=stars
    )
    if compatible is not None:
        assignments = log_compatible_assignments(most, compatible).item
    if noise_px is None:
        log_values = math.log(max(1, n_centroids - 3))
    else:
        log_values = -_log_share(n, most, assignments, noise_px, camera)
    expected = _log_expected(assignments(n), n, square_px, information, camera)
    if log_scales > 0.0:
        # The determinant with a fourth row, by Schur's complement.
        along, cross = _by_scale(sums)
        left = along - float(cross @ np.linalg.solve(gram, cross))
        scaled = _log_expected(assignments(n), n, square_px, information * left, camera, unknowns=4)
        expected = float(np.logaddexp(expected, scaled + math.log(log_scales)))
    return math.exp(min(0.0, expected + log_values))


def largest_squares_px(
    n: int,
    n_centroids: int,
    stars_in_frame: int,
    information: Array,
    camera: Camera,
    noise_px: float,
    limit: float,
) -> Array:
    """Return the largest sums of squared residuals of n stars that are answers, pixels squared.

    For these sums `false_match_probability` returns ``limit``, if ``noise_px`` is stated.
    ``information`` are determinants of sums of the squared derivatives (`place_information`).
    """
    most = min(n_centroids, stars_in_frame)
    assignments = partial(log_assignments, n_centroids=n_centroids, stars=stars_in_frame)
    log_values = -_log_share(n, most, assignments, noise_px, camera)
    expected = _log_expected(assignments(n), n, 1.0, 1.0, camera) + log_values
    with np.errstate(divide="ignore"):
        left = math.log(limit) - expected - 0.5 * np.log(information)
    return np.asarray(np.exp(np.minimum(left / (n - 1.5), 700.0)))


def place_information(body: Array) -> dict[tuple[int, int], Array]:
    """Return the terms of each direction in the sums of products of derivatives by three angles.

    Arrays of shape (N,) by row and column, on and above the diagonal; directions have the
    shape (N, 3). In units of the focal length, as `false_match_probability` has them.
    """
    x, y = (body[:, :2] / body[:, 2:]).T
    rows = np.stack([x * y, -1.0 - x * x, y]), np.stack([1.0 + y * y, -x * y, -x])
    return {(i, j): sum(row[i] * row[j] for row in rows) for i in range(3) for j in range(i, 3)}


def _sums(body: Array) -> list[list[float]]:
    """Return the sums of the products of 1, x, y, x x, x y and y y, over places (x, y).

    All sums of the derivatives of the places follow from them.
    """
    powers = np.empty((6, len(body)))
    powers[0] = 1.0
    np.divide(body[:, :2].T, body[:, 2], out=powers[1:3])
    np.multiply(powers[1:3], powers[1], out=powers[3:5])
    np.multiply(powers[2], powers[2], out=powers[5])
    found: list[list[float]] = (powers @ powers.T).tolist()
    return found


def _gram(sums: list[list[float]]) -> Array:
    """Return the sums of products of the derivatives by the three angles.

    In units of the focal length these are, of a place, (xy, 1 + yy), (-1 - xx, -xy) and (y, -x).
    """
    (n, x, y, *_), (_, xx, xy, *_), (_, _, yy, *_), (*_, x4, x3y, x2y2), (*_, xy3), (*_, y4) = sums
    first = x2y2 + n + 2.0 * yy + y4
    second = n + 2.0 * xx + x4 + x2y2
    mixed = -2.0 * xy - x3y - xy3
    return np.array([[first, mixed, -x], [mixed, second, -y], [-x, -y, xx + yy]])


def _by_scale(sums: list[list[float]]) -> tuple[float, Array]:
    """Return the sums of products of the derivative by the scale, (x, y), with all derivatives."""
    (_, x, y, *_), (_, xx, _, x3, x2y, xy2), (_, _, yy, _, _, y3), *_ = sums
    return xx + yy, np.array([y + x2y + y3, -x - x3 - xy2, 0.0])


def _log_expected(
    log_assignments_of_n: float,
    n: int,
    square_px: float,
    information: float,
    camera: Camera,
    unknowns: int = 3,
) -> float:
    left = 2 * n - unknowns
    root = camera.focal_length_px**unknowns * math.sqrt(max(information, 1e-300))
    attitudes = math.log(_ALL_ATTITUDES * root)
    unit_ball = 0.5 * left * math.log(math.pi) - math.lgamma(0.5 * left + 1.0)
    ball = unit_ball + 0.5 * left * math.log(max(square_px, 1e-30))
    frames = n * math.log(camera.width_px * camera.height_px)
    return log_assignments_of_n + attitudes + ball - frames


def _log_share(
    n: int, most: int, assignments: Callable[[int], float], noise_px: float, camera: Camera
) -> float:
    """Return the logarithm of the share of n, which is at most ``most``.

    The typical number of stars, n*, is the smallest whose agreements are `NEARLY_CERTAIN` if
    their stars are spread over the whole frame and the squared residuals are what the noise
    makes on average. If no number is, it is the largest possible one.
    """
    numbers = range(MIN_STARS, most + 1)
    square_of_frame = (camera.width_px**2 + camera.height_px**2) / 12.0
    spread = square_of_frame / camera.focal_length_px**2
    typical = numbers[-1]
    for number in numbers:
        square_px = (2 * number - 3) * noise_px**2
        expected = _log_expected(assignments(number), number, square_px, number**3 * spread, camera)
        if expected <= math.log(NEARLY_CERTAIN):
            typical = number
            break
    total = sum(NEXT_SHARE ** abs(number - typical) for number in numbers)
    return abs(n - typical) * math.log(NEXT_SHARE) - math.log(total)


def log_assignments(n: int, n_centroids: int, stars: int) -> float:
    """Return the logarithm of the number of assignments of n centroids to n stars."""
    return (
        math.lgamma(n_centroids + 1) - math.lgamma(n + 1) - math.lgamma(n_centroids - n + 1)
    ) + (math.lgamma(stars + 1) - math.lgamma(stars - n + 1))


def log_compatible_assignments(most: int, compatible: Mask) -> Array:
    """Bound the logarithms of the numbers of assignments of 0 to ``most`` compatible stars.

    Two bounds are taken from the centroids, two from the stars, and the least is returned. Let
    centroid i have c_i compatible stars. If each centroid of a choice took any of its stars, even
    one that is taken, the number of assignments would be the product of their c_i; its sum over all
    choices of n is the elementary symmetric polynomial e_n(c_1, ..., c_N).

    The theorem of Bregman counts stars once: a square matrix of zeros and ones has a permanent of
    at most the product of ``(r!)^(1/r)`` over its rows, r being their sums. The n rows of a
    choice, with M - n rows of ones below them, form such a matrix, and each assignment of the
    choice occurs ``(M - n)!`` times in its permanent. The sum over the choices is therefore at
    most ``e_n(g_1, ..., g_N) (M!)^((M - n)/M) / (M - n)!``, with ``g_i = (c_i!)^(1/c_i)``
    (0 if c_i is 0). If all are compatible, this is the number of `log_assignments`.

    Bregman 1973, "Some properties of nonnegative matrices and their permanents".
    """
    count, stars = compatible.shape
    bounds = [np.array([log_assignments(n, count, stars) for n in range(most + 1)])]
    for degrees, others in ((compatible.sum(axis=1), stars), (compatible.sum(axis=0), count)):
        degree = degrees[degrees > 0].astype(np.float64)
        log_factorial = np.array([math.lgamma(d + 1.0) for d in degree])
        whole = math.lgamma(others + 1)
        filled = np.array(
            [(others - n) / others * whole - math.lgamma(others - n + 1) for n in range(most + 1)]
        )
        bounds.append(_log_symmetric(np.log(degree), most))
        bounds.append(_log_symmetric(log_factorial / degree, most) + filled)
    return np.asarray(np.min(bounds, axis=0))


def _log_symmetric(logs: Array, most: int) -> Array:
    """Return the logarithms of the elementary symmetric polynomials up to a degree."""
    found = np.full(most + 1, -np.inf)
    found[0] = 0.0
    for log in logs:
        found[1:] = np.logaddexp(found[1:], found[:-1] + log)
    return found
