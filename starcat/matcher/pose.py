"""Poses: an attitude, the camera and the shape of the frame that it is tried with, and their fit.

If the focal length is known, the camera is the caller's and only the attitude is fitted. If it is
known to some per cent, it is fitted with the attitude. A shape of the frame is fitted by
`fit_shape`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Directions, Matrix, Pixels, Rows
from starcat.errors import ConfigError
from starcat.geometry.attitude import (
    Turn,
    after_turn,
    information,
    matrix_from_quaternion,
    quaternion_from_matrix,
    solve_wahba_svd,
)
from starcat.geometry.camera import Camera
from starcat.matcher.observation import Candidates, Observation
from starcat.matcher.shape import (
    FREE_TERMS,
    LARGEST_TERM,
    N_TERMS,
    NO_SHAPE,
    Shape,
    derivatives,
    half_ranges,
    solve_normal,
    undone_px,
)

_SCALINGS = 2
"""Rounds that find the scale of a few stars. The second corrects for angles taken as tangents."""

_STEPS_OF_SHAPE = 3
"""Steps of a fit that begins within some pixels of its end; the second is exact to 1e-6 px."""

MIN_WEIGHT = 1e-8
"""Least weight of a centroid over the largest of its frame; rounding errors exclude lower ones."""


@dataclass(frozen=True)
class Pose:
    """An attitude, a camera, and the shape of a frame."""

    matrix: Matrix  # attitude, ``body = matrix @ icrs``; shape (3, 3)
    camera: Camera  # the camera, with the focal length that goes with the attitude
    body: Directions  # directions of all centroids of a frame with that camera; shape (N, 3)
    px: Pixels  # places of all centroids without the shape; shape (N, 2)
    shape: Shape = NO_SHAPE


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
            factors = np.clip(factors * seen / apart, *observation.focal_range)
        body = scaled_directions(body, factors)
    return solve_wahba_svd(body, stars), factors


def linear_shapes(
    centroids: NDArray[np.integer[Any]], stars: Array, observation: Observation
) -> Array:
    """Return the scale, stretch and shear with which three centroids each are three stars.

    Centroids, shape (K, 3), and directions of stars, shape (K, 3, 3); the result has the shape
    (K, 3). Undone, the terms leave a turn of the camera, which is what QR decomposition separates.
    """
    if not len(centroids):
        return np.empty((0, 3))
    turned = stars @ np.swapaxes(solve_wahba_svd(observation.body[centroids], stars), 1, 2)
    at_stars = observation.camera.pixels_from_directions(turned.reshape(-1, 3)).reshape(-1, 3, 2)
    seen = observation.centroids_px[centroids]
    (ax, ay), (bx, by) = ((p[:, 1:] - p[:, :1]).transpose(2, 1, 0) for p in (at_stars, seen))
    # The linear map from the sides of the centroids to those of the stars, by Cramer's rule.
    area = bx[0] * by[1] - bx[1] * by[0]
    xx, yx = ((a[0] * by[1] - a[1] * by[0]) / area for a in (ax, ay))
    xy, yy = ((a[1] * bx[0] - a[0] * bx[1]) / area for a in (ax, ay))
    along_x = np.hypot(xx, yx)
    along_y = (xx * yy - xy * yx) / along_x
    return np.stack([1.0 - along_x, along_x - along_y, -(xx * xy + yx * yy) / along_x], axis=1)


def shaped_poses(candidates: Candidates, observation: Observation, icrs: Array) -> Iterator[Pose]:
    """Yield the poses of triangles with a linear shape of the frame."""
    shapes = linear_shapes(candidates.centroids, icrs[candidates.stars], observation)
    for centroids, stars, linear in zip(
        candidates.centroids, icrs[candidates.stars], shapes, strict=True
    ):
        terms = np.zeros(N_TERMS)
        terms[[0, 2, 3]] = linear
        pose = pose_of_shape(np.eye(3), Shape(terms, FREE_TERMS), observation)
        yield replace(pose, matrix=solve_wahba_svd(pose.body[centroids], stars))


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
    stated = observation.camera
    px = observation.centroids_px
    if factor == 1.0:
        return Pose(matrix, stated, observation.body, px)
    try:
        camera = stated.with_focal_length(factor * stated.focal_length_px)
    except ConfigError:  # the distortion would fold the image back on the detector
        return Pose(matrix, stated, observation.body, px)
    return Pose(matrix, camera, camera.directions_from_pixels(px), px)


def fit(pose: Pose, matched: Rows, stars: Array, observation: Observation) -> Pose:
    """Return the pose that fits centroids and their stars best."""
    if not observation.fov_error:
        return replace(pose, matrix=solve_wahba_svd(pose.body[matched], stars))
    seen = pose.body[matched]
    predicted = stars @ pose.matrix.T
    residual = seen - predicted
    turn, shrink = (
        np.cross(predicted, residual).sum(axis=0),
        float(np.vdot(_by_scale(seen), residual)),
    )
    try:
        step = np.linalg.solve(information(seen, with_scale=True), np.append(turn, shrink))
    except np.linalg.LinAlgError:
        step = np.zeros(4)
    longer = math.exp(min(max(float(step[3]), -1.0), 1.0))
    factor = pose.camera.focal_length_px / observation.camera.focal_length_px * longer
    shortest, longest = observation.focal_range
    scaled = pose_at(pose.matrix, min(max(factor, shortest), longest), observation)
    return replace(scaled, matrix=solve_wahba_svd(scaled.body[matched], stars))


def fit_shape(
    pose: Pose,
    matched: Rows,
    predicted_px: Pixels,
    observation: Observation,
    free: int,
    sigma_px: float,
) -> Pose | None:
    """Return the pose after one step of a fit of the attitude and ``free`` terms of the shape.

    ``predicted_px`` are the places of the stars of the matched centroids. None if the fit runs
    away.
    """
    camera, half = observation.camera, observation.half_ranges
    rows = derivatives(observation.centroids_px[matched], pose.body[matched], camera, free)
    terms = pose.shape.terms
    normal = solve_normal(pose.px[matched] - predicted_px, rows, terms, half, sigma_px)
    return None if normal is None else after_step(pose, normal.step, observation)


def after_step(pose: Pose, step: Array, observation: Observation) -> Pose | None:
    """Return the pose after a step of a fit; None if the fit runs away."""
    free = len(step) - 3
    terms = pose.shape.terms.copy()
    terms[:free] += step[3:]
    if np.abs(terms).max() > LARGEST_TERM:
        return None
    return pose_of_shape(_turned(pose.matrix, step), Shape(terms, free), observation)


def _turned(matrix: Matrix, step: Array) -> Matrix:
    """Return an attitude after the turn of a step of a fit: directions turn against the camera."""
    x, y, z = (-step[:3]).tolist()
    turn: Turn = x, y, z
    q = after_turn(quaternion_from_matrix(matrix).tolist(), turn)
    return matrix_from_quaternion(np.array(list(q)))


def pose_of_shape(matrix: Matrix, shape: Shape, observation: Observation) -> Pose:
    """Return the pose of an attitude and a shape of the frame."""
    camera = observation.camera
    px = undone_px(observation.centroids_px, shape.terms, camera)
    return Pose(matrix, camera, camera.directions_from_pixels(px), px, shape)


def shaped(pose: Pose, observation: Observation) -> Pose:
    """Return a pose with its focal length as the first term of a shape."""
    if pose.camera is observation.camera:
        return pose
    terms = np.zeros(N_TERMS)
    terms[0] = 1.0 - observation.camera.focal_length_px / pose.camera.focal_length_px
    return pose_of_shape(pose.matrix, Shape(terms, 1), observation)


def weights_of(sigma_px: Array) -> Array:
    """Return the weights of centroids by their noise, over the largest; least where not known."""
    noise_px = np.where(np.isfinite(sigma_px), sigma_px, np.inf)
    least = noise_px.min(initial=np.inf)
    if least == np.inf:
        return np.ones(len(noise_px))
    return np.asarray(np.maximum((least / noise_px) ** 2, MIN_WEIGHT))


def fit_by_weights(
    seen: Directions, stars: Directions, sigma_px: Array | None
) -> tuple[Matrix, float]:
    """Return the attitude that fits centroids best by their noise, and its residual, radians."""
    matrix = solve_wahba_svd(seen, stars, None if sigma_px is None else weights_of(sigma_px))
    difference = seen - stars @ matrix.T
    return matrix, math.sqrt(float(np.vdot(difference, difference)) / len(seen))


def fit_shape_by_weights(
    px: Pixels, stars: Directions, sigma_px: Array, matrix: Matrix, camera: Camera, shape: Shape
) -> tuple[Matrix, float]:
    """Return the attitude that fits centroids best with their shape, and its residual, radians.

    The fit begins with an attitude and a shape that are nearly right. No range limits its terms.
    """
    weight = np.sqrt(weights_of(sigma_px))[:, None]
    terms = shape.terms.copy()
    for _ in range(_STEPS_OF_SHAPE):
        places_px = undone_px(px, terms, camera)
        body = camera.directions_from_pixels(places_px)
        residual_px = places_px - camera.pixels_from_directions(stars @ matrix.T)
        rows = derivatives(px, body, camera, shape.free) * weight[..., None]
        normal = solve_normal(residual_px * weight, rows, terms, half_ranges(0.0), 0.0)
        if normal is None:
            break
        matrix = _turned(matrix, normal.step)
        terms[: shape.free] += normal.step[3:]
    seen = camera.directions_from_pixels(undone_px(px, terms, camera))
    return fit_by_weights(seen, stars, sigma_px)


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
    matched: Directions, focal_length_px: float, residual_rad: float, noise_px: float | None
) -> float:
    """Return the standard error of a focal length that was fitted with an attitude."""
    try:
        covariance = np.linalg.inv(information(matched, with_scale=True))
    except np.linalg.LinAlgError:
        return math.inf
    if noise_px is not None:
        sigma_rad = noise_px / focal_length_px
    else:
        free = 2 * len(matched) - 4
        sigma_rad = residual_rad * math.sqrt(len(matched) / free) * student_widening(free)
    return focal_length_px * sigma_rad * math.sqrt(max(0.0, float(covariance[3, 3])))


def student_widening(free: int) -> float:
    """Return the factor that widens a standard error from residuals with ``free`` degrees.

    Three widened errors have the coverage of three standard deviations. The factor is the quantile
    of Student's t over the normal quantile (Abramowitz and Stegun 1964, 26.7.5, at z = 3), within
    1.5 % from 5 degrees on. ``onboard/src/answer.c`` has the same function.
    """
    return 1.0 + (2.5 + (5.75 + 10.0625 / free) / free) / free
