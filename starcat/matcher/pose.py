"""Poses: an attitude and the camera that it is tried with, their fit, and how far the fit holds.

If the focal length is known, the camera is the caller's and only the attitude is fitted. If it is
known to some per cent, it is fitted with the attitude.

Ten stars within 100 px hardly determine how the camera is turned about their middle. An attitude
that only they agree with is not due to chance, and yet it can be wrong at the edge of the frame.
So the accuracy that the matched stars give is compared with the accuracy that all stars of the
frame would give.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from starcat.arrays import Array, Directions, Matrix, Pixels, Rows
from starcat.errors import ConfigError
from starcat.geometry.attitude import information, solve_wahba_svd
from starcat.geometry.camera import Camera
from starcat.matcher.observation import Candidates, Observation

_SCALINGS = 2
"""Rounds that find the scale of a few stars. The second corrects for angles taken as tangents."""

SCALE_DEVIATIONS = 3.0
"""Standard deviations above which a difference of scale is not taken for chance."""

SHAPE_CHANCE = 3e-3
"""A frame has another shape if noise gives as large a difference less often than this."""

SHAPE_TOLERANCES = 2.0
"""Smallest shift of the corners by another shape, in tolerances."""

MIN_BREADTH = 1e-4
"""Least breadth of matched stars from which the shape of a frame is measured: the determinant of
their second moments over the square of its trace."""

SURE_CORNER = 0.5
"""Stars determine their frame if the error of its corners is at most this, in tolerances, with a
known focal length; twice this with a fitted one, as the error then includes the focal length's."""

MIN_WEIGHT = 1e-8
"""Least weight of a centroid over the largest of its frame; rounding errors exclude lower ones."""


@dataclass(frozen=True)
class Pose:
    """An attitude and a camera."""

    matrix: Matrix  # attitude, ``body = matrix @ icrs``; shape (3, 3)
    camera: Camera  # the camera, with the focal length that goes with the attitude
    body: Directions  # directions of all centroids of a frame with that camera; shape (N, 3)


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


def fit(pose: Pose, matched: Rows, stars: Array, observation: Observation) -> Pose:
    """Return the pose that fits centroids and their stars best."""
    if not observation.fov_error:
        return Pose(solve_wahba_svd(pose.body[matched], stars), pose.camera, pose.body)
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
    shortest, longest = observation.focal_range
    scaled = pose_at(pose.matrix, min(max(factor, shortest), longest), observation)
    return Pose(solve_wahba_svd(scaled.body[matched], stars), scaled.camera, scaled.body)


def weights_of(sigma_px: Array) -> Array:
    """Return the weights of centroids by their noise, over the largest; least where not known."""
    known = np.where(np.isfinite(sigma_px), sigma_px, np.inf)
    least = known.min(initial=np.inf)
    if least == np.inf:
        return np.ones(len(known))
    return np.asarray(np.maximum((least / known) ** 2, MIN_WEIGHT))


def fit_by_weights(seen: Directions, stars: Directions, sigma_px: Array) -> tuple[Matrix, float]:
    """Return the attitude that fits centroids best by their noise, and its residual, radians."""
    matrix = solve_wahba_svd(seen, stars, weights_of(sigma_px))
    difference = seen - stars @ matrix.T
    return matrix, math.sqrt(float(np.vdot(difference, difference)) / len(seen))


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


def explained_fraction(
    matched: Directions,
    stars: Directions,
    residual_rad: float,
    pose: Pose,
    observation: Observation,
    enough: float = 1.0,
) -> float:
    """Return which share of a frame an attitude explains, by weight."""
    try:
        normal = information(matched, with_scale=observation.fov_error > 0.0)
        covariance: Array = np.linalg.inv(normal).astype(np.float64)
    except np.linalg.LinAlgError:
        return 0.0
    of_stars = weighted_share(covariance, stars)
    if of_stars >= enough:
        return of_stars
    of_centroids = weighted_share(covariance, pose.body)
    if of_centroids <= of_stars:
        return of_stars
    corner_rad = _corner_error_rad(covariance, len(matched), residual_rad, pose.camera)
    return of_stars if corner_rad > observation.tolerance_rad else of_centroids


def determines_frame(
    matched: Directions, residual_rad: float, pose: Pose, observation: Observation, factor: float
) -> bool:
    """Return whether the stars alone determine the place of every corner of a frame.

    They do if the error of every corner is a small part of the tolerance, even with a fitted focal
    length instead of the known one; ``factor`` is the reach over the final reach.
    """
    try:
        covariance: Array = np.linalg.inv(information(matched, with_scale=True)).astype(np.float64)
    except np.linalg.LinAlgError:
        return False
    corner_rad = _corner_error_rad(covariance, len(matched), residual_rad, pose.camera)
    most = SURE_CORNER * (2.0 if observation.fov_error else 1.0)
    return corner_rad <= most * factor * observation.tolerance_rad


def _corner_error_rad(covariance: Array, n: int, residual_rad: float, camera: Camera) -> float:
    # Three of the 2n components went into the attitude, a fourth into the scale.
    deviation_rad = residual_rad * math.sqrt(n / (2 * n - len(covariance)))
    return deviation_rad * corner_deviation(covariance, camera)


def weighted_share(covariance: Array, directions: Array) -> float:
    """Return which share of the stars of a frame an attitude explains, by their weight.

    The weight of a star is the variance of its position, given the matched stars. The weights
    of the matched stars themselves add up to three, the number of angles, wherever they are, or
    to four where the scale is free.
    Outside of them the weight grows with the square of the distance: with ten matched stars
    at 50 px from their middle, a star at 500 px has a weight of ten.
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


def is_deformed(
    predicted_px: Pixels,
    centroids_px: Pixels,
    camera: Camera,
    tolerance_px: float,
    *,
    is_partial: bool,
) -> bool:
    """Return whether a frame differs in scale, or in shape, from the stars that it matches.

    A frame of another scale means that the camera's focal length is wrong; one of another shape,
    that its pixels are not square, or that its axes are not at right angles. The attitude can be
    right, but towards the edge of the frame stars are taken for their neighbours.

    Parameters
    ----------
    predicted_px, centroids_px : arrays of shape (N, 2), N >= 4
        Places where the attitude puts the matched stars, and their centroids; pixels.
    camera : Camera
        Gives the distance from the middle of the frame to its corners.
    tolerance_px : float
        A difference that moves the corners less than this is ignored.
    is_partial : bool
        Whether the stars explain only a part of the frame. Then the shape is tested, too. If they
        match everywhere in the frame, it is not, because an uncalibrated lens differs a little
        from square pixels, which does no harm.
    """
    inner = predicted_px - predicted_px.sum(axis=0) / len(predicted_px)
    offset = centroids_px - predicted_px
    offset -= offset.sum(axis=0) / len(offset)
    (xx, xy), (_, yy) = inner.T @ inner
    (x_dx, x_dy), (y_dx, y_dy) = inner.T @ offset
    extent, left = float(xx + yy), float(np.vdot(offset, offset))
    excess = float(x_dx + y_dy) / extent
    corner_px = 0.5 * math.hypot(camera.width_px, camera.height_px)
    if abs(excess) * corner_px > tolerance_px:
        variance = (left - excess * excess * extent) / (2 * len(offset) - 4) / extent
        if excess * excess > SCALE_DEVIATIONS**2 * variance:
            return True
    determinant = float(xx * yy - xy * xy)
    if not is_partial or determinant <= MIN_BREADTH * extent * extent:
        return False
    # The linear map of the offsets: [[a, b], [c, d]].
    a, b = (yy * x_dx - xy * y_dx) / determinant, (xx * y_dx - xy * x_dx) / determinant
    c, d = (yy * x_dy - xy * y_dy) / determinant, (xx * y_dy - xy * x_dy) / determinant
    if 0.5 * math.hypot(a - d, b + c) * corner_px <= SHAPE_TOLERANCES * tolerance_px:
        return False
    # The offsets that remain after a turn and a scale, and after any linear map. For noise, their
    # ratio is below r with the probability r**(N - 3) (Fisher's F with 2 and 2N - 6 degrees).
    of_similar = left - ((x_dx + y_dy) ** 2 + (x_dy - y_dx) ** 2) / extent
    of_linear = left - (a * x_dx + b * y_dx + c * x_dy + d * y_dy)
    ratio = max(float(of_linear / of_similar), MIN_WEIGHT)
    return (len(offset) - 3) * math.log(ratio) < math.log(SHAPE_CHANCE)
