"""Makes the tables of `starcat.catalog.bands`: spectra.csv.gz, types.csv and reference.csv.

``python tools/bands.py spectra CATALOGS`` reads ``pickles_uvklib.tar.xz`` and
``hip_main.dat.gz`` of a folder and writes the spectra and the types; a test does the same.
``python tools/bands.py reference alpha_lyr_stis_011.fits`` writes Vega (CALSPEC) and the
law of extinction; it needs the PyPI package ``extinction``, which nothing else does.
"""

from __future__ import annotations

import gzip
import re
import sys
import tarfile
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DATA = Path(__file__).parents[1] / "starcat" / "bands" / "data"

WAVELENGTH_NM: Array = np.concatenate([np.arange(300.0, 1100.0, 2.5), np.arange(1100, 2501, 10.0)])
"""Fine enough for every published band: their magnitudes change by less than 1 mmag."""

ZONES_NM = (300, 350, 400, 500, 600, 700, 800, 900, 1000, 1100, 1300, 1500, 1800, 2100, 2501)
"""In each, the sources of the library's spectra are taken to err together."""

CLASSES = {"i": 1, "ii": 2, "iii": 3, "iv": 4, "v": 5}

SPECTRA_HEADER = """\
# Stellar spectra by type, Pickles 1998, PASP 110, 863 (CDS J/PASP/110/863), library UVKLIB:
# flux per wavelength, 1 at 555.6 nm, averaged over the width of a row. The column deviation is the
# relative deviation of the library's sources in the row's zone (root mean square of each spectrum,
# the median over the spectra). Made by tools/bands.py.
"""
TYPES_HEADER = """\
# How many stars of the Hipparcos catalogue (ESA SP-1200, 1997; records to V 6.6) are nearest to
# each type of the library. Made by tools/bands.py.
"""
REFERENCE_HEADER = """\
# Vega: CALSPEC alpha_lyr_stis_011 (Bohlin, Hubeny and Rauch 2020, AJ 160, 21), erg/s/cm2/A,
# averaged over the width of a row. Extinction: A(wavelength) in magnitudes for E(B-V) = 1 and
# R = 3.1, Fitzpatrick 1999, PASP 111, 63. Made by tools/bands.py.
"""


def averaged(wavelength_nm: Array, flux: Array) -> Array:
    """Return a spectrum averaged over the widths of the table's rows."""
    middles = 0.5 * (WAVELENGTH_NM[1:] + WAVELENGTH_NM[:-1])
    edges = np.concatenate([[WAVELENGTH_NM[0] - 1.25], middles, [WAVELENGTH_NM[-1] + 5.0]])
    edges = np.clip(edges, wavelength_nm[0], wavelength_nm[-1])
    steps = 0.5 * (flux[1:] + flux[:-1]) * np.diff(wavelength_nm)
    sums = np.interp(edges, wavelength_nm, np.concatenate([[0.0], np.cumsum(steps)]))
    return np.asarray(np.diff(sums) / np.diff(edges))


def library(path: Path) -> dict[str, Array]:
    """Return wavelength (nm), flux and deviation of each spectrum of the archive, by type."""
    found = {}
    with tarfile.open(path) as archive:
        for member in archive.getmembers():
            name = re.search(r"uk([obafgkm].*[iv])\.dat$", member.name)
            content = archive.extractfile(member) if name else None
            if name and content:
                rows = np.loadtxt(content, usecols=(0, 1, 2))
                found[name[1]] = np.stack([rows[:, 0] / 10.0, rows[:, 1], rows[:, 2]])
    return dict(sorted(found.items()))


def deviations(spectra: dict[str, Array]) -> Array:
    """Return the library's relative deviation at each row of the table."""
    at_row = np.empty(len(WAVELENGTH_NM))
    for low, high in pairwise(ZONES_NM):
        found = []
        for wavelength, flux, deviation in spectra.values():
            known = (wavelength >= low) & (wavelength < high) & (deviation > 0) & (flux > 0)
            if known.sum() > 5:
                found.append(np.sqrt(np.mean((deviation[known] / flux[known]) ** 2)))
        in_zone = np.searchsorted(ZONES_NM, WAVELENGTH_NM, side="right") == 1 + ZONES_NM.index(low)
        at_row[in_zone] = np.median(found)
    return at_row


def type_number(text: str) -> tuple[float, int] | None:
    """Return a spectral type as tens of letters plus subclass (A0 is 20), and its class or 0."""
    found = re.match(r"(?:g|d|sg|c)?([OBAFGKM])\s*(\d(?:\.\d)?)?", text)
    if not found:
        return None
    luminosity = re.search(r"(III|II|IV|I|V)", text[found.end() :])
    number = 10.0 * "OBAFGKM".index(found[1]) + float(found[2] or 5)
    return number, CLASSES[luminosity[1].lower()] if luminosity else 0


def library_number(name: str) -> tuple[float, int]:
    """Return a name of the library, such as b57v or m2p5v, as `type_number` does."""
    found = re.fullmatch(r"([obafgkm])(10|\d)(\d|p5)?([iv]+)", name)
    if not found:
        raise ValueError(f"{name} is no type of the library")
    first = float(found[2])
    second = first if not found[3] else first + 1.0 if found[3] == "p5" else float(found[3])
    number = 10.0 * "obafgkm".index(found[1]) + 0.5 * (first + second)
    return number, CLASSES[found[4]]


def counts(names: list[str], hip_main: Path) -> NDArray[np.int64]:
    """Return how many Hipparcos stars are nearest to each type of the library."""
    numbers = np.array([library_number(name) for name in names])
    count = np.zeros(len(names), dtype=np.int64)
    with gzip.open(hip_main, "rt", encoding="latin-1") as lines:
        for line in lines:
            parsed = type_number(line.split("|")[76].strip())
            if parsed is None:
                continue
            number, luminosity = parsed
            # Without a class: dwarfs up to K4, giants beyond, as in a catalog of bright stars.
            wanted = luminosity or (3 if number >= 45 else 5)
            apart = np.abs(numbers[:, 1] - wanted)
            weight = 0.3 * apart if not luminosity else 0.5 * apart + 3.0 * (apart > 0)
            count[np.argmin(np.abs(numbers[:, 0] - number) + weight)] += 1
    return count


def write_spectra(catalogs: Path, folder: Path) -> None:
    """Write spectra.csv.gz and types.csv."""
    spectra = library(catalogs / "pickles_uvklib.tar.xz")
    columns = [averaged(rows[0], rows[1]) for rows in spectra.values()]
    lines = [",".join(["wavelength_nm", "deviation", *spectra])]
    for row in zip(WAVELENGTH_NM, deviations(spectra), *columns, strict=True):
        lines.append(",".join([f"{row[0]:g}", f"{row[1]:.4f}", *(f"{x:.5g}" for x in row[2:])]))
    text = SPECTRA_HEADER + "\n".join(lines) + "\n"
    (folder / "spectra.csv.gz").write_bytes(gzip.compress(text.encode(), 9, mtime=0))
    count = counts(list(spectra), catalogs / "hip_main.dat.gz")
    rows = [f"{name},{number}" for name, number in zip(spectra, count, strict=True)]
    text = TYPES_HEADER + "\n".join(["type,stars", *rows]) + "\n"
    (folder / "types.csv").write_text(text, encoding="utf-8")


def write_reference(vega: Path, folder: Path) -> None:
    """Write reference.csv."""
    from astropy.io import fits
    from extinction import fitzpatrick99  # type: ignore[import-not-found]

    with fits.open(vega) as found:
        rows = found[1].data
        wavelength_nm = np.asarray(rows["WAVELENGTH"], dtype=np.float64) / 10.0
        flux = averaged(wavelength_nm, np.asarray(rows["FLUX"], dtype=np.float64))
    law = fitzpatrick99(WAVELENGTH_NM * 10.0, 3.1, 3.1)
    rows = zip(WAVELENGTH_NM, flux, law, strict=True)
    lines = [f"{a:g},{b:.6g},{c:.5f}" for a, b, c in rows]
    text = REFERENCE_HEADER + "\n".join(["wavelength_nm,vega,extinction", *lines]) + "\n"
    (folder / "reference.csv").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    {"spectra": write_spectra, "reference": write_reference}[sys.argv[1]](Path(sys.argv[2]), DATA)
