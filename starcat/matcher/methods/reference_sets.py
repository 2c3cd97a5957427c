"""Reference sets: one set of numbers for every star, and distances of observed numbers from it.

The directed, averaged Hausdorff distance from observed numbers to a star's set is the mean of
their smallest differences from its members. `within_reach` computes only the small ones, which
few stars have.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Rows
from starcat.matcher.methods.reference import rows_between


@dataclass(frozen=True)
class ReferenceSets:
    """The members of all stars' sets, by star and by value."""

    # The members of star n are ``offsets[n]:offsets[n + 1]``, when they are sorted by star; shape
    # (S + 1,).
    offsets: NDArray[np.int64]
    # The members of all stars, ascending; shape (M,).
    value: Array
    # The star that each member of ``value`` belongs to.
    star: Rows
    # Each member of ``value`` is the nearest of its star's members to all numbers from ``low`` up
    # to ``high``, the latter excluded; shape (M,).
    low: Array
    high: Array

    def __len__(self) -> int:
        """Return the number of stars."""
        return len(self.offsets) - 1


def reference_sets(values: Array, offsets: NDArray[np.int64]) -> ReferenceSets:
    """Arrange finite members, ascending within a star, by star and by value."""
    star = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    # An ``inf`` before the first star, between two stars and after the last one.
    fenced = np.full(len(values) + len(offsets), np.inf)
    place = np.arange(len(values)) + star + 1
    fenced[place] = values
    below, above = fenced[place - 1], fenced[place + 1]
    low = np.where(np.isinf(below), -np.inf, 0.5 * (below + values))
    high = 0.5 * (values + above)
    order = np.argsort(values, kind="stable")
    return ReferenceSets(offsets, values[order], star[order], low[order], high[order])


def means_of_minima(differences: Iterable[Array], offsets: NDArray[np.int64]) -> Array:
    """Return, for every star, the mean of the observed elements' smallest differences from it.

    The differences are the caller's, so elements need not be numbers: they may be points, for
    example, with distances as the differences. There is one array for every observed element: its
    difference from each member, sorted by star. The mean is ``inf`` where the star has no members,
    and where nothing was observed.
    """
    # For an empty interval, reduceat would return the member that follows it.
    filled = np.flatnonzero(np.diff(offsets))
    total, count = np.zeros(len(filled)), 0
    for difference in differences:
        if len(filled):
            total += np.minimum.reduceat(difference, offsets[filled])
        count += 1
    means = np.full(len(offsets) - 1, np.inf)
    if count:
        means[filled] = total / count
    return means


def within_reach(sets: ReferenceSets, numbers: Array, reach: Array) -> tuple[Rows, Rows, Array]:
    """Return the stars whose sets come nearer to observed numbers than the reach of each.

    Returns
    -------
    number, star : ndarray of int, shape (T,)
        Row of the number, ascending, and of the star.
    gain : ndarray of float64, shape (T,)
        The reach less the smallest difference from a member; 0 where the entry's member is
        not its star's nearest, so that gains may be summed.
    """
    start = np.searchsorted(sets.value, numbers - reach, side="left")
    stop = np.searchsorted(sets.value, numbers + reach, side="right")
    number, row = rows_between(start, stop)
    wanted = numbers[number]
    gain = reach[number] - np.abs(wanted - sets.value[row])
    gain *= (sets.low[row] <= wanted) & (wanted < sets.high[row])
    return number, sets.star[row], gain


def lowest(scores: Array, count: int) -> tuple[Rows, Array]:
    """Return the stars of the lowest scores and these scores, shape (N, count), the lowest first.

    ``scores`` has a row for each centroid, a column for each star; ``inf`` or NaN where the star is
    out of the question. Where there are no more, the star is -1 and the score ``inf``.
    """
    scores = np.where(np.isnan(scores), np.inf, scores)
    if scores.shape[1] < count:
        rest = ((0, 0), (0, count - scores.shape[1]))
        scores = np.pad(scores, rest, constant_values=np.inf)
    star = np.argpartition(scores, count - 1, axis=1)[:, :count]
    score = np.take_along_axis(scores, star, axis=1)
    order = np.lexsort((star, score))
    star, score = np.take_along_axis(star, order, axis=1), np.take_along_axis(score, order, axis=1)
    return np.where(np.isinf(score), -1, star), score
