"""Hipparcos (I/239, hip_main): meaning of the records.

Positions are ICRS at J1991.25. For variability there are a class of amplitude (H6) and the 5th
and 95th percentiles of the Hp magnitude, for doubles the components' separation and difference.
"""

from __future__ import annotations

import numpy as np

from starcat.arrays import Array
from starcat.catalog.readers.records import ParsedRecords
from starcat.catalog.stars.proper_motion import central_error
from starcat.catalog.stars.star_table import (
    Columns,
    join_flags,
    known_errors,
    numbered,
    text_column,
    where_known,
)
from starcat.catalog.stars.verdict import Verdicts

ASTROMETRY = (
    "ra_deg", "de_deg", "plx", "pm_ra", "pm_de", "e_ra", "e_de", "e_plx", "e_pm_ra", "e_pm_de",
    "pm_ra_ra", "pm_de_de",
)  # fmt: skip
"""Columns of the position in both catalogs of I/239."""

COLUMNS = {
    "hip_main": (
        "hip", "proxy", "v_mag", "var_flag", *ASTROMETRY, "bt_mag", "e_bt_mag", "vt_mag",
        "e_vt_mag", "b_v", "e_b_v", "v_i", "hp_mag", "e_hp_mag", "hp_max", "hp_min", "hvar_type",
        "ccdm", "n_comp", "mult_flag", "rho", "dhp", "hd", "sp_type",
    ),
}  # fmt: skip

_MAGNITUDES = {"V": "v_mag", "Hp": "hp_mag", "BT": "bt_mag", "VT": "vt_mag"}

CLASS_LOWER_BOUND_MAG = {b"2": 0.06, b"3": 0.61}
"""Smallest amplitude of class H6: 2 is 0.06 to 0.6 mag, 3 more than 0.6 (in steps of 0.01)."""


def magnitudes(records: ParsedRecords, band: str) -> Array:
    """Return the magnitudes of Hipparcos records."""
    return records[_MAGNITUDES[band]]


def shared_columns(records: ParsedRecords, mag: Array, second_mag: Array) -> Columns:
    """Return the star-table columns for the fields that both catalogs of I/239 have."""
    return {
        "ra_deg": records["ra_deg"],
        "dec_deg": records["de_deg"],
        "epoch_jyear": 1991.25,
        **_errors(records),
        "pm_ra_cosdec_mas_yr": records["pm_ra"],
        "pm_dec_mas_yr": records["pm_de"],
        "mag": mag,
        "second_mag": second_mag,
        "colour_mag": records["b_v"],
        "colour_bands": "B-V",
        "hd_number": records["hd"],
    }


def _errors(records: ParsedRecords) -> Columns:
    """Return parallaxes, and errors at the epoch where position and motion are independent."""
    columns: Columns = {
        "parallax_mas": records["plx"],
        "parallax_error_mas": known_errors(records["e_plx"]),
    }
    for axis, position, motion, correlation in (
        ("ra", "e_ra", "e_pm_ra", "pm_ra_ra"),
        ("dec", "e_de", "e_pm_de", "pm_de_de"),
    ):
        error, central = central_error(
            known_errors(records[position]),
            known_errors(records[motion]),
            records[correlation],
            1991.25,
        )
        columns[f"{axis}_error_mas"], columns[f"{axis}_central_jyear"] = error, central
        columns[f"pm_{axis}_error_mas_yr"] = known_errors(records[motion])
    return columns


def stars(records: ParsedRecords, band: str, _: Verdicts) -> Columns:
    """Return the star-table columns of Hipparcos records."""
    number = records.integers("hip")
    second = "Hp" if band != "Hp" else "V"
    n_comp = records["n_comp"]
    has_solution = ~records.is_blank("mult_flag")
    in_ccdm = ~records.is_blank("ccdm")
    is_class, is_type = ~records.is_blank("var_flag"), np.isin(records["hvar_type"], [b"P", b"U"])
    amplitude = amplitudes(records)
    return {
        **shared_columns(records, magnitudes(records, band), magnitudes(records, second)),
        "star_id": number,
        "designation": numbered("HIP", number),
        "band": band,
        "second_band": second,
        "mag_error": _magnitude_errors(records, band),
        "second_colour_mag": records["v_i"],
        "second_colour_bands": "V-I",
        "spectral_type": text_column(records["sp_type"]),
        "double_flag": join_flags(
            {
                "CCDM": (in_ccdm, records["ccdm"]),
                "H59": (has_solution, records["mult_flag"]),
                "Proxy": (~records.is_blank("proxy"), records["proxy"]),
            }
        ),
        "is_flagged_double": has_solution | (n_comp > 1),
        "companion_separation_arcsec": records["rho"],
        "companion_delta_mag": records["dhp"],
        "variable_flag": join_flags(
            {"H6": (is_class, records["var_flag"]), "H52": (is_type, records["hvar_type"])}
        ),
        "is_flagged_variable": is_type | np.isin(records["var_flag"], [b"2", b"3"]),
        "amplitude_mag": amplitude,
        "amplitude_source": where_known(amplitude, "hipparcos"),
        "hip_number": number,
    }


def _magnitude_errors(records: ParsedRecords, band: str) -> Array:
    """Return the errors of the magnitudes; the error of V follows from the errors of Hp and B-V."""
    if band != "V":
        return known_errors(records[f"e_{_MAGNITUDES[band]}"])
    # V is Hp minus a function of B-V that rises by about 0.2 mag per magnitude of colour.
    error: Array = np.hypot(
        known_errors(records["e_hp_mag"]), 0.2 * np.nan_to_num(records["e_b_v"])
    )
    return error


def amplitudes(records: ParsedRecords) -> Array:
    """Return the amplitude in Hp of each record."""
    amplitude: Array = records["hp_min"] - records["hp_max"]
    for flag, bound in CLASS_LOWER_BOUND_MAG.items():
        amplitude = np.where(records["var_flag"] == flag, np.fmax(amplitude, bound), amplitude)
    return amplitude
