"""The camera: pixels from directions and back.

Camera frame: x right, y down, z along the optical axis. Pixel coordinates start at the outer
corner of the top-left pixel, so the centre of that pixel is (0.5, 0.5) and the optical axis
of a centred camera is at (width/2, height/2). ``camera_file`` reads and writes its TOML.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from importlib import import_module
from numbers import Integral

import numpy as np
from numpy.typing import ArrayLike

from starcat.arguments import path_of, rows_of, without_unit, without_unit_of_count
from starcat.arrays import Array, Mask, Pixels
from starcat.errors import ConfigError
from starcat.geometry.distortion import Distortion, checked_number, distortion_of
from starcat.geometry.sphere import separation
from starcat.version import missing_packages

# Largest width and height that is accepted: no detector has more pixels on a side.
LARGEST_PX = 1_000_000

# A field of view is narrower than this: the edge of a wider field would be more than 89.4 deg from
# the axis, where a pinhole has no image.
WIDEST_FOV_DEG = 178.8


@dataclass(frozen=True, init=False, repr=False)
class Camera:
    """A camera with square pixels.

    Parameters
    ----------
    width_px, height_px : int
        Size of the detector.
    focal_length_px, fov_x_deg, fov_y_deg : float, optional
        One of the three: the focal length, or the full angle across the width or the height
        as it were without distortion and with the axis in the middle. Both angles are accepted
        if their focal lengths agree to 1e-3; the one across the width is used.
    principal_point_px : pair of float, optional
        Where the optical axis meets the detector's plane; the middle by default.
    distortion : Distortion, mapping or sequence of float, optional
        Distortion of the lens; none by default. A mapping has some of k1, k2, k3, p1 and p2 as
        keys. Five numbers are in the order of OpenCV: k1, k2, p1, p2, k3.
    readout_s : float, optional
        Time from the exposure of the first row to that of the last one (rolling shutter). It does
        not change the projection. With it an answer states how fast the camera turned.

    Raises
    ------
    ConfigError
        A ``ValueError`` too: if a value is out of range, the scale is missing or contradictory, or
        the distortion folds the image back on the detector.

    Examples
    --------
    >>> Camera(1024, 768, 512.0).fov_x_deg
    90.0
    """

    width_px: int
    height_px: int
    focal_length_px: float
    principal_point_px: tuple[float, float]
    distortion: Distortion
    readout_s: float | None

    def __init__(
        self,
        width_px: int,
        height_px: int,
        focal_length_px: float | None = None,
        *,
        fov_x_deg: float | None = None,
        fov_y_deg: float | None = None,
        principal_point_px: Iterable[float] | None = None,
        distortion: Distortion | Mapping[str, float] | ArrayLike | None = None,
        readout_s: float | None = None,
    ) -> None:
        w, h = _size("width_px", width_px), _size("height_px", height_px)
        lens = distortion_of(distortion)
        # A frozen dataclass refuses assignments; its dictionary is filled directly.
        vars(self).update(
            width_px=w,
            height_px=h,
            focal_length_px=_focal_length_px(w, h, focal_length_px, fov_x_deg, fov_y_deg),
            principal_point_px=(0.5 * w, 0.5 * h)
            if principal_point_px is None
            else _point("principal_point_px", principal_point_px),
            distortion=lens,
            readout_s=None if readout_s is None else checked_number("readout_s", readout_s, 0.0),
        )
        self._refuse_fold()

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Camera:
        """Read a camera file, as ``starcat calibrate`` writes it; a build spec is one, too.

        Parameters
        ----------
        path : str or path-like
            The file (TOML).

        Returns
        -------
        Camera

        Raises
        ------
        ConfigError
            If the file does not exist, or does not describe a camera.
        """
        try:
            # The specs use this package; an installation that only matches lacks them.
            files = import_module("starcat.pipeline.specs.camera_file")
        except ModuleNotFoundError as error:
            raise ConfigError(missing_packages("Camera.read", error)) from error
        camera: Camera = files.read_camera(path_of("path", path))
        return camera

    def __repr__(self) -> str:
        numbers = f"focal length {self.focal_length_px:.6g} px"
        if not self._is_centred:
            x, y = self.principal_point_px
            numbers += f", principal point {x:.6g}, {y:.6g} px"
        lens = {name: value for name, value in asdict(self.distortion).items() if value}
        numbers += "".join(f", {name} {value:.4g}" for name, value in lens.items())
        if self.readout_s is not None:
            numbers += f", readout {self.readout_s:.4g} s"
        return f"<Camera {self.in_words}: {numbers}>"

    def _refuse_fold(self) -> None:
        if self.distortion.is_none:
            return
        reach_px = float(np.hypot(*(self._corners - self.principal_point_px).T).max())
        fold_px = self.distortion.image_radius * self.focal_length_px
        if reach_px >= fold_px:
            raise ConfigError(
                f"it folds the image back at {fold_px:.6g} px from the principal point, "
                f"but the detector reaches out to {reach_px:.6g} px; expected a fold beyond that",
                parameter="distortion",
            )

    @property
    def _corners(self) -> Array:
        w, h = float(self.width_px), float(self.height_px)
        return np.array([[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]])

    @cached_property
    def _is_plain(self) -> bool:
        """Whether the axis is in the middle and nothing is distorted."""
        return self.distortion.is_none and self._is_centred

    @property
    def _is_centred(self) -> bool:
        return self.principal_point_px == (0.5 * self.width_px, 0.5 * self.height_px)

    @cached_property
    def middle_px(self) -> Array:
        """Middle of the detector, shape (2,)."""
        return np.array([0.5 * self.width_px, 0.5 * self.height_px])

    @cached_property
    def _axis_px(self) -> Array:
        return np.array(self.principal_point_px)

    @cached_property
    def corner_directions(self) -> Array:
        """Directions of the four corners in the camera frame, shape (4, 3)."""
        return self.directions_from_pixels(self._corners)

    def _widest_rad(self, centroids_px: Pixels) -> float:
        body = self.directions_from_pixels(centroids_px)
        return float(separation(body[:, None], body[None]).max())

    def with_focal_length(self, focal_length_px: float) -> Camera:
        """Return the same camera with another focal length.

        Parameters
        ----------
        focal_length_px : float
            Focal length, px.

        Returns
        -------
        Camera
            A new camera.

        Raises
        ------
        ConfigError
            If the distortion then folds the image on the detector.
        """
        return replace(self, focal_length_px=focal_length_px)

    @property
    def in_words(self) -> str:
        """Pixels and field of view, as reports print them."""
        size, field = (self.width_px, self.height_px), (self.fov_x_deg, self.fov_y_deg)
        return f"{size[0]} x {size[1]} px, {field[0]:.4g} x {field[1]:.4g} deg"

    @cached_property
    def fov_x_deg(self) -> float:
        """Separation of the middles of the left and the right edge, degrees."""
        if self._is_plain:
            return float(2.0 * np.degrees(np.arctan(0.5 * self.width_px / self.focal_length_px)))
        y = 0.5 * self.height_px
        return float(np.degrees(self._widest_rad(np.array([[0.0, y], [self.width_px, y]]))))

    @cached_property
    def fov_y_deg(self) -> float:
        """Separation of the middles of the top and the bottom edge, degrees."""
        if self._is_plain:
            return float(2.0 * np.degrees(np.arctan(0.5 * self.height_px / self.focal_length_px)))
        x = 0.5 * self.width_px
        return float(np.degrees(self._widest_rad(np.array([[x, 0.0], [x, self.height_px]]))))

    @property
    def pixel_arcsec(self) -> float:
        """Angle that a pixel on the optical axis covers, arcsec."""
        return float(np.degrees(1.0 / self.focal_length_px) * 3600.0)

    @cached_property
    def diagonal_rad(self) -> float:
        """Largest separation of two corners, radians."""
        return 2.0 * self.radius_rad if self._is_plain else self._widest_rad(self._corners)

    @cached_property
    def radius_rad(self) -> float:
        """Largest angle from the optical axis to a corner, radians."""
        if self._is_plain:
            half = 0.5 * np.hypot(self.width_px, self.height_px)
            return float(np.arctan(half / self.focal_length_px))
        x, y, z = self.directions_from_pixels(self._corners).T
        return float(np.arctan2(np.hypot(x, y), z).max())

    def pixels_from_directions(self, body: ArrayLike) -> Array:
        """Project directions in the camera frame, of any length, onto the detector.

        Parameters
        ----------
        body : array_like of float64, shape (N, 3)
            Directions in the camera frame: x right, y down, z along the boresight.

        Returns
        -------
        ndarray of float64, shape (N, 2)
            Pixels. NaN for a direction that lies behind the camera, or so far off the axis that
            the distortion folds its image back.

        Raises
        ------
        ConfigError
            If the argument has another shape, or a unit that cannot be converted.
        """
        body = rows_of("body", body, 3)
        z = np.where(body[:, 2:] > 0.0, body[:, 2:], np.nan)
        if self.distortion.is_none:
            pixels = body[:, :2] * (self.focal_length_px / z)
        else:
            image = self.distortion.distorted((body[:, :2] / z).view(np.complex128)[:, 0])
            pixels = image.view(np.float64).reshape(-1, 2) * self.focal_length_px
        pixels += self._axis_px
        return np.asarray(pixels)

    def directions_from_pixels(self, centroids_px: ArrayLike) -> Array:
        """Return the directions of centroids.

        Parameters
        ----------
        centroids_px : array_like of float64, shape (N, 2)
            Pixels; a quantity is converted.

        Returns
        -------
        ndarray of float64, shape (N, 3)
            Unit vectors in the camera frame; NaN if no direction inside the fold has that image,
            which happens only off the detector.

        Raises
        ------
        ConfigError
            If the argument has another shape, or a unit that cannot be converted.
        """
        centroids_px = rows_of("centroids_px", centroids_px, 2)
        body = np.empty((len(centroids_px), 3))
        np.subtract(centroids_px, self._axis_px, out=body[:, :2])
        body[:, 2] = self.focal_length_px
        if not self.distortion.is_none:
            image = (body[:, :2] / self.focal_length_px).view(np.complex128)[:, 0]
            z = self.distortion.undistorted(image)
            body[:, 0], body[:, 1], body[:, 2] = z.real, z.imag, 1.0
        body /= np.sqrt(np.einsum("ij,ij->i", body, body))[:, None]
        return body

    def contains(self, centroids_px: ArrayLike) -> Mask:
        """Return which pixels lie on the detector.

        Closed at the left and top edge, open at the right and bottom; NaN lies outside.

        Parameters
        ----------
        centroids_px : array_like of float64, shape (N, 2)
            Pixels; a quantity is converted.

        Returns
        -------
        ndarray of bool, shape (N,)
            True on the detector.

        Raises
        ------
        ConfigError
            If the argument has another shape, or a unit that cannot be converted.
        """
        centroids_px = rows_of("centroids_px", centroids_px, 2)
        inside = (centroids_px >= 0.0) & (centroids_px < 2.0 * self.middle_px)
        return np.asarray(inside[:, 0] & inside[:, 1])


def _size(name: str, value: object) -> int:
    value = without_unit_of_count(name, value)
    if isinstance(value, Integral) and not isinstance(value, bool):
        size = int(value)
        if 1 <= size <= LARGEST_PX:
            return size
    raise ConfigError(
        f"expected a whole number from 1 to {LARGEST_PX}", parameter=name, value=value
    )


def _point(name: str, value: Iterable[object]) -> tuple[float, float]:
    try:
        x, y = (checked_number(name, entry) for entry in without_unit(name, value))
    except (TypeError, ValueError):
        raise ConfigError(
            "expected two finite numbers, x and y", parameter=name, value=value
        ) from None
    return x, y


def _focal_length_px(
    width_px: int,
    height_px: int,
    focal_length_px: float | None,
    fov_x_deg: float | None,
    fov_y_deg: float | None,
) -> float:
    if focal_length_px is not None and fov_x_deg is None and fov_y_deg is None:
        return checked_number("focal_length_px", focal_length_px, 0.0)
    scales = {"focal_length_px": focal_length_px, "fov_x_deg": fov_x_deg, "fov_y_deg": fov_y_deg}
    given = [name for name, value in scales.items() if value is not None]
    if not given or focal_length_px is not None:
        raise ConfigError(
            f"found {' and '.join(given) or 'no scale'}",
            hint="expected one of focal_length_px, fov_x_deg and fov_y_deg",
        )
    if fov_x_deg is None:
        return _focal_length_from_fov("fov_y_deg", fov_y_deg, height_px)
    focal = _focal_length_from_fov("fov_x_deg", fov_x_deg, width_px)
    if fov_y_deg is not None:
        other = _focal_length_from_fov("fov_y_deg", fov_y_deg, height_px)
        if abs(other - focal) > 1e-3 * focal:
            square = np.degrees(2.0 * np.arctan(0.5 * height_px / focal))
            raise ConfigError(
                f"expected {square:.6g}, which square pixels give with fov_x_deg {fov_x_deg!r}, or "
                "neither of the two",
                parameter="fov_y_deg",
                value=fov_y_deg,
            )
    return focal


def _focal_length_from_fov(name: str, fov_deg: object, size_px: int) -> float:
    half_rad = np.radians(0.5 * checked_number(name, fov_deg, 0.0, WIDEST_FOV_DEG))
    return float(0.5 * size_px / np.tan(half_rad))
