"""Positions and motions in the columns of a table, and directions at any epoch."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from starcat.arrays import Array, Directions, Mask
from starcat.catalog.stars.proper_motion import Motion, propagate_directions
from starcat.catalog.stars.star_table import floats_of
from starcat.geometry.sphere import directions_from_radec


def motion_of(stars: pa.Table) -> Motion:
    """Return the positions of a table at their own epochs, with their proper motions."""
    return Motion(*(floats_of(stars, field.name) for field in fields(Motion)))


@dataclass(frozen=True)
class Positions:
    """The positions of N stars at their own epochs, and their motions."""

    directions: Directions  # shape (N, 3), ICRS
    epoch_jyear: Array
    motion: Motion
    has_motion: Mask

    @classmethod
    def of(cls, stars: pa.Table) -> Positions:
        """Return the positions in the columns of a table."""
        motion = motion_of(stars)
        directions = directions_from_radec(motion.ra_deg, motion.dec_deg)
        return cls(directions, floats_of(stars, "epoch_jyear"), motion, motion.is_known)

    def at(
        self, epoch_jyear: Array | float, rows: NDArray[np.int64] | slice = slice(None)
    ) -> Directions:
        """Return directions of some stars at an epoch; stars without proper motion stay.

        ``epoch_jyear`` is one epoch, or one for each of the rows.
        """
        directions, moves = self.directions[rows].copy(), self.has_motion[rows]
        motion = Motion(*(values[rows][moves] for values in vars(self.motion).values()))
        years = (epoch_jyear - self.epoch_jyear[rows])[moves]
        directions[moves] = propagate_directions(motion, years)[1]
        return directions
