"""How likely a candidate is the star's counterpart: likelihood ratios and reliabilities.

The ratio weighs two explanations of a candidate: that it is the star, whose position and
magnitude scatter around the star's own, and that it is one of the other stars thereabouts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from starcat.geometry.sphere import saff_kuijlaars
from starcat.products.match_probability import pair_probabilities

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

ARCSEC = np.pi / (180.0 * 3600.0)  # rad

TILES = 3072
"""Number of pieces of the sky, 13 square degrees each, in which counterparts are counted."""

TILES_AVERAGED = 9
"""The density of a tile is the mean over so many tiles around it, as one tile has few stars."""

MAG_BIN, MAG_SMOOTHING = 0.1, 0.5
"""Step of the distribution of magnitudes, and standard deviation of the kernel that smooths
it; magnitudes."""

MIN_MEASURED = 20
"""Least number of sure pairs from which anything is measured."""

LEAST_ERROR_RAD = 0.01 * ARCSEC
"""Least error of a position that is believed, radians: where measured errors are smaller, one
catalog has copied the positions of the other."""


class PositionsAndMagnitudes(Protocol):
    """What the odds need to know of a catalog."""

    @property
    def directions(self) -> Array:
        """ICRS unit vectors, shape (N, 3)."""

    @property
    def mag(self) -> Array:
        """Magnitudes, shape (N,); NaN where unknown."""

    @property
    def error_rad(self) -> Array | None:
        """Standard deviations of the positions, each axis."""


class CandidatePairs(Protocol):
    """What the odds need to know of pairs."""

    @property
    def star(self) -> Rows:
        """Rows of the stars, ascending."""

    @property
    def counterpart(self) -> Rows:
        """Rows of the candidates."""

    @property
    def separation_rad(self) -> Array:
        """Separations at the epoch of comparison."""

    @property
    def unmoved_years(self) -> Array:
        """Years between positions that neither proper motion could bridge."""


@dataclass(frozen=True)
class MatchModel:
    """How far a star may be from its own counterpart, and what the verdicts ask for.

    Attributes
    ----------
    position_error_rad : float, optional
        Standard deviation of the difference of two positions of a star, each axis, where the
        catalogs state none; measured if not given.
    unknown_motion_rad_yr : float
        Standard deviation of the proper motion of stars that have none in either catalog.
    outlier_share : float
        Share of the stars that are off by more than errors explain, up to the radius: double
        stars of which the catalogs measured different parts, wrong proper motions.
    expected_delta_mag : float, optional
        Magnitude of the counterpart minus that of the star, on average; measured if not given.
    colour_spread_mag : float
        Standard deviation of that difference: colours, variability, poor magnitudes.
    completeness : float, optional
        Share of the stars that have a counterpart at all; measured if not given.
    ambiguous_odds : float
        Two candidates whose odds differ by this factor or less cannot be told apart.
    min_probability : float
        A star whose candidates together are less probable has but doubtful ones.
    """

    position_error_rad: float | None = None
    unknown_motion_rad_yr: float = 0.02 * ARCSEC
    outlier_share: float = 0.02
    expected_delta_mag: float | None = None
    colour_spread_mag: float = 1.0
    completeness: float | None = None
    ambiguous_odds: float = 10.0
    min_probability: float = 0.5


@dataclass(frozen=True)
class Odds:
    """The odds of pairs, arrays of shape (M,), and the figures behind them.

    Attributes
    ----------
    log_ratio : ndarray of float64
        Natural logarithm of the likelihood ratio.
    probability : ndarray of float64
        That this candidate is the star.
    any_probability : ndarray of float64
        That any candidate of the star is.
    error_rad : ndarray of float64
        Standard deviation of the difference of the two positions, each axis.
    position_error_rad, delta_mag, completeness : float
        As given or measured; NaN for an error that the catalogs state themselves.
    """

    log_ratio: Array
    probability: Array
    any_probability: Array
    error_rad: Array
    position_error_rad: float
    delta_mag: float
    completeness: float

    def take(self, order: Rows) -> Odds:
        """Return the odds in another order.

        Parameters
        ----------
        order : ndarray of int64, shape (M,)
            Rows.

        Returns
        -------
        Odds
            The same pairs.
        """
        return replace(
            self,
            log_ratio=self.log_ratio[order],
            probability=self.probability[order],
            any_probability=self.any_probability[order],
            error_rad=self.error_rad[order],
        )


def match_odds(
    stars: PositionsAndMagnitudes,
    counterparts: PositionsAndMagnitudes,
    pairs: CandidatePairs,
    radius_rad: float,
    model: MatchModel,
) -> Odds:
    """Return how likely each candidate is the counterpart of its star.

    Parameters
    ----------
    stars, counterparts : MovingStars
        The two catalogs.
    pairs : Pairs
        All candidates within the radius, by star.
    radius_rad : float
        The radius.
    model : MatchModel
        What a star may differ by from its own counterpart.

    Returns
    -------
    Odds
        One row a pair.

    Notes
    -----
    ``L = Q q(dm) f(r) / n(m)``: f is the density of a star's own counterpart at the separation
    r, q that of its magnitude, n the density of all others on the sky and in magnitude. Without
    magnitudes ``q / n`` is one over the density on the sky.

    References
    ----------
    Sutherland and Saunders 1992, MNRAS 259, 413, section 2. Without magnitudes and outliers L
    is the Bayes factor of Budavari and Szalay 2008, ApJ 679, 301, for two catalogs with normal
    errors, times Q over the number of counterparts on such a sky.
    """
    i, j = pairs.star, pairs.counterpart
    delta = counterparts.mag[j] - stars.mag[i]
    sure = (_counts(i)[i] == 1) & (_counts(j)[j] == 1) if len(i) else np.empty(0, dtype=bool)
    density = _Density(counterparts.directions)
    around = density.around(stars.directions)
    offset = _offset(delta[sure], model)
    share = _completeness(i, around * np.pi * radius_rad**2, model)
    common = _common_error(stars, counterparts, pairs.separation_rad[sure], radius_rad, model)
    error = np.hypot(
        _stated_error(stars, counterparts, i, j) if np.isnan(common) else common,
        pairs.unmoved_years * model.unknown_motion_rad_yr,
    )
    log_ratio = np.log(share) + _log_place(pairs.separation_rad, error, radius_rad, model)
    log_ratio -= np.log(around[i])
    log_ratio += _log_colour(delta, counterparts.mag, j, offset, model)
    # As many counterparts have a star as stars have a counterpart.
    shared = min(share * len(around) / max(len(counterparts.mag), 1), 0.999)
    probability, any_probability = pair_probabilities(i, j, log_ratio, share, shared)
    return Odds(log_ratio, probability, any_probability, error, common, offset, share)


def _counts(rows: Rows) -> Rows:
    return np.bincount(rows)


def _common_error(
    stars: PositionsAndMagnitudes,
    counterparts: PositionsAndMagnitudes,
    sure_rad: Array,
    radius_rad: float,
    model: MatchModel,
) -> float:
    """Return the error that all pairs share; NaN where both catalogs state their own."""
    if stars.error_rad is not None and counterparts.error_rad is not None:
        return float("nan")
    if model.position_error_rad is not None:
        return model.position_error_rad
    if len(sure_rad) < MIN_MEASURED:
        return min(float(ARCSEC), 0.2 * radius_rad)
    # Separations have Rayleigh's distribution, whose median is sqrt(2 ln 2) standard deviations.
    measured = float(np.median(sure_rad)) / float(np.sqrt(2.0 * np.log(2.0)))
    return max(measured, LEAST_ERROR_RAD)


def _stated_error(
    stars: PositionsAndMagnitudes, counterparts: PositionsAndMagnitudes, i: Rows, j: Rows
) -> Array:
    """Return the error of each pair from those that the catalogs state."""
    if stars.error_rad is None or counterparts.error_rad is None:
        raise ValueError("error_rad is missing; both catalogs have to state their errors, or none")
    return np.asarray(np.hypot(stars.error_rad[i], counterparts.error_rad[j]))


def _offset(sure_delta: Array, model: MatchModel) -> float:
    if model.expected_delta_mag is not None:
        return model.expected_delta_mag
    known = sure_delta[~np.isnan(sure_delta)]
    return float(np.median(known)) if len(known) >= MIN_MEASURED else 0.0


def _completeness(i: Rows, expected: Array, model: MatchModel) -> float:
    """Return the share of stars that have a counterpart.

    It is one minus the share of stars without any candidate, over the share that would have
    none at random places (Fleuren et al. 2012, MNRAS 423, 2407).
    """
    if model.completeness is not None:
        return model.completeness
    if not len(expected):
        return 0.5
    blank = 1.0 - len(np.unique(i)) / len(expected)
    return float(np.clip(1.0 - blank / np.exp(-expected).mean(), 0.001, 0.999))


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


def _log_colour(delta: Array, mag: Array, j: Rows, offset: float, model: MatchModel) -> Array:
    """Return the logarithm of q over the distribution of magnitudes; 0 where one is unknown."""
    known = ~np.isnan(delta)
    ratio = np.zeros(len(delta))
    if known.any():
        off = (delta[known] - offset) / model.colour_spread_mag
        own = -0.5 * off**2 - np.log(model.colour_spread_mag * np.sqrt(2.0 * np.pi))
        ratio[known] = own - np.log(magnitude_density(mag, mag[j[known]]))
    return ratio


def magnitude_density(mag: Array, wanted: Array) -> Array:
    """Return the share of a catalog's stars per magnitude.

    Parameters
    ----------
    mag : ndarray of float64, shape (N,)
        Magnitudes of the catalog; NaN where unknown.
    wanted : ndarray of float64, shape (M,)
        Magnitudes of stars of the catalog.

    Returns
    -------
    ndarray of float64, shape (M,)
        Per magnitude, smoothed by a normal distribution; integrates to 1.
    """
    known = mag[~np.isnan(mag)]
    reach = int(np.ceil(4.0 * MAG_SMOOTHING / MAG_BIN))
    lowest = np.floor(known.min() / MAG_BIN) - reach
    place = np.floor(known / MAG_BIN).astype(np.int64) - int(lowest)
    counts = np.bincount(place, minlength=int(place.max()) + reach + 1).astype(np.float64)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * MAG_BIN / MAG_SMOOTHING) ** 2)
    density = np.convolve(counts, kernel / kernel.sum(), mode="same") / (len(known) * MAG_BIN)
    middles = (lowest + 0.5 + np.arange(len(density))) * MAG_BIN
    return np.asarray(np.interp(wanted, middles, density))


class _Density:
    """The number of stars per steradian, by tile of the sky."""

    def __init__(self, directions: Array) -> None:
        tiles = saff_kuijlaars(TILES)
        self._tree = cKDTree(tiles)
        counts = np.bincount(self._tiles(directions), minlength=TILES).astype(np.float64)
        around = np.asarray(self._tree.query(tiles, k=TILES_AVERAGED)[1])
        # At least one star is counted, so that no density is 0.
        total = np.maximum(counts[around].sum(axis=1), 1.0)
        self._density = total / (TILES_AVERAGED * 4.0 * np.pi / TILES)

    def _tiles(self, directions: Array) -> Rows:
        return np.asarray(self._tree.query(directions)[1], dtype=np.int64)

    def around(self, directions: Array) -> Array:
        """Return the density around directions."""
        density: Array = self._density[self._tiles(directions)]
        return density
