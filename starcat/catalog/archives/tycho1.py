"""Tycho-1 (I/239, tyc_main): meaning of the records.

Positions are ICRS at J1991.25. Some BT magnitudes are estimates that can be wrong by a magnitude
(T36 = T): these stars are rejected, as no magnitude limit is reliable for them.
"""

from __future__ import annotations

import numpy as np

from starcat.arrays import Array
from starcat.catalog.archives.hipparcos import ASTROMETRY, shared_columns
from starcat.catalog.archives.tycho2 import tycho_identity, tycho_magnitude_error
from starcat.catalog.readers.records import ParsedRecords
from starcat.catalog.stars.star_table import Columns, join_flags, where_known
from starcat.catalog.stars.verdict import Quality, Reason, Verdicts, quality_flags

COLUMNS = {
    "tyc_main": (
        "tyc1", "tyc2", "tyc3", "proxy", "v_mag", *ASTROMETRY, "dubious", "bt_mag", "r_bt_mag",
        "e_bt_mag", "vt_mag", "e_vt_mag", "b_v", "q", "vt_max", "vt_min", "var", "var_flag",
        "mult_flag", "hip", "hd", "remark",
    ),
}  # fmt: skip

_MAGNITUDES = {"V": "v_mag", "BT": "bt_mag", "VT": "vt_mag"}


def magnitudes(records: ParsedRecords, band: str) -> Array:
    """Return the magnitudes of Tycho-1 records."""
    return records[_MAGNITUDES[band]]


def stars(records: ParsedRecords, band: str, verdicts: Verdicts) -> Columns:
    """Return the star-table columns of Tycho-1 records."""
    number, designation = tycho_identity(records)
    verdicts.reject(np.isnan(records["ra_deg"]) | np.isnan(records["de_deg"]), Reason.no_position)
    estimated = records["r_bt_mag"] == b"T"
    verdicts.reject(estimated | (records["remark"] == b"M"), Reason.uncertain_magnitude)
    quality = records["q"]
    second = "VT" if band != "VT" else "BT"
    return {
        **shared_columns(records, magnitudes(records, band), magnitudes(records, second)),
        "star_id": number,
        "designation": designation,
        "band": band,
        "second_band": second,
        "mag_error": tycho_magnitude_error(records, band),
        **_duplicity(records),
        **_variability(records),
        "hip_number": records["hip"],
        "quality_flags": quality_flags(
            len(records),
            {
                Quality.ESTIMATED_MAGNITUDE: estimated,
                Quality.POOR_PHOTOMETRY: np.isin(quality, [7, 9]),
                Quality.PERHAPS_NOT_A_STAR: quality == 8,
                Quality.DUBIOUS_POSITION: records["dubious"] == b"X",
            },
        ),
    }


def _duplicity(records: ParsedRecords) -> Columns:
    is_suspect = records["q"] == 6
    flag = join_flags(
        {
            "T49": (~records.is_blank("mult_flag"), records["mult_flag"]),
            "T40=6": (is_suspect, None),
            "Proxy": (~records.is_blank("proxy"), records["proxy"]),
        }
    )
    is_double = np.isin(records["mult_flag"], [b"D", b"R", b"S"]) | is_suspect
    return {"double_flag": flag, "is_flagged_double": is_double}


def _variability(records: ParsedRecords) -> Columns:
    variable = np.isin(records["var_flag"], [b"U", b"V", b"W"])
    named = np.isin(records["var"], [b"G", b"N"])
    # VTmax and VTmin are percentiles of noisy transits: an amplitude only if flagged.
    amplitude = np.where(variable, records["vt_min"] - records["vt_max"], np.nan)
    return {
        "variable_flag": join_flags(
            {"T47": (named, records["var"]), "T48": (variable, records["var_flag"])}
        ),
        "is_flagged_variable": variable | named,
        "amplitude_mag": amplitude,
        "amplitude_source": where_known(amplitude, "tycho1"),
    }
