"""Tycho-2 (I/259): meaning of the records of ``tyc2`` and ``suppl_1``.

``tyc2`` has mean positions at J2000; records marked X have only the observed position, at
its own epoch near 1991.5. ``suppl_1`` has the brightest stars (Sirius, Vega, Arcturus …), at
J1991.25; if its mflag is H, the VT column has a Hipparcos Hp magnitude.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.arrays import Array, Mask
from starcat.catalog.photometry import JOHNSON_SLOPE, johnson_v
from starcat.catalog.readers.records import ParsedRecords
from starcat.catalog.stars.star_table import Columns, join_flags, known_errors
from starcat.catalog.stars.verdict import Quality, Verdicts, quality_flags

COLUMNS = {
    "tyc2": (
        "tyc1", "tyc2", "tyc3", "pflag", "ra_mean_deg", "de_mean_deg", "pm_ra", "pm_de",
        "e_ra_mean", "e_de_mean", "e_pm_ra", "e_pm_de", "ep_ra_mean", "ep_de_mean", "bt_mag",
        "e_bt_mag", "vt_mag", "e_vt_mag", "prox", "hip", "ccdm", "ra_deg", "de_deg", "ep_ra_1990",
        "ep_de_1990", "e_ra", "e_de", "posflg",
    ),
    "suppl_1": (
        "tyc1", "tyc2", "tyc3", "flag", "ra_deg", "de_deg", "pm_ra", "pm_de", "e_ra", "e_de",
        "e_pm_ra", "e_pm_de", "mflag", "bt_mag", "e_bt_mag", "vt_mag", "e_vt_mag", "prox", "hip",
        "ccdm",
    ),
}  # fmt: skip

PROX_BEYOND = 999
"""Value of ``prox`` for "no other star within 99.9 arcsec"; the unit is 0.1 arcsec."""


@cache
def _number_texts() -> pa.Array:
    """Return texts of all possible TYC2 and TYC3: a look-up is faster than formatting."""
    return pa.array([str(number) for number in range(100_000)])


@cache
def _region_texts() -> pa.Array:
    """Return texts of all possible TYC1, with the name of the catalog before the number."""
    return pc.binary_join_element_wise("TYC", _number_texts()[:10_000], " ")


def magnitudes(records: ParsedRecords, band: str) -> Array:
    """Return the magnitudes of Tycho-2 records."""
    return _magnitudes(records, band)[0]


def stars(records: ParsedRecords, band: str, _: Verdicts) -> Columns:
    """Return the star-table columns of Tycho-2 records."""
    position = (
        _positions_of_tyc2(records) if records.layout == "tyc2" else _positions_of_suppl(records)
    )
    number, designation = tycho_identity(records)
    in_ccdm = ~records.is_blank("ccdm")
    prox = records["prox"]
    photocentre = position.pop("is_photocentre")
    flag_parts = position.pop("double_flags")
    mag, bits = _magnitudes(records, band)
    bits[Quality.PHOTOCENTRE] = photocentre
    return {
        **position,
        "star_id": number,
        "designation": designation,
        "pm_ra_cosdec_mas_yr": records["pm_ra"],
        "pm_dec_mas_yr": records["pm_de"],
        "pm_ra_error_mas_yr": known_errors(records["e_pm_ra"]),
        "pm_dec_error_mas_yr": known_errors(records["e_pm_de"]),
        "mag": mag,
        "mag_error": tycho_magnitude_error(records, band),
        "band": band,
        **_second_magnitudes(records, band),
        "colour_mag": records["bt_mag"] - records["vt_mag"],
        "colour_bands": "BT-VT",
        "double_flag": join_flags({**flag_parts, "CCDM": (in_ccdm, records["ccdm"])}),
        "is_flagged_double": np.logical_or.reduce(
            [in_ccdm, *(where for where, _ in flag_parts.values())]
        ),
        "companion_separation_arcsec": np.where(prox < PROX_BEYOND, 0.1 * prox, np.nan),
        "hip_number": records["hip"],
        "quality_flags": quality_flags(len(records), bits),
    }


def _positions_of_tyc2(records: ParsedRecords) -> dict[str, Any]:
    """Return the mean positions at J2000, or the observed positions if there is no mean."""
    no_mean = np.isnan(records["ra_mean_deg"]) | np.isnan(records["de_mean_deg"])
    observed_jyear = 1990.0 + 0.5 * (records["ep_ra_1990"] + records["ep_de_1990"])
    photocentre = (records["pflag"] == b"P") | (records["posflg"] == b"P")
    return {
        "ra_deg": np.where(no_mean, records["ra_deg"], records["ra_mean_deg"]),
        "dec_deg": np.where(no_mean, records["de_deg"], records["de_mean_deg"]),
        "epoch_jyear": np.where(no_mean, observed_jyear, 2000.0),
        "ra_error_mas": known_errors(np.where(no_mean, records["e_ra"], records["e_ra_mean"])),
        "dec_error_mas": known_errors(np.where(no_mean, records["e_de"], records["e_de_mean"])),
        "ra_central_jyear": np.where(no_mean, observed_jyear, records["ep_ra_mean"]),
        "dec_central_jyear": np.where(no_mean, observed_jyear, records["ep_de_mean"]),
        "is_photocentre": photocentre,
        "double_flags": {
            "pflag": (records["pflag"] == b"P", records["pflag"]),
            "posflg": (np.isin(records["posflg"], [b"D", b"P"]), records["posflg"]),
        },
    }


def _positions_of_suppl(records: ParsedRecords) -> dict[str, Any]:
    nowhere = np.zeros(len(records), dtype=bool)
    return {
        "ra_deg": records["ra_deg"],
        "dec_deg": records["de_deg"],
        "epoch_jyear": 1991.25,
        "ra_error_mas": known_errors(records["e_ra"]),
        "dec_error_mas": known_errors(records["e_de"]),
        "ra_central_jyear": 1991.25,
        "dec_central_jyear": 1991.25,
        "is_photocentre": nowhere,
        "double_flags": {"pflag": (nowhere, None)},
    }


def _magnitudes(records: ParsedRecords, band: str) -> tuple[Array, dict[Quality, Mask]]:
    bt, vt = records["bt_mag"], records["vt_mag"]
    if band == "BT":
        return bt, {}
    is_hp = _is_hp(records)
    if band == "VT":
        return np.where(is_hp, np.nan, vt), {}
    # Without a colour Hp is used as V: for most stars they differ by less than 0.2 mag.
    v = johnson_v(np.where(is_hp, np.nan, bt), vt)
    bits = {
        Quality.ESTIMATED_MAGNITUDE: v.is_estimated | is_hp,
        Quality.COLOUR_OUT_OF_RANGE: v.is_out_of_range,
    }
    return v.mag, bits


def _second_magnitudes(records: ParsedRecords, band: str) -> Columns:
    """Return the magnitude in another band than the build's: BT, or for BT itself VT or Hp."""
    if band != "BT":
        return {"second_mag": records["bt_mag"], "second_band": "BT"}
    second = np.where(_is_hp(records), "Hp", "VT")
    return {"second_mag": records["vt_mag"], "second_band": pa.array(second)}


def _is_hp(records: ParsedRecords) -> Mask:
    """Return which records of supplement 1 have Hp in the column of VT."""
    if records.layout != "suppl_1":
        return np.zeros(len(records), dtype=bool)
    return np.asarray(records["mflag"] == b"H")


def tycho_magnitude_error(records: ParsedRecords, band: str) -> Array:
    """Return the errors of the magnitudes of Tycho records; NaN where V is an estimate."""
    bt_error, vt_error = known_errors(records["e_bt_mag"]), known_errors(records["e_vt_mag"])
    if band == "V":
        return np.hypot((1.0 + JOHNSON_SLOPE) * vt_error, JOHNSON_SLOPE * bt_error)
    return bt_error if band == "BT" else vt_error


def tycho_identity(records: ParsedRecords) -> tuple[NDArray[np.int64], pa.Array]:
    """Return the packed number and the designation of Tycho records."""
    parts = [records.integers(name) for name in ("tyc1", "tyc2", "tyc3")]
    number = parts[0] * 1_000_000 + parts[1] * 10 + parts[2]
    region = _region_texts().take(pa.array(parts[0]))
    texts = [_number_texts().take(pa.array(part)) for part in parts[1:]]
    return number, pc.binary_join_element_wise(region, *texts, "-")
