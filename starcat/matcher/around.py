"""Stars around a boresight, and a part of the sky that is kept at hand while a camera stays there.

Going through all stars of a database takes longer than comparing those of a field with a frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.geometry.sphere import zones_of
from starcat.matcher.database import Database

Rows = NDArray[np.int64]

MANY_STARS = 15_000
"""So many stars are searched by zones; a product of all is faster for fewer."""

MARGIN = 0.5
"""How far a boresight may move before another part is needed, over the radius around it."""


@dataclass(frozen=True)
class _Part:
    """The stars of a cap."""

    centre: tuple[float, float, float]
    cos_margin: float
    radius_rad: float
    rows: Rows
    directions: Array


class StarsAround:
    """The stars of a database, to be asked for those around a boresight.

    Notes
    -----
    What is kept makes answers faster and never different.
    """

    def __init__(self, database: Database) -> None:
        self._directions = database.directions
        self._zones = zones_of(database.directions) if len(database.mag) >= MANY_STARS else None
        self._part: _Part | None = None

    def near(self, boresight: Array, radius_rad: float) -> tuple[Rows, Array]:
        """Return the stars around a boresight."""
        part = self._part
        if part is not None and part.radius_rad >= radius_rad and _is_in(part, boresight):
            inside = (part.directions @ boresight >= math.cos(radius_rad)).nonzero()[0]
            return part.rows[inside], part.directions[inside]
        rows = self._rows(boresight, radius_rad)
        return rows, self._directions[rows]

    def _rows(self, boresight: Array, radius_rad: float) -> Rows:
        if self._zones is not None:
            return self._zones.near(boresight, radius_rad)
        return (self._directions @ boresight >= math.cos(radius_rad)).nonzero()[0]

    def keep(self, boresight: Array, radius_rad: float) -> None:
        """Keep the stars around a boresight at hand, unless those around a near one are."""
        part = self._part
        if part is None or part.radius_rad < radius_rad or not _is_in(part, boresight):
            margin_rad = MARGIN * radius_rad
            # Rounding of the products must not lose a star at the edge.
            widest_rad = min(math.pi, 1.001 * (radius_rad + margin_rad))
            rows = self._rows(boresight, widest_rad)
            x, y, z = boresight.tolist()
            self._part = _Part(
                (x, y, z), math.cos(margin_rad), radius_rad, rows, self._directions[rows]
            )


def stars_around(database: Database) -> StarsAround:
    """Return the stars of a database, to be asked for those around a boresight."""
    return database.derived(StarsAround)


def _is_in(part: _Part, boresight: Array) -> bool:
    (a, b, c), (x, y, z) = part.centre, boresight.tolist()
    return bool(a * x + b * y + c * z >= part.cos_margin)
