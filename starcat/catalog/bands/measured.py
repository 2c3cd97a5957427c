"""Errors of predicted magnitudes, from stars that were measured in both bands.

The tables ``relation_errors.csv`` and ``star_errors.csv`` of the data folder are made by
``tools/band_errors.py`` from genuine records. Only errors are taken from them: no
magnitude is fitted to measured stars.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from starcat.arrays import Array, Mask
from starcat.catalog.bands.photometry import variability_error
from starcat.catalog.bands.response import Response, shipped
from starcat.catalog.bands.synthetic import data_table

NEAR_IN_WAVELENGTH = 0.15
"""Standard deviation of the Gaussian weight of a measured band for a sensor's band, by the
logarithm of the ratio of their mean wavelengths."""

NOISE_MAG = 0.05
"""Largest difference of the 95th and the 5th percentile of Hp that constant stars show: it is above
this for 1 of 1,000 stars of the class C in H52 of Hipparcos."""

COMPANION_SHARE, COMPANION, LISTED, VARIABLE = "companion_share", "companion", "listed", "variable"
COLOUR_SHARE = "colour_share"
"""States of a star in ``star_errors.csv``."""


Bins = dict[tuple[str, str], dict[str, Array]]


@cache
def relation_errors() -> Bins:
    """Return the table of relations that ships with starcat."""
    return bands_in_bins(data_table("relation_errors.csv")[1])


def bands_in_bins(rows: list[list[str]]) -> Bins:
    """Return the least colour and the factor of each bin, shape (K, 2), by relation and band."""
    by_relation: dict[tuple[str, str], dict[str, list[list[float]]]] = {}
    for base, colour, target, low, _, factor in rows:
        bands = by_relation.setdefault((base, colour), {})
        bands.setdefault(target, []).append([float(low), float(factor)])
    return {
        key: {target: np.array(bins) for target, bins in bands.items()}
        for key, bands in by_relation.items()
    }


def error_factors(base: str, colour: tuple[str, str], target: Response, colour_mag: Array) -> Array:
    """Return the ratios of the measured errors of a relation to the computed ones.

    The factors were measured in the bands of catalogs. For a sensor's band, a measured band has
    more weight the nearer its mean wavelength is to the sensor's. No factor is below 1 then, as
    the response of a sensor is less well known. Without a measurement the factor is 1.

    Parameters
    ----------
    base : str
        The catalog's band, such as "G".
    colour : tuple of str
        Two bands, such as ("BP", "RP").
    target : Response
        The band that is predicted.
    colour_mag : ndarray of float64, shape (N,)
        Colours, mag. Beyond the measured colours the nearest factor is taken.

    Returns
    -------
    ndarray of float64, shape (N,)
        Factors by which the computed errors of the relation are multiplied.
    """
    bands = relation_errors().get((base, "-".join(colour)), {})
    if target.name in bands and target is shipped(target.name):
        return _in_bins(bands[target.name], colour_mag)
    total, weights = np.zeros(len(colour_mag)), 0.0
    for name, bins in bands.items():
        ratio = np.log(shipped(name).mean_nm / target.mean_nm) / NEAR_IN_WAVELENGTH
        # Without the second term all weights would be 0 for a sensor far from every measured band.
        weight = float(np.exp(-0.5 * ratio**2)) + 1e-6 / (1.0 + ratio**2)
        total += weight * _in_bins(bins, colour_mag)
        weights += weight
    return np.maximum(total / weights, 1.0) if weights else np.ones(len(colour_mag))


def _in_bins(bins: Array, colour_mag: Array) -> Array:
    """Return the factors of the bins of colours; the outer bins have no end."""
    low, factor = bins.T
    return np.asarray(factor[np.searchsorted(low[1:], colour_mag, side="right")])


@cache
def star_errors() -> dict[str, Array]:
    """Return the table of flagged stars that ships with starcat."""
    return states_of(data_table("star_errors.csv")[1])


def states_of(rows: list[list[str]]) -> dict[str, Array]:
    """Return lower limit, upper limit and value of the rows of each state, shape (K, 3)."""
    by_state: dict[str, list[list[float]]] = {}
    for state, low, high, _, value in rows:
        by_state.setdefault(state, []).append(
            [float(low or 0.0), float(high or np.inf), float(value)]
        )
    return {state: np.array(limits) for state, limits in by_state.items()}


def colour_share(bp_rp_mag: Array) -> Array:
    """Return the factor of the errors of flagged stars, by colour BP-RP.

    Most red stars are giants. A companion adds little to the light of a giant.

    Parameters
    ----------
    bp_rp_mag : ndarray of float64, shape (N,)
        Colours; NaN if unknown.

    Returns
    -------
    ndarray of float64, shape (N,)
        Factor of the errors that companions and variability add; 1 without a measured share.
    """
    factors = np.ones(len(bp_rp_mag))
    for low_mag, high_mag, share in star_errors()[COLOUR_SHARE]:
        factors[(bp_rp_mag >= low_mag) & (bp_rp_mag < high_mag)] = share
    return factors


def companion_light(delta_mag: Array) -> Array:
    """Return by how much the light of a companion brightens a star, mag; NaN if unknown.

    >>> round(float(companion_light(np.array([0.0]))[0]), 3)
    0.753
    """
    return np.asarray(
        2.5 * np.log10(1.0 + 10.0 ** (-0.4 * np.fmax(delta_mag, 0.0) + 0.0 * delta_mag))
    )


def companion_error(
    is_double: Mask, is_listed: Mask, separation_arcsec: Array, delta_mag: Array
) -> Array:
    """Return the standard error that companions add to magnitudes.

    The magnitude in a catalog includes the light of one star or of both; the further apart the
    stars are, the more often of one. If the difference of their magnitudes is known, the error is
    a measured fraction of the companion's light, else the measured scatter of such stars.

    Parameters
    ----------
    is_double, is_listed : ndarray of bool, shape (N,)
        Whether a star is flagged as a double, and whether any list of doubles has it.
    separation_arcsec, delta_mag : ndarray of float64, shape (N,)
        Separation and relative magnitude of the companion; NaN if unknown.

    Returns
    -------
    ndarray of float64, shape (N,)
        mag; 0 for single stars.
    """
    rows = star_errors()
    low, _, share = rows[COMPANION_SHARE].T
    row = np.searchsorted(low, np.nan_to_num(separation_arcsec, nan=np.inf), side="right") - 1
    with_light = share[np.clip(row, 0, len(low) - 1)] * companion_light(delta_mag)
    unknown = np.where(is_double, rows[COMPANION][0, 2], rows[LISTED][0, 2])
    error = np.where(np.isfinite(with_light), with_light, unknown)
    return np.where(is_double | is_listed, error, 0.0)


def variation_error(is_variable: Mask, amplitude_mag: Array) -> Array:
    """Return the standard error that variability adds; both of shape (N,), the amplitude in mag.

    For a flagged star without a known amplitude the error is the measured scatter of such stars.
    For a star without a flag, an amplitude up to `NOISE_MAG` is noise of the photometry.
    """
    is_unknown = is_variable & ~np.isfinite(amplitude_mag)
    usual = star_errors()[VARIABLE][0, 2]
    error = np.where(is_unknown, usual, variability_error(amplitude_mag))
    is_noise = ~is_variable & (np.nan_to_num(amplitude_mag) <= NOISE_MAG)
    return np.where(is_noise, 0.0, error)
