"""Geometry on the celestial sphere: directions, separations, tangent plane, spiral points, caps.

Directions are unit vectors, float64, one row per star, in the frame of the caller (ICRS throughout
starcat). Angles are in radians, or in degrees if the name ends in ``_deg``. Nothing here reads
files or depends on catalogs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from starcat.arrays import Array, Directions


def directions_from_radec(ra_deg: ArrayLike, dec_deg: ArrayLike) -> Array:
    """Return unit vectors from right ascension and declination.

    >>> directions_from_radec([0.0], [90.0]).round(12)
    array([[0., 0., 1.]])
    """
    ra = np.radians(np.asarray(ra_deg, dtype=np.float64))
    dec = np.radians(np.asarray(dec_deg, dtype=np.float64))
    u = np.empty((*np.broadcast(ra, dec).shape, 3))
    cos_dec = np.cos(dec)
    np.multiply(cos_dec, np.cos(ra), out=u[..., 0])
    np.multiply(cos_dec, np.sin(ra), out=u[..., 1])
    u[..., 2] = np.sin(dec)
    return u


def radec_from_directions(u: ArrayLike) -> tuple[Array, Array]:
    """Return right ascension in [0, 360) and declination, degrees, of vectors of any length but 0.

    The declination is exact at the poles (no arcsine).

    >>> radec_from_directions([[0.0, -1.0, 0.0]])
    (array([270.]), array([0.]))
    """
    v = np.asarray(u, dtype=np.float64)
    ra = np.degrees(np.arctan2(v[..., 1], v[..., 0]))
    ra = np.where(ra < 0.0, ra + 360.0, ra)
    # A tiny negative angle plus 360 rounds to 360 itself.
    ra = np.where(ra >= 360.0, 0.0, ra)
    dec = np.degrees(np.arctan2(v[..., 2], np.hypot(v[..., 0], v[..., 1])))
    return ra, dec


def separation(u: ArrayLike, v: ArrayLike) -> Array:
    """Return the great-circle separation of directions, radians, exact at all angles.

    ``2 atan2(|u - v|, |u + v|)``: an arc cosine of the dot product returns NaN when rounding
    takes the product above 1, and loses half of the digits at small angles.

    >>> float(separation([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])) * 2 / np.pi
    1.0
    """
    a = np.asarray(u, dtype=np.float64)
    b = np.asarray(v, dtype=np.float64)
    return np.asarray(2.0 * np.arctan2(_length(a - b), _length(a + b)))


def chord_from_separation(separation_rad: float) -> float:
    """Return the chord of the unit sphere that spans a separation: 0 to 2.

    >>> chord_from_separation(np.pi)
    2.0
    """
    return float(2.0 * np.sin(0.5 * min(max(separation_rad, 0.0), np.pi)))


def tangent_axes(ra_deg: ArrayLike, dec_deg: ArrayLike) -> tuple[Array, Array]:
    """Return the east and north unit vectors at positions.

    At a pole the right ascension determines the direction of east.
    """
    ra = np.radians(np.asarray(ra_deg, dtype=np.float64))
    dec = np.radians(np.asarray(dec_deg, dtype=np.float64))
    sin_ra, cos_ra = np.sin(ra), np.cos(ra)
    sin_dec = np.sin(dec)
    east = np.stack([-sin_ra, cos_ra, np.zeros_like(ra)], axis=-1)
    north = np.stack([-sin_dec * cos_ra, -sin_dec * sin_ra, np.cos(dec)], axis=-1)
    return east, north


def saff_kuijlaars(count: int) -> Array:
    """Return the generalised spiral points of Saff and Kuijlaars, from south to north.

    Saff and Kuijlaars, The Mathematical Intelligencer 19 (1997) 5:
    ``h_k = -1 + 2 (k - 1)/(N - 1)``, ``phi_k = phi_(k-1) + 3.6/sqrt(N (1 - h_k^2))``,
    ``phi_1 = phi_N = 0``.

    >>> saff_kuijlaars(3)[[0, 2], 2]
    array([-1.,  1.])
    """
    if count < 1:
        raise ValueError(f"count is {count}; expected at least 1")
    if count == 1:
        return np.array([[0.0, 0.0, -1.0]])
    height = -1.0 + 2.0 * np.arange(count) / (count - 1)
    radius = np.sqrt(np.maximum(0.0, (1.0 - height) * (1.0 + height)))
    step = np.zeros(count)
    step[1:-1] = 3.6 / (np.sqrt(count) * radius[1:-1])
    phi = np.cumsum(step) % (2.0 * np.pi)
    phi[-1] = 0.0
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), height], axis=-1)


def _length(v: Array) -> Array:
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", v, v)))


_ROUNDING = 1e-12  # margin by which a zone is wider than its cap: more than the sines' rounding


@dataclass(frozen=True)
class Zones:
    """Directions in order of declination."""

    # shape (N, 3): unit vectors, southernmost first, so that a zone is one contiguous block
    directions: Directions
    order: NDArray[np.int64]  # shape (N,): rows of the directions in the caller's array
    height: Array  # shape (N,): their third components

    def near(self, axis: Array, radius_rad: float) -> NDArray[np.int64]:
        """Return which directions lie within a cap, its edge included: rows, ascending.

        >>> zones_of(np.eye(3)).near(np.array([0.0, 0.6, 0.8]), 1.0)
        array([1, 2])
        """
        declination = math.asin(max(-1.0, min(1.0, float(axis[2]))))
        south = math.sin(max(-0.5 * math.pi, declination - radius_rad)) - _ROUNDING
        north = math.sin(min(0.5 * math.pi, declination + radius_rad)) + _ROUNDING
        first, last = np.searchsorted(self.height, [south, north])
        # A product of matrices would wake threads, which takes longer than the product; and the
        # chord keeps its digits where the cosine of a small angle does not.
        offset = self.directions[first:last] - axis
        chord = 2.0 * math.sin(0.5 * radius_rad)
        inside = np.einsum("ij,ij->i", offset, offset) <= chord * chord
        return np.sort(self.order[first:last][inside])


def zones_of(directions: Directions) -> Zones:
    """Return directions in order of declination."""
    order = np.argsort(directions[:, 2], kind="stable")
    ordered = directions[order]
    return Zones(ordered, order, np.ascontiguousarray(ordered[:, 2]))
