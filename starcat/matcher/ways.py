"""The number of ways to assign centroids to stars, which magnitudes make smaller.

A bound on the number of matchings of a bipartite graph: its two sides are the centroids of a frame
and the stars around an attitude, and a centroid is joined to the stars that it is compatible with.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array

Compatible = NDArray[np.bool_]

MAG_DEVIATIONS = 3.5
"""Largest difference of the magnitudes of a centroid and its star, in standard deviations."""


def compatible_pairs(mag: Array, star_mag: Array, noise_mag: float) -> Compatible:
    """Return which centroids may be which stars by their magnitudes.

    Examples
    --------
    >>> compatible_pairs(np.array([3.0, np.nan]), np.array([3.5, 5.0, np.nan]), 0.2)
    array([[ True, False,  True],
           [ True,  True,  True]])
    """
    return np.asarray(~(np.abs(mag[:, None] - star_mag) > MAG_DEVIATIONS * noise_mag))


def log_ways(n: int, n_centroids: int, stars: int) -> float:
    """Return the logarithm of the number of ways to assign n of the centroids to n of the stars.

    Examples
    --------
    >>> round(math.exp(log_ways(2, 3, 4)), 9)
    36.0
    """
    return (
        math.lgamma(n_centroids + 1) - math.lgamma(n + 1) - math.lgamma(n_centroids - n + 1)
    ) + (math.lgamma(stars + 1) - math.lgamma(stars - n + 1))


def log_compatible_ways(most: int, compatible: Compatible) -> Array:
    """Bound the numbers of ways to assign n centroids to n compatible stars.

    Notes
    -----
    Two bounds are taken from the centroids, two from the stars, and the least is returned. Let
    centroid i have c_i compatible stars. If each centroid of a choice took any of its stars, even
    one that is taken, the product of their c_i would count the ways; its sum over all choices of n
    is the elementary symmetric polynomial e_n(c_1, ..., c_N).

    The theorem of Bregman counts stars once: a square matrix of zeros and ones has a permanent of
    at most the product of ``(r!)^(1/r)`` over its rows, r being their sums. The n rows of a
    choice, with M - n rows of ones below them, are such a matrix, and each assignment of the
    choice occurs ``(M - n)!`` times in its permanent. The sum over the choices is therefore
    ``e_n(g_1, ..., g_N) (M!)^((M - n)/M) / (M - n)!`` at the most, with ``g_i = (c_i!)^(1/c_i)``
    (0 where c_i is). If all are compatible, this is the number of `log_ways`.

    References
    ----------
    Bregman 1973, "Some properties of nonnegative matrices and their permanents".

    Examples
    --------
    >>> log_compatible_ways(2, np.eye(2, dtype=bool)).round(9).tolist()
    [0.0, 0.693147181, 0.0]
    """
    count, stars = compatible.shape
    bounds = [np.array([log_ways(n, count, stars) for n in range(most + 1)])]
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
