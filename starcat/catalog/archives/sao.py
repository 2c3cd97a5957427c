"""SAO (I/131A): meaning of the records.

Positions and motions are FK5, equinox and epoch J2000; they are returned as ICRS. The proper
motion in right ascension is in seconds of time per year, without cos(dec).
"""

from __future__ import annotations

import erfa
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from starcat.arrays import Array, Mask
from starcat.catalog.readers.records import ParsedRecords
from starcat.catalog.stars.star_table import (
    Columns,
    join_flags,
    known_errors,
    numbered,
    text_column,
)
from starcat.catalog.stars.verdict import Reason, Verdicts
from starcat.geometry.sphere import directions_from_radec, radec_from_directions, tangent_axes

COLUMNS = {
    "sao": (
        "sao", "del_flag", "p_mag", "v_mag", "sp_type", "r_vmag", "rem", "dm_component", "hd",
        "m_hd", "ra2000_h", "ra2000_m", "ra2000_s", "pm_ra2000", "de2000_sign", "de2000_d",
        "de2000_m", "de2000_s", "pm_de2000", "ra2000_rad", "de2000_rad", "e_pm_ra", "e_ra2_s",
        "ep_ra2", "e_pm_de", "e_de2_s", "ep_de2",
    ),
}  # fmt: skip

PRINTED_PM_DEC_ARCSEC_YR = {208759: -0.180, 208795: -0.042, 212470: -0.072}
"""Proper motions of the printed catalog that are blank in the file (ReadMe of I/131A)."""


def magnitudes(records: ParsedRecords, band: str) -> Array:
    """Return the magnitudes of SAO records."""
    return records["v_mag" if band == "V" else "p_mag"]


def stars(records: ParsedRecords, band: str, verdicts: Verdicts) -> Columns:
    """Return the star-table columns of SAO records."""
    number = records.integers("sao")
    ra_deg, dec_deg = _positions(records)
    pm_ra, pm_dec = _proper_motions(records, number, dec_deg)
    ra_deg, dec_deg, pm_ra, pm_dec = icrs_from_fk5(ra_deg, dec_deg, pm_ra, pm_dec)
    verdicts.reject(records["del_flag"] == b"D", Reason.deleted)
    doubles, is_double, delta_mag = _duplicity(records)
    variable = np.isin(records["rem"], [4, 5, 6, 7])
    mean_of_range = records["r_vmag"] == 17
    return {
        "star_id": number,
        "designation": numbered("SAO", number),
        "ra_deg": ra_deg,
        "dec_deg": dec_deg,
        "epoch_jyear": 2000.0,
        "pm_ra_cosdec_mas_yr": pm_ra,
        "pm_dec_mas_yr": pm_dec,
        "ra_error_mas": 10.0 * known_errors(records["e_ra2_s"]),
        "dec_error_mas": 10.0 * known_errors(records["e_de2_s"]),
        "ra_central_jyear": records["ep_ra2"],
        "dec_central_jyear": records["ep_de2"],
        "pm_ra_error_mas_yr": known_errors(records["e_pm_ra"]),
        "pm_dec_error_mas_yr": known_errors(records["e_pm_de"]),
        "spectral_type": text_column(records["sp_type"]),
        "mag": magnitudes(records, band),
        "band": band,
        "second_mag": records["p_mag" if band == "V" else "v_mag"],
        "second_band": "P" if band == "V" else "V",
        "double_flag": doubles,
        "is_flagged_double": is_double,
        "companion_delta_mag": delta_mag,
        "variable_flag": join_flags(
            {"Rem": (variable, _digit(records["rem"])), "r_Vmag=17": (mean_of_range, None)}
        ),
        "is_flagged_variable": variable | mean_of_range,
        "hd_number": records["hd"],
    }


def icrs_from_fk5(
    ra_deg: Array, dec_deg: Array, pm_ra: Array, pm_dec: Array
) -> tuple[Array, Array, Array, Array]:
    """Transform FK5 positions and proper motions at J2000 to ICRS.

    The rotation is from the IAU SOFA routine FK5HIP, at most 32 mas; the spin of the FK5
    frame against Hipparcos (below 1 mas/yr) is removed from the proper motions.
    """
    rotation, spin = erfa.fk5hip()
    fk5 = directions_from_radec(ra_deg, dec_deg)
    east, north = tangent_axes(ra_deg, dec_deg)
    velocity = pm_ra[:, None] * east + pm_dec[:, None] * north
    spin_mas_yr = np.degrees(spin) * 3.6e6
    icrs = fk5 @ rotation.T
    # The sign convention is SOFA's, which gives the spin of FK5 relative to Hipparcos.
    velocity = (velocity + np.cross(fk5, spin_mas_yr)) @ rotation.T
    ra, dec = radec_from_directions(icrs)
    east, north = tangent_axes(ra, dec)
    return (
        ra,
        dec,
        np.asarray(np.einsum("ij,ij->i", velocity, east)),
        np.asarray(np.einsum("ij,ij->i", velocity, north)),
    )


def _positions(records: ParsedRecords) -> tuple[Array, Array]:
    """Return positions from the radians (to 2 mas), else from hours and degrees (to 15 mas)."""
    sign = np.where(records["de2000_sign"] == b"-", -1.0, 1.0)
    hours = records["ra2000_h"] + records["ra2000_m"] / 60.0 + records["ra2000_s"] / 3600.0
    degrees = records["de2000_d"] + records["de2000_m"] / 60.0 + records["de2000_s"] / 3600.0
    ra, dec = np.degrees(records["ra2000_rad"]), np.degrees(records["de2000_rad"])
    has_radians = ~(np.isnan(ra) | np.isnan(dec))
    degrees = np.where(degrees > 90.0, np.nan, degrees)  # beyond the pole
    return np.where(has_radians, ra, 15.0 * hours), np.where(has_radians, dec, sign * degrees)


def _proper_motions(
    records: ParsedRecords, number: NDArray[np.int64], dec_deg: Array
) -> tuple[Array, Array]:
    pm_ra = records["pm_ra2000"] * 15.0 * 1000.0 * np.cos(np.radians(dec_deg))
    pm_dec = records["pm_de2000"] * 1000.0
    for sao, printed in PRINTED_PM_DEC_ARCSEC_YR.items():
        pm_dec[(number == sao) & np.isnan(pm_dec)] = printed * 1000.0
    return pm_ra, pm_dec


def _duplicity(records: ParsedRecords) -> tuple[pa.Array, Mask, Array]:
    rem, m_hd = records["rem"], records["m_hd"]
    by_rem = np.isin(rem, [1, 2, 3, 7])
    by_hd = np.isin(m_hd, [1, 2, 9])
    composite = np.char.startswith(records["sp_type"], b"+++")
    component = ~records.is_blank("dm_component")
    combined = records["r_vmag"] == 16
    flag = join_flags(
        {
            "Rem": (by_rem, _digit(rem)),
            "m_HD": (by_hd, _digit(m_hd)),
            "Sp=+++": (composite, None),
            "DM": (component, records["dm_component"]),
            "r_Vmag=16": (combined, None),
        }
    )
    # m_HD 1 and 2 mark the members of a pair whose magnitudes differ by 0.3 at most.
    delta_mag = np.where(np.isin(m_hd, [1, 2]), 0.3, np.nan)
    return flag, by_rem | by_hd | composite | component | combined, delta_mag


def _digit(code: Array) -> NDArray[np.bytes_]:
    return np.where(np.isnan(code), 0, code).astype(np.uint8).astype("S1")
