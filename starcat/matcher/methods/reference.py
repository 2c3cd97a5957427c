"""Reference stars: the centroids around one of them, and the order in which they are tried.

Several methods compare the neighbourhood of one centroid, the reference star, with that of
every star. The centroid nearest to the centre of the frame is tried first, because most of its
neighbours are in the frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Rows
from starcat.matcher.observation import Candidates, Observation
from starcat.matcher.settings import LOOKUP

RANKS = (1, 5, 20)
"""Number of candidates of each reference star that have been tried after each round."""


@dataclass(frozen=True)
class Surroundings:
    """The centroids around one of them, the nearest first."""

    # Rows of the observation.
    centroids: Rows
    # Separation from the reference star, radians; shape (n,).
    separation_rad: Array
    # Position angle at the reference star, radians, -pi to pi. It runs counter-clockwise on the
    # sky as seen, from an arbitrary axis: only differences have a meaning; shape (n,).
    position_angle_rad: Array

    def __len__(self) -> int:
        """Return the number of centroids around."""
        return len(self.centroids)


def references(observation: Observation) -> Rows:
    """Return the centroids in the order in which they serve as reference stars: from the centre."""
    camera = observation.camera
    x, y = (observation.centroids_px - [0.5 * camera.width_px, 0.5 * camera.height_px]).T
    return np.lexsort((y, x, x * x + y * y))


def surroundings(observation: Observation, reference: int, radius_rad: float) -> Surroundings:
    """Return the other centroids up to a separation, itself included, the nearest first."""
    apart, u = observation.separation_rad[reference], observation.body[reference]
    inside = apart <= radius_rad
    inside[reference] = False
    rows = np.flatnonzero(inside)
    # East is y x u, north u x east: as on the sky their product points outwards, so that angles
    # run the same way. No direction that a camera sees is along y.
    x, _, z = u / np.hypot(u[0], u[2])
    offset = observation.body[rows] - u
    to_east = offset @ np.array([z, 0.0, -x])
    to_north = offset @ np.array([-x * u[1], x * u[0] + z * u[2], -z * u[1]])
    angle = np.arctan2(to_east, to_north)
    order = np.lexsort((angle, apart[rows]))
    return Surroundings(rows[order], apart[rows][order], angle[order])


def by_reference(
    observation: Observation, *proposals: Callable[[int], Candidates]
) -> Iterator[Candidates]:
    """Propose the best of every reference star, then the next ranks of all of them together.

    Each of ``proposals`` returns the candidates of a reference star, given its row, the best first;
    the second is asked when all reference stars have been asked the first. The papers stop at the
    best star of the reference star nearest to the centre. Here another reference star decides where
    that one is a false star, or has lost its neighbours.
    """
    found: list[Candidates] = []
    for propose in proposals:
        for reference in references(observation):
            observation.budget.spend(LOOKUP)
            found.append(propose(int(reference)))
            if len(found[-1]):
                yield found[-1][:1]
    for first, last in pairwise(RANKS):
        batch = [ranked[first:last] for ranked in found]
        if any(len(part) for part in batch):
            yield Candidates(
                np.concatenate([part.centroids for part in batch]),
                np.concatenate([part.stars for part in batch]),
            )


def rows_between(
    start: NDArray[np.integer[Any]], stop: NDArray[np.integer[Any]]
) -> tuple[Rows, Rows]:
    """Return run and row of each entry of several runs of rows, given their starts and stops.

    Examples
    --------
    >>> rows_between(np.array([5, 2, 9]), np.array([7, 2, 10]))
    (array([0, 0, 2]), array([5, 6, 9]))
    """
    count = stop - start
    run = np.repeat(np.arange(len(count)), count)
    return run, np.arange(len(run)) + np.repeat(start - np.cumsum(count) + count, count)
