"""Reference stars, and consensus: which names of single centroids agree with each other.

Several methods compare the neighbourhood of one centroid, the reference star, with that of
each star. The centroid nearest to the centre of the frame is tried first, because most of its
neighbours are in the frame.

Some methods rank stars for every centroid on its own; a name is a pair of a centroid and one of
these stars. Two names can both be right only if the two stars are as far apart as the two
centroids. The names that agree with the most other names come first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Mask, Rows
from starcat.geometry.sphere import separation
from starcat.matcher.database import MatcherDatabase, ProductArrays
from starcat.matcher.observation import Candidates, Observation
from starcat.matcher.settings import LOOKUP
from starcat.matcher.star_cells import rows_between

BATCHES = (4, 16, 64)
"""Sizes of the first batches of pairs; all later batches have the last size."""

MAX_NAMES = 2048
"""Largest number of names that are compared; if there are more, low ranks are left out."""


def consistent_candidates(
    ranked: NDArray[np.integer],
    observation: Observation,
    database: MatcherDatabase,
    most: int = 1000,
) -> Iterator[Candidates]:
    """Propose the names of centroids that agree with each other, at most ``most`` pairs.

    ``ranked`` has rows of the database's stars for every centroid, shape (N, K), the best first;
    -1 if there are fewer. The first candidate is one correspondence: the pair with the highest
    support and all names that agree with both and with each other. Then every pair follows by
    falling support, and pairs of equal support by falling separation.

    The support of a name is the number of other centroids with a name that agrees with it. True
    names agree with each other; false names rarely do, even if there are many. The support of a
    pair is the sum of the support of both names.
    """
    centroid, star = _names(ranked)
    fits = consistent(centroid, star, observation, database)
    first, second = np.nonzero(np.triu(fits))
    if not len(first):
        return
    count = support(fits, centroid, len(observation))
    apart = observation.separation_rad[centroid[first], centroid[second]]
    order = np.lexsort((-apart, -(count[first] + count[second])))[:most]
    pairs = np.stack([first[order], second[order]], axis=-1)
    largest = _all_agreeing(pairs[0], fits, count)
    if len(largest) > 2:
        yield Candidates(centroid[largest][None, :], star[largest][None, :])
    done = step = 0
    while done < len(pairs):
        size = BATCHES[min(step, len(BATCHES) - 1)]
        batch = pairs[done : done + size]
        yield Candidates(centroid[batch], star[batch])
        done, step = done + size, step + 1


def consistent(
    centroid: Rows, star: Rows, observation: Observation, database: MatcherDatabase
) -> Mask:
    """Return which names are as far apart as their centroids, symmetric, shape (L, L).

    False for two names of one centroid and for one star at two centroids.

    The bounds on the separation are compared as squared chords, ``2 - 2 u.v``, which one
    matrix product yields to 4e-16: 4 mas at separation 0 and less beyond.
    """
    low, high = _squared_chords(observation)
    u = database.directions[star]
    square = 2.0 - 2.0 * (u @ u.T)
    fits = square >= low[centroid][:, centroid]
    fits &= square <= high[centroid][:, centroid]
    fits &= star[:, None] != star
    return np.asarray(fits)


def support(fits: Mask, centroid: Rows, count: int) -> NDArray[np.int64]:
    """Count for each name the other centroids with a name that agrees with it, shape (L,)."""
    agrees = np.zeros((len(centroid), count), dtype=bool)
    name, other = np.nonzero(fits)
    agrees[name, centroid[other]] = True
    return np.asarray(agrees.sum(axis=1))


def _names(ranked: NDArray[np.integer]) -> tuple[Rows, Rows]:
    """Return centroid and star of every name, the first ranks of all centroids first."""
    rank, centroid = np.nonzero(ranked.T >= 0)
    rank, centroid = rank[:MAX_NAMES], centroid[:MAX_NAMES]
    # Products may keep rows in few bits.
    return centroid, ranked[centroid, rank].astype(np.intp)


def _all_agreeing(pair: Rows, fits: Mask, count: NDArray[np.int64]) -> Rows:
    """Return a pair and the names that agree with it and each other, the best supported first."""
    agreeing = list(pair)
    remaining = fits[pair[0]] & fits[pair[1]]
    while remaining.any():
        best = int(np.argmax(np.where(remaining, count, -1)))
        agreeing.append(best)
        remaining &= fits[best]
    return np.array(agreeing)


def neighbour_candidates(
    reference: int,
    stars: Rows,
    product: ProductArrays,
    observation: Observation,
    database: MatcherDatabase,
) -> Candidates:
    """Return the stars that a reference star may be, with two neighbours that agree.

    ``stars`` are the stars that it can be, without repeats, and ``product`` lists the neighbours
    of every star in ``star_offsets`` and ``neighbour``. There is at most one candidate for each
    star, the best supported first. It names three centroids: the reference star, and two whose
    stars are neighbours of the star at the same separations from it and from each other.
    """
    owner, star, centroid = _named_by_neighbours(reference, stars, product, observation, database)
    first, second = _agreeing_pairs(owner, star, centroid, observation, database)
    agrees = np.zeros((len(owner), len(observation)), dtype=bool)
    agrees[first, centroid[second]] = agrees[second, centroid[first]] = True
    count = agrees.sum(axis=1)
    apart = observation.separation_rad[centroid[first], centroid[second]]
    order = np.lexsort((-apart, -(count[first] + count[second])))
    _, leader = np.unique(owner[first[order]], return_index=True)
    best = order[np.sort(leader)]
    first, second = first[best], second[best]
    reference_column = np.full(len(best), reference)
    return Candidates(
        np.stack([reference_column, centroid[first], centroid[second]], axis=-1),
        np.stack([stars[owner[first]], star[first], star[second]], axis=-1),
    )


def _agreeing_pairs(
    owner: Rows, star: Rows, centroid: Rows, observation: Observation, database: MatcherDatabase
) -> tuple[Rows, Rows]:
    """Return the pairs of names of the same owner, which ascend, that agree."""
    after = np.arange(len(owner)) + 1
    first, second = rows_between(after, np.searchsorted(owner, owner, side="right"))
    low, high = _squared_chords(observation)
    u, v = database.directions[star[first]], database.directions[star[second]]
    square = 2.0 - 2.0 * np.einsum("ij,ij->i", u, v)
    ends = centroid[first], centroid[second]
    agree = (square >= low[ends]) & (square <= high[ends]) & (star[first] != star[second])
    return first[agree], second[agree]


def _squared_chords(observation: Observation) -> tuple[Array, Array]:
    """Return the bounds on the squared chord of centroids' stars; none fit one centroid."""
    apart, tolerance_rad = observation.separation_rad, observation.side_tolerance_rad
    low = 4.0 * np.sin(0.5 * np.maximum(apart - tolerance_rad, 0.0)) ** 2
    high = 4.0 * np.sin(0.5 * np.minimum(apart + tolerance_rad, np.pi)) ** 2
    np.fill_diagonal(low, np.inf)
    return low, high


def _named_by_neighbours(
    reference: int,
    stars: Rows,
    product: ProductArrays,
    observation: Observation,
    database: MatcherDatabase,
) -> tuple[Rows, Rows, Rows]:
    """Return the stars with neighbours as far away as centroids are from the reference star."""
    offsets = product["star_offsets"]
    owner, row = rows_between(offsets[stars], offsets[stars + 1])
    star = product["neighbour"][row].astype(np.intp)
    apart = separation(database.directions[stars[owner]], database.directions[star])
    observed = observation.separation_rad[reference]
    nearest = np.argsort(observed, kind="stable")
    nearest = nearest[nearest != reference]
    tolerance_rad = observation.side_tolerance_rad
    low = np.searchsorted(observed[nearest], apart - tolerance_rad, side="left")
    high = np.searchsorted(observed[nearest], apart + tolerance_rad, side="right")
    name, rank = rows_between(low, high)
    return owner[name], star[name], nearest[rank]


RANKS = (1, 5, 20)
"""Number of candidates of each reference star that have been tried after each round."""


@dataclass(frozen=True)
class Surroundings:
    """The centroids around one of them, the nearest first."""

    centroids: Rows  # rows of the observation
    separation_rad: Array  # separation from the reference star, radians; shape (n,)
    # Position angle at the reference star, radians, -pi to pi. It runs counter-clockwise on the
    # sky as seen, from an arbitrary axis: only differences have a meaning; shape (n,).
    position_angle_rad: Array

    def __len__(self) -> int:
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
    the second one is called after the first was called for all reference stars. The papers stop at
    the best star of the reference star nearest to the centre. Here another reference star decides
    if that one is a false star, or has lost its neighbours.
    """
    proposed: list[Candidates] = []
    for propose in proposals:
        for reference in references(observation):
            observation.budget.spend(LOOKUP)
            proposed.append(propose(int(reference)))
            if len(proposed[-1]):
                yield proposed[-1][:1]
    for first, last in pairwise(RANKS):
        batch = [ranked[first:last] for ranked in proposed]
        if any(len(part) for part in batch):
            yield Candidates(
                np.concatenate([part.centroids for part in batch]),
                np.concatenate([part.stars for part in batch]),
            )
