"""Identification by dynamic angles (S2): neighbours in counter-clockwise order.

The angle from one neighbour of a reference star to the next, and that neighbour's separation,
lead to stars that have the same. With the two neighbours laid upon each other, the neighbours
that agree in angle and separation are counted. Where no reference star leads to an answer, every
pair of the frame is a base (`pair_voting`). Needs the product ``neighbours``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from starcat.arrays import Array, Rows
from starcat.geometry.patterns import bin_of
from starcat.matcher.database import Database, ProductArrays
from starcat.matcher.methods.consensus import Surroundings, by_reference, rows_between, surroundings
from starcat.matcher.methods.pair_voting import bases
from starcat.matcher.observation import Candidates, Observation

_TURN = 2.0 * np.pi

PASSED_OVER = (2, 3, 4)
"""When the angles to the next neighbour lead nowhere, those to the ones after it: of the
centroids between, some may be no guide stars."""


@dataclass(frozen=True)
class Tolerance:
    """How far angles and separations may be off."""

    # S2's eps_dis.
    separation_rad: float
    # S2's eps_ang; None for what ``separation_rad`` across makes of the angle.
    angle_rad: float | None = None

    def between(self, one: Array, other: Array) -> Array:
        """Return the largest error of the angle between neighbours of these separations."""
        if self.angle_rad is not None:
            return np.full(np.shape(one), self.angle_rad)
        least = self.separation_rad / np.pi
        one, other = np.maximum(one, least), np.maximum(other, least)
        return self.separation_rad * np.hypot(1.0 / one, 1.0 / other)


def candidates(observation: Observation, database: Database) -> Iterator[Candidates]:
    """Propose what a reference star and the farthest neighbour that agrees are.

    At the end three stars each are proposed, of all pairs of the frame (Sun et al. 2021, S2).
    """
    tolerance = Tolerance(observation.side_tolerance_rad)

    def propose(steps: tuple[int, ...]) -> Callable[[int], Candidates]:
        return lambda reference: rank_stars(observation, database, reference, tolerance, steps)[0]

    yield from by_reference(observation, propose((1,)), propose(PASSED_OVER))
    yield from bases(observation, database)


def rank_stars(
    observation: Observation,
    database: Database,
    reference: int,
    tolerance: Tolerance,
    steps: tuple[int, ...] = (1,),
) -> tuple[Candidates, Array]:
    """Return the stars that a reference star may be, the best first, and their scores.

    Each comes with the farthest neighbour that agrees: the baseline of the attitude. A score is
    S2's S (eq. 9), the share of the observed neighbours that agree; of equal stars those with
    fewer neighbours come first. S2's answer is the best star of the first of `references`.
    """
    product = database.products["neighbours"]
    # The radius is not among the product's numbers; its largest separation does as well.
    around = surroundings(observation, reference, product["separation_rad"].max(initial=0.0))
    found = [_look_up(around, product, tolerance, step) for step in steps]
    started, begin = (np.concatenate(part) for part in zip(*found, strict=True))
    start, observed, row = _walk(started, begin, around, product, tolerance)
    agrees = np.zeros((len(begin), len(around)), dtype=bool)
    agrees[start, observed] = True
    count = agrees.sum(axis=1)
    # The farthest agreeing neighbour of every start: the last one assigned stays.
    farthest = np.zeros(len(begin), dtype=np.intp)
    order = np.argsort(observed, kind="stable")
    farthest[start[order]] = order
    star = product["star"][begin].astype(np.intp)
    best = np.lexsort((begin, -count, star))
    best = best[np.unique(star[best], return_index=True)[1]]
    size = product["star_offsets"][star[best] + 1] - product["star_offsets"][star[best]]
    best = best[np.lexsort((star[best], size, -count[best]))]
    end = farthest[best]
    centroids = np.stack([np.full_like(best, reference), around.centroids[observed[end]]], axis=-1)
    stars = np.stack([star[best], product["neighbour"][row[end]].astype(np.intp)], axis=-1)
    return Candidates(centroids, stars), count[best] / max(1, len(around))


def _look_up(
    around: Surroundings, product: ProductArrays, tolerance: Tolerance, steps: int
) -> tuple[Rows, Rows]:
    """Return neighbours of a reference star and the product's rows that they may be.

    Separation and angle to the neighbour so many steps on agree; the bins that the tolerance
    touches are read. Neighbours are given by their place in the surroundings.
    """
    order = np.argsort(around.position_angle_rad, kind="stable")
    angle, apart = around.position_angle_rad[order], around.separation_rad[order]
    if len(order) < steps:
        return order[:0], order[:0]
    step = np.append(angle[steps:], angle[:steps] + _TURN) - angle
    error = tolerance.between(apart, np.roll(apart, -steps))
    least, most = np.maximum(step - error, 0.0), np.minimum(step + error, _TURN)
    near, far = np.maximum(apart - tolerance.separation_rad, 0.0), apart + tolerance.separation_rad
    numbers = product.numbers
    separations = int(numbers["n_separation_bins"])
    table = numbers["angle_bin_rad"], numbers["separation_bin_rad"], int(numbers["n_angle_bins"])
    low = bin_of(least, near, *table, separations)
    high = bin_of(most, far, *table, separations)
    # The bins of one angle are next to each other, from the least separation to the largest.
    observed, angle_bin = rows_between(low // separations, high // separations + 1)
    first = angle_bin * separations + low[observed] % separations
    last = angle_bin * separations + high[observed] % separations
    offsets = product["lookup_offsets"]
    run, entry = rows_between(offsets[first], offsets[last + 1])
    observed, row = observed[run], product["lookup_rows"][entry].astype(np.intp)
    fits = np.abs(product["separation_rad"][row] - apart[observed]) <= tolerance.separation_rad
    fits &= np.abs(product["successive_angle_rad"][row] - step[observed]) <= error[observed]
    return order[observed[fits]], row[fits]


def _walk(
    started: Rows, begin: Rows, around: Surroundings, product: ProductArrays, tolerance: Tolerance
) -> tuple[Rows, Rows, Rows]:
    """Return the start, the observed neighbour and the product's row of all that agree.

    A walk along both lists at once pairs what agrees in the angle from the start and in the
    separation; here all starts are walked together, by separation first.
    """
    star, offsets = product["star"][begin].astype(np.intp), product["star_offsets"]
    begun, row = rows_between(offsets[star], offsets[star + 1])
    apart, reach = around.separation_rad, tolerance.separation_rad
    low = np.searchsorted(apart, product["separation_rad"][row] - reach, side="left")
    high = np.searchsorted(apart, product["separation_rad"][row] + reach, side="right")
    pair, observed = rows_between(low, high)
    begun, row = begun[pair], row[pair]
    origin = started[begun]
    turn = product["position_angle_rad"][row] - product["position_angle_rad"][begin[begun]]
    turn -= around.position_angle_rad[observed] - around.position_angle_rad[origin]
    turn -= _TURN * np.round(turn / _TURN)
    fits = np.abs(turn) <= tolerance.between(apart[observed], apart[origin])
    return begun[fits], observed[fits], row[fits]
