"""Amplitudes of variable stars, from another source than the star table that they are joined to.

The General Catalogue of Variable Stars names a star by one number: up to six digits are a
Hipparcos number, more are a Gaia DR3 source id. Its magnitude flag 1 says that the "minimum" is
an amplitude itself.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.catalog.ingest import ingest
from starcat.catalog.parts import FileReading, read_files
from starcat.catalog.readers.blocks import Block
from starcat.catalog.readers.delimited import parse_delimited
from starcat.catalog.readers.records import Records, number_from_text
from starcat.catalog.source import RANGES, data_source
from starcat.catalog.source_files import FileFacts, SourceFiles
from starcat.catalog.stars import floats_of, with_columns
from starcat.catalog.verdict import Reason
from starcat.progress import Progress, no_progress

GCVS_COLUMNS = ("star_ref", "var_type", "mag_max", "mag_flag", "mag_min")

_DIGITS = re.compile(r"[0-9]{1,19}")
_LARGEST_HIP = 999_999


@dataclass(frozen=True)
class AmplitudeTable:
    """Amplitudes by the numbers under which stars are known, arrays of shape (M,)."""

    source: str
    files: tuple[FileFacts, ...]
    kept: int  # records that could be used
    rejected: dict[str, int]  # the others, by reason
    amplitude_mag: Array  # NaN where unknown; in GCVS a lower bound where the minimum is a limit
    flag: NDArray[np.object_]  # the source's code for the variability, None where it has none
    numbers: dict[str, NDArray[np.int64]]
    """Keys by name, ``hip_number``, ``hd_number``, ``tyc`` or ``gaia``; 0 where unknown."""


def read_amplitudes(
    source_name: str, paths: Sequence[Path], progress: Progress = no_progress
) -> AmplitudeTable:
    """Read the amplitudes of a source."""
    if source_name == "gcvs":
        return read_gcvs(paths, progress)
    read = ingest(source_name, paths, neighbours=False, progress=progress)
    # A star without a position can still be known to vary.
    usable = read.rejected.filter(pc.is_valid(read.rejected["star_id"]))
    columns = [name for name in usable.column_names if name in read.stars.column_names]
    tables = [read.stars.select(columns), usable.select(columns)]
    stars = pa.concat_tables(tables, promote_options="permissive")
    known = pc.or_(pc.is_valid(stars["amplitude_mag"]), pc.is_valid(stars["variable_flag"]))
    stars = stars.filter(known)
    numbers = {name: _whole(stars, name) for name in ("hip_number", "hd_number")}
    if source_name == "tycho1":
        numbers = {"tyc": stars["star_id"].to_numpy(), **numbers}
    return AmplitudeTable(
        source_name,
        read.files,
        len(read.stars),
        read.rejected_by_reason,
        floats_of(stars, "amplitude_mag"),
        np.array(stars["variable_flag"].to_pylist(), dtype=object),
        numbers,
    )


def read_gcvs(paths: Sequence[Path], progress: Progress = no_progress) -> AmplitudeTable:
    """Read the General Catalogue of Variable Stars."""
    files = SourceFiles.find(data_source("gcvs"), paths)

    def parse(block: Block) -> Records:
        return parse_delimited(block.data, block.file.layout, GCVS_COLUMNS, block.first_line)

    parts: list[Records] = []
    readings: list[FileReading] = []
    for reading, parsed in read_files(files.files, parse, progress=progress):
        parts += parsed
        readings.append(reading)
    facts = tuple(reading.facts for reading in readings)
    files.check_contents(facts)

    def text(name: str) -> list[str]:
        return [value.decode("latin-1").strip() for part in parts for value in part[name].tolist()]

    number = np.array([_star_number(ref) for ref in text("star_ref")], dtype=np.int64)
    known = number > 0
    brightest, faintest = (_magnitudes(text(name)) for name in ("mag_max", "mag_min"))
    flag = np.concatenate([np.asarray(part["mag_flag"], dtype=np.float64) for part in parts])
    # A few records contradict themselves: an "amplitude" fainter than the maximum is a
    # magnitude after all, and a minimum brighter than the maximum says nothing.
    is_amplitude = (flag == 1) & ~(faintest > brightest)
    amplitude = np.where(is_amplitude, faintest, faintest - brightest)
    amplitude[amplitude < 0.0] = np.nan
    is_hip = number <= _LARGEST_HIP
    rejected = {
        Reason.malformed_record.name: sum(reading.malformed for reading in readings),
        Reason.no_identity.name: int(np.count_nonzero(~known)),
    }
    return AmplitudeTable(
        "gcvs",
        facts,
        int(np.count_nonzero(known)),
        {reason: count for reason, count in rejected.items() if count},
        amplitude[known],
        np.array([kind or None for kind in text("var_type")], dtype=object)[known],
        {
            "hip_number": np.where(is_hip, number, 0)[known],
            "gaia": np.where(is_hip, 0, number)[known],
        },
    )


def _star_number(text: str) -> int:
    """Return the number that names a star; 0 where the text is none."""
    number = int(text) if _DIGITS.fullmatch(text) else 0
    return number if number < 2**63 else 0


def _magnitudes(texts: list[str]) -> Array:
    """Return magnitudes, NaN where there is none; a limit sign stands before its number."""
    values = np.full(len(texts), np.nan)
    for i, text in enumerate(texts):
        try:
            values[i] = number_from_text(text.lstrip("<>(").encode("latin-1"))
        except ValueError:
            continue
    least, greatest = RANGES["mag"]
    values[(values < least) | (values > greatest)] = np.nan
    return values


def join_amplitudes(stars: pa.Table, table: AmplitudeTable) -> tuple[pa.Table, int]:
    """Join amplitudes and codes to the stars that a source knows."""
    amplitude = floats_of(stars, "amplitude_mag")
    flag = np.array(stars["variable_flag"].to_pylist(), dtype=object)
    origin = np.array(stars["amplitude_source"].to_pylist(), dtype=object)
    is_variable = stars["is_flagged_variable"].to_numpy().copy()
    matched = np.zeros(len(stars), dtype=bool)
    for name, keys in table.numbers.items():
        star, row = _match(_star_numbers(stars, name), keys)
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
                flag[s] = _with_code(flag[s], f"{table.source}:{table.flag[r]}")
                is_variable[s] = True
    columns = {
        "amplitude_mag": amplitude,
        "amplitude_source": pa.array(origin, pa.string()),
        "variable_flag": pa.array(flag, pa.string()),
        "is_flagged_variable": is_variable,
    }
    return with_columns(stars, columns), int(matched.sum())


def _with_code(codes: str | None, code: str) -> str:
    if codes is None:
        return code
    return codes if code in codes.split(";") else f"{codes};{code}"


def _whole(stars: pa.Table, name: str) -> NDArray[np.int64]:
    return np.array(pc.fill_null(stars[name], 0), dtype=np.int64)


def _star_numbers(stars: pa.Table, key: str) -> NDArray[np.int64]:
    """Return the stars' own numbers of a kind; 0 where they have none."""
    if key in {"hip_number", "hd_number"}:
        return _whole(stars, key)
    catalog = {"tyc": ("tycho1", "tycho2"), "gaia": ("gaia",)}[key]
    of_kind = np.isin(np.array(stars["catalog"].to_pylist(), dtype=object), catalog)
    return np.where(of_kind, np.maximum(stars["star_id"].to_numpy(), 0), 0)


def _match(
    wanted: NDArray[np.int64], keys: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows of stars and of records that share a number other than 0."""
    order = np.argsort(keys, kind="stable")
    low = np.searchsorted(keys[order], wanted, side="left")
    high = np.searchsorted(keys[order], wanted, side="right")
    count = np.where(wanted > 0, high - low, 0)
    star = np.repeat(np.arange(len(wanted)), count)
    step = np.arange(len(star)) - np.repeat(np.cumsum(count) - count, count)
    return star, order[np.repeat(low, count) + step]
