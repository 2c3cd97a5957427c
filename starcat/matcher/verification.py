"""Verification: whether an attitude explains a frame, and how likely that is by chance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcat.attitude import solve_wahba_svd
from starcat.camera import Camera
from starcat.matcher.database import Database

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Agreement:
    """How well an attitude explains a frame.

    Attributes
    ----------
    matrix : ndarray of float64, shape (3, 3)
        Attitude refined on all matched stars.
    star_index : ndarray of int32, shape (N,)
        Row of each centroid's star, -1 where none.
    stars_in_frame : int
        Database stars that the attitude puts on the detector.
    residual_rad : float
        Root mean square separation of the matched.
    """

    matrix: Array
    star_index: NDArray[np.int32]
    stars_in_frame: int
    residual_rad: float

    @property
    def n_matched(self) -> int:
        """Number of centroids with a star."""
        return int((self.star_index >= 0).sum())


def agree(
    matrix: Array,
    body: Array,
    centroids_px: Array,
    camera: Camera,
    database: Database,
    radius_px: float,
) -> Agreement:
    """Match the centroids of a frame with the stars that an attitude predicts.

    Parameters
    ----------
    matrix : ndarray of float64, shape (3, 3)
        Attitude to test, ``body = matrix @ icrs``.
    body : ndarray of float64, shape (N, 3)
        Directions of the centroids in the camera frame.
    centroids_px : ndarray of float64, shape (N, 2)
        The centroids.
    camera : Camera
        The camera.
    database : Database
        The stars.
    radius_px : float
        Largest distance at which a star and a centroid agree.

    Returns
    -------
    Agreement
        After one refinement on all stars that matched; each star has one centroid at most.
    """
    near = np.flatnonzero(database.directions @ matrix[2] >= np.cos(0.55 * camera.diagonal_rad))
    index, in_frame = _nearest(matrix, near, centroids_px, camera, database, radius_px)
    for _ in range(2):
        matched = index >= 0
        if matched.sum() < 2:
            break
        matrix = solve_wahba_svd(body[matched], database.directions[index[matched]])
        index, in_frame = _nearest(matrix, near, centroids_px, camera, database, radius_px)
    matched = index >= 0
    difference = body[matched] - database.directions[index[matched]] @ matrix.T
    square = float(np.einsum("ij,ij->", difference, difference)) / max(1, int(matched.sum()))
    return Agreement(matrix, index, in_frame, float(np.sqrt(square)))


def _nearest(
    matrix: Array,
    near: NDArray[np.int64],
    centroids_px: Array,
    camera: Camera,
    database: Database,
    radius_px: float,
) -> tuple[NDArray[np.int32], int]:
    """Give each centroid the star that is nearest to it, if the star has none nearer."""
    index = np.full(len(centroids_px), -1, dtype=np.int32)
    predicted = camera.pixels_from_directions(database.directions[near] @ matrix.T)
    inside = camera.contains(predicted)
    near, predicted = near[inside], predicted[inside]
    if not len(near):
        return index, 0
    offset = centroids_px[:, None, :] - predicted[None, :, :]
    square = np.einsum("ijk,ijk->ij", offset, offset)
    star = square.argmin(axis=1)
    rows = np.arange(len(centroids_px))
    mutual = (square[:, star].argmin(axis=0) == rows) & (square[rows, star] <= radius_px**2)
    index[mutual] = near[star[mutual]]
    return index, len(near)


def chance_of_agreement(
    n_centroids: int, n_matched: int, n_fixed: int, stars_in_frame: int, area_fraction: float
) -> float:
    """Return the chance that a wrong attitude explains as many centroids.

    Parameters
    ----------
    n_centroids, n_matched : int
        Centroids in the frame, and those with a star.
    n_fixed : int
        Centroids that the attitude was computed from, which agree by construction.
    stars_in_frame : int
        Database stars on the detector.
    area_fraction : float
        Area of the circle of agreement over the area of the detector.

    Returns
    -------
    float
        Binomial tail: at least ``n_matched - n_fixed`` of ``n_centroids - n_fixed`` points
        fall within the circle of some star.

    Examples
    --------
    >>> chance_of_agreement(10, 3, 3, 20, 1e-5)
    1.0
    """
    trials, wanted = n_centroids - n_fixed, n_matched - n_fixed
    if wanted <= 0:
        return 1.0
    p = min(0.5, stars_in_frame * area_fraction)
    if p <= 0.0:
        return 0.0
    term, tail = 1.0, 0.0
    for k in range(trials + 1):
        if k >= wanted:
            tail += term * (1.0 - p) ** (trials - k)
        term *= p * (trials - k) / (k + 1)
    return float(min(1.0, tail))
