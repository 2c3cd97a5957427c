"""The library of stellar spectra: Pickles 1998, reddened by the law of Fitzpatrick 1999.

Each of the 108 types stands for as many stars as Hipparcos has of it, and for several amounts of
reddening. The tables of ``data`` are made by ``tests/builders/bands.py``.
"""

from __future__ import annotations

import gzip
import re
from dataclasses import dataclass
from functools import cache

import numpy as np

from starcat.arrays import Array
from starcat.resources import resource_folder

REDDENING_MAG = np.array([0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8])
"""E(B-V) that every spectrum is taken with."""

MEAN_REDDENING_MAG, MEAN_REDDENING_OF_FAR_MAG = 0.03, 0.2
"""Of the stars that trackers see, most are within 200 pc; O, early B stars and supergiants are
further. Reddenings fall off exponentially with these means."""


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
    content = (resource_folder("bands/data") / name).read_bytes()
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
    """Return a spectral type as a number and a luminosity class; NaN for what it does not say.

    Examples
    --------
    >>> parsed_type("B9p SiEu"), parsed_type("k2iii"), parsed_type("b57v")
    ((19.0, nan), (52.0, 3.0), (16.0, 5.0))
    """
    found = _TYPE.match(text)
    if found is None or found["first"] is None:
        return np.nan, np.nan
    letter = "OBAFGKM".index(found["letter"].upper())
    first, second = float(found["first"]), found["second"]
    if second:
        last = first + 1.0 if second.upper() == "P5" else float(second)
        first = 0.5 * (first + last)
    return 10.0 * letter + first, _CLASSES.get((found["class"] or "").upper(), np.nan)
