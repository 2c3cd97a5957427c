"""Magnitudes of spectra through responses.

A band counts photons: its magnitude is that of the sum of flux times wavelength times electrons per
photon, from a zero point that is Vega's, the AB system's or a reference star's.
"""

from __future__ import annotations

import numpy as np

from starcat.arrays import Array
from starcat.bands.response import LIMITS_NM, Response, shipped
from starcat.bands.spectra import library, parsed_type
from starcat.errors import ConfigError

AB_ZERO = 3.631e-20
"""erg/s/cm2/Hz of an AB magnitude of 0 (Oke and Gunn 1983, ApJ 266, 713)."""

LIGHT_A_S = 2.99792458e18
"""Speed of light, angstroms a second."""

_FINE_NM = np.arange(LIMITS_NM[0], LIMITS_NM[1] + 0.25, 0.5)


def row_weights(response: Response) -> Array:
    """Return what a unit of flux in each row of the library's spectra adds to the signal."""
    rows = library().wavelength_nm
    photons = response.photon_efficiency(_FINE_NM) * _FINE_NM
    right = np.clip(np.searchsorted(rows, _FINE_NM, side="right"), 1, len(rows) - 1)
    share = np.clip((_FINE_NM - rows[right - 1]) / (rows[right] - rows[right - 1]), 0.0, 1.0)
    weights = np.bincount(right, photons * share, len(rows))
    weights += np.bincount(right - 1, photons * (1.0 - share), len(rows))
    return np.asarray(weights)


def synthetic_magnitudes(response: Response) -> Array:
    """Return the magnitudes of the library's spectra, shape (E, T), in a response's band.

    The spectra have one flux at 555.6 nm before they are reddened; only differences between bands
    mean something.
    """
    weights = row_weights(response)
    return np.asarray(-2.5 * np.log10(library().flux @ weights) - zero_mag(response, weights))


def zero_mag(response: Response, weights: Array) -> float:
    """Return the magnitude, from a signal alone, of what has 0 mag in the band."""
    kind, _, said = response.zero_point.partition(" ")
    if kind == "vega":
        return float(-2.5 * np.log10(library().vega @ weights)) - float(said)
    if kind == "ab":
        flux = AB_ZERO * LIGHT_A_S / (10.0 * _FINE_NM) ** 2
        photons = response.photon_efficiency(_FINE_NM) * _FINE_NM
        return float(-2.5 * np.log10(np.sum(flux * photons))) + float(said)
    row = type_row(said)
    visual = synthetic_magnitudes(shipped("V"))[0, row]
    return float(-2.5 * np.log10(library().flux[0, row] @ weights) - visual)


def type_row(text: str) -> int:
    """Return the row of a spectral type in the library, such as A0V."""
    types = library().types
    name = text.lower()
    if name not in types:
        near = [one.upper() for one in types if one[0] == name[0]]
        raise ConfigError(
            f"zero point: no spectrum of the type {text!r}; the library has {', '.join(near)}",
            key="zero_point",
            value=text,
        )
    return types.index(name)


def checked_zero_point(text: str) -> str:
    """Return a zero point as a spec states it, as a response has it: 'vega' or a spectral type."""
    if text.lower() == "vega":
        return "vega 0"
    if np.isnan(parsed_type(text)[0]):
        raise ConfigError(
            f"zero point: found {text!r}; expected 'vega' (Vega has magnitude 0) or a spectral "
            "type such as A0V (a star of it has the magnitude that it has in V)",
            key="zero_point",
            value=text,
        )
    return f"type {library().types[type_row(text)]}"
