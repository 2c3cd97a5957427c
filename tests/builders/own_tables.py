"""Tables that starcat has never seen: one sky in nine formats, with odd names, units and frames.

Each table comes with the map that makes it a source, and with what its columns mean, by which a
draft of the map is counted. Frames are turned by ERFA and astropy, not by starcat.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import erfa
import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
import pyarrow.parquet as pq
from astropy import units as u
from astropy.coordinates import FK5, ICRS, Angle, Galactic, SkyCoord
from astropy.io import fits
from astropy.io.votable import from_table
from astropy.table import MaskedColumn, Table
from astropy.time import Time
from hats_stores import write_catalog

MAS = np.pi / 648_000_000.0
COUNT = 240
NO_MOTION, NO_MAG, NO_PLACE = 5, 6, 7
"""Rows with missing values; the last row repeats the first."""


@dataclass(frozen=True)
class Sky:
    """Stars as they are: ICRS at J2000."""

    ids: np.ndarray
    ra: np.ndarray
    dec: np.ndarray
    pm_ra: np.ndarray
    pm_dec: np.ndarray
    v: np.ndarray
    b: np.ndarray
    is_double: np.ndarray
    is_variable: np.ndarray

    def at(self, jyear: float) -> tuple[np.ndarray, ...]:
        """Return positions in degrees and motions at another time, by ERFA."""
        zero, far = np.zeros(COUNT), np.full(COUNT, 0.01)
        found = erfa.pmsafe(
            np.radians(self.ra), np.radians(self.dec),
            self.pm_ra * MAS / np.cos(np.radians(self.dec)), self.pm_dec * MAS, far, zero,
            2451545.0, 0.0, 2451545.0, (jyear - 2000.0) * 365.25,
        )  # fmt: skip
        ra, dec, pm_ra, pm_dec = found[:4]
        return np.degrees(ra), np.degrees(dec), pm_ra * np.cos(dec) / MAS, pm_dec / MAS

    def fk5(self) -> tuple[np.ndarray, ...]:
        """Return places and motions in FK5 at J2000, radians, by ERFA, of stars at 100 pc."""
        ra, dec, pm_ra, pm_dec = self.at(2000.0)
        dec = np.radians(dec)
        pm = (pm_ra * MAS / np.cos(dec), pm_dec * MAS)
        return tuple(erfa.h2fk5(np.radians(ra), dec, *pm, np.full(COUNT, 0.01), np.zeros(COUNT)))


def make_sky() -> Sky:
    """Return the sky of all tables."""
    rng = np.random.default_rng(25)
    v = rng.uniform(2.0, 9.0, COUNT)
    columns = (
        rng.permutation(np.arange(1001, 1001 + COUNT)), rng.uniform(0.0, 360.0, COUNT),
        np.degrees(np.arcsin(rng.uniform(-0.98, 0.98, COUNT))), rng.normal(0.0, 80.0, COUNT),
        rng.normal(0.0, 80.0, COUNT), v, v + rng.uniform(-0.1, 1.5, COUNT),
        rng.random(COUNT) < 0.1, rng.random(COUNT) < 0.1,
    )  # fmt: skip
    for values in columns:
        values[-1] = values[0]
    return Sky(*columns)


@dataclass(frozen=True)
class Case:
    """A table, its map, and what a draft should find."""

    name: str
    make: Callable[[Sky, Path], Path]  # writes the table into a folder
    epoch_jyear: float
    toml: str
    meant: dict[str, str]  # key of the map by column; several columns may make one value
    has_motion: bool = True
    arcsec: float = 1e-3  # how well positions agree
    mas_yr: float = 0.01


def _blank(values: np.ndarray, row: int, shown: str = "") -> list[str]:
    return [shown if n == row else str(value) for n, value in enumerate(values)]


def _sexagesimal(degrees: np.ndarray, hours: bool) -> list[str]:
    unit = u.hourangle if hours else u.deg
    angles = Angle((degrees * u.deg).to(unit))
    return list(angles.to_string(sep=":", precision=8, alwayssign=not hours, pad=True))


def semicolons(sky: Sky, folder: Path) -> Path:
    """CSV with semicolons, texts of hours and degrees, FK5, thousandths of magnitudes."""
    r, d, dr, dd, _, _ = sky.fk5()
    rows = zip(
        sky.ids, _blank(_sexagesimal(np.degrees(r), True), NO_PLACE),
        _sexagesimal(np.degrees(d), False),
        _blank(dr / MAS / 15.0 * 1e-3, NO_MOTION, "NULL"), dd / MAS * 1e-3,
        _blank(sky.v * 1e3, NO_MAG), np.where(sky.is_double, "D", ""), strict=True,
    )  # fmt: skip
    head = "Star No;R.A. 2000;Decl. 2000;mu alpha [s/yr];mu delta [arcsec/yr];mV [mmag];Double?"
    path = folder / "mycat.csv"
    path.write_text("\n".join([head, *(";".join(map(str, row)) for row in rows)]) + "\n")
    return path


def old_plates(sky: Sky, folder: Path) -> Path:
    """ECSV in the FK4 system of B1950."""
    r, d, dr, dd, _, _ = erfa.fk524(*sky.fk5())
    table = Table()
    table["nr"] = [f"P{n}" for n in sky.ids]
    table["alpha1950"] = MaskedColumn(np.degrees(r), unit="deg", mask=np.arange(COUNT) == NO_PLACE)
    table["delta1950"] = np.degrees(d) * u.deg
    table["mu_a_cosd"] = MaskedColumn(
        dr * np.cos(d) / MAS * 1e-3, unit="arcsec/yr", mask=np.arange(COUNT) == NO_MOTION
    )
    table["mu_d"] = dd / MAS * 1e-3 * u.arcsec / u.yr
    table["mpg"] = MaskedColumn(sky.b, unit="mag", mask=np.arange(COUNT) == NO_MAG)
    table["m_vis"] = MaskedColumn(sky.v, unit="mag", mask=np.arange(COUNT) == NO_MAG)
    table["var"] = sky.is_variable
    path = folder / "plates.ecsv"
    table.write(path, format="ascii.ecsv", delimiter=",")
    return path


def galactic(sky: Sky, folder: Path) -> Path:
    """FITS in galactic coordinates, radians, whole numbers with a null."""
    ra, dec, pm_ra, pm_dec = sky.at(1991.25)
    place = SkyCoord(
        ra * u.deg,
        dec * u.deg,
        pm_ra_cosdec=pm_ra * u.mas / u.yr,
        pm_dec=pm_dec * u.mas / u.yr,
        frame=ICRS,
    ).transform_to(Galactic())
    lon = np.where(np.arange(COUNT) == NO_PLACE, np.nan, place.l.rad)
    pm = np.where(np.arange(COUNT) == NO_MOTION, np.nan, place.pm_l_cosb.to_value("arcsec/yr"))
    mags = np.where(np.arange(COUNT) == NO_MAG, -9999, np.round(sky.v * 1000)).astype(np.int16)
    columns = [
        fits.Column("IDENT", "12A", array=[f"{n}" for n in sky.ids]),
        fits.Column("GLON", "D", "rad", array=lon),
        fits.Column("GLAT", "D", "rad", array=place.b.rad),
        fits.Column("PM_L_COSB", "D", "arcsec/yr", array=pm),
        fits.Column("PM_B", "D", "arcsec/yr", array=place.pm_b.to_value("arcsec/yr")),
        fits.Column("VMAG", "I", "mmag", null=-9999, array=mags),
        fits.Column("E_VMAG", "E", "mag", array=np.full(COUNT, 0.02)),
        fits.Column("DUP", "L", array=sky.is_double),
        fits.Column("SPECTRUM", "100E", array=np.zeros((COUNT, 100))),
    ]
    path = folder / "galaxy.fits"
    fits.BinTableHDU.from_columns(columns, name="STARS").writeto(path)
    return path


def observatory(sky: Sky, folder: Path) -> Path:
    """VOTable with UCDs; the names say nothing."""
    ra, dec, pm_ra, pm_dec = sky.at(2016.0)
    table = Table()
    meant = (
        ("c1", sky.ids, "", "meta.id;meta.main", -1),
        ("c2", ra, "deg", "pos.eq.ra;meta.main", NO_PLACE),
        ("c3", dec, "deg", "pos.eq.dec;meta.main", -1),
        ("c4", pm_ra, "mas/yr", "pos.pm;pos.eq.ra", NO_MOTION),
        ("c5", pm_dec, "mas/yr", "pos.pm;pos.eq.dec", -1),
        ("c6", sky.v, "mag", "phot.mag;em.opt.V", NO_MAG),
        ("c7", sky.b, "mag", "phot.mag;em.opt.B", NO_MAG),
        ("c8", np.full(COUNT, 3.0), "mas", "pos.parallax.trig", -1),
        ("c9", sky.is_variable.astype(np.int16), "", "src.var", -1),
    )
    for name, values, unit, _, blank in meant:
        table[name] = MaskedColumn(values, unit=unit or None, mask=np.arange(COUNT) == blank)
    made = from_table(table)
    for field, row in zip(made.get_first_table().fields, meant, strict=True):
        field.ucd = row[3]
    path = folder / "observatory.vot"
    made.to_xml(str(path))
    return path


def ipac(sky: Sky, folder: Path) -> Path:
    """IPAC table, as IRSA writes them, by astropy."""
    ra, dec, pm_ra, pm_dec = sky.at(2000.0)
    rows = np.arange(COUNT)
    table = Table({
        "ra": MaskedColumn(ra, unit="deg", mask=rows == NO_PLACE),
        "dec": MaskedColumn(dec, unit="deg", mask=rows == NO_PLACE),
        "designation": [f"P{n}" for n in sky.ids],
        "pmra": MaskedColumn(pm_ra, unit="mas/yr", mask=rows == NO_MOTION),
        "pmdec": MaskedColumn(pm_dec, unit="mas/yr", mask=rows == NO_MOTION),
        "j_m": MaskedColumn(sky.v, unit="mag", mask=rows == NO_MAG),
        "h_m": MaskedColumn(sky.b, unit="mag", mask=rows == NO_MAG),
        "j_msigcom": MaskedColumn(np.full(COUNT, 0.02), unit="mag"),
        "dup": sky.is_double.astype(np.int64),
        "vflag": ["V" if one else "" for one in sky.is_variable],
    })  # fmt: skip
    table.meta["comments"] = ["of all sky"]
    path = folder / "irsa.tbl"
    table.write(path, format="ascii.ipac")
    return path


def fluxes(sky: Sky, folder: Path) -> Path:
    """Parquet with fluxes, a date for each position, and names for identifiers."""
    ra, dec, pm_ra, pm_dec = sky.at(2010.5)
    flux = 3631e9 * 10 ** (-0.4 * sky.v)
    rows = np.arange(COUNT)
    table = pa.table({
        "objID": [f"SURVEY J{n}+12" for n in sky.ids],
        "raMean": pa.array(ra, mask=rows == NO_PLACE),
        "decMean": dec,
        "obs_mjd": np.full(COUNT, Time(2010.5, format="jyear", scale="tt").mjd),
        "pmra": pa.array(pm_ra, mask=rows == NO_MOTION),
        "pmdec": pm_dec,
        "e_pmra": np.full(COUNT, 0.5),
        "flux_r_nJy": pa.array(flux, mask=rows == NO_MAG),
        "ruwe": np.where(sky.is_double, 3.0, 1.0),
        "neighbours": pa.array([[1, 2]] * COUNT),
    })  # fmt: skip
    path = folder / "survey.parquet"
    pq.write_table(table, path, row_group_size=100)
    return path


def precessed(sky: Sky, folder: Path) -> Path:
    """Arrow file, FK5 of another equinox, two components whose light is added."""
    ra, dec, _, _ = sky.at(1975.0)
    place = SkyCoord(ra * u.deg, dec * u.deg, frame=ICRS).transform_to(FK5(equinox="J1975"))
    rows = np.arange(COUNT)
    light = 10 ** (-0.4 * sky.v)
    one, two = -2.5 * np.log10(0.7 * light), -2.5 * np.log10(0.3 * light)
    table = pa.table({
        "HD": sky.ids.astype(np.int32),
        "RA1975": pa.array(place.ra.hour, mask=rows == NO_PLACE),
        "DE1975": place.dec.deg,
        "Vmag A": pa.array(one, mask=rows == NO_MAG),
        "Vmag B": two,
        "mult": pa.array(np.where(sky.is_double, "M", "S")).dictionary_encode(),
        "vflag": np.where(sky.is_variable, 2, 0),
    })  # fmt: skip
    path = folder / "epoch1975.arrow"
    feather.write_feather(table, path, compression="uncompressed")
    return path


def lsdb(sky: Sky, folder: Path) -> Path:
    """A HATS catalog with the names of Gaia DR3."""
    ra, dec, pm_ra, pm_dec = sky.at(2016.0)
    rows = np.arange(COUNT)
    table = pa.table({
        "source_id": sky.ids.astype(np.int64),
        "ra": ra, "dec": dec,
        "pmra": pa.array(pm_ra, mask=rows == NO_MOTION), "pmdec": pa.array(pm_dec),
        "ra_error": np.full(COUNT, 0.02), "dec_error": np.full(COUNT, 0.03),
        "pmra_error": np.full(COUNT, 0.02), "pmdec_error": np.full(COUNT, 0.02),
        "parallax": np.full(COUNT, 2.0), "parallax_error": np.full(COUNT, 0.1),
        "radial_velocity": np.full(COUNT, np.nan), "ruwe": np.where(sky.is_double, 3.0, 1.0),
        "phot_g_mean_mag": pa.array(sky.v, mask=rows == NO_MAG),
        "phot_bp_mean_mag": sky.b, "phot_rp_mean_mag": sky.v - 0.5,
        "phot_g_mean_flux_over_error": np.full(COUNT, 500.0),
        "phot_bp_mean_flux_over_error": np.full(COUNT, 200.0),
        "phot_rp_mean_flux_over_error": np.full(COUNT, 200.0),
        "phot_variable_flag": np.where(sky.is_variable, "VARIABLE", "NOT_AVAILABLE"),
        "non_single_star": np.zeros(COUNT, np.int16),
        "in_qso_candidates": np.zeros(COUNT, bool), "in_galaxy_candidates": np.zeros(COUNT, bool),
    })  # fmt: skip
    path = folder / "gaia_hats"
    write_catalog(table.append_column("ra_deg", [ra]).append_column("dec_deg", [dec]), path, 100)
    return path


def vizier(sky: Sky, folder: Path) -> Path:
    """TSV, gzipped, as VizieR writes it: comments, a line of units, hours, minutes."""
    ra, dec, pm_ra, pm_dec = sky.at(2000.0)
    hours = ra / 15.0
    size = np.abs(dec)
    columns = {
        "recno": ("", sky.ids), "RAh": ("h", np.floor(hours)),
        "RAm": ("min", np.floor(hours % 1 * 60)), "RAs": ("s", hours * 60 % 1 * 60),
        "DE-": ("", np.where(dec < 0, "-", "+")), "DEd": ("deg", np.floor(size)),
        "DEm": ("arcmin", np.floor(size % 1 * 60)), "DEs": ("arcsec", size * 60 % 1 * 60),
        "pmRA": ("mas/yr", _blank(pm_ra, NO_MOTION)), "pmDE": ("mas/yr", pm_dec),
        "Bmag": ("mag", sky.b), "Vmag": ("mag", _blank(sky.v, NO_MAG)),
        "e_Vmag": ("mag", np.full(COUNT, 0.01)), "HIP": ("", sky.ids),
        "SpType": ("", np.full(COUNT, "G2V")),
    }  # fmt: skip
    columns["RAh"] = ("h", _blank(columns["RAh"][1], NO_PLACE))
    lines = ["#RESOURCE=table of VizieR", "#INFO", "\t".join(columns)]
    lines += ["\t".join(unit for unit, _ in columns.values()), "\t".join("---" for _ in columns)]
    lines += [
        "\t".join(map(str, row)) for row in zip(*(v for _, v in columns.values()), strict=True)
    ]
    path = folder / "asu.tsv.gz"
    path.write_bytes(gzip.compress(("\n".join(lines) + "\n").encode(), mtime=0))
    return path


CASES = (
    Case("csv", semicolons, 2000.0, """
name = "mine"
frame = "FK5"
epoch = "J2000"
[columns]
star_id = "Star No"
ra = "R.A. 2000"
dec = "Decl. 2000"
pm_ra = { value = "mu alpha [s/yr]", unit = "s/yr" }
pm_dec = { value = "mu delta [arcsec/yr]", unit = "arcsec/yr" }
[magnitudes]
V = { value = "mV [mmag]", unit = "0.001 mag" }
[flags]
double = "\\"Double?\\" = 'D'"
""", {
        "Star No": "star_id", "R.A. 2000": "ra", "Decl. 2000": "dec", "mu alpha [s/yr]": "pm_ra",
        "mu delta [arcsec/yr]": "pm_dec", "mV [mmag]": "magnitudes.V", "Double?": "flags.double",
    }, mas_yr=0.05),
    Case("ecsv", old_plates, float(Time("B1950").jyear), """
name = "plates"
frame = "FK4"
epoch = "B1950"
[columns]
star_id = "nr"
ra = "alpha1950"
dec = "delta1950"
pm_ra_cosdec = "mu_a_cosd"
pm_dec = "mu_d"
[magnitudes]
V = "m_vis"
B = "mpg"
[flags]
variable = "var"
""", {
        "nr": "star_id", "alpha1950": "ra", "delta1950": "dec", "mu_a_cosd": "pm_ra_cosdec",
        "mu_d": "pm_dec", "mpg": "magnitudes.pg", "m_vis": "magnitudes.V", "var": "flags.variable",
    }, arcsec=0.003, mas_yr=0.2),
    Case("fits", galactic, 1991.25, """
name = "galaxy"
frame = "galactic"
epoch = 1991.25
table = "STARS"
[columns]
star_id = "IDENT"
ra = "GLON"
dec = "GLAT"
pm_ra_cosdec = "PM_L_COSB"
pm_dec = "PM_B"
[magnitudes]
V = "VMAG"
[magnitude_errors]
V = "E_VMAG"
[flags]
double = "DUP"
""", {
        "IDENT": "star_id", "GLON": "ra", "GLAT": "dec", "PM_L_COSB": "pm_ra_cosdec",
        "PM_B": "pm_dec",
        "VMAG": "magnitudes.V", "E_VMAG": "magnitude_errors.V", "DUP": "flags.double",
    }),
    Case("votable", observatory, 2016.0, """
name = "observatory"
epoch = 2016.0
[columns]
star_id = "c1"
ra = "c2"
dec = "c3"
pm_ra_cosdec = "c4"
pm_dec = "c5"
parallax = "c8"
[magnitudes]
V = "c6"
B = "c7"
[flags]
variable = "c9 > 0"
""", {
        "c1": "star_id", "c2": "ra", "c3": "dec", "c4": "pm_ra_cosdec", "c5": "pm_dec",
        "c6": "magnitudes.V", "c7": "magnitudes.B", "c8": "parallax", "c9": "flags.variable",
    }),
    Case("ipac", ipac, 2000.0, """
name = "irsa"
epoch = 2000.0
[columns]
star_id = "designation"
ra = "ra"
dec = "dec"
pm_ra_cosdec = "pmra"
pm_dec = "pmdec"
[magnitudes]
J = "j_m"
H = "h_m"
[magnitude_errors]
J = "j_msigcom"
[flags]
double = "dup > 0"
variable = "vflag = 'V'"
""", {
        "ra": "ra", "dec": "dec", "designation": "star_id", "pmra": "pm_ra_cosdec",
        "pmdec": "pm_dec", "j_m": "magnitudes.J", "h_m": "magnitudes.H",
        "j_msigcom": "magnitude_errors.J", "dup": "flags.double", "vflag": "flags.variable",
    }),
    Case("parquet", fluxes, 2010.5, """
name = "survey"
epoch = { value = "obs_mjd", scale = "mjd" }
[columns]
star_id = "objID"
designation = "objID"
ra = "raMean"
dec = "decMean"
pm_ra_cosdec = { value = "pmra", unit = "mas/yr" }
pm_dec = { value = "pmdec", unit = "mas/yr" }
pm_ra_error = { value = "e_pmra", unit = "mas/yr" }
ruwe = "ruwe"
[magnitudes]
V = { value = "flux_r_nJy", unit = "nJy" }
[flags]
double = "ruwe > 1.4"
""", {
        "objID": "star_id", "raMean": "ra", "decMean": "dec", "obs_mjd": "epoch",
        "pmra": "pm_ra_cosdec", "pmdec": "pm_dec", "e_pmra": "pm_ra_error",
        "flux_r_nJy": "magnitudes.r", "ruwe": "ruwe",
    }),
    Case("arrow", precessed, 1975.0, """
name = "epoch1975"
frame = "FK5"
equinox = "J1975"
epoch = "J1975"
[columns]
star_id = "HD"
ra = { value = "RA1975", unit = "h" }
dec = "DE1975"
hd_number = "HD"
[magnitudes]
V = 'add_mags("Vmag A", "Vmag B")'
[flags]
double = "mult IN ('M', 'C')"
variable = "vflag > 0"
""", {
        "HD": "star_id", "RA1975": "ra", "DE1975": "dec", "Vmag A": "magnitudes.V",
        "Vmag B": "magnitudes.VmagB", "mult": "flags.double", "vflag": "flags.variable",
    }, has_motion=False, arcsec=0.05),
    Case("hats", lsdb, 2016.0, "", {
        "source_id": "star_id", "ra": "ra", "dec": "dec", "pmra": "pm_ra_cosdec", "pmdec": "pm_dec",
        "ra_error": "ra_error", "dec_error": "dec_error", "pmra_error": "pm_ra_error",
        "pmdec_error": "pm_dec_error", "parallax": "parallax", "parallax_error": "parallax_error",
        "radial_velocity": "radial_velocity", "ruwe": "ruwe", "phot_g_mean_mag": "magnitudes.G",
        "phot_bp_mean_mag": "magnitudes.BP", "phot_rp_mean_mag": "magnitudes.RP",
        "phot_variable_flag": "flags.variable", "non_single_star": "flags.double",
    }),
    Case("tsv", vizier, 2000.0, """
name = "asu"
epoch = 2000.0
[columns]
star_id = "recno"
ra = { value = "RAh + RAm / 60 + RAs / 3600", unit = "hourangle" }
dec = '''CASE WHEN "DE-" = '-' THEN -1 ELSE 1 END * (DEd + DEm / 60 + DEs / 3600)'''
pm_ra_cosdec = "pmRA"
pm_dec = "pmDE"
hip_number = "HIP"
spectral_type = "SpType"
[magnitudes]
V = "Vmag"
B = "Bmag"
[magnitude_errors]
V = "e_Vmag"
""", {
        "recno": "star_id", "RAh": "ra", "RAm": "ra", "RAs": "ra", "DE-": "dec", "DEd": "dec",
        "DEm": "dec", "DEs": "dec", "pmRA": "pm_ra_cosdec", "pmDE": "pm_dec",
        "Bmag": "magnitudes.B",
        "Vmag": "magnitudes.V", "e_Vmag": "magnitude_errors.V", "HIP": "hip_number",
        "SpType": "spectral_type",
    }),
)  # fmt: skip
