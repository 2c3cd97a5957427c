"""Poses: an attitude, and the camera that it is tried with.

Where the focal length is known, the camera is the caller's and only the attitude is fitted. Where
it is known to some per cent, it is fitted with the attitude.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.errors import ConfigError
from starcat.geometry.attitude import solve_wahba_near, solve_wahba_svd
from starcat.geometry.camera import Camera
from starcat.matcher.methods.candidates import Candidates
from starcat.matcher.observation import Observation
from starcat.matcher.spread import information

_SCALINGS = 2
"""Rounds that find the scale of a few stars; a second one, because angles are no tangents."""

_THREE_SIGMA = 3.0


@dataclass(frozen=True)
class Pose:
    """An attitude and a camera.

    Attributes
    ----------
    matrix : ndarray of float64, shape (3, 3)
        Attitude, ``body = matrix @ icrs``.
    camera : Camera
        The camera, with the focal length that goes with the attitude.
    body : ndarray of float64, shape (N, 3)
        Directions of all centroids of a frame with that camera.
    """

    matrix: Array
    camera: Camera
    body: Array


def first_poses(
    candidates: Candidates, observation: Observation, icrs: Array
) -> tuple[Array, Array]:
    """Return the attitudes and scales that candidates stand for."""
    body, stars = observation.body[candidates.centroids], icrs[candidates.stars]
    factors = np.ones(len(candidates))
    if observation.fov_error:
        apart = np.sqrt(_squared_chords(stars))
        for _ in range(_SCALINGS):
            seen = np.sqrt(_squared_chords(scaled_directions(body, factors)))
            factors = observation.focal_range.clip(factors * seen / apart)
        body = scaled_directions(body, factors)
    return solve_wahba_svd(body, stars), factors


def scaled_directions(body: Array, factors: Array) -> Array:
    """Return directions as a camera with another focal length sees them."""
    longer = np.empty((len(factors), *body.shape[-2:]))
    longer[..., :2] = body[..., :2]
    np.multiply(body[..., 2], factors[:, None], out=longer[..., 2])
    longer /= np.sqrt(np.einsum("...i,...i->...", longer, longer))[..., None]
    return longer


def _squared_chords(directions: Array) -> Array:
    """Return the sum of the squared chords between neighbours of K groups, shape (K,)."""
    chords = directions - directions[:, np.arange(-1, directions.shape[1] - 1)]
    return np.asarray(np.einsum("kij,kij->k", chords, chords))


def pose_at(matrix: Array, factor: float, observation: Observation) -> Pose:
    """Return the pose of an attitude and a scale."""
    own = observation.camera
    if factor == 1.0:
        return Pose(matrix, own, observation.body)
    try:
        camera = own.with_focal_length(factor * own.focal_length_px)
    except ConfigError:  # the distortion would fold the image back on the detector
        return Pose(matrix, own, observation.body)
    return Pose(matrix, camera, camera.directions_from_pixels(observation.centroids_px))


def refitted(
    pose: Pose, matched: NDArray[np.int64], stars: Array, observation: Observation
) -> Pose:
    """Return the pose that fits centroids and their stars best."""
    if not observation.fov_error:
        near = solve_wahba_near(pose.body[matched], stars, pose.matrix)
        return Pose(near, pose.camera, pose.body)
    seen = pose.body[matched]
    predicted = stars @ pose.matrix.T
    left = seen - predicted
    turn, shrink = np.cross(predicted, left).sum(axis=0), float(np.vdot(_by_scale(seen), left))
    try:
        step = np.linalg.solve(information(seen, with_scale=True), np.append(turn, shrink))
    except np.linalg.LinAlgError:
        step = np.zeros(4)
    longer = math.exp(min(max(float(step[3]), -1.0), 1.0))
    factor = pose.camera.focal_length_px / observation.camera.focal_length_px * longer
    scaled = pose_at(pose.matrix, float(observation.focal_range.clip(factor)), observation)
    return Pose(solve_wahba_svd(scaled.body[matched], stars), scaled.camera, scaled.body)


def _by_scale(body: Array) -> Array:
    """Return how directions move as the focal length that they are computed with shrinks.

    A longer focal length moves them towards the axis: the derivative by its logarithm is the
    negative of this.
    """
    z = body[:, 2:]
    moved = z * z * body
    moved[:, 2] -= body[:, 2]
    return np.asarray(moved)


def focal_length_error_px(
    pose: Pose, matched: NDArray[np.int64], residual_rad: float, observation: Observation
) -> float:
    """Return the standard error of a focal length that was fitted with an attitude."""
    focal_px, n = pose.camera.focal_length_px, len(matched)
    try:
        covariance = np.linalg.inv(information(pose.body[matched], with_scale=True))
    except np.linalg.LinAlgError:
        return math.inf
    if observation.noise_px is not None:
        sigma_rad = observation.noise_px / focal_px
    else:
        free = 2 * n - 4
        sigma_rad = residual_rad * math.sqrt(n / free) * _student(free) / _THREE_SIGMA
    return focal_px * sigma_rad * math.sqrt(max(0.0, float(covariance[3, 3])))


def _student(free: int) -> float:
    """Return the quantile of Student's t that three sigma are of the normal distribution.

    References
    ----------
    Abramowitz and Stegun 1964, 26.7.5.
    """
    z = _THREE_SIGMA
    return (
        z
        + (z**3 + z) / (4.0 * free)
        + (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / (96.0 * free**2)
        + (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / (384.0 * free**3)
    )
