"""Amplitudes of variable stars from a separate source, joined to a star table.

The General Catalogue of Variable Stars identifies a star by one number: up to six digits are a
Hipparcos number, more are a Gaia DR3 source id. If its magnitude flag is 1, the "minimum" is an
amplitude. The Variable Star Index (VSX) marks amplitudes by a bracket, and identifies stars by
their positions.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.arrays import Array, Mask
from starcat.catalog.ingest import ingest_catalog
from starcat.catalog.joins import (
    Keys,
    numbers_in,
    read_joined,
    read_records,
    texts_of,
    whole_numbers,
    with_code,
)
from starcat.catalog.readers.records import ParsedRecords
from starcat.catalog.source import data_source
from starcat.catalog.source_files import FileFacts
from starcat.catalog.stars.star_table import floats_of, with_columns
from starcat.catalog.stars.verdict import Reason
from starcat.geometry.sphere import directions_from_radec
from starcat.progress import Progress, no_progress

GCVS_COLUMNS = ("star_ref", "var_type", "mag_max", "mag_flag", "mag_min")

VSX_COLUMNS = ("var_flag", "ra_deg", "de_deg", "var_type", "mag_max", "f_min", "mag_min")

_DIGITS = re.compile(r"[0-9]{1,19}")
_LARGEST_HIP = 999_999
_SUSPECTED = 1  # flag of VSX; 0 is variable, 2 constant or non-existing, 3 perhaps a duplicate


@dataclass(frozen=True)
class AmplitudeTable:
    """Amplitudes with the keys of their stars, arrays of shape (M,)."""

    source: str
    files: tuple[FileFacts, ...]
    kept: int  # records that could be used
    rejected: dict[str, int]  # unusable records, by reason
    amplitude_mag: Array  # NaN if unknown; in GCVS a lower bound if the minimum is a limit
    flag: NDArray[np.object_]  # the source's code for the variability, or None
    keys: Keys
    role = "variability"  # name in the manifest


def read_amplitudes(
    source_name: str, paths: Sequence[Path], progress: Progress = no_progress
) -> AmplitudeTable:
    """Read the amplitudes of a source."""
    if data_source(source_name).kind == "variability":
        table: AmplitudeTable = read_joined(source_name, paths, progress)
        return table
    read = ingest_catalog(source_name, paths, neighbours=False, progress=progress)
    # A star without a position can still be a known variable.
    usable = read.rejected.filter(pc.is_valid(read.rejected["star_id"]))
    columns = [name for name in usable.column_names if name in read.stars.column_names]
    tables = [read.stars.select(columns), usable.select(columns)]
    stars = pa.concat_tables(tables, promote_options="permissive")
    is_variable = pc.or_(pc.is_valid(stars["amplitude_mag"]), pc.is_valid(stars["variable_flag"]))
    stars = stars.filter(is_variable)
    numbers = {name: whole_numbers(stars, name) for name in ("hip_number", "hd_number")}
    if source_name == "tycho1":
        numbers = {"tyc": stars["star_id"].to_numpy(), **numbers}
    return AmplitudeTable(
        source_name,
        read.files,
        len(read.stars),
        read.rejected_by_reason,
        floats_of(stars, "amplitude_mag"),
        np.array(stars["variable_flag"].to_pylist(), dtype=object),
        Keys(numbers),
    )


def read_gcvs(paths: Sequence[Path], progress: Progress = no_progress) -> AmplitudeTable:
    """Read the General Catalogue of Variable Stars."""
    read = read_records("gcvs", paths, {"gcvs": GCVS_COLUMNS}, progress)

    def text(name: str) -> list[str]:
        return [value for part in read.parts for value in texts_of(part[name])]

    number = np.array([_star_number(ref) for ref in text("star_ref")], dtype=np.int64)
    has_number = number > 0
    flag = np.concatenate([np.asarray(part["mag_flag"], dtype=np.float64) for part in read.parts])
    amplitude = _amplitudes(text("mag_max"), text("mag_min"), flag == 1)
    is_hip = number <= _LARGEST_HIP
    return AmplitudeTable(
        "gcvs",
        read.files,
        int(np.count_nonzero(has_number)),
        read.rejected(**{Reason.no_identity.name: int(np.count_nonzero(~has_number))}),
        amplitude[has_number],
        np.array([kind or None for kind in text("var_type")], dtype=object)[has_number],
        Keys(
            {
                "hip_number": np.where(is_hip, number, 0)[has_number],
                "gaia": np.where(is_hip, 0, number)[has_number],
            }
        ),
    )


def read_vsx(paths: Sequence[Path], progress: Progress = no_progress) -> AmplitudeTable:
    """Read the Variable Star Index; constant stars and duplicates are left out."""
    read = read_records("vsx", paths, {"vsx": VSX_COLUMNS}, progress)
    parts = [part.where(part["var_flag"] <= _SUSPECTED) for part in read.parts]
    amplitude = np.concatenate([_amplitudes_of_vsx(part) for part in parts])
    # Intern the types: there are millions of records but few types.
    types = (sys.intern(kind) or None for part in parts for kind in texts_of(part["var_type"]))
    radec = [np.concatenate([part[name] for part in parts]) for name in ("ra_deg", "de_deg")]
    left_out = sum(map(len, read.parts)) - len(amplitude)
    return AmplitudeTable(
        "vsx",
        read.files,
        len(amplitude),
        read.rejected(**{Reason.deleted.name: left_out}),
        amplitude,
        np.fromiter(types, dtype=object, count=len(amplitude)),
        Keys({}, directions_from_radec(*radec)),
    )


def _amplitudes_of_vsx(part: ParsedRecords) -> Array:
    maxima, minima = texts_of(part["mag_max"]), texts_of(part["mag_min"])
    return _amplitudes(maxima, minima, part["f_min"] == b"(")


def _star_number(text: str) -> int:
    """Return the number of a star; 0 if the text is not a number."""
    number = int(text) if _DIGITS.fullmatch(text) else 0
    return number if number < 2**63 else 0


def _amplitudes(maxima: list[str], minima: list[str], is_amplitude: Mask) -> Array:
    """Return amplitudes: maximum minus minimum magnitude, or the minimum if it is an amplitude."""
    brightest, faintest = numbers_in(maxima, "mag"), numbers_in(minima, "mag")
    # A few records contradict themselves. An "amplitude" fainter than the maximum is really a
    # magnitude, and a minimum brighter than the maximum is ignored.
    is_own = is_amplitude & ~(faintest > brightest)
    amplitude = np.where(is_own, faintest, faintest - brightest)
    amplitude[amplitude < 0.0] = np.nan
    return amplitude


def join_amplitudes(stars: pa.Table, table: AmplitudeTable) -> tuple[pa.Table, int]:
    """Join amplitudes and codes to the stars that a source contains."""
    amplitude = floats_of(stars, "amplitude_mag")
    flag = np.array(stars["variable_flag"].to_pylist(), dtype=object)
    origin = np.array(stars["amplitude_source"].to_pylist(), dtype=object)
    is_variable = stars["is_flagged_variable"].to_numpy().copy()
    matched = np.zeros(len(stars), dtype=bool)
    for star, row in table.keys.match(stars):
        fresh = ~matched[star]
        star, row = star[fresh], row[fresh]
        matched[star] = True
        # Several records may share a number (components): the largest amplitude counts.
        order = np.argsort(np.nan_to_num(table.amplitude_mag[row], nan=-1.0), kind="stable")
        for s, r in zip(star[order], row[order], strict=True):
            larger = table.amplitude_mag[r] > amplitude[s] or np.isnan(amplitude[s])
            if larger and not np.isnan(table.amplitude_mag[r]):
                amplitude[s], origin[s] = table.amplitude_mag[r], table.source
            if table.flag[r] is not None:
                flag[s] = with_code(flag[s], f"{table.source}:{table.flag[r]}")
                is_variable[s] = True
    columns = {
        "amplitude_mag": amplitude,
        "amplitude_source": pa.array(origin, pa.string()),
        "variable_flag": pa.array(flag, pa.string()),
        "is_flagged_variable": is_variable,
    }
    return with_columns(stars, columns), int(matched.sum())
