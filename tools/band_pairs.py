"""Compares magnitudes predicted from one catalog with those measured by another.

``python tools/band_pairs.py CATALOGS`` prints the table of docs/bands.md, from the genuine
records of a folder (``hip_main.dat.gz``, ``tyc_main.dat.gz``, ``psc_measured.gz``) and the embedded
sky. The stars are single and constant: no entry in CCDM, one component, and H52 is C or blank.
"""

from __future__ import annotations

import gzip
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.bands.photometry import band_error
from starcat.catalog.bands.relation import Prediction, predict_by_type, relation
from starcat.catalog.bands.response import shipped
from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.catalog.stars.verdict import Quality
from starcat.catalog.store.reading import read_catalog

Array = NDArray[np.float64]

SOURCES = {
    "G, BP-RP": ("G", ("BP", "RP")),
    "V, B-V": ("V", ("B", "V")),
    "V, V-I": ("V", ("V", "I")),
    "V, type": ("V", ("", "")),
    "VT, BT-VT": ("VT", ("BT", "VT")),
    "Hp, B-V": ("Hp", ("B", "V")),
    "J, J-Ks": ("J", ("J", "Ks")),
}
TARGETS = ("Hp", "V", "BT", "VT", "G", "J", "H", "Ks")

WITHIN_ARCSEC = 1.5
FEWEST = 30

NOT_SOUND = Quality.SATURATED | Quality.BLENDED | Quality.POOR_PHOTOMETRY | Quality.CONTAMINATED


@dataclass(frozen=True)
class Pair:
    """What a relation does on stars that were measured in both bands."""

    residual_mag: Array  # measured minus predicted
    error_mag: Array  # predicted, with the target's own error
    colour_mag: Array

    @property
    def rms_mag(self) -> float:
        return float(np.sqrt(np.mean(self.residual_mag**2)))

    @property
    def chi_square(self) -> float:
        return float(np.mean((self.residual_mag / self.error_mag) ** 2))

    def of(self, low: float, high: float) -> Pair:
        """Return the stars of a range of colours."""
        inside = (self.colour_mag >= low) & (self.colour_mag < high)
        return Pair(self.residual_mag[inside], self.error_mag[inside], self.colour_mag[inside])


@cache
def measured(catalogs: Path, *, infrared: bool = False) -> dict[str, Any]:
    """Return the magnitudes of single, constant stars in every band, and their spectral types.

    They are stars of Hipparcos to V 6.6. Few of them are faint enough for 2MASS: its bands
    are compared for stars of Tycho-1 to V 8.
    """
    source, name = ("tycho1", "tyc_main.dat.gz") if infrared else ("hipparcos", "hip_main.dat.gz")
    found = {}
    for band in ("V", "BT", "VT") if infrared else ("V", "BT", "VT", "Hp"):
        stars = read_stars(source, catalogs / name, band, 2016.0)
        found[band] = floats_of(stars, "mag")
    found["B"] = floats_of(stars, "colour_mag") + found["V"]
    found["I"] = found["V"] - floats_of(stars, "second_colour_mag")
    types = np.array([text or "" for text in stars["spectral_type"].to_pylist()])
    if infrared:
        found["Hp"] = np.full(len(stars), np.nan)
        kept = ~(stars["is_flagged_double"].to_numpy() | stars["is_flagged_variable"].to_numpy())
    else:
        kept = np.isin(stars["star_id"].to_numpy(), single_and_constant(catalogs / name))
    gaia = read_stars("gaia", embedded_sky(), None, 2016.0)
    place, near = nearest(directions_of(stars), directions_of(gaia))
    near &= gaia["star_id"].to_numpy()[place] > 0  # without stars that Hipparcos itself supplied
    found["G"] = np.where(near, floats_of(gaia, "mag")[place], np.nan)
    found["BP"] = np.where(near, floats_of(gaia, "second_mag")[place], np.nan)
    found["RP"] = found["BP"] - floats_of(gaia, "colour_mag")[place]
    found |= _infrared(catalogs, directions_of(read_stars(source, catalogs / name, "V", 1999.5)))
    return {band: mag[kept] for band, mag in {**found, "type": types}.items()}


def _infrared(catalogs: Path, u: Array) -> dict[str, Array]:
    """Return the 2MASS magnitudes at directions of 1999.5, if all three have good quality."""
    read = {b: read_stars("2mass", catalogs / "psc_measured.gz", b, None) for b in ("J", "H", "Ks")}
    flags = np.bitwise_or.reduce([one["quality_flags"].to_numpy() for one in read.values()])
    place, near = nearest(u, directions_of(read["J"]))
    near &= (flags & NOT_SOUND == 0)[place]
    return {
        band: np.where(near, floats_of(one, "mag")[place], np.nan) for band, one in read.items()
    }


def single_and_constant(path: Path) -> list[int]:
    """Return the numbers of Hipparcos records of single stars with constant light."""
    numbers = []
    with gzip.open(path, "rt", encoding="latin-1") as lines:
        for line in lines:
            cells = [cell.strip() for cell in line.split("|")]
            ccdm, components, solution, variability = (cells[k] for k in (55, 58, 59, 52))
            if not ccdm and components == "1" and not solution and variability in ("", "C"):
                numbers.append(int(cells[1]))
    return numbers


def read_stars(source: str, path: Path, band: str | None, epoch_jyear: float | None) -> pa.Table:
    read = read_catalog(
        source, [path], band=band, epoch_jyear=epoch_jyear, read_limit_mag=None, neighbours=False
    )
    return read.stars


def nearest(u: Array, others: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the row of the nearest other star, and whether it is near."""
    distance, place = cKDTree(others).query(u)
    return place, distance < np.radians(WITHIN_ARCSEC / 3600.0)


def predictions(stars: dict[str, Any], source: str, target: str) -> tuple[Prediction, Array]:
    """Return what one source predicts in a band, and the colours that it does so by."""
    base, (first, second) = SOURCES[source]
    if not first:
        mag = np.where(stars["type"] == "", np.nan, stars[base])
        types, error = stars["type"].tolist(), band_error(base, mag)
        return predict_by_type(base, shipped(target), mag, types, error), np.zeros(len(mag))
    colour = stars[first] - stars[second]
    colour_error = np.hypot(*(band_error(band, stars[base]) for band in (first, second)))
    made = relation(base, (first, second), shipped(target))
    error = band_error(base, stars[base])
    return made.predict(stars[base], colour, error, colour_error), colour


def pair(stars: dict[str, Any], source: str, target: str) -> Pair:
    """Return how a source's predictions agree with a band, within the colours of the relation."""
    found, colour = predictions(stars, source, target)
    residual = stars[target] - found.mag
    error = np.hypot(found.error_mag, band_error(target, stars[target]))
    known = np.isfinite(residual) & found.has_colour & ~found.is_outside
    return Pair(residual[known], error[known], colour[known])


def table(catalogs: Path) -> str:
    """Return the table of all pairs, as docs/bands.md has it."""
    optical, infrared = measured(catalogs), measured(catalogs, infrared=True)
    lines = ["| from | " + " | ".join(TARGETS) + " |", "|---" * (len(TARGETS) + 1) + "|"]
    for source, (base, colour) in SOURCES.items():
        cells = []
        for target in TARGETS:
            if target == base or (target in colour and base in colour):
                cells.append("")
                continue
            is_infrared = {target, base} & {"J", "H", "Ks"}
            found = pair(infrared if is_infrared else optical, source, target)
            if len(found.residual_mag) < FEWEST:
                cells.append("")
                continue
            bias = float(np.median(found.residual_mag))
            count = len(found.residual_mag)
            cells.append(f"{found.rms_mag:.3f} ({bias:+.3f}, {found.chi_square:.1f}, {count:,})")
        lines.append(f"| {source} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.stdout.write(table(Path(sys.argv[1])) + "\n")
