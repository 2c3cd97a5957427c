"""Tycho-1 (I/239, tyc_main): what its records mean.

Positions are ICRS at J1991.25. Some BT magnitudes are estimates that may be a magnitude off
(T36 = T): those stars are rejected, as no limit can be trusted for them.
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.catalog.quality import Quality, quality_flags
from starcat.catalog.readers.records import Records
from starcat.catalog.stars import StarBlock, Values, join_flags, where_known
from starcat.catalog.verdict import Reason, Verdicts

COLUMNS = {
    "tyc_main": [
        "tyc1",
        "tyc2",
        "tyc3",
        "proxy",
        "v_mag",
        "ra_deg",
        "de_deg",
        "dubious",
        "pm_ra",
        "pm_de",
        "bt_mag",
        "r_bt_mag",
        "vt_mag",
        "b_v",
        "q",
        "vt_max",
        "vt_min",
        "var",
        "var_flag",
        "mult_flag",
        "hip",
        "hd",
        "remark",
    ]
}

_NUMBER_TEXTS = pa.array([str(number) for number in range(100_000)])
"""Texts of all numbers that TYC2 and TYC3 can be, as looking up is faster than formatting."""

_REGION_TEXTS = pc.binary_join_element_wise("TYC", _NUMBER_TEXTS[:10_000], " ")
"""Texts of all numbers that TYC1 can be, with the name of the catalog before them."""

_MAGNITUDES = {"V": "v_mag", "BT": "bt_mag", "VT": "vt_mag"}


def stars(records: Records, band: str) -> StarBlock:
    """Return the star-table columns of Tycho-1 records."""
    number, designation = tycho_identity(records)
    verdicts = Verdicts(len(records))
    verdicts.reject(np.isnan(records["ra_deg"]) | np.isnan(records["de_deg"]), Reason.no_position)
    estimated = records["r_bt_mag"] == b"T"
    verdicts.reject(estimated | (records["remark"] == b"M"), Reason.uncertain_magnitude)
    quality = records["q"]
    second = "VT" if band != "VT" else "BT"
    return StarBlock(
        {
            "star_id": number,
            "designation": designation,
            "ra_deg": records["ra_deg"],
            "dec_deg": records["de_deg"],
            "epoch_jyear": 1991.25,
            "pm_ra_cosdec_mas_yr": records["pm_ra"],
            "pm_dec_mas_yr": records["pm_de"],
            "mag": records[_MAGNITUDES[band]],
            "band": band,
            "second_mag": records[_MAGNITUDES[second]],
            "second_band": second,
            "colour_mag": records["b_v"],
            "colour_bands": "B-V",
            **_duplicity(records),
            **_variability(records),
            "hip_number": records["hip"],
            "hd_number": records["hd"],
            "quality_flags": quality_flags(
                len(records),
                {
                    Quality.ESTIMATED_MAGNITUDE: estimated,
                    Quality.POOR_PHOTOMETRY: np.isin(quality, [7, 9]),
                    Quality.PERHAPS_NOT_A_STAR: quality == 8,
                    Quality.DUBIOUS_POSITION: records["dubious"] == b"X",
                },
            ),
        },
        verdicts,
    )


def _duplicity(records: Records) -> dict[str, Values]:
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


def _variability(records: Records) -> dict[str, Values]:
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


def tycho_identity(records: Records) -> tuple[NDArray[np.int64], pa.Array]:
    """Return the packed number and the designation of Tycho records."""
    parts = [records.integers(name) for name in ("tyc1", "tyc2", "tyc3")]
    number = parts[0] * 1_000_000 + parts[1] * 10 + parts[2]
    region = _REGION_TEXTS.take(pa.array(parts[0]))
    texts = [_NUMBER_TEXTS.take(pa.array(part)) for part in parts[1:]]
    return number, pc.binary_join_element_wise(region, *texts, "-")
