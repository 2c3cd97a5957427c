"""Identification by dynamic angles (S2): neighbours in counter-clockwise order, then pair voting.

The angle from one neighbour of a reference star to the next, and that neighbour's separation,
lead to stars with the same angle and separation. The two are superposed on each other, and the
neighbours that agree in angle and separation are counted. Needs the product ``neighbours``.

That needs a star whose neighbours are mostly in the frame and mostly guide stars. If a camera
misses stars and sees false ones, few fields have such a star. So if no reference star leads to an
answer, every pair of the frame is a base: it is superposed on all pairs of stars with the same
separation, and the other centroids are compared with the stars there. This finds a field of four
known stars, whatever is missing and whatever else is seen. It takes ten times as long.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from starcat.arrays import Array, Rows
from starcat.geometry.patterns import bin_of
from starcat.geometry.sphere import separation
from starcat.matcher.database import MatcherDatabase, ProductArrays
from starcat.matcher.methods.consensus import Surroundings, by_reference, surroundings
from starcat.matcher.observation import Candidates, Observation
from starcat.matcher.settings import LOOKUP
from starcat.matcher.star_cells import cells_for, rows_between

_TURN = 2.0 * np.pi

PASSED_OVER = (2, 3, 4)
"""Steps to later neighbours that are tried if the angles to the next neighbour lead nowhere: some
of the centroids between them may not be guide stars."""


def angle_tolerance_rad(tolerance_rad: float, first_rad: Array, second_rad: Array) -> Array:
    """Return the largest error of the angle between neighbours of these separations."""
    least = tolerance_rad / np.pi
    first_rad, second_rad = np.maximum(first_rad, least), np.maximum(second_rad, least)
    return tolerance_rad * np.hypot(1.0 / first_rad, 1.0 / second_rad)


def candidates(observation: Observation, database: MatcherDatabase) -> Iterator[Candidates]:
    """Propose stars for a reference centroid and the farthest centroid that agrees with it.

    At the end three stars each are proposed, of all pairs of the frame (Sun et al. 2021, S2).
    """

    def propose(steps: tuple[int, ...]) -> Callable[[int], Candidates]:
        return lambda reference: rank_stars(observation, database, reference, steps)[0]

    yield from by_reference(observation, propose((1,)), propose(PASSED_OVER))
    yield from bases(observation, database)


def rank_stars(
    observation: Observation,
    database: MatcherDatabase,
    reference: int,
    steps: tuple[int, ...] = (1,),
) -> tuple[Candidates, Array]:
    """Return the stars that a reference star may be, the best first, and their scores.

    Each comes with the farthest neighbour that agrees: the baseline of the attitude. A score is
    S2's S (eq. 9), the share of the observed neighbours that agree; at equal scores stars with
    fewer neighbours come first. S2's answer is the best star of the first of `references`.
    """
    product, tolerance_rad = database.products["neighbours"], observation.side_tolerance_rad
    # The radius is not among the product's numbers; its largest separation does as well.
    around = surroundings(observation, reference, product["separation_rad"].max(initial=0.0))
    lookups = [_look_up(around, product, tolerance_rad, step) for step in steps]
    started, begin = (np.concatenate(part) for part in zip(*lookups, strict=True))
    start, observed, row = _walk(started, begin, around, product, tolerance_rad)
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
    around: Surroundings, product: ProductArrays, tolerance_rad: float, steps: int
) -> tuple[Rows, Rows]:
    """Return neighbours of a reference star and the product's rows that they may be.

    The separation, and the angle to the neighbour ``steps`` further on, agree. The bins that the
    tolerance touches are read. Neighbours are given by their place in the surroundings.
    """
    order = np.argsort(around.position_angle_rad, kind="stable")
    angle, apart = around.position_angle_rad[order], around.separation_rad[order]
    if len(order) < steps:
        return order[:0], order[:0]
    step = np.append(angle[steps:], angle[:steps] + _TURN) - angle
    error = angle_tolerance_rad(tolerance_rad, apart, np.roll(apart, -steps))
    least, most = np.maximum(step - error, 0.0), np.minimum(step + error, _TURN)
    near, far = np.maximum(apart - tolerance_rad, 0.0), apart + tolerance_rad
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
    fits = np.abs(product["separation_rad"][row] - apart[observed]) <= tolerance_rad
    fits &= np.abs(product["successive_angle_rad"][row] - step[observed]) <= error[observed]
    return order[observed[fits]], row[fits]


def _walk(
    started: Rows, begin: Rows, around: Surroundings, product: ProductArrays, tolerance_rad: float
) -> tuple[Rows, Rows, Rows]:
    """Return the start, the observed neighbour and the product's row of all that agree.

    A walk along both lists at once pairs what agrees in the angle from the start and in the
    separation; here all starts are walked together, by separation first.
    """
    star, offsets = product["star"][begin].astype(np.intp), product["star_offsets"]
    begun, row = rows_between(offsets[star], offsets[star + 1])
    apart = around.separation_rad
    low = np.searchsorted(apart, product["separation_rad"][row] - tolerance_rad, side="left")
    high = np.searchsorted(apart, product["separation_rad"][row] + tolerance_rad, side="right")
    pair, observed = rows_between(low, high)
    begun, row = begun[pair], row[pair]
    origin = started[begun]
    turn = product["position_angle_rad"][row] - product["position_angle_rad"][begin[begun]]
    turn -= around.position_angle_rad[observed] - around.position_angle_rad[origin]
    turn -= _TURN * np.round(turn / _TURN)
    fits = np.abs(turn) <= angle_tolerance_rad(tolerance_rad, apart[observed], apart[origin])
    return begun[fits], observed[fits], row[fits]


MIN_OTHERS = 2
"""Centroids beside the base that have to be near a star: four in all, as an answer needs."""

REACH = 3.0
"""Largest distance of another centroid from its star, in units of the tolerance. It is larger than
for an agreement, because an attitude from two stars has a larger error."""

MAX_PLACES = 2**20
"""Largest number of places in the sky that a frame is looked up at: some tenths of a second."""


def bases(observation: Observation, database: MatcherDatabase) -> Iterator[Candidates]:
    """Propose what two centroids and a third one are, a batch for each pair of the frame.

    At least one further centroid is near a star then. All pairs up to the radius of the product
    ``neighbours`` are tried, the first centroids of the observation first. These are the brightest
    centroids if magnitudes are known.
    """
    order, apart_rad = database.cached(_by_separation)
    if not len(order):
        return
    tolerance_rad = observation.side_tolerance_rad
    second, first = np.tril_indices(len(observation), -1)
    separation_rad = observation.separation_rad[first, second]
    low = np.searchsorted(apart_rad, separation_rad - tolerance_rad, side="left")
    high = np.searchsorted(apart_rad, separation_rad + tolerance_rad, side="right")
    places = np.cumsum(high - low) * max(0, len(observation) - 2)
    for centroid, other, begin, end in zip(
        *(ends[places <= MAX_PLACES].tolist() for ends in (first, second, low, high)), strict=True
    ):
        observation.budget.spend(LOOKUP + end - begin)
        proposed = _on_base(centroid, other, order[begin:end], observation, database)
        if len(proposed):
            yield proposed


def _on_base(
    centroid: int, other: int, rows: Rows, observation: Observation, database: MatcherDatabase
) -> Candidates:
    """Return which pairs of stars put enough of the other centroids near a star, with a third."""
    product = database.products["neighbours"]
    stars = np.stack([product["star"][rows], product["neighbour"][rows]], axis=-1).astype(np.intp)
    others = np.delete(np.arange(len(observation)), [centroid, other])
    seen = observation.body[others] @ _axes(observation.body[centroid], observation.body[other]).T
    icrs = seen @ _axes(*np.moveaxis(database.directions[stars], 1, 0))
    reach_rad = REACH * observation.tolerance_rad
    near = cells_for(database, reach_rad).has_star(icrs.reshape(-1, 3), reach_rad)
    near = near.reshape(len(rows), len(others))
    row, third = np.nonzero(near & (near.sum(axis=1) >= MIN_OTHERS)[:, None])
    star = (icrs[row, third] @ database.directions.T).argmax(axis=1)
    ends = np.broadcast_to([centroid, other], (len(row), 2))
    proposed = Candidates(
        np.column_stack([ends, others[third]]), np.column_stack([stars[row], star])
    )
    u = database.directions[proposed.stars]
    error = (
        separation(u[:, :2], u[:, 2:]) - observation.separation_rad[proposed.centroids[:, 2:], ends]
    )
    return proposed[np.all(np.abs(error) <= observation.side_tolerance_rad, axis=1)]


def _axes(u: Array, v: Array) -> Array:
    """Return axes that go with two directions: their middle, across it, across both.

    Laying the axes of two pairs upon each other is the attitude of least squares.
    """
    middle, across = u + v, np.cross(u, v)
    middle /= np.sqrt(np.einsum("...i,...i->...", middle, middle))[..., None]
    across /= np.sqrt(np.einsum("...i,...i->...", across, across))[..., None]
    return np.stack([middle, np.cross(across, middle), across], axis=-2)


def _by_separation(database: MatcherDatabase) -> tuple[Rows, Array]:
    """Return the rows of the product by separation, and the separations in this order."""
    apart_rad = np.asarray(database.products["neighbours"]["separation_rad"])
    order = np.argsort(apart_rad, kind="stable")
    return order, apart_rad[order]
