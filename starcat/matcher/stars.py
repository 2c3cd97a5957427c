"""The stars of an answer: their places, their centroids, and the accuracy of the attitude."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Directions, Matrix, Pixels
from starcat.geometry.attitude import information
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import radec_from_directions, separation
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.observation import Frame
from starcat.matcher.pose import student_widening, weights_of
from starcat.matcher.shape import Shape, shape_covariance, undone_px

ARCSEC = math.degrees(1.0) * 3600.0
"""Arcseconds in a radian."""

STEP_PX = 0.01
"""Step of the differences that give the derivative of a direction by its pixel, to 1e-9."""


class MatchedStar(NamedTuple):
    """One star of a frame; its values are described at `MatchedStars`."""

    spot: int
    star_id: int
    star_index: int
    star: str
    ra_deg: float
    dec_deg: float
    mag: float
    x_px: float
    y_px: float
    dx_px: float
    dy_px: float
    separation_arcsec: float
    observed_mag: float
    difference_mag: float
    sigma_px: float


@dataclass(frozen=True, eq=False)
class MatchedStars:
    """The stars of a frame, one row each, in the order of the centroids.

    ``stars.mag`` and the like are arrays of all stars; ``stars[0]`` and an iteration give single
    stars.

    Attributes
    ----------
    spot : ndarray of int64, shape (n,)
        Row of the centroid in the frame as it was given.
    star_id : ndarray of int64, shape (n,)
        Permanent star numbers.
    star_index : ndarray of int32, shape (n,)
        Rows of the database.
    star : tuple of str
        Designations; the star number if the database has none.
    ra_deg, dec_deg : ndarray of float64, shape (n,)
        ICRS, at the epoch of the database.
    mag : ndarray of float64, shape (n,)
        Magnitudes of the database.
    x_px, y_px : ndarray of float64, shape (n,)
        The centroids.
    dx_px, dy_px : ndarray of float64, shape (n,)
        Centroid minus the place where attitude and camera put the star.
    separation_arcsec : ndarray of float64, shape (n,)
        Angle between the centroid's direction and the star's.
    observed_mag, difference_mag : ndarray of float64, shape (n,)
        Magnitude of the centroid as it was given, and this minus the database's; NaN if not
        given. The zero point is the caller's.
    sigma_px : ndarray of float64, shape (n,)
        Noise of the centroid on each axis as it was stated; NaN if not stated.
    """

    spot: NDArray[np.int64]
    star_id: NDArray[np.int64]
    star_index: NDArray[np.int32]
    star: tuple[str, ...]
    ra_deg: Array
    dec_deg: Array
    mag: Array
    x_px: Array
    y_px: Array
    dx_px: Array
    dy_px: Array
    separation_arcsec: Array
    observed_mag: Array
    difference_mag: Array
    sigma_px: Array

    def __len__(self) -> int:
        return len(self.spot)

    @overload
    def __getitem__(self, star: int) -> MatchedStar: ...
    @overload
    def __getitem__(self, star: slice) -> list[MatchedStar]: ...
    def __getitem__(self, star: int | slice) -> MatchedStar | list[MatchedStar]:
        if isinstance(star, slice):
            return [self[n] for n in range(*star.indices(len(self)))]
        row = range(len(self))[star]
        columns = {name: getattr(self, name) for name in MatchedStar._fields}
        return MatchedStar(
            **{
                name: values.item(row) if name != "star" else values[row]
                for name, values in columns.items()
            }
        )

    def __iter__(self) -> Iterator[MatchedStar]:
        return map(self.__getitem__, range(len(self)))

    def __repr__(self) -> str:
        names = ", ".join(self.star[:3]) + (", ..." if len(self) > 3 else "")
        return f"<MatchedStars: {len(self)}{': ' if self.star else ''}{names}>"


_NO_ROWS = np.empty(0, dtype=np.int64)
NO_STARS = MatchedStars(_NO_ROWS, _NO_ROWS, _NO_ROWS.astype(np.int32), (), *(11 * (np.empty(0),)))
"""The stars of a frame that was not identified."""


def name_of_number(star_id: int) -> str:
    """Return the name of a star of an onboard image, which has only numbers.

    The embedded sky has the stars that Gaia lacks under their negative numbers of Hipparcos.
    """
    return str(star_id) if star_id > 0 else f"HIP {-star_id}"


def matched_stars(
    star_index: NDArray[np.int32],
    matrix: Matrix,
    camera: Camera,
    frame: Frame,
    database: MatcherDatabase,
    noise_px: float | None,
    shape: Shape | None = None,
) -> MatchedStars:
    """Return the stars that centroids were identified as, one row per star.

    ``noise_px`` is the noise of all centroids if the frame does not state it for each.
    """
    spot = np.flatnonzero(star_index >= 0)
    row = star_index[spot]
    seen_px = frame.centroids_px[spot]
    u = database.directions[row]
    at_px = seen_px if shape is None else undone_px(seen_px, shape.terms, camera)
    offset = at_px - camera.pixels_from_directions(u @ matrix.T)
    seen = camera.directions_from_pixels(at_px) @ matrix
    ra_deg, dec_deg = radec_from_directions(u)
    mag = np.asarray(database.mag[row], dtype=np.float64)
    observed_mag = np.full(len(spot), np.nan) if frame.mag is None else frame.mag[spot]
    sigma_px = np.full(len(spot), noise_px or np.nan)
    if frame.sigma_px is not None:
        sigma_px = np.where(np.isfinite(frame.sigma_px[spot]), frame.sigma_px[spot], np.nan)
    ids = database.star_id[row]
    names = zip(database.designation[row].tolist(), ids.tolist(), strict=True)
    return MatchedStars(
        spot=spot,
        star_id=ids,
        star_index=row,
        star=tuple(name.decode() or name_of_number(number) for name, number in names),
        ra_deg=ra_deg,
        dec_deg=dec_deg,
        mag=mag,
        x_px=seen_px[:, 0],
        y_px=seen_px[:, 1],
        dx_px=offset[:, 0],
        dy_px=offset[:, 1],
        separation_arcsec=separation(seen, u) * ARCSEC,
        observed_mag=observed_mag,
        difference_mag=observed_mag - mag,
        sigma_px=sigma_px,
    )


def degrees_of_freedom(stars: MatchedStars, unknowns: int) -> int:
    """Return two per star whose noise is known, minus the ``unknowns`` that were fitted."""
    return 2 * int(np.isfinite(stars.sigma_px).sum()) - unknowns


def reduced_chi_square(stars: MatchedStars, free: int) -> float:
    """Return the squared offsets of centroids, in their noise, over the degrees of freedom.

    It is 1 on average if the stated noise is right; NaN if no noise is stated or no degree of
    freedom is left.
    """
    if free <= 0:
        return math.nan
    has_noise = np.isfinite(stars.sigma_px)
    square = (stars.dx_px**2 + stars.dy_px**2)[has_noise] / stars.sigma_px[has_noise] ** 2
    return float(square.sum()) / free


NOTABLE_DEVIATIONS = 3.0
"""Standard deviations of chi-square beyond which residuals are not those of noise."""


def model_covariance(
    stars: MatchedStars, camera: Camera, unknowns: int, otherwise_px: float
) -> Array:
    """Return the covariance of an attitude by errors of places that noise does not explain.

    If a frame has a shape that is in no model, its residuals are larger than the noise. Neighbours
    are off alike then, and the attitude is off as much as they are, however many there are. Shape
    (3, 3), square arcseconds; 0 if chance explains the residuals. ``otherwise_px`` is the noise of
    centroids whose noise is not stated.
    """
    free = max(1, 2 * len(stars) - unknowns)
    square = stars.dx_px**2 + stars.dy_px**2
    sigma_px = np.where(np.isnan(stars.sigma_px), otherwise_px, stars.sigma_px)
    ratio = float((square / sigma_px**2).sum()) / free
    if not ratio > 1.0 + NOTABLE_DEVIATIONS * math.sqrt(2.0 / free):
        return np.zeros((3, 3))
    excess_px2 = float(square.sum()) / free * (1.0 - 1.0 / ratio)
    turn = excess_px2 / camera.focal_length_px**2
    roll = 12.0 * excess_px2 / (camera.width_px**2 + camera.height_px**2)
    return ARCSEC**2 * np.diag([turn, turn, roll])


def turns_per_px(px: Pixels, body: Directions, camera: Camera) -> list[Array]:
    """Return the torque ``b x db`` of an error of each centroid of 1 px in x, and of 1 px in y.

    ``body`` are the directions b of the centroids; arrays of shape (N, 3).
    """
    torques = []
    for axis in (0, 1):
        # Steps lead inwards, so that they end inside the fold of the distortion.
        step = np.where(px[:, axis] > camera.principal_point_px[axis], -STEP_PX, STEP_PX)
        once, twice = px.copy(), px.copy()
        once[:, axis] += step
        twice[:, axis] += 2.0 * step
        moved = 4.0 * (camera.directions_from_pixels(once) - body)
        moved -= camera.directions_from_pixels(twice) - body
        torques.append(np.cross(body, moved) * (0.5 / step)[:, None])
    return torques


def noises_px(stars: MatchedStars, unknowns: int) -> Array:
    """Return the noise of the centroid of each star.

    If it is not stated, it is computed from the 2n residuals, of which ``unknowns`` numbers were
    fitted, and multiplied by `student_widening`.
    """
    sigma_px = stars.sigma_px
    if not np.isnan(sigma_px).any():
        return sigma_px
    square = float(stars.dx_px @ stars.dx_px + stars.dy_px @ stars.dy_px)
    free = max(1, 2 * len(stars) - unknowns)
    of_residuals = math.sqrt(square / free) * student_widening(free)
    return np.where(np.isnan(sigma_px), of_residuals, sigma_px)


def attitude_covariance(
    stars: MatchedStars, camera: Camera, unknowns: int = 3, shape: Shape | None = None
) -> Array:
    """Return the covariance of an attitude that the centroids of stars determine, shape (3, 3).

    It is for small rotations about the axes of the camera (x right, y down, z along the boresight),
    in square arcseconds; NaN if the stars determine no attitude. The noise of a centroid is that
    of `noises_px`.

    The attitude solves Wahba's problem with the weights w of `weights_of`, so its error is
    ``A^-1 sum(w b x db)``: A is the `information` of the directions b, and their errors db are the
    errors of the pixels by the derivative of the camera. With a camera of a narrow field and
    equal weights this is the inverse of A times the variance of a direction. An error that all
    stars share, such as of the focal length or the distortion, is not included.

    With a fitted shape it is the inverse of the information of the attitude and its terms, so that
    their errors are included.
    """
    px = np.column_stack([stars.x_px, stars.y_px])
    weights, sigma_px = weights_of(stars.sigma_px), noises_px(stars, unknowns)
    if shape is not None:
        return ARCSEC**2 * shape_covariance(px, sigma_px, camera, shape)[:3, :3]
    body = camera.directions_from_pixels(px)
    total = np.zeros((3, 3))
    for turns in turns_per_px(px, body, camera):
        turned = turns * (weights * sigma_px)[:, None]
        total += turned.T @ turned
    matrix = information(body, weights=weights)
    if np.linalg.matrix_rank(matrix, hermitian=True) < 3:
        return np.full((3, 3), np.nan)
    inverse = np.linalg.inv(matrix)
    covariance = ARCSEC**2 * (inverse @ total @ inverse)
    return np.asarray(0.5 * (covariance + covariance.T))
