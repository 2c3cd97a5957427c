"""The shape of a frame: how the places of its centroids differ from those of the stated camera.

Real frames are larger or smaller than their camera says, a lens that nobody calibrated moves the
corners, and a rolling shutter exposes the rows at different attitudes, which stretches and shears
the frame. A shape is a sum of terms, each of which moves every place by a known vector:

========= ====================================================================
scale     the place itself: another focal length
radial    the place times its squared distance from the axis: a lens; without
          mean scale over the detector, so that it is independent of the scale
stretch   the row: the frame is longer along y
shear     the row, along x
tilt_x    the place times x: a detector that is tilted, or a lens off its centre
tilt_y    the place times y
========= ====================================================================

Places are counted from the principal point, in pixels. `undone_px` removes a shape from centroids:
their places are then the places that the stated camera would give, so that the matching, the camera
and the bound need no change. Terms are numbers without a unit; a term of 0.01 of the scale, the
stretch or the shear moves a place by 1 % of its distance, and 0.01 of the radial term moves a
corner by 1 % more than the mean.

``onboard/src/shape.c`` has the same functions.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from starcat.arrays import Array, Directions, Mask, Pixels
from starcat.geometry.camera import Camera

N_TERMS = 6

HALF_RANGES = (0.05, 0.10, 0.10, 0.10, 0.10, 0.10)
"""Largest terms of a shape, of both signs. Wide ranges cost little evidence, half a decade for each
factor of three; with narrow ones the true shape can be out of reach, and part of a frame agrees."""

MODELS = (0, 1, 2, 4, 6)
"""Numbers of terms that are fitted with the attitude: none, scale, lens, rolling shutter, tilt."""

WIDER_RANGE = 2.0
"""A scale outside of the stated range is looked for up to this many times the range."""

FREE_TERMS = 4
"""Number of first terms with which the stars of an answer must determine the boresight."""

LARGEST_TERM = 0.5
"""A fit that reaches a larger term has run away."""


class Shape(NamedTuple):
    """A shape that was fitted with an attitude."""

    terms: Array  # shape (6,), in the order of the table; terms that were not fitted are 0
    free: int  # number of terms that were fitted: one of `MODELS`


NO_SHAPE = Shape(np.zeros(N_TERMS), 0)


def half_ranges(
    fov_error: float, camera: Camera | None = None, camera_error: float | None = None
) -> Array:
    """Return the largest terms; a stated error of the focal length is the range of the scale.

    A stated error of a camera at its corners, as a share of the half diagonal, narrows all ranges
    to the terms that move a corner so far.
    """
    half = np.array(HALF_RANGES)
    if camera is not None and camera_error is not None:
        size = np.array([camera.width_px, camera.height_px], dtype=np.float64)
        moved = basis(size * [[0, 0], [0, 1], [1, 0], [1, 1]], camera)
        largest = np.linalg.norm(moved, axis=1).max(axis=0)
        half = np.minimum(half, camera_error * math.sqrt(_corner_square(camera)) / largest)
    if fov_error:
        half[0] = -math.log1p(-fov_error)
    return half


def basis(px: Pixels, camera: Camera) -> Array:
    """Return by how much each unit of a term moves a place, pixels; shape (N, 2, 6)."""
    q = px - np.asarray(camera.principal_point_px)
    x, y = q.T
    corner_px = math.sqrt(_corner_square(camera))
    moves = np.zeros((len(px), 2, N_TERMS))
    moves[:, :, 0] = q
    moves[:, :, 1] = q * ((x * x + y * y) / _corner_square(camera) - _mean_scale(camera))[:, None]
    moves[:, 1, 2] = y
    moves[:, 0, 3] = y
    moves[:, :, 4] = q * (x / corner_px)[:, None]
    moves[:, :, 5] = q * (y / corner_px)[:, None]
    return moves


def undone_px(px: Pixels, terms: Array, camera: Camera) -> Pixels:
    """Return the places that the stated camera would give for centroids of a frame's shape."""
    return px - basis(px, camera) @ terms


def margin_px(terms: Array, camera: Camera) -> float:
    """Return how far beyond the stated detector the places of a frame of a shape can lie.

    At most as far as its corners, the middles of its sides and its middle.

    >>> camera = Camera(width_px=1000, height_px=800, fov_x_deg=12.0)
    >>> round(margin_px(np.array([-0.1, 0.0, 0.0, 0.0, 0.0, 0.0]), camera), 9)  # a wider field
    50.0
    """
    if not terms.any():
        return 0.0
    x, y = np.meshgrid([0.0, 1.0, 2.0], [0.0, 1.0, 2.0])
    px = camera.middle_px * np.column_stack([x.ravel(), y.ravel()])
    beyond = np.abs(undone_px(px, terms, camera) - camera.middle_px) - camera.middle_px
    return max(0.0, float(beyond.max()))


def is_near_frame(px: Pixels, camera: Camera, beyond_px: float) -> Mask:
    """Return which places are on the detector, or at most so far beyond it; shape (N,)."""
    near = np.abs(px - camera.middle_px) <= camera.middle_px + beyond_px
    return np.asarray(near[:, 0] & near[:, 1])


def of_scale(shape: Shape, camera: Camera) -> tuple[Shape, Camera]:
    """Return a shape and a camera that hold the same directions, the scale in the focal length."""
    if not shape.free:
        return shape, camera
    factor = 1.0 - float(shape.terms[0])
    terms = shape.terms / factor
    terms[0] = 0.0
    return Shape(terms, shape.free), camera.with_focal_length(camera.focal_length_px / factor)


def log_growth(px: Pixels, terms: Array, camera: Camera) -> float:
    """Return the logarithm of the ratio of the areas around places, before over after.

    It is the sum over the places: the volume of all frames is measured before a shape is undone.
    """
    x, y = (px - np.asarray(camera.principal_point_px)).T
    square = _corner_square(camera)
    scale, radial, stretch, shear, *tilt = terms.tolist()
    tilt_x, tilt_y = (part / math.sqrt(square) for part in tilt)
    same = 1.0 - scale - radial * ((x * x + y * y) / square - _mean_scale(camera))
    same -= tilt_x * x + tilt_y * y
    xx = same - 2.0 * radial * x * x / square - tilt_x * x
    yy = same - 2.0 * radial * y * y / square - tilt_y * y - stretch
    xy = -2.0 * radial * x * y / square - shear - tilt_y * x
    yx = -2.0 * radial * x * y / square - tilt_x * y
    determinant = xx * yy - xy * yx
    return -float(np.log(np.maximum(determinant, 1e-3)).sum())


def derivatives(px: Pixels, body: Directions, camera: Camera, free: int = N_TERMS) -> Array:
    """Return how places move with three angles, and how terms move them; shape (N, 2, 3 + free).

    ``px`` are the centroids, and ``body`` their directions without the shape; pixels per radian and
    per unit of a term.
    """
    f = camera.focal_length_px
    x, y = (body[:, :2] / body[:, 2:]).T
    rates = np.empty((len(px), 2, 3 + free))
    rates[:, 0, 0], rates[:, 0, 1], rates[:, 0, 2] = -f * x * y, f * (1.0 + x * x), -f * y
    rates[:, 1, 0], rates[:, 1, 1], rates[:, 1, 2] = -f * (1.0 + y * y), f * x * y, f * x
    rates[:, :, 3:] = basis(px, camera)[:, :, :free]
    return rates


class Normal(NamedTuple):
    """The normal equations of a fit of an attitude and a shape, and what they lead to."""

    covariance: Array  # of three angles and the free terms, for noise of one pixel; 3 + free rows
    step: Array  # turn in radians, and changes of the terms
    gain: float  # by how much the step lowers the squared residuals


def solve_normal(
    residual_px: Array, rows: Array, terms: Array, half: Array, sigma_px: float
) -> Normal | None:
    """Return the step of a least-squares fit, None if the places determine none.

    A term has a prior: its standard deviation is its largest value. Without it six stars run away;
    with it the residuals only grow, so that the bound on false matches stays a bound.
    """
    count = rows.shape[2]
    free = count - 3
    jac = rows.reshape(-1, count)
    prior = np.concatenate([np.zeros(3), (sigma_px / half[:free]) ** 2])
    right = jac.T @ residual_px.ravel()
    right[3:] -= prior[3:] * terms[:free]
    try:
        covariance: Array = np.asarray(np.linalg.inv(jac.T @ jac + np.diag(prior)), np.float64)
    except np.linalg.LinAlgError:
        return None
    step = covariance @ right
    return Normal(covariance, step, float(step @ right)) if np.isfinite(step).all() else None


def shape_covariance(px: Pixels, sigma_px: Array, camera: Camera, shape: Shape) -> Array:
    """Return the covariance of an attitude and a shape from the centroids of stars and their noise.

    Three angles in radians, then the terms; shape (3 + free, 3 + free). NaN if the stars determine
    none.
    """
    body = camera.directions_from_pixels(undone_px(px, shape.terms, camera))
    rows = derivatives(px, body, camera, shape.free) / sigma_px[:, None, None]
    normal = solve_normal(np.zeros((len(px), 2)), rows, shape.terms, half_ranges(0.0), 1.0)
    count = 3 + shape.free
    return np.full((count, count), np.nan) if normal is None else normal.covariance


def corner_error_rad(covariance: Array, camera: Camera) -> float:
    """Return the standard error of an attitude at the corners of a frame, for noise of one pixel.

    It is that of the boresight on its worst axis, with that of the roll at the corner.
    """
    (a, b), (_, d) = covariance[:2, :2].tolist()
    largest = 0.5 * (a + d) + math.hypot(0.5 * (a - d), b)
    return math.sqrt(max(0.0, largest + float(covariance[2, 2]) * _corner_rad(camera) ** 2))


def largest_influence_rad(residual: Array, rows: Array, covariance: Array, camera: Camera) -> float:
    """Return by how much the corners of a frame turn if one star is left out of a fit, at most.

    ``residual`` and ``rows`` are those of the fit, ``covariance`` that of `Normal`.
    """
    moved = covariance @ rows.transpose(0, 2, 1)  # of all unknowns by each coordinate; (N, u, 2)
    kept = np.eye(2) - rows @ moved
    determinant = np.maximum(kept[:, 0, 0] * kept[:, 1, 1] - kept[:, 0, 1] ** 2, 1e-12)
    x, y = residual.T
    back = np.stack(
        [kept[:, 1, 1] * x - kept[:, 0, 1] * y, kept[:, 0, 0] * y - kept[:, 0, 1] * x], axis=1
    )
    turn = np.einsum("nij,nj->ni", moved[:, :3], back) / determinant[:, None]
    turn[:, 2] *= _corner_rad(camera)
    return float(np.sqrt((turn * turn).sum(axis=1).max()))


def chance_of_ratio(ratio: float, free: int) -> float:
    """Return how often noise lowers squared residuals to ``ratio`` by six terms, or further.

    ``free`` degrees of freedom are left: Fisher's F with 6 and ``free`` degrees, in closed form.

    >>> round(chance_of_ratio(0.2, 9), 4)
    0.009
    """
    kept = max(0.0, min(1.0, ratio))
    half, gone = 0.5 * free, 1.0 - kept
    return math.pow(kept, half) * (1.0 + half * gone * (1.0 + 0.5 * (half + 1.0) * gone))


def chance_of_gain(gain: float) -> float:
    """Return how often noise lowers chi-square by ``gain`` or more by six terms.

    >>> round(chance_of_gain(16.8119), 4)
    0.01
    """
    half = 0.5 * max(0.0, gain)
    return math.exp(-half) * (1.0 + half * (1.0 + 0.5 * half))


def _corner_square(camera: Camera) -> float:
    return 0.25 * (camera.width_px**2 + camera.height_px**2)


def _corner_rad(camera: Camera) -> float:
    return math.sqrt(_corner_square(camera)) / camera.focal_length_px


def _mean_scale(camera: Camera) -> float:
    """Return the scale that the radial term has over the detector, by least squares.

    The mean of r^4 over the mean of r^2 of a rectangle about its centre, over its corner's r^2; for
    a square 7/15.
    """
    w, h = camera.width_px**2, camera.height_px**2
    return 0.6 - (8.0 / 15.0) * w * h / (w + h) ** 2
