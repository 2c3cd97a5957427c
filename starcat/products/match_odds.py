"""How likely a candidate is the star's counterpart: likelihood ratios and reliabilities.

The ratio weighs two explanations of a candidate: that it is the star, whose position and
magnitude scatter around the star's own, and that it is one of the other stars thereabouts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.products.match_figures import CandidatePairs, Figures, MatchModel
from starcat.products.match_probability import pair_probabilities
from starcat.products.star_counts import PositionsAndMagnitudes, tiles_of

Rows = NDArray[np.int64]


@dataclass(frozen=True)
class Odds:
    """The odds of pairs, arrays of shape (M,), and the figures behind them."""

    log_ratio: Array  # natural logarithm of the likelihood ratio
    probability: Array  # that this candidate is the star
    any_probability: Array  # that any candidate of the star is
    error_rad: Array  # standard deviation of the difference of the two positions, each axis
    # position_error_rad, delta_mag, completeness: as given or measured; NaN for an error that the
    # catalogs state themselves
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
    figures: Figures,
    model: MatchModel,
) -> Odds:
    """Return how likely each candidate is the counterpart of its star.

    Parameters
    ----------
    stars, counterparts : MovingStars
        The two catalogs, or parts of them.
    pairs : Pairs
        All candidates within the radius, by star.
    radius_rad : float
        The radius.
    figures : Figures
        What is known of the two whole catalogs.
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


def _stated_error(
    stars: PositionsAndMagnitudes, counterparts: PositionsAndMagnitudes, i: Rows, j: Rows
) -> Array:
    """Return the error of each pair from those that the catalogs state."""
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
    """Return the logarithm of q over the distribution of magnitudes; 0 where one is unknown."""
    known = ~np.isnan(delta)
    ratio = np.zeros(len(delta))
    if known.any():
        off = (delta[known] - figures.delta_mag) / model.colour_spread_mag
        own = -0.5 * off**2 - np.log(model.colour_spread_mag * np.sqrt(2.0 * np.pi))
        ratio[known] = own - np.log(figures.magnitudes.density(mag[known]))
    return ratio
