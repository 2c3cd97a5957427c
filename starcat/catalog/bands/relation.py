"""Relations from the bands of a catalog to a sensor's band: magnitude offsets and their errors.

A relation is a smooth line through the library's spectra: at each colour a straight line is fitted
to the spectra of about that colour, with more weight on common types. Nothing is fitted to stars of
the sky. The error of a relation has three parts: the scatter of the spectra about the line, the
effect of errors of the library's own flux calibration, and the uncertainty of the zero points of
published bands. Their sum is multiplied by a factor that was measured on stars (`measured.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from starcat.arrays import Array, Mask
from starcat.catalog.bands.measured import error_factors
from starcat.catalog.bands.response import Response, shipped
from starcat.catalog.bands.synthetic import library, parsed_type, row_weights, synthetic_magnitudes

GRID_MAG = 0.02
"""Step of the colours at which a relation is computed."""

WIDTH_MAG, WIDEST_MAG = 0.06, 0.6
"""Standard deviation of the Gaussian weight of spectra by their difference of colour. If the
library has few spectra at a colour, the width grows up to the second value."""

MIN_TYPES = 3.0
"""Smallest number of types from which the line at a colour is fitted."""

ZERO_POINT_MAG = 0.007
"""Uncertainty of the passband and zero point of a published band (Bessell and Murphy 2012,
section 4: 0.01 mag)."""

PASSBAND_SHARE = 0.002
"""Relative uncertainty of the mean wavelength of a response: 1.1 nm at 550 nm. Zero points are set
by white stars, so the error grows with the difference between a star's colour and theirs."""

OUTSIDE_MAG = 0.5
"""Growth of the error per magnitude that a colour is outside of the library's colours."""

TYPE_WIDTH, CLASS_WIDTH = 1.5, 0.7
"""Standard deviations, in subclasses and luminosity classes, of the spectra that a type means."""


@dataclass(frozen=True)
class Prediction:
    """Magnitudes in a sensor's band."""

    mag: Array  # shape (N,): NaN if the base magnitude is NaN
    error_mag: Array  # shape (N,): standard deviation
    is_outside: Mask  # shape (N,): the colour is outside of the relation's
    has_colour: Mask  # shape (N,): False if a mean over all stars was used


@dataclass(frozen=True)
class Relation:
    """The offset to add to a magnitude in a base band, by colour."""

    base: str  # a shipped response, such as "G"
    colour: tuple[str, str]  # such as ("BP", "RP")
    target: Response
    colour_mag: Array  # shape (G,), rising
    offset_mag: Array  # shape (G,): target minus base
    slope: Array  # shape (G,): of the offset by colour
    scatter_mag: Array  # shape (G,): of the spectra about the offset
    calibration_mag: Array  # shape (G,): from errors of the library's fluxes
    band_mag: Array  # shape (G,): from errors of the passbands and their zero points
    measured: Array  # shape (G,): measured errors over the sum of these three
    typical_offset_mag: float  # the offset for stars without a colour
    typical_scatter_mag: float
    typical_error_mag: float  # the error of the relation at common colours
    typical_computed_mag: float  # the same without the measured factor

    @property
    def error_mag(self) -> Array:
        """The error of the relation at each colour of the grid, shape (G,)."""
        return np.asarray(self.measured * self.computed_error_mag)

    @property
    def computed_error_mag(self) -> Array:
        """The error that the library's spectra alone predict, shape (G,)."""
        squares = self.scatter_mag**2 + self.calibration_mag**2 + self.band_mag**2
        return np.asarray(np.sqrt(squares))

    def predict(
        self, mag: Array, colour_mag: Array, mag_error: Array, colour_error: Array
    ) -> Prediction:
        """Return magnitudes in the target's band.

        Parameters
        ----------
        mag, colour_mag : ndarray of float64, shape (N,)
            Magnitudes in the base band, and colours; NaN where unknown.
        mag_error, colour_error : ndarray of float64, shape (N,)
            Their standard deviations.

        Returns
        -------
        Prediction
            Beyond its ends the relation continues as a straight line, and the error grows.
        """
        grid, has_colour = self.colour_mag, np.isfinite(colour_mag)
        colour = np.where(has_colour, colour_mag, grid[0])
        beyond = colour - np.clip(colour, grid[0], grid[-1])
        slope = np.interp(colour, grid, self.slope)
        offset = np.interp(colour, grid, self.offset_mag) + slope * beyond
        relation = np.interp(colour, grid, self.error_mag) + OUTSIDE_MAG * np.abs(beyond)
        offset = np.where(has_colour, offset, self.typical_offset_mag)
        relation = np.where(has_colour, relation, self.typical_scatter_mag)
        by_colour = np.where(has_colour, slope * colour_error, 0.0)
        error = np.sqrt(relation**2 + mag_error**2 + by_colour**2)
        return Prediction(mag + offset, error, has_colour & (beyond != 0.0), has_colour)


def _zone_shares(response: Response) -> Array:
    """Return the fraction of each spectrum's signal that comes from each zone, shape (E, T, Z)."""
    spectra = library()
    signal = spectra.flux * row_weights(response)
    starts = np.flatnonzero(np.diff(spectra.deviation, prepend=-1.0) != 0)
    return np.asarray(np.add.reduceat(signal, starts, axis=2) / signal.sum(axis=2)[..., None])


def _zone_deviations() -> Array:
    """Return the library's relative error in each zone, shape (Z,)."""
    deviation = library().deviation
    return deviation[np.flatnonzero(np.diff(deviation, prepend=-1.0) != 0)]


def relation(base: str, colour: tuple[str, str], target: Response) -> Relation:
    """Return the relation from a band and a colour of a catalog to a sensor's band."""
    first, second = (shipped(band) for band in colour)
    x = (synthetic_magnitudes(first) - synthetic_magnitudes(second)).ravel()
    y = (synthetic_magnitudes(target) - synthetic_magnitudes(shipped(base))).ravel()
    weight = library().weight
    grid = _grid(x)
    kernels = np.stack([_kernel(x, at) for at in grid])
    each = kernels * weight.ravel()
    total = each.sum(axis=1)
    mean_x, mean_y = each @ x / total, each @ y / total
    square = np.maximum((each @ x**2) / total - mean_x**2, 1e-9)
    slope = ((each @ (x * y)) / total - mean_x * mean_y) / square
    offset = mean_y + slope * (grid - mean_x)
    residual = y - (offset[:, None] + slope[:, None] * (x - grid[:, None]))
    scatter = np.sqrt(np.sum(each * residual**2, axis=1) / total)
    shares = _zone_shares(target) - _zone_shares(shipped(base))
    by_colour = _zone_shares(first) - _zone_shares(second)
    at_spectrum = np.interp(x, grid, slope).reshape(weight.shape)
    excess = shares - at_spectrum[..., None] * by_colour
    calibration = 1.0857 * np.sqrt(np.sum((excess * _zone_deviations()) ** 2, axis=2)).ravel()
    typical = float(np.sum(weight.ravel() * y))
    band = each @ _band_variance(shipped(base), target) / total
    measured = error_factors(base, colour, target, grid)
    at_colour = scatter**2 + each @ calibration**2 / total + band
    return Relation(
        base=base,
        colour=colour,
        target=target,
        colour_mag=grid,
        offset_mag=offset,
        slope=slope,
        scatter_mag=scatter,
        calibration_mag=np.sqrt(each @ calibration**2 / total),
        band_mag=np.sqrt(band),
        measured=measured,
        typical_offset_mag=typical,
        typical_scatter_mag=float(np.sqrt(np.sum(weight.ravel() * (y - typical) ** 2))),
        typical_error_mag=_typical(x, grid, measured**2 * at_colour),
        typical_computed_mag=_typical(x, grid, at_colour),
    )


def _typical(x: Array, grid: Array, variance: Array) -> float:
    """Return the root mean square error over the spectra, weighted by how common they are."""
    return float(np.sqrt(library().weight.ravel() @ np.interp(x, grid, variance)))


def _band_variance(base: Response, target: Response) -> Array:
    """Return the variance that errors of two passbands make for each spectrum, shape (E * T,)."""
    if base is target:
        return np.zeros(library().weight.size)
    variance = np.full(library().weight.shape, ZERO_POINT_MAG**2)
    for band in (base, target):
        shifted = replace(band, wavelength_nm=band.wavelength_nm * (1.0 + PASSBAND_SHARE))
        variance = variance + (synthetic_magnitudes(shifted) - synthetic_magnitudes(band)) ** 2
    return np.asarray(variance).ravel()


def _grid(x: Array) -> Array:
    """Return the colours from the bluest spectrum to the reddest."""
    low, high = np.floor(x.min() / GRID_MAG), np.ceil(x.max() / GRID_MAG)
    return np.arange(low, high + 1.0) * GRID_MAG


def _kernel(x: Array, at: float) -> Array:
    """Return the weight of each spectrum at a colour, without its frequency in the sky."""
    share = library().weight / library().weight.sum(axis=0)
    width = WIDTH_MAG
    while True:
        near = np.exp(-0.5 * ((x - at) / width) ** 2)
        if width >= WIDEST_MAG or np.sum(near * share.ravel()) >= MIN_TYPES:
            return np.asarray(near)
        width *= 1.2


@cache
def _type_kernel(number: float, luminosity: float) -> Array:
    """Return the weights, sum 1, of the spectra that a spectral type can mean."""
    spectra = library()
    near = np.exp(-0.5 * ((spectra.number - number) / TYPE_WIDTH) ** 2)
    if np.isfinite(luminosity):
        near = near * np.exp(-0.5 * ((spectra.luminosity - luminosity) / CLASS_WIDTH) ** 2)
    weights = near * spectra.weight
    return np.asarray(weights / weights.sum())


def predict_by_type(
    base: str, target: Response, mag: Array, types: list[str], mag_error: Array
) -> Prediction:
    """Return magnitudes in a sensor's band from a band and spectral types such as K2III or A0."""
    difference = synthetic_magnitudes(target) - synthetic_magnitudes(shipped(base))
    everywhere = library().weight
    bands = _band_variance(shipped(base), target).reshape(everywhere.shape)
    by_type: dict[str, tuple[float, float, bool]] = {}
    for text in set(types):
        number, luminosity = parsed_type(text)
        is_known = bool(np.isfinite(number))
        weights = _type_kernel(number, luminosity) if is_known else everywhere
        mean = float(np.sum(weights * difference))
        scatter = float(np.sqrt(np.sum(weights * ((difference - mean) ** 2 + bands))))
        by_type[text] = (mean, scatter, is_known)
    rows = np.array([by_type[text] for text in types]).reshape(-1, 3)
    error = np.sqrt(rows[:, 1] ** 2 + mag_error**2)
    return Prediction(mag + rows[:, 0], error, np.zeros(len(mag), bool), rows[:, 2] > 0)


def combined(predictions: list[Prediction]) -> Prediction:
    """Return the mean of predictions from several catalogs, weighted by their errors.

    A prediction is left out if it is unknown, or outside of its relation while another is inside.
    """
    mags = np.stack([prediction.mag for prediction in predictions])
    errors = np.stack([prediction.error_mag for prediction in predictions])
    outside = np.stack([prediction.is_outside for prediction in predictions])
    is_known = np.isfinite(mags)
    inside = is_known & ~outside
    counted = np.where(inside.any(axis=0), inside, is_known)
    weight = np.where(counted, 1.0 / np.maximum(errors, 1e-6) ** 2, 0.0)
    total = weight.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mag = np.sum(np.where(counted, mags, 0.0) * weight, axis=0) / total
        error = np.sqrt(1.0 / total)
    has_colour = np.any(
        np.stack([prediction.has_colour for prediction in predictions]) & counted, axis=0
    )
    is_outside = np.asarray(is_known.any(axis=0) & ~inside.any(axis=0))
    return Prediction(mag, error, is_outside, np.asarray(has_colour))
