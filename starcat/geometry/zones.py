"""Zones: the directions within a cap of the sphere, found without looking at all of them.

The directions are kept in order of their third component, the sine of the declination. A cap lies
between two declinations, so that only the zone between them is looked at: of a camera of 2 deg,
one star in fifty.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Directions

_ROUNDING = 1e-12
"""By so much a zone is wider than its cap: more than the sines are off by."""


@dataclass(frozen=True)
class Zones:
    """Directions in order of declination."""

    # shape (N, 3): unit vectors, southernmost first, so that a zone is read from one place
    directions: Directions
    order: NDArray[np.int64]  # shape (N,): rows that they had when they were given
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
