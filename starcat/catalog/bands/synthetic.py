"""Spectra of stars, and the magnitudes that they have through a passband."""

from __future__ import annotations

import gzip
import re
from dataclasses import dataclass
from functools import cache

import numpy as np

from starcat.arrays import Array
from starcat.catalog.bands.response import LIMITS_NM, Response, shipped
from starcat.errors import ConfigError
from starcat.resources import resource_folder

REDDENING_MAG = np.array([0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8])
"""The values of E(B-V) by which every spectrum is reddened."""

MEAN_REDDENING_MAG, MEAN_REDDENING_OF_FAR_MAG = 0.03, 0.2
"""Means of the exponential distributions of E(B-V). Most stars that trackers see are within 200 pc;
O and early B stars and supergiants are further away."""


@dataclass(frozen=True)
class SpectralLibrary:
    """Spectra by type and reddening."""

    types: tuple[str, ...]  # such as "a0v", shape (T,)
    number: Array  # shape (T,): tens are the letters O B A F G K M, units the subclass
    luminosity: Array  # shape (T,): 1 (supergiants) to 5 (dwarfs)
    stars: Array  # shape (T,): how many stars of the sky to V 6.6 are nearest to the type
    wavelength_nm: Array  # shape (N,)
    flux: Array  # shape (E, T, N): per wavelength, reddened by each of `REDDENING_MAG`
    weight: Array  # shape (E, T), sum 1: how common the spectrum is
    deviation: Array  # shape (N,): relative error of the flux, the same within a zone
    vega: Array  # shape (N,): erg/s/cm2/A


def data_table(name: str) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of a table of the data folder."""
    content = (resource_folder("catalog/bands/data") / name).read_bytes()
    text = (gzip.decompress(content) if name.endswith(".gz") else content).decode()
    lines = [line.split(",") for line in text.splitlines() if not line.startswith("#")]
    return lines[0], lines[1:]


@cache
def library() -> SpectralLibrary:
    """Return the library, read once."""
    names, rows = data_table("spectra.csv.gz")
    columns = np.array(rows, dtype=np.float64).T
    _, reference = data_table("reference.csv")
    _, vega, extinction = np.array(reference, dtype=np.float64).T
    stars = np.array([float(row[1]) for row in data_table("types.csv")[1]])
    types = tuple(names[2:])
    parsed = np.array([parsed_type(name) for name in types])
    dimming = 10.0 ** (-0.4 * REDDENING_MAG[:, None] * extinction)
    far = (parsed[:, 0] < 13.0) | (parsed[:, 1] <= 2)
    mean = np.where(far, MEAN_REDDENING_OF_FAR_MAG, MEAN_REDDENING_MAG)
    common = np.exp(-REDDENING_MAG[:, None] / mean) * np.gradient(REDDENING_MAG)[:, None]
    # One star more of each type, so that none is impossible.
    weight = common / common.sum(axis=0) * (stars + 1.0)
    return SpectralLibrary(
        types=types,
        number=parsed[:, 0],
        luminosity=parsed[:, 1],
        stars=stars,
        wavelength_nm=columns[0],
        flux=columns[2:][None] * dimming[:, None],
        weight=weight / weight.sum(),
        deviation=columns[1],
        vega=vega,
    )


_TYPE = re.compile(
    r"\s*(?:g|d|sg|c)?(?P<letter>[OBAFGKM])\s*(?P<first>10|\d(?:\.\d)?)?(?P<second>\d|P5)?"
    r"[^IV]*?(?P<class>III|II|IV|I|V)?(?:[^IV].*)?$",
    re.IGNORECASE,
)
_CLASSES = {"I": 1.0, "II": 2.0, "III": 3.0, "IV": 4.0, "V": 5.0}


def parsed_type(text: str) -> tuple[float, float]:
    """Return a spectral type as a number and a luminosity class; NaN for a part that is missing.

    Examples
    --------
    >>> parsed_type("B9p SiEu"), parsed_type("k2iii"), parsed_type("b57v")
    ((19.0, nan), (52.0, 3.0), (16.0, 5.0))
    """
    match = _TYPE.match(text)
    if match is None or match["first"] is None:
        return np.nan, np.nan
    letter = "OBAFGKM".index(match["letter"].upper())
    first, second = float(match["first"]), match["second"]
    if second:
        last = first + 1.0 if second.upper() == "P5" else float(second)
        first = 0.5 * (first + last)
    return 10.0 * letter + first, _CLASSES.get((match["class"] or "").upper(), np.nan)


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
    have a meaning.
    """
    weights = row_weights(response)
    return np.asarray(-2.5 * np.log10(library().flux @ weights) - zero_mag(response, weights))


def zero_mag(response: Response, weights: Array) -> float:
    """Return the magnitude, computed from the signal alone, of a star of 0 mag in the band."""
    kind, _, value = response.zero_point.partition(" ")
    if kind == "vega":
        return float(-2.5 * np.log10(library().vega @ weights)) - float(value)
    if kind == "ab":
        flux = AB_ZERO * LIGHT_A_S / (10.0 * _FINE_NM) ** 2
        photons = response.photon_efficiency(_FINE_NM) * _FINE_NM
        return float(-2.5 * np.log10(np.sum(flux * photons))) + float(value)
    row = type_row(value)
    visual = synthetic_magnitudes(shipped("V"))[0, row]
    return float(-2.5 * np.log10(library().flux[0, row] @ weights) - visual)


def type_row(text: str) -> int:
    """Return the row of a spectral type in the library, such as A0V."""
    types = library().types
    name = text.lower()
    if name not in types:
        near = [spectral_type.upper() for spectral_type in types if spectral_type[0] == name[0]]
        raise ConfigError(
            f"zero point: no spectrum of the type {text!r}; the library has {', '.join(near)}",
            key="zero_point",
            value=text,
        )
    return types.index(name)


def checked_zero_point(text: str) -> str:
    """Return the zero point of a spec, 'vega' or a spectral type, in the form of a response."""
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
