"""Identification by sets of distances under a Hausdorff distance (S5, S1 and S1's baseline).

Angular (S5): a centroid's feature is the set of its separations from the others, a star's the set
of its separations from its neighbours, product ``hausdorff_angular``. Every centroid is named
after the stars whose sets are nearest in the mean; `consensus` finds the names that agree.

Ratios (S1): a reference star's feature is the set of its gnomonic distances from the centroids
around it, over the smallest of them; a star's comes from the product ``hausdorff_l2``. Ratios
depend neither on the camera's roll nor on its scale, but inherit the relative error of the
divisor, and all are wrong where the nearest neighbour is missing or false.

Points (S1's baseline): the centroids around a reference star are compared, as points of its
tangent plane, with the neighbours of every star, product ``hausdorff_l2``, by the L1 norm. Points
turn and stretch with the image, so the camera has to be upright, with a roll of 0, and of the
nominal scale.

A reference set is a set of numbers for every star. The directed, averaged Hausdorff distance from
observed numbers to it is the mean of their smallest differences from its members.

The papers' answers without a verification are in `starcat_lab.bare_methods`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Rows
from starcat.geometry.sphere import radec_from_directions, tangent_axes
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.methods.consensus import (
    by_reference,
    consistent_candidates,
    neighbour_candidates,
    references,
    surroundings,
)
from starcat.matcher.observation import Candidates, Observation
from starcat.matcher.settings import LOOKUP
from starcat.matcher.star_cells import rows_between

FIRST_ROUND = (16, 5)
"""Number of the first centroids that take part, and number of names that each of them gets."""

SECOND_ROUND = (64, 100)
"""The same two numbers for a second round, if the names of the first round do not agree."""

DIVISOR_ROUNDS = ((1, 30), (2, 30), (3, 400))
"""Rounds: number of nearest distances, of the frame and of a star, that are tried as divisors,
and number of best stars of each pair of divisors that become candidates."""

STARS_BY_POINTS = 30
"""Number of the best stars of a reference star that become candidates."""

_AT_ONCE = 1 << 22
"""Largest number of values in memory while observed separations are compared with all stars."""

_UP = np.array([0.0, -1.0, 0.0])


def angular_candidates(observation: Observation, database: MatcherDatabase) -> Iterator[Candidates]:
    """Propose names of several centroids that agree with each other.

    Then, for each centroid and many more names, the names follow whose neighbours agree.

    The paper counts every difference in full, so that one false or missing star outweighs all
    stars that agree. Here a difference counts at most as ``side_tolerance_rad``.

    Rotation-invariant feature with modified Hausdorff distance (S5).
    """
    cap_rad = observation.side_tolerance_rad
    first, count = FIRST_ROUND
    stars, _ = rank_by_separations(observation, database, cap_rad=cap_rad, count=count, first=first)
    yield from consistent_candidates(stars, observation, database)
    first, count = SECOND_ROUND
    stars, _ = rank_by_separations(observation, database, cap_rad=cap_rad, count=count, first=first)
    product = database.products["hausdorff_angular"]

    def propose(reference: int) -> Candidates:
        named = stars[reference] if reference < first else stars[0, :0]
        return neighbour_candidates(reference, named[named >= 0], product, observation, database)

    yield from by_reference(observation, propose)


def rank_by_separations(
    observation: Observation,
    database: MatcherDatabase,
    *,
    cap_rad: float,
    count: int,
    first: int | None = None,
) -> tuple[Rows, Array]:
    """Rank the stars for every centroid by the directed, averaged Hausdorff distance.

    A difference counts at most as ``cap_rad``; only the ``first`` centroids take part. Return rows
    of stars, shape (N, count), the nearest set first, -1 after the last star, and their scores in
    radians, ``inf`` after the last star. A score is the mean, over the separations of the centroid
    within the radius of the reference sets, of the smallest difference from a member of the set.
    A centroid without such separations has no stars.
    """
    product = database.products["hausdorff_angular"]
    sets = database.cached(_separation_sets)
    apart = observation.separation_rad[:first, :first]
    near = np.triu(apart <= product.numbers["radius_rad"], 1)
    a, b = np.nonzero(near)
    total = np.zeros((len(apart), len(sets)))
    at_once = max(1, _AT_ONCE // max(1, len(sets)))
    for start in range(0, len(a), at_once):
        pairs = slice(start, start + at_once)
        observation.budget.spend(LOOKUP * len(a[pairs]))
        _add_differences(total, sets, apart, a[pairs], b[pairs], cap_rad)
    used = near.sum(axis=0) + near.sum(axis=1)
    with np.errstate(invalid="ignore"):
        return lowest(total / used[:, None], count)


def _add_differences(
    total: Array, sets: ReferenceSets, apart: Array, a: Rows, b: Rows, cap_rad: float
) -> None:
    number, star, gain = within_reach(sets, apart[a, b], np.full(len(a), cap_rad))
    for end in (a, b):
        cell = end[number] * len(sets) + star
        total -= np.bincount(cell, gain, total.size).reshape(total.shape)
        total += cap_rad * np.bincount(end, minlength=len(total))[:, None]


def _separation_sets(database: MatcherDatabase) -> ReferenceSets:
    product = database.products["hausdorff_angular"]
    return reference_sets(product["separation_rad"], product["star_offsets"])


def ratio_candidates(observation: Observation, database: MatcherDatabase) -> Iterator[Candidates]:
    """Propose stars for a reference centroid and two of its neighbours.

    The paper divides by the smallest distance and takes the best star. Here the best of many
    stars become candidates. Later rounds also divide by the second and third smallest distance,
    of the frame and of the star, in case the nearest neighbour is false, missing or inaccurate.
    Differences of ratios count in units of their largest error, and at most 1.

    Wang et al. 2020 (S1).
    """
    product = database.products["hausdorff_l2"]

    for divisors, count in DIVISOR_ROUNDS:

        def propose(reference: int, divisors: int = divisors, count: int = count) -> Candidates:
            stars = likely_stars(observation, database, reference, divisors, count)
            return neighbour_candidates(reference, stars, product, observation, database)

        yield from by_reference(observation, propose)


def likely_stars(
    observation: Observation, database: MatcherDatabase, reference: int, divisors: int, count: int
) -> Rows:
    """Return the stars that a reference star is likely to be, ascending.

    ``divisors`` is the number of nearest distances, of the frame and of each star, that serve as
    divisors, at most 3; ``count`` is the number of stars for each pair of divisors.

    Distances d err by e each, so d/d' errs by ``e/d' sqrt(1 + (d/d')^2)``: a difference counts at
    most as this error.
    """
    distance = distances_around(observation, database, reference)
    error = observation.side_tolerance_rad
    best = [np.empty(0, dtype=np.intp)]
    for divisor in range(min(divisors, len(distance) - 1)):
        ratio = np.delete(distance, divisor) / distance[divisor]
        reach = error / distance[divisor] * np.sqrt(1.0 + ratio * ratio)
        for sets in database.cached(_ratio_sets)[:divisors]:
            number, star, gain = within_reach(sets, ratio, reach)
            share = gain / reach[number]
            # The contribution is 1 minus the square of the difference over the reach.
            agreement = np.bincount(star, share * (2.0 - share), len(sets))
            score = np.where(agreement > 0.0, -agreement, np.inf)
            best.append(lowest(score[None, :], count)[0][0])
    likely = np.unique(np.concatenate(best))
    return likely[likely >= 0]


def distances_around(
    observation: Observation,
    database: MatcherDatabase,
    reference: int,
    radius_rad: float | None = None,
) -> Array:
    """Return the distances of the centroids around one, if not 0, in focal lengths, ascending."""
    if radius_rad is None:
        radius_rad = database.products["hausdorff_l2"].numbers["radius_rad"]
    apart_rad = surroundings(observation, reference, radius_rad).separation_rad
    return np.tan(apart_rad[apart_rad > 0.0])


def _ratio_sets(database: MatcherDatabase) -> tuple[ReferenceSets, ...]:
    """Return the stars' distances over the smallest, the second and the third smallest."""
    product = database.products["hausdorff_l2"]
    ratio, offsets = product["ratio"], product["star_offsets"]
    count = np.diff(offsets)
    ratio_sets = []
    for divisor in range(max(divisors for divisors, _ in DIVISOR_ROUNDS)):
        has = count > divisor
        members = np.repeat(has, count)
        smallest = ratio[offsets[:-1][has] + divisor]
        kept = np.where(has, count, 0)
        over = ratio[members] / np.repeat(smallest, count[has])
        ratio_sets.append(reference_sets(over, np.concatenate([[0], np.cumsum(kept)])))
    return tuple(ratio_sets)


def point_candidates(observation: Observation, database: MatcherDatabase) -> Iterator[Candidates]:
    """Propose what a reference star and two of its neighbours are, if the roll is 0.

    This is the baseline of Wang et al. 2020 (S1).
    """
    product = database.products["hausdorff_l2"]

    def propose(reference: int) -> Candidates:
        stars, _ = rank_by_points(observation, database, reference, count=STARS_BY_POINTS)
        return neighbour_candidates(reference, stars[stars >= 0], product, observation, database)

    yield from by_reference(observation, propose)


def rank_by_points(
    observation: Observation, database: MatcherDatabase, reference: int | None = None, *, count: int
) -> tuple[Rows, Array]:
    """Rank the stars for a reference star, the nearest to the centre of the frame by default.

    Return rows of stars, shape (count,), the best first, -1 after the last; and scores, ``inf``
    after the last. A score is the mean, over the centroids within the radius of the reference
    sets, of the smallest L1 distance to a neighbour of the star, in units of the focal length.

    The image's up is taken for north at the reference star. This is exact in the centre of the
    image; elsewhere the meridians converge, more so near a pole. Every centroid is compared
    with the neighbours of all stars, so the time grows with the product of the two numbers.

    Wang et al. 2020 (S1), eq. 6; Dubuisson and Jain 1994, "A modified Hausdorff distance for
    object matching", whose directed distance is averaged.
    """
    product = database.products["hausdorff_l2"]
    reference = int(references(observation)[0]) if reference is None else reference
    rows = surroundings(observation, reference, product.numbers["radius_rad"]).centroids
    x, y = _observed_points(observation, reference, rows)
    star_x, star_y = database.cached(_neighbour_points)
    distances = (
        np.abs(star_x - one_x) + np.abs(star_y - one_y) for one_x, one_y in zip(x, y, strict=True)
    )
    scores = means_of_minima(distances, product["star_offsets"])
    stars, best = lowest(scores[None, :], count)
    return stars[0], best[0]


def _observed_points(observation: Observation, reference: int, rows: Rows) -> tuple[Array, Array]:
    """Return centroids on the tangent plane at one of them: to the left and up."""
    u, body = observation.body[reference], observation.body[rows]
    up = _UP - (_UP @ u) * u
    up /= np.sqrt(up @ up)
    depth = body @ u
    return body @ np.cross(up, u) / depth, body @ up / depth


def _neighbour_points(database: MatcherDatabase) -> tuple[Array, Array]:
    """Return all neighbours on the tangent planes at their stars: to the east and north."""
    product = database.products["hausdorff_l2"]
    star = product["star"]
    u = database.directions[product["neighbour"]]
    east, north = tangent_axes(*radec_from_directions(database.directions))
    depth = np.einsum("ij,ij->i", u, database.directions[star])
    x, y = (np.einsum("ij,ij->i", u, axis[star]) / depth for axis in (east, north))
    return x, y


@dataclass(frozen=True)
class ReferenceSets:
    """The members of all stars' sets, by star and by value."""

    # The members of star n are ``offsets[n]:offsets[n + 1]``, when they are sorted by star; shape
    # (S + 1,).
    offsets: NDArray[np.int64]
    value: Array  # the members of all stars, ascending; shape (M,)
    star: Rows  # the star that each member of ``value`` belongs to
    # Each member of ``value`` is the nearest of its star's members to all numbers x with
    # ``low <= x < high``; shape (M,).
    low: Array
    high: Array

    def __len__(self) -> int:
        return len(self.offsets) - 1


def reference_sets(values: Array, offsets: NDArray[np.int64]) -> ReferenceSets:
    """Arrange finite members, ascending within a star, by star and by value."""
    star = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    # An ``inf`` before the first star, between two stars and after the last one.
    fenced = np.full(len(values) + len(offsets), np.inf)
    index = np.arange(len(values)) + star + 1
    fenced[index] = values
    below, above = fenced[index - 1], fenced[index + 1]
    low = np.where(np.isinf(below), -np.inf, 0.5 * (below + values))
    high = 0.5 * (values + above)
    order = np.argsort(values, kind="stable")
    return ReferenceSets(offsets, values[order], star[order], low[order], high[order])


def means_of_minima(differences: Iterable[Array], offsets: NDArray[np.int64]) -> Array:
    """Return, for every star, the mean of the observed elements' smallest differences from it.

    The caller computes the differences, so elements can be points, for example, with distances as
    differences. ``differences`` has one array per observed element: its difference from each
    member, sorted by star. The mean is ``inf`` for a star without members, and for all stars if
    nothing was observed.
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

    Each result has the row of the number, ascending, the row of the star, and a gain: the reach
    minus the smallest difference from a member, or 0 if the entry's member is not the nearest of
    its star, so that gains can be summed.
    """
    start = np.searchsorted(sets.value, numbers - reach, side="left")
    stop = np.searchsorted(sets.value, numbers + reach, side="right")
    number, row = rows_between(start, stop)
    target = numbers[number]
    gain = reach[number] - np.abs(target - sets.value[row])
    gain *= (sets.low[row] <= target) & (target < sets.high[row])
    return number, sets.star[row], gain


def lowest(scores: Array, count: int) -> tuple[Rows, Array]:
    """Return the stars of the lowest scores and these scores, shape (N, count), the lowest first.

    ``scores`` has one row per centroid and one column per star, and ``inf`` or NaN for a star that
    is excluded. If there are fewer than ``count``, the other stars are -1 and their scores ``inf``.
    """
    scores = np.where(np.isnan(scores), np.inf, scores)
    if scores.shape[1] < count:
        rest = ((0, 0), (0, count - scores.shape[1]))
        scores = np.pad(scores, rest, constant_values=np.inf)
    limit = np.partition(scores, count - 1, axis=1)[:, count - 1 : count]
    star = np.empty((len(scores), count), dtype=np.intp)
    for row, (of_row, is_low) in enumerate(zip(scores, scores <= limit, strict=True)):
        low = np.flatnonzero(is_low)  # more than `count` if several are equal: the first are kept
        star[row] = low[np.argsort(of_row[low], kind="stable")[:count]]
    score = np.take_along_axis(scores, star, axis=1)
    return np.where(np.isinf(score), -1, star), score
