"""Statistics of two whole catalogs that the odds of a cross-identification need.

They are the density on the sky, the distribution of magnitudes, the errors, and how complete a
catalog is. All of them come from counts and medians, so that a catalog in one piece and the same
catalog in parts, in any order, give the same bits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy
from numpy.typing import NDArray

from starcat.arrays import Array, Directions, Mask
from starcat.geometry.sphere import saff_kuijlaars

Rows = NDArray[np.int64]

ARCSEC = np.pi / (180.0 * 3600.0)  # rad

TILES = 3072  # number of pieces of the sky, 13 square degrees each, in which stars are counted

# The density of a tile is the mean over this many tiles around it, as a tile has few stars.
TILES_AVERAGED = 9

# Step of the distribution of magnitudes, and standard deviation of the kernel that smooths it;
# magnitudes.
MAG_BIN, MAG_SMOOTHING = 0.1, 0.5

MIN_MEASURED = 20
"""Least number of sure pairs from which anything is measured."""

MIN_ERROR_RAD = 0.01 * ARCSEC
"""Smallest credible error of a position, radians: if measured errors are smaller, one catalog has
copied the positions of the other."""


@dataclass(frozen=True)
class MovingStars:
    """Stars of one catalog, each at its own epoch."""

    directions: Array  # shape (N, 3): ICRS unit vectors at ``epoch_jyear``
    # shape (N, 3): proper motions as vectors along the sky, radians a year; 0 where unknown
    velocities: Array
    has_motion: Mask  # shape (N,): whether the proper motion is known
    epoch_jyear: Array  # shape (N,): Julian years
    mag: Array  # shape (N,): magnitudes; NaN where unknown
    # shape (N,): standard deviations of the positions, each axis, radians
    error_rad: Array | None = None

    def at(self, rows: Rows, epoch_jyear: Array | float) -> Array:
        """Return directions of some stars at an epoch; stars without proper motion stay."""
        years = np.broadcast_to(epoch_jyear, len(rows)) - self.epoch_jyear[rows]
        moved: Array = self.directions[rows] + self.velocities[rows] * years[:, None]
        moved /= np.sqrt(np.einsum("ij,ij->i", moved, moved))[:, None]
        return moved


@dataclass(frozen=True)
class CandidatePairs:
    """Stars and candidate counterparts within a radius; arrays of shape (M,)."""

    star: Rows  # rows of the first set
    counterpart: Rows  # rows of the other set
    separation_rad: Array  # radians, at ``epoch_jyear``
    epoch_jyear: Array  # Julian year at which the two were compared
    unmoved_years: Array  # years between their positions if neither could be moved, else 0

    def take(self, rows: Rows | Mask) -> CandidatePairs:
        """Return some of the pairs."""
        return CandidatePairs(*(column[rows] for column in vars(self).values()))


@dataclass(frozen=True)
class MagnitudeCounts:
    """Numbers of stars by magnitude."""

    lowest: int  # number of the first bin; bin k begins at ``k * MAG_BIN``
    counts: Rows  # shape (K,): stars of each bin; empty if no magnitude is known

    @classmethod
    def of(cls, mag: Array) -> MagnitudeCounts:
        """Count magnitudes; NaN where unknown."""
        known = mag[~np.isnan(mag)]
        if not len(known):
            return cls(0, np.empty(0, dtype=np.int64))
        place = np.floor(known / MAG_BIN).astype(np.int64)
        lowest = int(place.min())
        return cls(lowest, np.bincount(place - lowest))

    def __add__(self, other: MagnitudeCounts) -> MagnitudeCounts:
        if not len(self.counts) or not len(other.counts):
            return self if len(self.counts) else other
        lowest = min(self.lowest, other.lowest)
        end = max(each.lowest + len(each.counts) for each in (self, other))
        counts = np.zeros(end - lowest, dtype=np.int64)
        for each in (self, other):
            start = each.lowest - lowest
            counts[start : start + len(each.counts)] += each.counts
        return MagnitudeCounts(lowest, counts)

    def density(self, wanted: Array) -> Array:
        """Return the share of the stars per magnitude, smoothed; it integrates to 1."""
        reach = int(np.ceil(4.0 * MAG_SMOOTHING / MAG_BIN))
        counts = np.pad(self.counts, reach).astype(np.float64)
        kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * MAG_BIN / MAG_SMOOTHING) ** 2)
        whole = self.counts.sum() * MAG_BIN
        density = np.convolve(counts, kernel / kernel.sum(), mode="same") / whole
        middles = (self.lowest - reach + 0.5 + np.arange(len(density))) * MAG_BIN
        return np.asarray(np.interp(wanted, middles, density))


@dataclass(frozen=True)
class Census:
    """Counts of the stars of a catalog, or of a part of it."""

    tiles: Rows  # shape (TILES,): stars in each tile of the sky
    magnitudes: MagnitudeCounts  # stars by magnitude

    @classmethod
    def of(cls, stars: MovingStars) -> Census:
        """Count the stars of a catalog, or of a part of it."""
        tiles = np.bincount(tiles_of(stars.directions), minlength=TILES)
        return cls(tiles, MagnitudeCounts.of(stars.mag))

    def __add__(self, other: Census) -> Census:
        return Census(self.tiles + other.tiles, self.magnitudes + other.magnitudes)

    @property
    def stars(self) -> int:
        """Number of stars counted."""
        return int(self.tiles.sum())

    def density(self) -> Array:
        """Return the number of stars per steradian around each tile, never 0.

        At least one star is counted.
        """
        total = np.maximum(self.tiles[_tiles()[1]].sum(axis=1).astype(np.float64), 1.0)
        return np.asarray(total / (TILES_AVERAGED * 4.0 * np.pi / TILES))


def tiles_of(directions: Directions) -> Rows:
    """Return the tiles of the sky that directions are in, 0 to ``TILES - 1``."""
    return np.asarray(_tiles()[0].query(directions)[1], dtype=np.int64)


@cache
def _tiles() -> tuple[scipy.spatial.cKDTree, Rows]:
    """Return a tree of the tiles' middles, and the tiles around each."""
    middles = saff_kuijlaars(TILES)
    tree = scipy.spatial.cKDTree(middles)
    return tree, np.asarray(tree.query(middles, k=TILES_AVERAGED)[1], dtype=np.int64)


@dataclass(frozen=True)
class MatchModel:
    """How far a star can be from its own counterpart, and the limits of the verdicts."""

    # standard deviation of the difference of two positions of a star, each axis, if the catalogs
    # state none; measured if not given
    position_error_rad: float | None = None
    # standard deviation of the proper motion of stars that have none in either catalog
    unknown_motion_rad_yr: float = 0.02 * ARCSEC
    # share of stars that are off by more than their stated errors: double stars of which the
    # catalogs measured different parts, wrong proper motions
    outlier_share: float = 0.02
    # mean magnitude of the counterpart minus the star's; measured if not given
    expected_delta_mag: float | None = None
    # standard deviation of that difference: colours, variability, poor magnitudes
    colour_spread_mag: float = 1.0
    # share of the stars that have a counterpart at all; measured if not given
    completeness: float | None = None
    # two candidates whose odds differ by this factor or less are ambiguous
    ambiguous_odds: float = 10.0
    # all candidates of a star are doubtful if together they are less probable than this
    min_probability: float = 0.5


@dataclass(frozen=True)
class Measured:
    """Values measured from all candidate pairs of two catalogs."""

    with_candidates: int  # stars that have any
    sure: int  # pairs whose star and candidate have no other
    sure_with_mag: int  # sure pairs with both magnitudes
    median_separation_rad: float  # median over sure pairs; NaN if there are none
    median_delta_mag: float


def is_sure(star: Rows, counterpart: Rows) -> Mask:
    """Return which pairs are sure: neither the star nor the candidate has another."""
    if not len(star):
        return np.empty(0, dtype=bool)
    alone = np.bincount(star)[star] == 1
    return np.asarray(alone & (np.bincount(counterpart)[counterpart] == 1))


def measure(stars: MovingStars, counterparts: MovingStars, pairs: CandidatePairs) -> Measured:
    """Return the values measured from the pairs of two whole catalogs."""
    sure = is_sure(pairs.star, pairs.counterpart)
    angle = pairs.separation_rad[sure]
    delta = counterparts.mag[pairs.counterpart[sure]] - stars.mag[pairs.star[sure]]
    known = delta[~np.isnan(delta)]
    return Measured(
        len(np.unique(pairs.star)),
        len(angle),
        len(known),
        float(np.median(angle)) if len(angle) else float("nan"),
        float(np.median(known)) if len(known) else float("nan"),
    )


@dataclass(frozen=True)
class Figures:
    """Values that all pairs of two catalogs share."""

    # standard deviation of the difference of two positions of a star, each axis, unless the
    # catalogs state their errors themselves
    position_error_rad: float
    delta_mag: float  # mean magnitude of the counterpart minus the star's
    completeness: float  # share of the stars that have a counterpart
    shared: float  # share of the counterparts that have a star
    density: Array  # shape (TILES,): counterparts per steradian around each tile of the sky
    magnitudes: MagnitudeCounts  # magnitudes of the counterparts


def figures_of(
    stars: Census, counterparts: Census, measured: Measured, radius_rad: float, model: MatchModel
) -> Figures:
    """Return the figures of two catalogs, given by the model or measured."""
    density = counterparts.density()
    share = _completeness(stars, measured, density * np.pi * radius_rad**2, model)
    # As many counterparts have a star as stars have a counterpart.
    shared = min(share * stars.stars / max(counterparts.stars, 1), 0.999)
    return Figures(
        _position_error(measured, radius_rad, model),
        _offset(measured, model),
        share,
        shared,
        density,
        counterparts.magnitudes,
    )


def _position_error(measured: Measured, radius_rad: float, model: MatchModel) -> float:
    """Return the error that all pairs share."""
    if model.position_error_rad is not None:
        return model.position_error_rad
    if measured.sure < MIN_MEASURED:
        return min(float(ARCSEC), 0.2 * radius_rad)
    # Separations have Rayleigh's distribution, whose median is sqrt(2 ln 2) standard deviations.
    error = measured.median_separation_rad / float(np.sqrt(2.0 * np.log(2.0)))
    return max(error, MIN_ERROR_RAD)


def _offset(measured: Measured, model: MatchModel) -> float:
    if model.expected_delta_mag is not None:
        return model.expected_delta_mag
    return measured.median_delta_mag if measured.sure_with_mag >= MIN_MEASURED else 0.0


def _completeness(stars: Census, measured: Measured, expected: Array, model: MatchModel) -> float:
    """Return the share of stars that have a counterpart.

    It is ``1 - a / b``: a is the share of stars without any candidate, b the share that would have
    none at random places (Fleuren et al. 2012, MNRAS 423, 2407). b is a sum over tiles that is
    rounded once, so that the order of the stars does not matter.
    """
    if model.completeness is not None:
        return model.completeness
    if not stars.stars:
        return 0.5
    blank = 1.0 - measured.with_candidates / stars.stars
    by_chance = math.fsum((stars.tiles * np.exp(-expected)).tolist()) / stars.stars
    return float(np.clip(1.0 - blank / by_chance, 0.001, 0.999))
