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
from starcat.matcher.budget import LOOKUP
from starcat.matcher.methods.candidates import Candidates
from starcat.matcher.observation import Observation

RANKS = (1, 5, 20)
"""Number of candidates of each reference star that have been tried after each round."""


@dataclass(frozen=True)
class Surroundings:
    """The centroids around one of them, the nearest first.

    Attributes
    ----------
    centroids : ndarray of int, shape (n,)
        Rows of the observation.
    separation_rad : ndarray of float64, shape (n,)
        Separation from the reference star, radians.
    position_angle_rad : ndarray of float64, shape (n,)
        Position angle at the reference star, radians, -pi to pi. It runs counter-clockwise on
        the sky as seen, from an arbitrary axis: only differences have a meaning.
    """

    centroids: Rows
    separation_rad: Array
    position_angle_rad: Array

    def __len__(self) -> int:
        """Return the number of centroids around."""
        return len(self.centroids)


def references(observation: Observation) -> Rows:
    """Return the centroids in the order in which they serve as reference stars.

    Parameters
    ----------
    observation : Observation
        The frame.

    Returns
    -------
    ndarray of int, shape (N,)
        Rows of the observation, the nearest to the centre of the frame first.
    """
    camera = observation.camera
    x, y = (observation.centroids_px - [0.5 * camera.width_px, 0.5 * camera.height_px]).T
    return np.lexsort((y, x, x * x + y * y))


def surroundings(observation: Observation, reference: int, radius_rad: float) -> Surroundings:
    """Return the centroids around one of them.

    Parameters
    ----------
    observation : Observation
        The frame.
    reference : int
        Row of the observation.
    radius_rad : float
        Largest separation, radians, itself included.

    Returns
    -------
    Surroundings
        The other centroids, the nearest first; equally near ones by position angle.
    """
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
    """Propose the best of every reference star, then more of all.

    Parameters
    ----------
    observation : Observation
        The frame.
    *proposals : callable
        Each returns the candidates of a reference star, given its row, the best first; the
        second is asked when all reference stars have been asked the first.

    Yields
    ------
    Candidates
        The best one of a reference star at a time, then those of the next ranks of all
        reference stars together.

    Notes
    -----
    The papers stop at the best star of the reference star nearest to the centre. Here another
    reference star decides where that one is a false star, or has lost its neighbours.
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
    """Return all rows of several runs of rows.

    Parameters
    ----------
    start, stop : ndarray of int, shape (K,)
        First row of each run, and the row after its last.

    Returns
    -------
    run, row : ndarray of int, shape (M,)
        Run and row of each entry, run after run.

    Examples
    --------
    >>> rows_between(np.array([5, 2, 9]), np.array([7, 2, 10]))
    (array([0, 0, 2]), array([5, 6, 9]))
    """
    count = stop - start
    run = np.repeat(np.arange(len(count)), count)
    return run, np.arange(len(run)) + np.repeat(start - np.cumsum(count) + count, count)
