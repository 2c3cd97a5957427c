"""Spread: whether the matched stars determine the attitude and the scale of the whole frame.

Ten stars within 100 px hardly determine how the camera is turned about their middle. An attitude
that only they agree with is not due to chance, and yet it may be wrong at the edge of the frame.
So the accuracy that the matched stars give is compared with the one that all stars of the frame
would give.
"""

from __future__ import annotations

import math

import numpy as np

from starcat.arrays import Array
from starcat.geometry.attitude import inverse
from starcat.geometry.camera import Camera
from starcat.matcher.observation import Observation

SCALE_DEVIATIONS = 3.0
"""Standard deviations above which a difference of scale is not taken for chance."""

_UNIT = np.eye(3)


def share_of_frame(
    matched: Array,
    stars: Array,
    residual_rad: float,
    observation: Observation,
    enough: float = 1.0,
) -> float:
    """Return which share of a frame an attitude explains, by weight."""
    with_scale = observation.fov_error > 0.0
    try:
        normal = information(matched, with_scale=with_scale)
        covariance = np.asarray(
            np.linalg.inv(normal) if with_scale else inverse(normal), dtype=np.float64
        )
    except np.linalg.LinAlgError:
        return 0.0
    of_stars = explained_share(covariance, stars)
    if of_stars >= enough:
        return of_stars
    of_centroids = explained_share(covariance, observation.body)
    if of_centroids <= of_stars:
        return of_stars
    # Three of the 2n components went into the attitude, a fourth into the scale.
    deviation_rad = residual_rad * math.sqrt(len(matched) / (2 * len(matched) - len(covariance)))
    corner_rad = deviation_rad * corner_deviation(covariance, observation.camera)
    return of_stars if corner_rad > observation.tolerance_rad else of_centroids


def information(directions: Array, *, with_scale: bool = False) -> Array:
    """Return the information matrix of an attitude that the centroids of stars determine.

    References
    ----------
    Shuster and Oh 1981, "Three-axis attitude determination from vector observations".
    """
    of_angles = len(directions) * _UNIT - directions.T @ directions
    if not with_scale:
        return np.asarray(of_angles)
    x, y, z = directions.T
    found = np.empty((4, 4))
    found[:3, :3] = of_angles
    # A turn d moves the direction u of a star by d x u; a longer focal length moves that of its
    # centroid by u_z e_z - u_z^2 u, towards the axis.
    found[:3, 3] = found[3, :3] = -float(np.vdot(y, z)), float(np.vdot(x, z)), 0.0
    found[3, 3] = float(np.vdot(z * z, 1.0 - z * z))
    return found


def explained_share(covariance: Array, directions: Array) -> float:
    """Return which share of the stars of a frame an attitude explains, by their weight.

    Notes
    -----
    The weight of a star is the variance of its position, given the matched stars. The weights
    of the matched stars themselves add up to three, the number of angles, wherever they are, or
    to four where the scale is free.
    Outside of them the weight grows with the square of the distance: with ten matched stars
    at 50 px from their middle, a star at 500 px has a weight of ten.

    Examples
    --------
    >>> place = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    >>> near = np.column_stack([0.01 * place, np.ones(4)])
    >>> near /= np.linalg.norm(near, axis=1)[:, None]
    >>> far = np.array([[0.1, 0.1, 1.0], [-0.1, 0.0, 1.0]]) / np.sqrt([[1.02], [1.01]])
    >>> covariance = np.linalg.inv(information(near))
    >>> round(explained_share(covariance, near), 6)
    1.0
    >>> round(explained_share(covariance, np.concatenate([near, far])), 3)
    0.02
    """
    unknowns = len(covariance)
    weights = np.vdot(covariance, information(directions, with_scale=unknowns == 4))
    return unknowns / float(weights)


def corner_deviation(covariance: Array, camera: Camera) -> float:
    """Return the error of the worst corner of a frame under an attitude."""
    corners = camera.corner_directions
    if len(covariance) == 3:
        along = np.einsum("ni,ij,nj->n", corners, covariance, corners)
        variance = float(np.trace(covariance) - along.min())
    else:
        variance = max(
            float(np.vdot(covariance, information(corner[None], with_scale=True)))
            for corner in corners
        )
    # Rounding may make it negative where the stars nearly coincide.
    return math.sqrt(max(0.0, variance))


def is_scaled(predicted_px: Array, centroids_px: Array, observation: Observation) -> bool:
    """Return whether a frame differs in scale from the stars that it matches.

    Notes
    -----
    A frame of another scale means that the camera's focal length is wrong. The attitude may be
    right, but towards the edge of the frame stars are taken for their neighbours.
    """
    camera = observation.camera
    inner = predicted_px - predicted_px.sum(axis=0) / len(predicted_px)
    extent = float(np.vdot(inner, inner))
    offset = centroids_px - predicted_px
    excess = float(np.vdot(inner, offset)) / extent
    corner_px = 0.5 * math.hypot(camera.width_px, camera.height_px)
    if abs(excess) * corner_px <= observation.tolerance_px:
        return False
    left = offset - excess * inner
    left -= left.sum(axis=0) / len(left)
    variance = float(np.vdot(left, left)) / (2 * len(left) - 4) / extent
    return excess * excess > SCALE_DEVIATIONS**2 * variance
