"""One frame as the methods see it: its usable centroids, their directions and their order."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from starcat.arrays import Array
from starcat.geometry.camera import Camera
from starcat.matcher.budget import Budget

MIN_SHARE = 1.0 / 3.0
"""Smallest share of a frame that the attitude of an answer explains.

The share is that of the centroids or that of the stars, whichever is larger. Every one of them
is weighted by the uncertainty that the matched stars leave in its position (`explained_share`).
Without weights, the many stars of one cluster would accept an attitude that is right in the
cluster and wrong in the rest of the frame.
"""

WIDEST_FOV_ERROR = 0.5
"""Largest relative error of a focal length that is found with the attitude."""


@dataclass(frozen=True)
class FocalRange:
    """Focal lengths that a frame may have, over the one that was given.

    Attributes
    ----------
    low, high : float
        Ends, 0 < low <= 1 <= high.
    """

    low: float = 1.0
    high: float = 1.0

    @property
    def log_width(self) -> float:
        """Logarithm of the longest over the shortest."""
        return math.log(self.high / self.low)

    def clip(self, factors: Array | float) -> Array:
        """Return factors, those outside of the range moved to its nearer end."""
        return np.minimum(np.maximum(factors, self.low), self.high)


@dataclass(frozen=True)
class Observation:
    """The usable centroids of a frame.

    Attributes
    ----------
    rows : ndarray of int64, shape (N,)
        Row of each centroid in the frame as it was given.
    centroids_px : ndarray of float64, shape (N, 2)
        Pixels. Brightest first where magnitudes are known, else nearest to the centre first,
        so that nothing depends on the order in which they were given.
    body : ndarray of float64, shape (N, 3)
        Directions in the camera frame.
    mag : ndarray of float64, shape (N,), or None
        Magnitudes, NaN for a centroid without one; None where none is known.
    camera : Camera
        The camera.
    tolerance_px : float
        Largest error of a centroid, as a radius.
    dropped : tuple of (int, str)
        Row and reason of every centroid that is not used: ``not_finite``, ``out_of_frame`` or
        ``duplicate``.
    noise_px : float or None
        Standard deviation of a centroid on each axis, where it was stated.
    noise_mag : float or None
        Standard deviation of a magnitude in the band of the database, where it was stated.
    fov_error : float
        Largest relative error of the focal length, 0 where it is known.
    min_share : float
        Smallest share of the frame that the attitude of an answer explains.
    budget : Budget
        What the search may take.
    """

    rows: NDArray[np.int64]
    centroids_px: Array
    body: Array
    mag: Array | None
    camera: Camera
    tolerance_px: float
    dropped: tuple[tuple[int, str], ...] = ()
    noise_px: float | None = None
    noise_mag: float | None = None
    fov_error: float = 0.0
    min_share: float = MIN_SHARE
    budget: Budget = field(default_factory=Budget, compare=False, repr=False)

    def __len__(self) -> int:
        """Return the number of usable centroids."""
        return len(self.rows)

    @property
    def tolerance_rad(self) -> float:
        """Largest error of a direction, radians."""
        return self.tolerance_px / self.camera.focal_length_px

    @cached_property
    def focal_range(self) -> FocalRange:
        """Focal lengths that are allowed, whether the error is a part of the given or the true."""
        return FocalRange(1.0 - self.fov_error, 1.0 / (1.0 - self.fov_error))

    @cached_property
    def separation_rad(self) -> Array:
        """Separations between all centroids, radians, shape (N, N)."""
        x, y, z = self.body.T
        dx, dy, dz = x[:, None] - x, y[:, None] - y, z[:, None] - z
        # The chord loses no digits at small angles, where the cosine would.
        return np.asarray(2.0 * np.arcsin(0.5 * np.sqrt(dx * dx + dy * dy + dz * dz)))


def observe(
    centroids_px: ArrayLike,
    camera: Camera,
    tolerance_px: float,
    magnitudes: ArrayLike | None = None,
    *,
    noise_px: float | None = None,
    noise_mag: float | None = None,
    fov_error: float = 0.0,
    min_share: float = MIN_SHARE,
    budget: Budget | None = None,
) -> Observation:
    """Prepare a frame for identification."""
    given, mag = as_frame(centroids_px, magnitudes)
    usable = camera.contains(given)
    if usable.all():
        dropped, rows = [], _own_order(given, mag, camera)
    else:
        rows, dropped = usable.nonzero()[0], _unusable(given, usable)
        rows = rows[_own_order(given[rows], None if mag is None else mag[rows], camera)]
    rows, repeats = _without_repeats(rows, given)
    kept = given[rows]
    known = None if mag is None or not np.isfinite(mag[rows]).any() else mag[rows]
    body = camera.directions_from_pixels(kept)
    return Observation(
        rows,
        kept,
        body,
        known,
        camera,
        tolerance_px,
        (*dropped, *repeats),
        noise_px,
        noise_mag,
        fov_error,
        min_share,
        budget or Budget(),
    )


def as_frame(
    centroids_px: ArrayLike, magnitudes: ArrayLike | None = None
) -> tuple[Array, Array | None]:
    """Return what a caller gives as arrays."""
    given = np.asarray(centroids_px, dtype=np.float64)
    given = given.reshape(0, 2) if given.size == 0 else given
    if given.ndim != 2 or given.shape[1] != 2:
        raise ValueError(f"centroids_px has shape {given.shape}; expected (N, 2)")
    mag = None if magnitudes is None else np.asarray(magnitudes, dtype=np.float64)
    if mag is not None and mag.shape != (len(given),):
        raise ValueError(f"magnitudes have shape {mag.shape}; expected ({len(given)},)")
    return given, mag


def _unusable(given: Array, usable: NDArray[np.bool_]) -> list[tuple[int, str]]:
    finite = np.asarray(np.isfinite(given).all(axis=1))
    return [
        (int(row), "out_of_frame" if finite[row] else "not_finite")
        for row in np.flatnonzero(~usable)
    ]


def _own_order(centroids_px: Array, mag: Array | None, camera: Camera) -> NDArray[np.int64]:
    """Return the brightest first (unknown ones last), or the nearest to the centre."""
    x, y = (centroids_px - camera.middle_px).T
    distance = x * x + y * y
    return np.lexsort((y, x, distance) if mag is None else (y, x, distance, mag))


def _without_repeats(
    rows: NDArray[np.int64], given: Array
) -> tuple[NDArray[np.int64], list[tuple[int, str]]]:
    x = np.sort(given[rows, 0])
    if not (x[1:] == x[:-1]).any():
        return rows, []
    place = given[rows, 0] + 1j * given[rows, 1]
    order = np.argsort(place, kind="stable")
    same = np.diff(place[order]) == 0.0
    if not same.any():
        return rows, []
    repeats = order[1:][same]
    return np.delete(rows, repeats), [(int(row), "duplicate") for row in np.sort(rows[repeats])]
