"""The all-sky map: Mollweide's equal-area projection, right ascension to the left.

The projection has a closed inverse, so a map is a raster of directions, each with the value
of its nearest boresight.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from starcat.arrays import Array
from starcat.geometry.sphere import directions_from_radec, radec_from_directions

HALF_WIDTH, HALF_HEIGHT = float(2.0 * np.sqrt(2.0)), float(np.sqrt(2.0))
"""Half axes of the ellipse, for a sphere of radius 1."""

GALACTIC_POLE_DEG = (192.85948, 27.12825)
"""Right ascension and declination, ICRS: ESA SP-1200 (1997), volume 1, equation 1.5.11."""


def project(ra_deg: ArrayLike, dec_deg: ArrayLike) -> tuple[Array, Array]:
    """Return x and y of positions on the map, in which right ascension grows to the left.

    Examples
    --------
    >>> x, y = project([270.0], [0.0])
    >>> round(float(x[0] / HALF_WIDTH), 9), abs(round(float(y[0]), 9))
    (0.5, 0.0)
    """
    dec = np.radians(np.asarray(dec_deg, dtype=np.float64))
    east = -np.radians((np.asarray(ra_deg, dtype=np.float64) + 180.0) % 360.0 - 180.0)
    theta = _auxiliary(dec)
    return HALF_WIDTH / np.pi * east * np.cos(theta), HALF_HEIGHT * np.sin(theta)


def _auxiliary(dec: Array) -> Array:
    """Solve 2 theta + sin 2 theta = pi sin dec, by bisection: it does not fail at the poles."""
    low, high = np.full_like(dec, -0.5 * np.pi), np.full_like(dec, 0.5 * np.pi)
    target = np.pi * np.sin(dec)
    for _ in range(52):
        middle = 0.5 * (low + high)
        too_low = 2.0 * middle + np.sin(2.0 * middle) < target
        low, high = np.where(too_low, middle, low), np.where(too_low, high, middle)
    return 0.5 * (low + high)


def nearest_raster(boresights: Array, values: NDArray[np.int64], width: int) -> Array:
    """Return the map as a raster of the value at the nearest boresight.

    Shape (width // 2, width), north at the top; NaN outside of the ellipse.
    """
    height = width // 2
    x = ((np.arange(width) + 0.5) / width * 2.0 - 1.0) * HALF_WIDTH
    y = (1.0 - (np.arange(height) + 0.5) / height * 2.0) * HALF_HEIGHT
    theta = np.arcsin(y / HALF_HEIGHT)[:, None]
    dec = np.arcsin((2.0 * theta + np.sin(2.0 * theta)) / np.pi)
    east = np.pi * x[None, :] / (HALF_WIDTH * np.cos(theta))
    inside = np.abs(east) <= np.pi
    ra_deg = np.degrees(-east)[inside]
    dec_deg = np.degrees(np.broadcast_to(dec, east.shape))[inside]
    _, nearest = cKDTree(boresights).query(directions_from_radec(ra_deg, dec_deg))
    raster = np.full((height, width), np.nan)
    raster[inside] = values[nearest]
    return raster


def galactic_equator(count: int = 721) -> tuple[Array, Array]:
    """Return ra_deg and dec_deg along the galactic equator, the first again at the end."""
    pole = directions_from_radec(*GALACTIC_POLE_DEG)
    ascending = np.cross([0.0, 0.0, 1.0], pole)
    ascending /= np.linalg.norm(ascending)
    angle = np.linspace(0.0, 2.0 * np.pi, count)[:, None]
    circle = np.cos(angle) * ascending + np.sin(angle) * np.cross(pole, ascending)
    return radec_from_directions(circle)
