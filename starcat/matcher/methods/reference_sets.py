"""Reference sets: one set of numbers for every star, and distances of observed numbers from it.

The directed, averaged Hausdorff distance from observed numbers to a star's set is the mean of
their smallest differences from its members. `smallest_differences` computes the differences for
all stars; `within_reach` computes only the small ones, which few stars have.
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
    """The members of all stars' sets, by star and by value.

    Attributes
    ----------
    offsets : ndarray of int64, shape (S + 1,)
        The members of star n are ``offsets[n]:offsets[n + 1]``, when they are sorted by star.
    fenced : ndarray of float64, shape (M + S + 1,)
        The members by star, ascending, with an ``inf`` before the first star, between two stars
        and after the last one; no number is near to it.
    value : ndarray of float64, shape (M,)
        The members of all stars, ascending.
    star : ndarray of int, shape (M,)
        The star that each member of ``value`` belongs to.
    low, high : ndarray of float64, shape (M,)
        Each member of ``value`` is the nearest of its star's members to all numbers from
        ``low`` up to ``high``, the latter excluded.
    """

    offsets: NDArray[np.int64]
    fenced: Array
    value: Array
    star: Rows
    low: Array
    high: Array

    def __len__(self) -> int:
        """Return the number of stars."""
        return len(self.offsets) - 1


def reference_sets(values: Array, offsets: NDArray[np.int64]) -> ReferenceSets:
    """Arrange the members of sets by star and by value.

    Parameters
    ----------
    values : ndarray of float64, shape (M,)
        Finite members, ascending within a star.
    offsets : ndarray of int64, shape (S + 1,)
        The members of star n are ``offsets[n]:offsets[n + 1]``.

    Returns
    -------
    ReferenceSets
        The arranged sets, which take 40 bytes a member.
    """
    star = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    fenced = np.full(len(values) + len(offsets), np.inf)
    place = np.arange(len(values)) + star + 1
    fenced[place] = values
    below, above = fenced[place - 1], fenced[place + 1]
    low = np.where(np.isinf(below), -np.inf, 0.5 * (below + values))
    high = 0.5 * (values + above)
    order = np.argsort(values, kind="stable")
    return ReferenceSets(offsets, fenced, values[order], star[order], low[order], high[order])


def smallest_differences(sets: ReferenceSets, numbers: Array) -> Array:
    """Return how near numbers come to every star's set.

    Parameters
    ----------
    sets : ReferenceSets
        The sets of S stars.
    numbers : ndarray of float64, shape (Q,)
        Observed numbers, in any order.

    Returns
    -------
    ndarray of float64, shape (Q, S)
        Smallest absolute difference from a member; ``inf`` where the set is empty.

    Notes
    -----
    The numbers are sorted, and the members between one number and the next are counted by star.
    The running sum of these counts is the place of each number among the members of each star.
    """
    count = len(sets)
    order = np.argsort(numbers, kind="stable")
    ends = np.searchsorted(sets.value, numbers[order], side="left")
    interval = np.repeat(np.arange(len(numbers)), np.diff(ends, prepend=0))
    key = interval * count + sets.star[: len(interval)]
    below = np.bincount(key, minlength=len(numbers) * count).reshape(-1, count).cumsum(axis=0)
    place = below + (sets.offsets[:-1] + np.arange(count))
    wanted = numbers[order][:, None]
    to_below, to_above = wanted - sets.fenced[place], wanted - sets.fenced[place + 1]
    nearest = np.empty((len(numbers), count))
    nearest[order] = np.minimum(np.abs(to_below), np.abs(to_above))
    return nearest


def means_of_minima(differences: Iterable[Array], offsets: NDArray[np.int64]) -> Array:
    """Return, for every star, the mean of the observed elements' smallest differences from it.

    The differences are the caller's, so elements need not be numbers: they may be points, for
    example, with distances as the differences.

    Parameters
    ----------
    differences : iterable of ndarray of float64, shape (M,)
        One array for every observed element: its difference from each member, sorted by star.
    offsets : ndarray of int64, shape (S + 1,)
        The members of star n are ``offsets[n]:offsets[n + 1]``.

    Returns
    -------
    ndarray of float64, shape (S,)
        ``inf`` where the star has no members, and where nothing was observed.
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
    """Return the stars whose sets come nearer to numbers than a reach.

    Parameters
    ----------
    sets : ReferenceSets
        The sets of S stars.
    numbers, reach : ndarray of float64, shape (Q,)
        Observed numbers, in any order, and the largest difference that counts for each.

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
    """Return the stars of the lowest scores.

    Parameters
    ----------
    scores : ndarray of float64, shape (N, S)
        A row for each centroid, a column for each star; ``inf`` or NaN where the star is out
        of the question.
    count : int
        Number of stars to return for each row.

    Returns
    -------
    stars : ndarray of int, shape (N, count)
        Rows of the stars, the lowest score first; -1 where there are no more.
    scores : ndarray of float64, shape (N, count)
        Their scores; ``inf`` where there are no more.
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
