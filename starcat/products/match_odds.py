"""How likely a candidate is the star's counterpart: likelihood ratios and reliabilities.

The ratio weighs two explanations of a candidate: that it is the star, with a position and a
magnitude that scatter around the star's own, and that it is another star of the neighbourhood.

A star has at most one counterpart, and a counterpart at most one star. The ratios of all pairs are
weights of matchings, sets of pairs that share no star and no candidate; the probability of a pair
is the share of the matchings that contain it. Belief propagation finds it exactly if the pairs of a
cluster close no ring; small clusters with a ring, such as two components of a double star in
either catalog, are written out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.products.match_figures import (
    CandidatePairs,
    Figures,
    MatchModel,
    MovingStars,
    tiles_of,
)

Rows = NDArray[np.int64]

ROUNDS = 60
"""Number of rounds of messages; pairs that are in no ring need far fewer."""

MAX_WRITTEN_OUT = 12
"""Largest number of pairs of a cluster whose matchings are all listed; larger ones use messages."""

MAX_WEIGHT = 50.0
"""Largest natural logarithm of the weight of a pair. It is as good as certain, and the product
of a dozen such weights is still a float."""


@dataclass(frozen=True)
class Odds:
    """The odds of pairs, arrays of shape (M,), and the figures behind them."""

    log_ratio: Array  # natural logarithm of the likelihood ratio
    probability: Array  # probability that this candidate is the star
    any_probability: Array  # probability that any candidate of the star is
    error_rad: Array  # standard deviation of the difference of the two positions, each axis
    position_error_rad: float  # given or measured; NaN if the catalogs state their errors
    delta_mag: float
    completeness: float

    def take(self, order: Rows) -> Odds:
        """Return the odds in another order."""
        arrays: dict[str, Any] = {
            name: value[order]
            for name, value in vars(self).items()
            if isinstance(value, np.ndarray)
        }
        return replace(self, **arrays)


def match_odds(
    stars: MovingStars,
    counterparts: MovingStars,
    pairs: CandidatePairs,
    radius_rad: float,
    figures: Figures,
    model: MatchModel,
) -> Odds:
    """Return how likely each candidate is the counterpart of its star, one row per pair.

    The stars can be parts of the two catalogs; the pairs are all candidates, by star.

    ``L = Q q(dm) f(r) / n(m)``: f is the density of a star's own counterpart at the separation
    r, q its density in magnitude, n the density of all others on the sky and in magnitude. Without
    magnitudes ``q / n`` is one over the density on the sky.

    Sutherland and Saunders 1992, MNRAS 259, 413, section 2. Without magnitudes and outliers L
    is the Bayes factor of Budavari and Szalay 2008, ApJ 679, 301, for two catalogs with normal
    errors, times Q over the number of counterparts on such a sky.
    """
    i, j = pairs.star, pairs.counterpart
    share = figures.completeness
    common = figures.position_error_rad
    if stars.error_rad is not None and counterparts.error_rad is not None:
        common = float("nan")
    error = np.hypot(
        _stated_error(stars, counterparts, i, j) if np.isnan(common) else common,
        pairs.unmoved_years * model.unknown_motion_rad_yr,
    )
    log_ratio = np.log(share) + _log_place(pairs.separation_rad, error, radius_rad, model)
    rows, place = np.unique(i, return_inverse=True)
    log_ratio -= np.log(figures.density[tiles_of(stars.directions[rows])][place])
    log_ratio += _log_colour(
        counterparts.mag[j] - stars.mag[i], counterparts.mag[j], figures, model
    )
    probability, any_probability = pair_probabilities(i, j, log_ratio, share, figures.shared)
    return Odds(log_ratio, probability, any_probability, error, common, figures.delta_mag, share)


def _stated_error(stars: MovingStars, counterparts: MovingStars, i: Rows, j: Rows) -> Array:
    """Return the error of each pair from the errors that the catalogs state."""
    if stars.error_rad is None or counterparts.error_rad is None:
        raise ValueError("error_rad is missing; both catalogs have to state their errors, or none")
    return np.asarray(np.hypot(stars.error_rad[i], counterparts.error_rad[j]))


def _log_place(angle: Array, error: Array, radius_rad: float, model: MatchModel) -> Array:
    """Return the logarithm of f: a normal error, and a share of outliers.

    Outliers have no scale of their own: between the error and the radius every factor of
    separation is as likely as any other, so that their density falls with its square.
    """
    normal = -0.5 * (angle / error) ** 2 - np.log(2.0 * np.pi * error**2)
    scales = 0.5 + np.log(np.maximum(radius_rad / error, 1.0))
    with np.errstate(divide="ignore"):  # the model may have no outliers
        outlier = np.log(model.outlier_share) - np.log(
            2.0 * np.pi * np.maximum(angle, error) ** 2 * scales
        )
    return np.asarray(np.logaddexp(np.log1p(-model.outlier_share) + normal, outlier))


def _log_colour(delta: Array, mag: Array, figures: Figures, model: MatchModel) -> Array:
    """Return the logarithm of q over the distribution of magnitudes; 0 if one is unknown."""
    known = ~np.isnan(delta)
    ratio = np.zeros(len(delta))
    if known.any():
        off = (delta[known] - figures.delta_mag) / model.colour_spread_mag
        own = -0.5 * off**2 - np.log(model.colour_spread_mag * np.sqrt(2.0 * np.pi))
        ratio[known] = own - np.log(figures.magnitudes.density(mag[known]))
    return ratio


def pair_probabilities(
    star: Rows, candidate: Rows, log_ratio: Array, completeness: float, shared: float
) -> tuple[Array, Array]:
    """Return two probabilities of each pair: for itself, and for any candidate of its star.

    The first: the candidate is the star, and neither belongs to another pair. The second: one of
    the star's candidates is the star, whatever other stars claim. The stars ascend; the ratios are
    natural logarithms, shape (M,). Q is ``completeness``, the share of the stars that have a
    counterpart, S is ``shared``, the share of the counterparts that have a star.

    A pair weighs ``w = L / ((1 - Q) (1 - S))``: L compares the candidate with all stars of the
    neighbourhood, of which a share S are counterparts of other stars and have their own pairs.
    A pair without competing pairs has the probability ``w / (1 + w)``. The messages follow the
    monomer-dimer model, ``x(i, j) = 1 / (1 + sum of w(i, k) x(k, i) over the other candidates k)``
    and the same from the candidates' side. Their logarithms are averaged with the previous ones,
    or they would oscillate.

    Sutherland and Saunders 1992, MNRAS 259, 413, section 2, for one star. Heilmann and Lieb
    1972, Communications in Mathematical Physics 25, 190, for matchings as a model.
    """
    if not len(star):
        return np.empty(0), np.empty(0)
    weight = log_ratio - np.log1p(-completeness) - np.log1p(-shared)
    groups, other_groups = _Groups(star), _Groups(candidate)
    alone_total = np.logaddexp(groups.sum_of_others(weight), weight)
    any_probability = _share(alone_total)
    probability = _share(weight)
    contested = (groups.size_of_each > 1) | (other_groups.size_of_each > 1)
    if contested.any():
        probability[contested] = _in_clusters(
            star[contested], candidate[contested], weight[contested]
        )
    return probability, any_probability


def _share(log_odds: Array) -> Array:
    """Return the probabilities that odds are equal to."""
    return np.asarray(np.exp(-np.logaddexp(0.0, -log_odds)))


def _in_clusters(star: Rows, candidate: Rows, weight: Array) -> Array:
    """Return the probabilities of pairs that compete with other pairs."""
    stars, candidates = _Groups(star), _Groups(candidate)
    weight = np.minimum(weight, MAX_WEIGHT)
    from_candidate = np.zeros(len(star))
    for _ in range(ROUNDS):
        from_star = -np.logaddexp(0.0, stars.sum_of_others(weight + from_candidate))
        reply = -np.logaddexp(0.0, candidates.sum_of_others(weight + from_star))
        from_candidate = 0.5 * (from_candidate + reply)
    own = weight + from_candidate
    whole = np.logaddexp(0.0, np.logaddexp(stars.sum_of_others(own), own))
    probability = np.asarray(np.exp(own - whole))
    # The messages keep the sum over a star's candidates at 1 at most. The sum over a candidate's
    # stars may be 1.02 in large rings.
    of_candidate = np.bincount(candidate, weights=probability)[candidate]
    probability /= np.maximum(of_candidate, 1.0)
    for rows in _small_rings(star, candidate):
        probability[rows] = _written_out(star[rows], candidate[rows], np.exp(weight[rows]))
    return probability


def _small_rings(star: Rows, candidate: Rows) -> Iterator[Rows]:
    """Yield the pairs of each cluster that has a ring, and few enough pairs to list matchings."""
    stars, i = np.unique(star, return_inverse=True)
    candidates, j = np.unique(candidate, return_inverse=True)
    nodes = len(stars) + len(candidates)
    edges = scipy.sparse.coo_array((np.ones(len(i)), (i, len(stars) + j)), shape=(nodes, nodes))
    _, label = scipy.sparse.csgraph.connected_components(edges, directed=False)
    of_pair = np.asarray(label, dtype=np.int64)[i]
    order = np.argsort(of_pair, kind="stable")
    first, pairs = runs(of_pair[order])
    # A cluster with as many edges as nodes, or more, has a ring.
    is_ring = pairs >= np.bincount(label)[of_pair[order][first]]
    for start, count in zip(first[is_ring].tolist(), pairs[is_ring].tolist(), strict=True):
        if count <= MAX_WRITTEN_OUT:
            yield order[start : start + count]


def _written_out(star: Rows, candidate: Rows, weight: Array) -> Array:
    """Return the share of all matchings that have each pair."""
    i, j, w = star.tolist(), candidate.tolist(), weight.tolist()
    having = [0.0] * len(w)

    def extend(start: int, used: frozenset[int], product: float) -> float:
        total = product
        for k in range(start, len(w)):
            # Inverted, a row of one catalog is never taken for a row of the other.
            ends = {i[k], ~j[k]}
            if not used & ends:
                part = extend(k + 1, used | ends, product * w[k])
                having[k] += part
                total += part
        return total

    whole = extend(0, frozenset(), 1.0)
    return np.array(having) / whole


class _Groups:
    """Groups of rows that belong together, and sums over the other rows of each group."""

    def __init__(self, group: Rows) -> None:
        self._order = np.argsort(group, kind="stable")
        self._first, self._size = runs(group[self._order])
        self.size_of_each = np.empty(len(group), dtype=np.int64)
        self.size_of_each[self._order] = np.repeat(self._size, self._size)

    def sum_of_others(self, logarithm: Array) -> Array:
        """Return the logarithm of the sum over the other rows of each row's group.

        A total less the row itself would lose all digits where the row is nearly the total.
        """
        x = logarithm[self._order]
        before, after = np.full(len(x), -np.inf), np.full(len(x), -np.inf)
        for k in range(1, int(self._size.max())):
            long = self._size > k
            row = self._first[long] + k
            before[row] = np.logaddexp(before[row - 1], x[row - 1])
            row = self._first[long] + self._size[long] - 1 - k
            after[row] = np.logaddexp(after[row + 1], x[row + 1])
        result = np.empty(len(x))
        result[self._order] = np.logaddexp(before, after)
        return result


def runs(group: Rows) -> tuple[Rows, Rows]:
    """Return where the runs of equal numbers in a sorted array begin, and their lengths.

    >>> runs(np.array([2, 2, 7]))
    (array([0, 2]), array([2, 1]))
    """
    first = np.flatnonzero(np.diff(group, prepend=-1))
    return first, np.diff(np.append(first, len(group)))
