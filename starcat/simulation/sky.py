"""The sky of a simulation: points of light, guide stars and others."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.geometry.sphere import Zones, zones_of


@dataclass(frozen=True)
class Sky:
    """Points of light.

    Attributes
    ----------
    directions : ndarray of float64, shape (N, 3)
        ICRS unit vectors.
    mag : ndarray of float64, shape (N,)
        Magnitudes.
    star_index : ndarray of int32, shape (N,)
        Row of the guide star in the database, -1 for what is none.
    """

    directions: Array
    mag: Array
    star_index: NDArray[np.int32]

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.mag)

    @cached_property
    def zones(self) -> Zones:
        """The points in order of declination."""
        return zones_of(self.directions)

    def brighter(self, limit_mag: float) -> Sky:
        """Return the points up to a magnitude."""
        seen = self.mag <= limit_mag
        return Sky(self.directions[seen], self.mag[seen], self.star_index[seen])
