"""Counterparts: which entry of one catalog is which star of another, and how sure that is.

Input: two sets of moving stars. Output: all pairs of a star and a candidate within a radius,
with separation, magnitude difference, odds and a verdict in words. Separations are measured at
one epoch of the pair: a star with proper motion is moved to its candidate's epoch, a candidate
with proper motion to the epoch of a star without. This module does not depend on catalogs or files.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.geometry.sphere import chord_from_separation, separation
from starcat.products.match_figures import (
    CandidatePairs,
    Census,
    Figures,
    MatchModel,
    MovingStars,
    figures_of,
    measure,
)
from starcat.products.match_odds import Odds, match_odds, runs

Rows = NDArray[np.int64]

VERDICTS = ("unique", "best", "ambiguous", "taken", "doubtful", "other")
"""Verdicts on a candidate, in words; the numbers of `Matches.verdict` are places here."""

UNIQUE, BEST, AMBIGUOUS, TAKEN, DOUBTFUL, OTHER = range(len(VERDICTS))

CHUNK = 1 << 17
"""Number of stars that are searched at once, which bounds the memory for large catalogs."""


@dataclass(frozen=True)
class Matches:
    """Every candidate of every star, by star and rank; arrays of shape (M,)."""

    star: Rows  # rows of the first set
    counterpart: Rows  # rows of the other set
    rank: Rows  # rank of the candidate among the candidates of its star; 1 is the likeliest
    star_rank: Rows  # rank of the star among the stars of its candidate
    n_candidates: Rows  # number of candidates of the star, within the radius
    n_stars: Rows  # number of stars that have this candidate
    separation_rad: Array  # radians, at ``epoch_jyear``
    # magnitude of the candidate minus the star's; NaN if either is unknown
    delta_mag: Array
    epoch_jyear: Array  # Julian year at which the two were compared
    odds: Odds  # probability of each pair, and the model behind it
    verdict: Rows  # index into `VERDICTS`

    def count(self, verdict: str) -> int:
        """Return how many stars have a best candidate with a verdict."""
        return int(((self.rank == 1) & (self.verdict == VERDICTS.index(verdict))).sum())

    def take(self, order: Rows) -> Matches:
        """Return some of the matches."""
        arrays = {name: value[order] for name, value in vars(self).items() if name != "odds"}
        return Matches(**arrays, odds=self.odds.take(order))


def crossmatch(
    stars: MovingStars, counterparts: MovingStars, radius_rad: float, model: MatchModel
) -> Matches:
    """Find the counterparts of stars in another catalog, in order of (star, rank).

    The radius is the largest separation of a candidate at the epoch of the comparison, itself
    included. Of two candidates with the same odds the nearer one, then the one with the lower
    row, comes first.

    Sutherland and Saunders 1992, MNRAS 259, 413, section 2: likelihood ratio and reliability.
    """
    if not radius_rad > 0.0:
        raise ValueError(f"radius_rad is {radius_rad}; expected a positive angle")
    pairs = candidate_pairs(stars, counterparts, radius_rad)
    measured = measure(stars, counterparts, pairs)
    figures = figures_of(Census.of(stars), Census.of(counterparts), measured, radius_rad, model)
    return judged(stars, counterparts, pairs, radius_rad, figures, model)


def judged(
    stars: MovingStars,
    counterparts: MovingStars,
    pairs: CandidatePairs,
    radius_rad: float,
    figures: Figures,
    model: MatchModel,
) -> Matches:
    """Give every pair its odds, ranks and verdict, in order of (star, rank).

    The figures are computed from the whole catalogs. If stars and counterparts are parts of them,
    a verdict is right only if all other pairs of its star and its candidate are included, and a
    probability is right if this holds for the whole cluster of the pair.
    """
    odds = match_odds(stars, counterparts, pairs, radius_rad, figures, model)
    i, j = pairs.star, pairs.counterpart
    star_rank, n_stars = _rank(j, odds.log_ratio, pairs.separation_rad, i)
    rank, n_candidates = _rank(i, odds.log_ratio, pairs.separation_rad, j)
    verdict = _verdicts(i, j, rank, star_rank, odds, model)
    order = np.lexsort((rank, i))
    found = Matches(
        i,
        j,
        rank,
        star_rank,
        n_candidates,
        n_stars,
        pairs.separation_rad,
        counterparts.mag[j] - stars.mag[i],
        pairs.epoch_jyear,
        odds,
        verdict,
    )
    return found.take(order)


def candidate_pairs(
    stars: MovingStars, counterparts: MovingStars, radius_rad: float
) -> CandidatePairs:
    """Find every pair within a radius at the epoch that the two are compared at.

    In order of (star, counterpart); the radius is included.

    Both are first compared at one epoch in the middle. There each query has a wider radius, by its
    largest proper motion up to the farthest epoch of the other catalog: Barnard's star needs
    10 arcsec per year, most stars next to nothing.
    """
    moving = np.flatnonzero(stars.has_motion)
    still = np.flatnonzero(~stars.has_motion)
    everyone = np.arange(len(counterparts.mag))
    none, nothing = np.empty(0, np.int64), np.empty(0)
    parts = [CandidatePairs(none, none, nothing, nothing, nothing)]
    if len(moving) and len(everyone):
        middle, reach = _middle(counterparts.epoch_jyear)
        drift = _speed(stars, moving) * reach
        query = stars.at(moving, middle)
        for near, found in _near(query, radius_rad + drift, counterparts.directions):
            parts.append(_trim(stars, counterparts, moving[near], found, radius_rad))
    if len(still) and len(everyone):
        # These candidates move and these stars do not: search for stars around each candidate as
        # far as its own motion can have taken it.
        middle, reach = _middle(stars.epoch_jyear[still])
        drift = _speed(counterparts, everyone) * reach
        query = counterparts.at(everyone, middle)
        for near, found in _near(query, radius_rad + drift, stars.directions[still]):
            parts.append(_trim(stars, counterparts, still[found], near, radius_rad))
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    joined = CandidatePairs(*map(np.concatenate, columns))
    return joined.take(np.lexsort((joined.counterpart, joined.star)))


def _middle(epochs: Array) -> tuple[float, float]:
    """Return the median epoch and the years from it to the farthest one."""
    middle = float(np.median(epochs))
    return middle, float(np.abs(epochs - middle).max())


def _speed(stars: MovingStars, rows: Rows) -> Array:
    """Return the proper motions of stars, radians a year."""
    velocity = stars.velocities[rows]
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", velocity, velocity)))


def _near(query: Array, radii: Array, others: Array) -> Iterator[tuple[Rows, Rows]]:
    """Yield rows of queries and of others that are near each other, in pieces.

    A piece is searched with the largest of its radii, at most half as wide again as its least:
    most radii are nearly the same, and the few wide ones do not slow down the others.
    """
    tree = scipy.spatial.cKDTree(others, leafsize=32, balanced_tree=False)
    order = np.argsort(radii, kind="stable")
    ascending = radii[order]
    start = 0
    while start < len(order):
        alike = int(np.searchsorted(ascending, 1.5 * ascending[start], side="right"))
        end = min(alike, start + CHUNK)
        piece = order[start:end]
        part = scipy.spatial.cKDTree(query[piece], leafsize=32, balanced_tree=False)
        chord = _chord(float(ascending[end - 1]))
        found = part.sparse_distance_matrix(tree, chord, output_type="ndarray")
        yield piece[found["i"]], found["j"].astype(np.int64)
        start = end


def _chord(separation_rad: float) -> float:
    """Return the radius of a search as a chord, a little wider than asked.

    The separations are compared with the radius afterwards.
    """
    return chord_from_separation(separation_rad) * (1.0 + 1e-9) + 1e-14


def _trim(
    stars: MovingStars, counterparts: MovingStars, i: Rows, j: Rows, radius_rad: float
) -> CandidatePairs:
    """Return the pairs that are within the radius at their epoch."""
    star_moves, other_moves = stars.has_motion[i], counterparts.has_motion[j]
    epoch_i, epoch_j = stars.epoch_jyear[i], counterparts.epoch_jyear[j]
    epoch = np.where(star_moves | ~other_moves, epoch_j, epoch_i)
    angle = separation(stars.at(i, epoch), counterparts.at(j, epoch))
    unmoved = np.where(star_moves | other_moves, 0.0, np.abs(epoch_j - epoch_i))
    return CandidatePairs(i, j, angle, epoch, unmoved).take(angle <= radius_rad)


def _rank(group: Rows, log_ratio: Array, angle: Array, other: Rows) -> tuple[Rows, Rows]:
    """Return each pair's rank within its group, from 1, and the size of the group."""
    order = np.lexsort((other, angle, -log_ratio, group))
    first, size = runs(group[order])
    rank, count = np.empty_like(group), np.empty_like(group)
    rank[order] = np.arange(len(group)) - np.repeat(first, size) + 1
    count[order] = np.repeat(size, size)
    return rank, count


def _verdicts(i: Rows, j: Rows, rank: Rows, star_rank: Rows, odds: Odds, model: MatchModel) -> Rows:
    """Return the verdict on each pair, as an index into `VERDICTS`."""
    near = float(np.log(model.ambiguous_odds))
    behind, lead = _gaps(i, rank, odds.log_ratio)
    star_behind, star_lead = _gaps(j, star_rank, odds.log_ratio)
    verdict = np.full(len(i), BEST)
    alone = np.isinf(lead) & np.isinf(star_lead)
    verdict[alone] = UNIQUE
    verdict[(lead <= near) | (star_lead <= near) | (star_rank > 1)] = AMBIGUOUS
    verdict[star_behind > near] = TAKEN
    verdict[rank > 1] = np.where(behind[rank > 1] <= near, AMBIGUOUS, OTHER)
    verdict[(odds.any_probability < model.min_probability) & (rank == 1)] = DOUBTFUL
    verdict[(odds.any_probability < model.min_probability) & (rank > 1)] = OTHER
    return verdict


def _gaps(group: Rows, rank: Rows, log_ratio: Array) -> tuple[Array, Array]:
    """Return how far each pair is behind the best of its group, and how far the best one leads.

    The lead of a pair that is not the best, and of one that is alone, is infinite.
    """
    behind, lead = np.zeros(len(group)), np.full(len(group), np.inf)
    order = np.lexsort((rank, group))
    first, size = runs(group[order])
    behind[order] = np.repeat(log_ratio[order[first]], size) - log_ratio[order]
    several = first[size > 1]
    lead[order[several]] = log_ratio[order[several]] - log_ratio[order[several + 1]]
    return behind, lead
