"""The probability that chance alone agrees with a frame as well as an attitude does.

It is bounded by an expected number: that of the attitudes, over the whole sky, which put as many
stars as near to centroids that lie anywhere on the detector. This number does not depend on how
many candidates a method has tried.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from starcat.geometry.attitude import determinant
from starcat.geometry.camera import Camera

Array = NDArray[np.float64]

_ALL_ATTITUDES = 8.0 * math.pi**2
"""Volume of the rotations, cubic radians."""


def false_match_probability(
    square_px: float, body: Array, n_centroids: int, stars_in_frame: int, camera: Camera
) -> float:
    """Bound the probability that random centroids agree as well with any attitude.

    Parameters
    ----------
    square_px : float
        Sum of the squared distances between the matched centroids and the places of their
        stars, after the attitude was fitted to them, square pixels.
    body : ndarray of float64, shape (n, 3)
        Directions of the matched centroids in the camera frame, n >= 2.
    n_centroids : int
        Centroids in the frame, matched or not.
    stars_in_frame : int
        Stars of the database that the attitude puts on the detector or within reach of it.
    camera : Camera
        The camera, whose detector size and focal length are used.

    Returns
    -------
    float
        Upper bound, 0 to 1.

    Notes
    -----
    There are ``C(N, n) M! / (M - n)!`` ways to assign n of N centroids to n of M stars. In each
    of them, the frames whose squared residuals sum to less than Q in some attitude fill the
    volume ``8 pi^2 f^3 sqrt(det H)`` times that of a ball of radius sqrt(Q) in the 2n - 3
    dimensions that the fit leaves free, out of A^n for all frames. The first factor is that of
    all attitudes, in pixels; H is the sum, over the n places, of the squared derivatives by the
    three angles. The product is the expected number. Its sum over the N - 3 possible values of
    n bounds the probability. M is counted around the field, so the bound is higher in a crowded
    field, and where most of the field is left unexplained.

    Examples
    --------
    >>> camera = Camera(1024, 1024, 4871.0)
    >>> rays = camera.directions_from_pixels(np.array([[9.0, 9], [900, 99], [500, 900], [99, 800]]))
    >>> exact = false_match_probability(1e-6, rays, 4, 4, camera)
    >>> loose = false_match_probability(100.0, rays, 4, 40, camera)
    >>> exact < 1e-20 < loose
    True
    """
    n, stars = len(body), max(len(body), stars_in_frame)
    x, y = body[:, 0] / body[:, 2], body[:, 1] / body[:, 2]
    # How places move as the camera turns about its three axes, in units of the focal length.
    turned = np.array([[x * y, -1.0 - x * x, y], [1.0 + y * y, -x * y, -x]])
    information = determinant(np.einsum("ain,ajn->ij", turned, turned))
    if not information > 0.0:
        return 1.0
    left = 2 * n - 3
    attitudes = math.log(_ALL_ATTITUDES * camera.focal_length_px**3 * math.sqrt(information))
    unit_ball = 0.5 * left * math.log(math.pi) - math.lgamma(0.5 * left + 1.0)
    ball = unit_ball + 0.5 * left * math.log(max(square_px, 1e-30))
    frames = n * math.log(camera.width_px * camera.height_px)
    ways = _log_ways(n, n_centroids, stars)
    expected = ways + attitudes + ball - frames + math.log(max(1, n_centroids - 3))
    return math.exp(min(0.0, expected))


def _log_ways(n: int, n_centroids: int, stars: int) -> float:
    """Return the logarithm of the number of ways to assign n centroids to n stars."""
    return (
        math.lgamma(n_centroids + 1) - math.lgamma(n + 1) - math.lgamma(n_centroids - n + 1)
    ) + (math.lgamma(stars + 1) - math.lgamma(stars - n + 1))
