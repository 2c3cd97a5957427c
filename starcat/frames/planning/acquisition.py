"""The probability that frames are identified, and the errors of their attitudes, before they exist.

A star is detected with its own probability. With n detected stars, the answer is certain enough if
the squared residuals are below a limit that depends on n, on where the stars are, and on how many
stars the database has in the frame (`starcat.matcher.chance`); these residuals in units of the
noise have a chi-square distribution with 2n - 3 degrees of freedom. The sum over n, weighted by the
probability that n stars are detected, is the probability of acquisition. It supposes that the
method proposes the right stars whenever there are enough of them.
"""

from __future__ import annotations

import numpy as np
import scipy

from starcat.arrays import Array, Directions, Pixels, Rows
from starcat.geometry.attitude import information_terms
from starcat.geometry.camera import Camera
from starcat.matcher.chance import MIN_STARS, largest_squares_px, place_information
from starcat.matcher.stars import ARCSEC, turns_per_px

ENOUGH_STARS = 40
"""More detected stars than this count as this many; far fewer are enough for an answer."""


def detected_counts(probability: Array, group: Rows, count: int) -> Array:
    """Return the probabilities that 0, 1, ... stars of each group are detected.

    ``probability`` and ``group``, ascending, have the shape (P,). The result has the shape
    (count, ENOUGH_STARS + 1); its last column includes all larger numbers.
    """
    chance = np.zeros((count, ENOUGH_STARS + 1))
    chance[:, 0] = 1.0
    rank = np.arange(len(group)) - np.searchsorted(group, group)
    for star in range(int(rank.max(initial=-1)) + 1):
        rows = rank == star
        p, at = probability[rows, None], group[rows]
        before = chance[at]
        after = before * (1.0 - p)
        after[:, 1:] += before[:, :-1] * p
        after[:, -1] += before[:, -1] * p[:, 0]
        chance[at] = after
    return chance


def acquisition_probability(
    body: Directions,
    probability: Array,
    group: Rows,
    in_frame: Rows,
    n_false: Rows,
    camera: Camera,
    noise_px: float,
    limit: float,
) -> Array:
    """Return the probability that each of K frames is identified.

    Parameters
    ----------
    body : ndarray of float64, shape (P, 3)
        Directions of the stars of all frames in the camera's frame.
    probability, group : ndarray, shape (P,)
        Probability that each star is detected, and its frame, 0 to K - 1, ascending.
    in_frame, n_false : ndarray of int, shape (K,)
        Stars of the database in each frame, detected or not, and centroids that are not stars.
    camera : Camera
    noise_px : float
        Standard deviation of a centroid on each axis, as given to the matcher.
    limit : float
        Largest false-match probability of an answer.
    """
    count = len(in_frame)
    expected = np.bincount(group, probability, count)
    gram = np.empty((count, 3, 3))
    for (i, j), term in place_information(body).items():
        gram[:, i, j] = gram[:, j, i] = np.bincount(group, term * probability, count)
    spread = np.maximum(np.linalg.det(gram), 0.0) / np.maximum(expected, 1e-9) ** 3
    counts = detected_counts(probability, group, count)
    acquisition = np.zeros(count)
    kinds, kind = np.unique(np.stack([in_frame, n_false], axis=1), axis=0, return_inverse=True)
    for number, (stars, false) in enumerate(kinds.tolist()):
        rows = np.flatnonzero(kind.ravel() == number)
        for n in range(MIN_STARS, min(stars, ENOUGH_STARS) + 1):
            square_px = largest_squares_px(
                n, n + false, stars, n**3 * spread[rows], camera, noise_px, limit
            )
            is_certain = scipy.special.gammainc(n - 1.5, 0.5 * square_px / noise_px**2)
            acquisition[rows] += counts[rows, n] * is_certain
    return np.asarray(np.minimum(acquisition, 1.0))


def expected_errors_arcsec(
    body: Directions,
    px: Pixels,
    probability: Array,
    group: Rows,
    count: int,
    camera: Camera,
    noise_px: float,
) -> Array:
    """Return the standard deviations of attitudes about the axes of the camera, shape (count, 3).

    They are computed as in `attitude_covariance`, with every star weighted by its probability to
    be detected; infinite if the stars determine no attitude.
    """
    normal, torque = np.zeros((count, 3, 3)), np.zeros((count, 3, 3))
    for (i, j), term in information_terms(body).items():
        normal[:, i, j] = normal[:, j, i] = np.bincount(group, term * probability, count)
    for turns in turns_per_px(px, body, camera):
        for i, j in np.ndindex(3, 3):
            torque[:, i, j] += np.bincount(group, turns[:, i] * turns[:, j] * probability, count)
    deviations = np.full((count, 3), np.inf)
    eigenvalues = np.linalg.eigvalsh(normal)
    is_determined = (eigenvalues[:, 0] > 1e-9) & (np.bincount(group, probability, count) >= 2.0)
    inverse = np.linalg.inv(normal[is_determined])
    covariance = inverse @ torque[is_determined] @ inverse
    deviations[is_determined] = (
        np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)) * noise_px * ARCSEC
    )
    return deviations
