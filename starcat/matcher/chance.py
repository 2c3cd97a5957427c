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

Prior. Near a prior attitude only the attitudes within its error are searched, and their volume
takes the place of the volume of all attitudes (`log_attitudes_within`). The expected number is that
of the attitudes within the error. So the bound holds whether the prior is right or wrong, if the
prior does not depend on the places of the frame's centroids.

Shape. If terms of the frame's shape are fitted too (`starcat.matcher.shape`), the frames that
agree form a manifold with as many more dimensions. Its volume is the integral over the box of the
ranges of the terms: ``8 pi^2 prod(2 h) sqrt(det J^T J)`` times the volume of a ball in 2n - 3 - d
dimensions, J being the derivatives of the places by the angles and the d terms, and h their largest
values. The faces, edges and corners of the box add the numbers of the models with fewer terms. The
areas around the places before the shape was undone are larger or smaller (`log_growth`). A known
camera has the corner alone, a focal length that is known to some per cent has one edge.

Magnitudes. Assignments of centroids to stars that they are not compatible with are never
agreements, so they are not counted. If the noise of the centroids is stated too, a magnitude is a
residual as a place is: the square of its difference, in whole standard deviations, is added to Q in
units of the noise of a place. An assignment whose magnitudes differ by s in all leaves a ball of
the squared radius Q - s for the places. With half of its dimensions k, and the typical rate of 1/3
(k = n - 3/2, and Q has 3n - 3 dimensions), its volume is at most ``Q^k exp(-s / 3)``, times a term
that is above 1 only for larger Q than the typical one (`_log_ball`). So each pair of a centroid and
a star counts ``exp(-d^2 / 3)``, with d their difference (`log_weighted_assignments`).

The hypothesis is that the places of the centroids are random; it makes no assumption about their
magnitudes. So the expected number is the number for random places with the magnitudes of the frame,
whatever they are. It also holds if false spots have the same magnitudes as stars, and if the stated
error is wrong (then true frames can be missed).

Noise. If no noise is stated, each of the N - 3 values of n is allotted the same share of
the probability: the expected number is divided by 1 / (N - 3). Any other shares are valid
too, if they add up to 1 at every attitude and do not depend on where the centroids are. A
stated noise shows, before any residual is seen, which n will matter: those whose agreements are
typically about as rare as the limit of 1e-9. Fewer stars are seldom enough, and more stars need no
share, because they are far beyond certain. So the share of n falls as the fifth root of the factor
by which its typical expected number is above or below 1e-9 (`_log_share`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from itertools import combinations

import numpy as np

from starcat.arrays import Array, Deviations
from starcat.geometry.camera import Camera
from starcat.matcher.settings import CERTAIN

LOG_ALL_ATTITUDES = math.log(8.0 * math.pi**2)
"""Logarithm of the volume of all rotations, cubic radians."""

NO_TERMS = np.empty(0)

MIN_STARS = 4
"""Smallest number of matched stars: three determine an attitude, a fourth confirms it."""

LOG_NO_WAYS = -1e30
"""Stands for the logarithm of 0, so that differences of it are numbers."""

INCOMPATIBLE = 4
"""Whole deviations of magnitudes that differ by more than a centroid and its star can."""

MAGNITUDE_RATE = 1.0 / 3.0
"""Rate by which a squared deviation lowers the logarithm of the number of assignments."""

FALL_OF_SHARE = 0.2
"""Power of the factor from the limit to a typical expected number with which shares fall."""


def log_false_match_probability(
    square_px: float,
    rows: Array,
    n_centroids: int,
    stars_in_frame: int,
    camera: Camera,
    *,
    noise_px: float | None = None,
    deviations: Deviations | None = None,
    half_ranges: Array = NO_TERMS,
    log_growth: float = 0.0,
    log_attitudes: float = LOG_ALL_ATTITUDES,
) -> float:
    """Bound the probability that random centroids agree as well with any attitude: its logarithm.

    ``square_px`` is the sum of the squared residuals, those of magnitudes in units of the noise of
    a place; ``deviations`` are those of all centroids and stars. ``rows``, shape (n, 2, 3 + d), are
    the derivatives of the places of the centroids that agree, in pixels, by three angles and by the
    d terms that were fitted too. ``half_ranges`` are the largest values of these terms.
    ``log_attitudes`` is the logarithm of the volume of the attitudes that are searched.
    """
    n = len(rows)
    stars = max(n, stars_in_frame)
    if noise_px is not None and n < MIN_STARS:
        return 0.0
    most = n if noise_px is None else min(n_centroids, stars)
    assignments: Callable[[int], float] = partial(
        log_assignments, n_centroids=n_centroids, stars=stars
    )
    rate = 0.0
    if deviations is not None:
        assignments = log_weighted_assignments(most, deviations).item
        rate = rate_of_magnitudes(noise_px)
    if noise_px is None:
        log_values = math.log(max(1, n_centroids - 3))
    else:
        log_values = -_log_share(n, most, assignments, noise_px, camera, log_attitudes, rate)
    jacobian = rows.reshape(2 * n, -1)
    gram = jacobian.T @ jacobian
    total = -math.inf
    for size in range(len(half_ranges) + 1):
        for terms in combinations(range(len(half_ranges)), size):
            columns = [0, 1, 2, *(3 + term for term in terms)]
            sign, log_determinant = np.linalg.slogdet(gram[np.ix_(columns, columns)])
            if sign <= 0 or 2 * n <= len(columns):
                if not terms:
                    return 0.0
                continue  # these terms move no place: the face has no volume
            box = sum(math.log(2.0 * half_ranges[term]) for term in terms)
            log_root = 0.5 * log_determinant + log_attitudes - LOG_ALL_ATTITUDES
            expected = _log_expected(assignments(n), n, log_root, camera)
            face = expected + _log_ball(2 * n - len(columns), square_px, rate)
            total = float(np.logaddexp(total, box + face))
    return min(0.0, total + log_growth + log_values)


def log_attitudes_within(angle_rad: float) -> float:
    """Return the logarithm of the volume of the attitudes within an angle of rotation.

    The ball of the radius of the angle has at least this volume.
    """
    return min(LOG_ALL_ATTITUDES, math.log(4.0 / 3.0 * math.pi) + 3.0 * math.log(angle_rad))


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

    For these sums the bound (`log_false_match_probability`) is ``limit``, if the noise is stated.
    ``information`` are determinants of sums of the squared derivatives (`place_information`).
    """
    most = min(n_centroids, stars_in_frame)
    assignments = partial(log_assignments, n_centroids=n_centroids, stars=stars_in_frame)
    log_values = -_log_share(n, most, assignments, noise_px, camera)
    log_root = 3.0 * math.log(camera.focal_length_px)
    expected = _log_expected(assignments(n), n, log_root, camera) + log_values
    expected += _log_ball(2 * n - 3, 1.0)
    with np.errstate(divide="ignore"):
        log_margin = math.log(limit) - expected - 0.5 * np.log(information)
    return np.asarray(np.exp(np.minimum(log_margin / (n - 1.5), 700.0)))


def place_information(body: Array) -> dict[tuple[int, int], Array]:
    """Return the terms of each direction in the sums of products of derivatives by three angles.

    Arrays of shape (N,) by row and column, on and above the diagonal; directions have the
    shape (N, 3). In units of the focal length.
    """
    x, y = (body[:, :2] / body[:, 2:]).T
    rows = np.stack([x * y, -1.0 - x * x, y]), np.stack([1.0 + y * y, -x * y, -x])
    return {(i, j): sum(row[i] * row[j] for row in rows) for i in range(3) for j in range(i, 3)}


def rate_of_magnitudes(noise_px: float | None) -> float:
    """Return `MAGNITUDE_RATE` per squared pixel; 0 if magnitudes are no residuals."""
    return 0.0 if noise_px is None else MAGNITUDE_RATE / noise_px**2


def _log_expected(log_assignments_of_n: float, n: int, log_root: float, camera: Camera) -> float:
    """Return the logarithm of the expected number of agreements of n stars, without `_log_ball`.

    ``log_root`` is the logarithm of the root of the determinant of the squared derivatives by the
    unknowns, in pixels.
    """
    frames = n * math.log(camera.width_px * camera.height_px)
    return log_assignments_of_n + LOG_ALL_ATTITUDES + log_root - frames


def _log_ball(dimensions: int, square_px: float, rate: float = 0.0) -> float:
    """Return the logarithm of the volume of a ball, by the square of its radius.

    With a ``rate``, the volume times ``exp(-rate s)`` is at least that of the ball of the square
    less any s.
    """
    half = 0.5 * dimensions
    square_px = max(square_px, 1e-30)
    excess = rate * square_px / half
    beyond = half * (excess - 1.0 - math.log(excess)) if excess > 1.0 else 0.0
    return half * math.log(math.pi * square_px) - math.lgamma(half + 1.0) + beyond


def _log_share(
    n: int,
    most: int,
    assignments: Callable[[int], float],
    noise_px: float,
    camera: Camera,
    log_attitudes: float = LOG_ALL_ATTITUDES,
    rate: float = 0.0,
) -> float:
    """Return the logarithm of the share of n, which is at most ``most``."""
    typical = (
        _log_typical(number, assignments, noise_px, camera, log_attitudes, rate)
        for number in range(MIN_STARS, most + 1)
    )
    shares = np.array([-FALL_OF_SHARE * abs(log - math.log(CERTAIN)) for log in typical])
    return float(shares[n - MIN_STARS] - np.logaddexp.reduce(shares))


def least_matches(
    n_centroids: int, stars: int, camera: Camera, noise_px: float, limit: float
) -> int:
    """Return the smallest number of matches that is typically accepted, of ``stars`` in a frame."""
    assignments = partial(log_assignments, n_centroids=n_centroids, stars=stars)
    most = min(n_centroids, stars)
    for number in range(MIN_STARS, most):
        if _log_typical(number, assignments, noise_px, camera) <= math.log(limit):
            return number
    return most


def _log_typical(
    n: int,
    assignments: Callable[[int], float],
    noise_px: float,
    camera: Camera,
    log_attitudes: float = LOG_ALL_ATTITUDES,
    rate: float = 0.0,
) -> float:
    """Return the logarithm of the expected number of typical agreements of n stars.

    Their residuals are what noise makes on average, and they are spread over the whole frame.
    """
    residuals = 2 * n - 3 + (n if rate > 0.0 else 0)
    square_of_frame = (camera.width_px**2 + camera.height_px**2) / 12.0
    log_root = 0.5 * (3.0 * math.log(n) + math.log(square_of_frame))
    log_root += 2.0 * math.log(camera.focal_length_px) + log_attitudes - LOG_ALL_ATTITUDES
    expected = _log_expected(assignments(n), n, log_root, camera)
    return expected + _log_ball(2 * n - 3, residuals * noise_px**2)


def log_assignments(n: int, n_centroids: int, stars: int) -> float:
    """Return the logarithm of the number of assignments of n centroids to n stars."""
    return (
        math.lgamma(n_centroids + 1) - math.lgamma(n + 1) - math.lgamma(n_centroids - n + 1)
    ) + (math.lgamma(stars + 1) - math.lgamma(stars - n + 1))


def log_weighted_assignments(most: int, deviations: Deviations) -> Array:
    """Bound the logarithms of the sums of the weights of the assignments of 0 to ``most`` stars.

    A pair of a centroid and a star has the weight ``exp(-d^2 / 3)``, d being the whole deviations
    of their magnitudes (0 if they are `INCOMPATIBLE`), and an assignment the product of its pairs.

    The theorem of Bregman bounds the permanent of a square matrix of zeros and ones by the product
    of ``(r!)^(1/r)`` over its rows, r being their sums. A permanent is linear in each row, and a
    row of weights is a sum of rows of zeros and ones: of the pairs that differ by d at most, times
    what the weight falls from d to d + 1. So the permanent is at most the product of such sums g_i
    of ``(r!)^(1/r)``. The n rows of a choice, with M - n rows of ones below them, form a square
    matrix, and each assignment of the choice occurs ``(M - n)!`` times in its permanent. The sum
    over the choices is therefore at most ``e_n(g_1, ..., g_N) (M!)^((M - n)/M) / (M - n)!``, with
    the elementary symmetric polynomial e_n. Rows are centroids or stars, whichever are fewer: so
    the bound is lower. If all weights are 1, it is the number of `log_assignments`.

    Few pairs are compatible if magnitudes are accurate. Then e_n of the sums of the weights of each
    row, which lets rows have one column, is less, and is returned.

    Bregman 1973, "Some properties of nonnegative matrices and their permanents".
    """
    rows = deviations if deviations.shape[0] <= deviations.shape[1] else deviations.T
    others = rows.shape[1]
    roots = np.exp([math.lgamma(r + 1.0) / max(r, 1) for r in range(others + 1)])
    roots[0] = 0.0
    weight = np.append(np.exp(-MAGNITUDE_RATE * np.arange(INCOMPATIBLE) ** 2), 0.0)
    sums = np.zeros(len(rows))
    for d, fall in enumerate(weight[:-1] - weight[1:]):
        sums += fall * roots[(rows <= d).sum(axis=1)]
    plain = weight[rows].sum(axis=1)
    degrees = np.arange(most + 1)
    filled = (others - degrees) / others * math.lgamma(others + 1)
    filled -= np.array([math.lgamma(others - n + 1) for n in degrees])
    least = np.minimum(_log_symmetric(sums, most) + filled, _log_symmetric(plain, most))
    return np.asarray(np.maximum(least, LOG_NO_WAYS))


def _log_symmetric(numbers: Array, most: int) -> Array:
    """Return the logarithms of the elementary symmetric polynomials up to a degree."""
    log_sums = np.full(most + 1, -np.inf)
    log_sums[0] = 0.0
    for log in np.log(numbers[numbers > 0.0]):
        log_sums[1:] = np.logaddexp(log_sums[1:], log_sums[:-1] + log)
    return log_sums
