"""Measures the errors of magnitudes in a sensor's band, and prints how honest they are.

``python tools/band_errors.py fit CATALOGS`` writes ``relation_errors.csv`` and
``star_errors.csv`` of `starcat.catalog.bands` from the genuine records of a folder
(``hip_main.dat.gz``, ``tyc_main.dat.gz``, ``psc_measured.gz``, ``wds_hip.dat.gz``,
``gcvs.tsv.gz``) and the embedded sky. Every second star is used for the fit; the others validate
it.

``python tools/band_errors.py table CATALOGS`` prints chi-square per star by colour for Hp,
VT and J, for single and for flagged stars, for both halves.
"""

from __future__ import annotations

import gzip
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise, product
from pathlib import Path
from unittest import mock

import numpy as np
import pyarrow as pa
from band_pairs import NOT_SOUND, nearest, read_stars, single_and_constant
from numpy.typing import NDArray
from scipy.optimize import brentq

from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.bands import measured
from starcat.catalog.bands.measured import companion_light
from starcat.catalog.bands.photometry import band_error, variability_error
from starcat.catalog.bands.relation import relation
from starcat.catalog.bands.response import shipped
from starcat.catalog.sensor_band import companion_doubt, in_sensor_band
from starcat.catalog.stars.star_table import directions_of, floats_of, with_columns

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

DATA = Path(__file__).parents[1] / "starcat" / "bands" / "data"

EDGES = {
    "BP-RP": (-0.5, 0.0, 0.5, 1.0, 1.5, 2.0, 6.0),
    "B-V": (-0.5, 0.0, 0.4, 0.8, 1.2, 3.0),
    "V-I": (-0.5, 0.0, 0.4, 0.8, 1.2, 6.0),
    "BT-VT": (-0.5, 0.0, 0.5, 1.0, 1.5, 4.0),
    "J-Ks": (-0.3, 0.2, 0.5, 2.0),
}
INFRARED = ("J", "H", "Ks")
PAIRS = {
    "BP-RP": (("G", "BP", "RP"), ("Hp", "V", "BT", "VT", *INFRARED)),
    "B-V": (("V", "Hp", "B"), ("G", *INFRARED)),
    "V-I": (("V", "Hp", "I"), ("G", *INFRARED)),
    "BT-VT": (("BT", "VT"), ("Hp", "G", *INFRARED)),
    "J-Ks": (INFRARED, ("Hp", "V", "BT", "VT", "G")),
}
"""By colour the base bands and the bands that they predict: only bands of another instrument, as
V and B-V of Hipparcos were computed from Hp, BT and VT."""


FEWEST = 12
"""A bin of colours has at least this many stars of the fit; smaller bins join the next bin."""

CLOSE_PAIR_ARCSEC = 5.0
OUTLIER = 8.0
"""Single stars that are off by this many errors are left out of the fit; the table counts them."""

SEPARATIONS_ARCSEC = (0.0, 0.15, 0.5, 1000.0)
RED_MAG = (1.0, 1.5, 6.0)
"""Limits of BP-RP between which stars are red, and most of them giants."""

RELATIONS_HEADER = """\
# Measured errors of relations over the errors computed from the library of spectra, by colour: a
# factor for each base band, colour and band of a catalog that it predicts. Measured for {stars}
# single and constant stars of Hipparcos and Tycho-1, Gaia and 2MASS, of which every second was
# used. Made by tools/band_errors.py.
"""
STARS_HEADER = """\
# What companions and variability add to the error of a magnitude, measured as Hp minus Hp predicted
# from Gaia's G and BP-RP, for every second flagged star of Hipparcos. companion_share: the share of
# the light of a companion of known magnitude difference, by separation in arcsec. The next three
# are standard deviations in mag: companion of unknown difference, in a list without a flag,
# and variable of unknown amplitude. The factor `colour_share` is for the errors of companions, by
# BP-RP in mag, from VT as well as Hp.
# Made by tools/band_errors.py.
"""


@dataclass(frozen=True)
class Sample:
    """Stars that several catalogs measured."""

    table: pa.Table  # rows of Hipparcos or Tycho-1, magnitudes in V
    gaia: pa.Table  # the same stars in the embedded sky, flags of Hipparcos joined
    mag: dict[str, Array]  # by band; NaN if not measured
    error: dict[str, Array]  # stated by the catalog, else its usual error
    is_single: Mask  # constant light, and in no list of doubles
    is_unflagged: Mask  # no flag of a double or variable star

    def single_in(self, *bands: str) -> Mask:
        """Return the single stars for a comparison; few were measured in the infrared."""
        return self.is_unflagged if set(bands) & set(INFRARED) else self.is_single

    def fitted(self) -> Mask:
        """Return which stars are for the fit; the others validate it."""
        return np.arange(len(self.is_single)) % 2 == 1


@cache
def sample(catalogs: Path, *, infrared: bool = False) -> Sample:
    """Return the stars of Hipparcos to V 6.6, for the infrared the stars of Tycho-1 to V 8."""
    source, name = ("tycho1", "tyc_main.dat.gz") if infrared else ("hipparcos", "hip_main.dat.gz")
    read = {b: read_stars(source, catalogs / name, b, 2016.0) for b in ("V", "BT", "VT")}
    if not infrared:
        read["Hp"] = read_stars(source, catalogs / name, "Hp", 2016.0)
    table = read["V"]
    mag = {band: floats_of(one, "mag") for band, one in read.items()}
    error = {
        band: np.where(np.isfinite(stated), stated, band_error(band, mag[band]))
        for band, stated in ((band, floats_of(one, "mag_error")) for band, one in read.items())
    }
    # A Tycho magnitude without the other one is not sound: three VT are off by 0.3 to 0.6 mag.
    both = np.isfinite(mag["BT"]) & np.isfinite(mag["VT"])
    mag |= {band: np.where(both, mag[band], np.nan) for band in ("BT", "VT")}
    mag["B"] = floats_of(table, "colour_mag") + mag["V"]
    mag["I"] = mag["V"] - floats_of(table, "second_colour_mag")
    sky = read_stars("gaia", embedded_sky(), None, 2016.0)
    place, near = nearest(directions_of(table), directions_of(sky))
    near &= sky["star_id"].to_numpy()[place] > 0  # without stars that Hipparcos itself supplied
    gaia = sky.take(pa.array(place))
    mag["G"] = np.where(near, floats_of(gaia, "mag"), np.nan)
    mag["BP"] = np.where(near, floats_of(gaia, "second_mag"), np.nan)
    mag["RP"] = mag["BP"] - floats_of(gaia, "colour_mag")
    for band, one, found in _infrared(catalogs, source, name):
        mag[band] = np.where(found, floats_of(one, "mag"), np.nan)
    for band in mag:
        error.setdefault(band, band_error(band, mag[band]))
    flags = {
        name: table[name]
        for name in (
            "is_flagged_double", "double_flag", "companion_separation_arcsec",
            "companion_delta_mag", "is_flagged_variable", "amplitude_mag",
        )
    }  # fmt: skip
    known = {"mag": mag["G"], "second_mag": mag["BP"]}
    gaia = with_columns(gaia, {**flags, **known})
    unflagged = ~(table["is_flagged_double"].to_numpy() | table["is_flagged_variable"].to_numpy())
    return Sample(table, gaia, mag, error, _is_single(catalogs, table, unflagged), unflagged)


def _infrared(catalogs: Path, source: str, name: str) -> Iterator[tuple[str, pa.Table, Mask]]:
    u = directions_of(read_stars(source, catalogs / name, "V", 1999.5))
    for band in INFRARED:
        one = read_stars("2mass", catalogs / "psc_measured.gz", band, None)
        place, near = nearest(u, directions_of(one))
        one = one.take(pa.array(place))
        yield band, one, near & (one["quality_flags"].to_numpy() & NOT_SOUND == 0)


def _is_single(catalogs: Path, table: pa.Table, unflagged: Mask) -> Mask:
    """Return which stars no list calls double or variable."""
    hip = np.nan_to_num(floats_of(table, "hip_number")).astype(np.int64)
    named = [*close_pairs(catalogs), *variables(catalogs)]
    known = single_and_constant(catalogs / "hip_main.dat.gz")
    return np.asarray(unflagged & np.isin(hip, known) & ~np.isin(hip, named))


def close_pairs(catalogs: Path) -> Iterator[int]:
    """Give the Hipparcos numbers of the WDS pairs that are close."""
    with gzip.open(catalogs / "wds_hip.dat.gz", "rt", encoding="latin-1") as lines:
        for line in lines:
            cells = line.split()
            if len(cells) == 5 and cells[0].isdigit() and float(cells[4]) < CLOSE_PAIR_ARCSEC:
                yield int(cells[0])


def variables(catalogs: Path) -> Iterator[int]:
    """Give the Hipparcos numbers of the stars of the GCVS."""
    with gzip.open(catalogs / "gcvs.tsv.gz", "rt", encoding="utf-8") as lines:
        for line in lines:
            number = line.split("\t")[0]
            if number.isdigit() and int(number) < 1_000_000:
                yield int(number)


def solved(residual: Array, fixed: Array, scale: Array) -> float:
    """Return x so that the mean of residual^2 / (fixed^2 + (x scale)^2) is 1; 0 if none is."""

    def excess(x: float) -> float:
        return float(np.mean(residual**2 / (fixed**2 + (x * scale) ** 2))) - 1.0

    return float(brentq(excess, 0.0, 1000.0)) if excess(0.0) > 0.0 else 0.0


# --- The fit


def _bins(colour: Array, edges: tuple[float, ...]) -> list[tuple[float, float]]:
    """Return bins of colours with enough stars each."""
    found: list[tuple[float, float]] = []
    low = edges[0]
    for high in edges[1:]:
        if np.count_nonzero((colour >= low) & (colour < high)) >= FEWEST:
            found.append((low, high))
            low = high
    if found:
        found[-1] = (found[-1][0], edges[-1])
    return found


def relation_rows(catalogs: Path) -> Iterator[str]:
    """Give the rows of relation_errors.csv."""
    for text, (bases, targets) in PAIRS.items():
        first, second = text.split("-")
        for base, target in product(bases, targets):
            bands = {base, first, second, target}
            # Few stars of Hipparcos are faint enough for 2MASS.
            is_deep = bool(bands & set(INFRARED)) and not bands & {"Hp", "I"}
            stars = sample(catalogs, infrared=is_deep)
            yield from _rows_of(stars, base, (first, second), target)


def _rows_of(stars: Sample, base: str, colour: tuple[str, str], target: str) -> Iterator[str]:
    made = relation(base, colour, shipped(target))
    x = stars.mag[colour[0]] - stars.mag[colour[1]]
    nothing = np.zeros(len(x))
    residual = stars.mag[target] - made.predict(stars.mag[base], x, nothing, nothing).mag
    computed = np.interp(x, made.colour_mag, made.computed_error_mag)
    colour_error = np.hypot(*(band_error(band, stars.mag[base]) for band in colour))
    fixed = np.sqrt(
        stars.error[base] ** 2
        + stars.error[target] ** 2
        + (np.interp(x, made.colour_mag, made.slope) * colour_error) ** 2
    )
    used = stars.single_in(base, target) & stars.fitted() & np.isfinite(residual) & np.isfinite(x)
    used &= np.abs(residual) < OUTLIER * np.hypot(computed, fixed)
    text = "-".join(colour)
    for low, high in _bins(x[used], EDGES[text]):
        rows = used & (x >= low) & (x < high)
        factor = solved(residual[rows], fixed[rows], computed[rows])
        yield f"{base},{text},{target},{low:g},{rows.sum()},{factor:.2f}"


def star_rows(catalogs: Path) -> Iterator[str]:
    """Give the rows of star_errors.csv."""
    stars = sample(catalogs)
    colour = stars.mag["BP"] - stars.mag["RP"]
    colour_error = np.hypot(*(band_error(band, stars.mag["G"]) for band in ("BP", "RP")))
    made = relation("G", ("BP", "RP"), shipped("Hp")).predict(
        stars.mag["G"], colour, stars.error["G"], colour_error
    )
    residual = np.where(made.has_colour, stars.mag["Hp"] - made.mag, np.nan)
    fixed = np.hypot(made.error_mag, stars.error["Hp"])
    double, variable = (
        stars.gaia[name].to_numpy() for name in ("is_flagged_double", "is_flagged_variable")
    )
    listed = stars.gaia["double_flag"].is_valid().to_numpy() & ~double
    used = stars.fitted() & np.isfinite(residual)
    apart, delta = (
        floats_of(stars.gaia, f"companion_{name}") for name in ("separation_arcsec", "delta_mag")
    )
    light = companion_light(delta)
    whole = np.hypot(fixed, variability_error(floats_of(stars.gaia, "amplitude_mag")))
    usual = used & double & np.isfinite(light)
    usual &= np.abs(residual) < OUTLIER * np.hypot(whole, light)
    for low, high in pairwise(SEPARATIONS_ARCSEC):
        rows = usual & (apart >= low) & (apart < high)
        share = solved(residual[rows], whole[rows], light[rows])
        yield f"companion_share,{low:g},{high:g},{rows.sum()},{share:.2f}"
    one = np.ones(len(residual))
    states = {
        "companion": (double & ~np.isfinite(light), whole),
        "listed": (listed, whole),
        "variable": (variable & ~double & ~listed, fixed),
    }
    for state, (mask, known) in states.items():
        rows = used & mask
        yield f"{state},,,{rows.sum()},{solved(residual[rows], known[rows], one[rows]):.3f}"


def colour_rows(catalogs: Path) -> Iterator[str]:
    """Give the rows of star_errors.csv by colour, from Hp and VT, with the other rows in use."""
    stars = sample(catalogs)
    companions = companion_doubt(stars.gaia)
    used = (companions > 0.0) & ~stars.gaia["is_flagged_variable"].to_numpy() & stars.fitted()
    _, residual, error, colour = (
        np.concatenate(one)
        for one in zip(*((used, *case.judged(catalogs)[1:]) for case in CASES[:2]), strict=True)
    )
    used, companions = np.tile(used, 2), np.tile(companions, 2)
    used &= np.isfinite(residual) & (np.abs(residual) < OUTLIER * error)
    fixed = np.sqrt(np.maximum(error**2 - companions**2, 0.0))
    for low, high in pairwise(RED_MAG):
        rows = used & (colour >= low) & (colour < high)
        share = solved(residual[rows], fixed[rows], companions[rows])
        yield f"colour_share,{low:g},{high:g},{rows.sum()},{share:.2f}"


RELATIONS_COLUMNS = "base,colour,target,low_mag,stars,factor"
STARS_COLUMNS = "state,low,high,stars,value"


def tables(catalogs: Path) -> dict[str, str]:
    """Return the contents of both tables by name; what ships with starcat is not used."""
    with mock.patch.object(measured, "relation_errors", return_value={}):
        relations = list(relation_rows(catalogs))
    bins = measured.bands_in_bins([row.split(",") for row in relations])
    with mock.patch.object(measured, "relation_errors", return_value=bins):
        stars = list(star_rows(catalogs))
        states = measured.states_of([row.split(",") for row in stars])
        states[measured.COLOUR_SHARE] = np.empty((0, 3))
        with mock.patch.object(measured, "star_errors", return_value=states):
            stars += colour_rows(catalogs)
    header = RELATIONS_HEADER.format(stars=f"{sample(catalogs).is_single.sum():,}")
    return {
        "relation_errors.csv": header + "\n".join([RELATIONS_COLUMNS, *relations]) + "\n",
        "star_errors.csv": STARS_HEADER + "\n".join([STARS_COLUMNS, *stars]) + "\n",
    }


# --- The validation


@dataclass(frozen=True)
class Case:
    """One prediction that the table judges."""

    title: str
    source: str
    target: str
    colour: str
    infrared: bool = False

    def judged(self, catalogs: Path) -> tuple[Sample, Array, Array, Array]:
        """Return the stars, measured minus predicted, stated errors of it, and colours."""
        stars = sample(catalogs, infrared=self.infrared)
        table = stars.gaia if self.source == "gaia" else stars.table
        made = in_sensor_band(table, self.source, shipped(self.target)).stars
        residual = stars.mag[self.target] - floats_of(made, "mag")
        error = np.hypot(floats_of(made, "mag_error"), stars.error[self.target])
        first, second = self.colour.split("-")
        return stars, residual, error, stars.mag[first] - stars.mag[second]


CASES = (
    Case("Hp from Gaia", "gaia", "Hp", "BP-RP"),
    Case("VT from Gaia", "gaia", "VT", "BP-RP"),
    Case("J from Gaia", "gaia", "J", "BP-RP", infrared=True),
    Case("J from Hipparcos (V, V-I)", "hipparcos", "J", "V-I"),
    Case("J from Tycho-1 (V, B-V)", "tycho1", "J", "B-V", infrared=True),
)


@dataclass(frozen=True)
class Line:
    """A bin of colours of one case."""

    case: Case
    low: float
    high: float
    residual: Array
    error: Array

    @property
    def z(self) -> Array:
        return np.asarray(self.residual / self.error)

    @property
    def chi_square(self) -> float:
        return float(np.mean(self.z**2))

    @property
    def usual_chi_square(self) -> float:
        """Without the stars that are off by `OUTLIER` stated errors."""
        return float(np.mean(self.z[np.abs(self.z) < OUTLIER] ** 2))

    @property
    def outliers(self) -> int:
        return int(np.count_nonzero(np.abs(self.z) >= OUTLIER))


def lines(
    catalogs: Path, case: Case, wanted: Callable[[Sample, str], Mask], *, fewest: int = FEWEST
) -> Iterator[Line]:
    """Give the bins of a case for some of the stars."""
    stars, residual, error, x = case.judged(catalogs)
    rows = wanted(stars, case.target) & np.isfinite(residual) & np.isfinite(error) & np.isfinite(x)
    for low, high in pairwise(EDGES[case.colour]):
        inside = rows & (x >= low) & (x < high)
        if inside.sum() >= fewest:
            yield Line(case, low, high, residual[inside], error[inside])


def single(stars: Sample, target: str) -> Mask:
    """Single and constant stars of the half that was not used for the fit."""
    return stars.single_in(target) & ~stars.fitted()


def single_fitted(stars: Sample, target: str) -> Mask:
    """Single and constant stars of the half that was used for the fit."""
    return stars.single_in(target) & stars.fitted()


def flagged(stars: Sample, _: str) -> Mask:
    """Stars with a flag of a double or variable star, of the half not used for the fit."""
    return _flagged(stars) & ~stars.fitted()


def flagged_fitted(stars: Sample, _: str) -> Mask:
    """Stars with a flag of a double or variable star, of the half used for the fit."""
    return _flagged(stars) & stars.fitted()


def _flagged(stars: Sample) -> Mask:
    return np.asarray(~stars.is_unflagged | stars.table["double_flag"].is_valid().to_numpy())


def table(catalogs: Path) -> str:
    """Return the table of chi-square per star."""
    out = [
        "| prediction | stars | colour | n | rms mag | mean error | chi-square | without outliers "
        "| outliers |",
        "|---" * 9 + "|",
    ]
    for wanted in (single, single_fitted, flagged, flagged_fitted):
        for case in CASES:
            for one in lines(catalogs, case, wanted):
                rms = float(np.sqrt(np.mean(one.residual**2)))
                out.append(
                    f"| {case.title} | {wanted.__name__} | {case.colour} {one.low:g} to "
                    f"{one.high:g} | {len(one.z):,} | {rms:.3f} | {one.error.mean():.3f} | "
                    f"{one.chi_square:.2f} | {one.usual_chi_square:.2f} | {one.outliers} |"
                )
    return "\n".join(out)


if __name__ == "__main__":
    if sys.argv[1] == "fit":
        for name, text in tables(Path(sys.argv[2])).items():
            (DATA / name).write_text(text, encoding="utf-8")
    else:
        sys.stdout.write(table(Path(sys.argv[2])) + "\n")
