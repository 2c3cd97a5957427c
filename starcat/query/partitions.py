"""The areas of the sky that the partitions of a store cover, for the macros of SQL.

Pixels become circles and boxes around them. No package for HEALPix is loaded: only four corners and
a centre are needed, and loading a package takes longer than a query.

References
----------
Gorski et al. 2005, ApJ 622, 759, section 4 (HEALPix).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Mask
from starcat.catalog.store.layout import Pixel
from starcat.geometry.sphere import separation

MARGIN_DEG = 1e-6
"""Margin by which circles and boxes are wider than their corners, for rounding errors."""

_RING_OF_FACE = np.array([2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4])
_EIGHTH_OF_FACE = np.array([1, 3, 5, 7, 0, 2, 4, 6, 1, 3, 5, 7])
_CORNERS = ((0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0))


EXTENT = ("x", "y", "z", "cosine", "sine", "reach", "ra_from", "ra_to", "dec_from", "dec_to")
"""The direction of the middle of a circle, cosine and sine of its radius and the radius, the sides
of a box. Angles are in degrees; ``ra_from`` is from 0 to 360, ``ra_to`` is larger, and above 360
if the box goes through 0."""


def extents(pixels: Sequence[Pixel]) -> Array:
    """Return circles and boxes that hold N pixels, a row of `EXTENT` for each."""
    order = np.array([pixel.order for pixel in pixels], dtype=np.int64)
    number = np.array([pixel.number for pixel in pixels], dtype=np.int64)
    centre, middle, _ = _position(order, number, 0.5, 0.5)
    corners = [_position(order, number, *corner) for corner in _CORNERS]
    reach = np.max([separation(centre, corner) for corner, _, _ in corners], axis=0)
    # The pole has no right ascension; the neighbouring corners have the range of the sides.
    east = np.array([np.where(is_pole, 0.0, _turned(ra - middle)) for _, ra, is_pole in corners])
    dec = np.degrees([np.arcsin(corner[:, 2]) for corner, _, _ in corners])
    first = middle + east.min(axis=0) - MARGIN_DEG
    width = np.ptp(east, axis=0) + 2 * MARGIN_DEG
    ra_from = np.mod(first, 360.0)
    reach_deg = np.degrees(reach) + MARGIN_DEG
    angle = np.radians(reach_deg)
    return np.column_stack(
        [
            centre, np.cos(angle), np.sin(angle), reach_deg, ra_from,
            ra_from + width, dec.min(axis=0) - MARGIN_DEG, dec.max(axis=0) + MARGIN_DEG,
        ]
    )  # fmt: skip


def _position(
    order: NDArray[np.int64], number: NDArray[np.int64], x: float, y: float
) -> tuple[Array, Array, Mask]:
    """Return directions and right ascensions of a point of each pixel, and which are a pole.

    The point is given by its parts of the way along the two sides that meet in the south.
    """
    face = number >> 2 * order
    side = np.left_shift(1, order).astype(np.float64)
    east = (_every_second_bit(number, order) + x) / side
    west = (_every_second_bit(number >> 1, order) + y) / side
    # From the north pole down: 0 at the pole, 1 at the edge of its cap, 2 at the equator.
    ring = _RING_OF_FACE[face] - east - west
    cap = np.minimum(1.0, np.minimum(ring, 4.0 - ring))
    z = np.where(ring < 1.0, 1.0 - cap**2 / 3.0, np.where(ring > 3.0, cap**2 / 3.0 - 1.0, 0.0))
    z = np.where(cap < 1.0, z, (2.0 - ring) * 2.0 / 3.0)
    is_pole = cap <= 0.0
    along = _EIGHTH_OF_FACE[face] * cap + east - west
    ra_deg = 45.0 * along / np.where(is_pole, 1.0, cap)
    radius = np.where(cap < 1.0, cap * np.sqrt((1.0 + np.abs(z)) / 3.0), np.sqrt(1.0 - z**2))
    angle = np.radians(ra_deg)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1), ra_deg, is_pole


def _every_second_bit(number: NDArray[np.int64], order: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the number that the bits 0, 2, 4 … below an order are."""
    bits = np.zeros_like(number)
    for bit in range(int(order.max(initial=0))):
        bits |= np.where(bit < order, (number >> bit) & (1 << bit), 0)
    return bits


def _turned(angle_deg: Array) -> Array:
    return np.mod(angle_deg + 180.0, 360.0) - 180.0
