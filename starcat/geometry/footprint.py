"""A part of the sphere: which directions are inside, and random directions inside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from starcat.arrays import Array, Directions, Mask
from starcat.errors import BuildError
from starcat.geometry.sphere import radec_from_directions, tangent_axes

_MAX_AT_ONCE = 200_000
_MAX_DRAWS = 50_000_000


@dataclass(frozen=True)
class Ring:
    """The directions between two circles around an axis; a cap has one circle only."""

    axis: Array  # unit vector, shape (3,)
    low: float  # least and largest cosine of the angle from the axis
    high: float

    @property
    def fraction(self) -> float:
        """Fraction of the sphere that the ring covers."""
        return 0.5 * (self.high - self.low)

    def random_directions(self, count: int, generator: np.random.Generator) -> Directions:
        """Return directions uniform over the ring, shape (count, 3)."""
        along = generator.uniform(self.low, self.high, count)
        turn = generator.uniform(0.0, 2.0 * np.pi, count)
        east, north = tangent_axes(*radec_from_directions(self.axis))
        across = np.cos(turn)[:, None] * east + np.sin(turn)[:, None] * north
        radius = np.sqrt(np.maximum(0.0, 1.0 - along * along))
        return np.asarray(along[:, None] * self.axis + radius[:, None] * across)


@dataclass(frozen=True)
class Footprint:
    """A part of the sphere."""

    name: str  # what it is in messages
    contains: Callable[[Directions], Mask]  # which of directions, shape (N, 3), are inside
    ring: Ring  # a ring that the part does not leave

    def random_directions(self, count: int, generator: np.random.Generator) -> Directions:
        """Return directions uniform over the part, shape (count, 3).

        Raises
        ------
        BuildError
            If the part is so small in its ring that drawing takes too long.
        """
        batches, drawn, have = [np.empty((0, 3))], 0, 0
        at_once = max(100, count)
        while have < count:
            if drawn >= _MAX_DRAWS:
                raise BuildError(
                    f"{self.name} covers about {max(have, 1) / drawn:.1g} of the sphere around "
                    "its parts, too little to draw directions from it",
                    hint="give a larger region",
                )
            directions = self.ring.random_directions(at_once, generator)
            batches.append(directions[self.contains(directions)])
            drawn, have = drawn + len(directions), have + len(batches[-1])
            at_once = min(2 * at_once, _MAX_AT_ONCE)
        return np.concatenate(batches)[:count]
