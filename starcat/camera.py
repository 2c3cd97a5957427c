"""The pinhole camera: pixels from directions and back.

Camera frame: x right, y down, z along the boresight. Pixel coordinates start at the outer
corner of the top-left pixel, so the centre of that pixel is (0.5, 0.5) and the optical axis
of a centred camera is at (width/2, height/2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with square pixels.

    Attributes
    ----------
    width_px, height_px : int
        Size of the detector.
    focal_length_px : float
        Focal length in pixels.
    """

    width_px: int
    height_px: int
    focal_length_px: float

    def __post_init__(self) -> None:
        if self.width_px < 1 or self.height_px < 1 or not self.focal_length_px > 0.0:
            raise ValueError(
                f"camera of {self.width_px} x {self.height_px} px with focal length "
                f"{self.focal_length_px} px; all three must be positive"
            )

    @classmethod
    def from_fov(cls, width_px: int, height_px: int, fov_x_deg: float) -> Camera:
        """Return the camera whose full horizontal field is given.

        Parameters
        ----------
        width_px, height_px : int
            Size of the detector.
        fov_x_deg : float
            Full angle across the width, degrees, below 180.

        Returns
        -------
        Camera
            Square pixels: the vertical field follows from the height.

        Raises
        ------
        ValueError
            If the field is not between 0 and 180 degrees.

        Examples
        --------
        >>> round(Camera.from_fov(1024, 1024, 12.0).fov_y_deg, 9)
        12.0
        """
        if not 0.0 < fov_x_deg < 180.0:
            raise ValueError(f"fov_x_deg is {fov_x_deg}; expected more than 0 and less than 180")
        focal_length_px = 0.5 * width_px / np.tan(np.radians(0.5 * fov_x_deg))
        return cls(width_px, height_px, float(focal_length_px))

    @property
    def fov_x_deg(self) -> float:
        """Full angle across the width, degrees."""
        return float(2.0 * np.degrees(np.arctan(0.5 * self.width_px / self.focal_length_px)))

    @property
    def fov_y_deg(self) -> float:
        """Full angle across the height, degrees."""
        return float(2.0 * np.degrees(np.arctan(0.5 * self.height_px / self.focal_length_px)))

    @property
    def diagonal_rad(self) -> float:
        """Largest separation that fits into the frame, corner to corner, radians."""
        half = 0.5 * np.hypot(self.width_px, self.height_px)
        return float(2.0 * np.arctan(half / self.focal_length_px))

    def pixels_from_directions(self, body: Array) -> Array:
        """Project directions in the camera frame.

        Parameters
        ----------
        body : ndarray of float64, shape (N, 3)
            Directions in the camera frame.

        Returns
        -------
        ndarray of float64, shape (N, 2)
            Pixels (x right, y down); NaN where a direction lies behind the camera.
        """
        z = np.where(body[:, 2] > 0.0, body[:, 2], np.nan)
        centre = np.array([0.5 * self.width_px, 0.5 * self.height_px])
        return np.asarray(body[:, :2] * (self.focal_length_px / z)[:, None] + centre)

    def directions_from_pixels(self, centroids_px: Array) -> Array:
        """Return the directions that centroids point at.

        Parameters
        ----------
        centroids_px : ndarray of float64, shape (N, 2)
            Pixels (x right, y down, origin at the outer corner of the top-left pixel).

        Returns
        -------
        ndarray of float64, shape (N, 3)
            Unit vectors in the camera frame.
        """
        body = np.empty((len(centroids_px), 3))
        body[:, 0] = centroids_px[:, 0] - 0.5 * self.width_px
        body[:, 1] = centroids_px[:, 1] - 0.5 * self.height_px
        body[:, 2] = self.focal_length_px
        body /= np.sqrt(np.einsum("ij,ij->i", body, body))[:, None]
        return body

    def contains(self, centroids_px: Array) -> NDArray[np.bool_]:
        """Return which pixels lie on the detector.

        Parameters
        ----------
        centroids_px : ndarray of float64, shape (N, 2)
            Pixels; NaN lies outside.

        Returns
        -------
        ndarray of bool, shape (N,)
            Closed at the left and top edge, open at the right and bottom.
        """
        x, y = centroids_px[:, 0], centroids_px[:, 1]
        return np.asarray((x >= 0) & (x < self.width_px) & (y >= 0) & (y < self.height_px))
