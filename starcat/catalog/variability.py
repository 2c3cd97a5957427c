"""Amplitudes of variable stars, joined to a star table from another source."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.catalog.archives.gcvs import read_gcvs
from starcat.catalog.file_parts import FileFacts
from starcat.catalog.ingest import ingest
from starcat.catalog.stars import floats_of, with_columns
from starcat.progress import Progress, no_progress


@dataclass(frozen=True)
class AmplitudeTable:
    """Amplitudes by the numbers under which stars are known.

    Attributes
    ----------
    source : str
        Data source of the amplitudes.
    files : tuple of FileFacts
        What was read.
    kept : int
        Records that could be used.
    rejected : dict of str to int
        The others, by reason.
    amplitude_mag : ndarray of float64, shape (M,)
        NaN where unknown.
    flag : ndarray of object, shape (M,)
        The source's code for the variability, None where it has none.
    numbers : dict of str to ndarray of float64 or int64, shape (M,)
        Keys by name: ``hip_number``, ``hd_number``, ``tyc`` or ``gaia``; 0 where unknown.
    """

    source: str
    files: tuple[FileFacts, ...]
    kept: int
    rejected: dict[str, int]
    amplitude_mag: Array
    flag: NDArray[np.object_]
    numbers: dict[str, NDArray[np.int64]]


def read_amplitudes(
    source_name: str, paths: Sequence[Path], progress: Progress = no_progress
) -> AmplitudeTable:
    """Read the amplitudes of a source."""
    if source_name == "gcvs":
        gcvs = read_gcvs(paths, progress)
        return AmplitudeTable(
            "gcvs", gcvs.files, len(gcvs.amplitude_mag), gcvs.rejected, gcvs.amplitude_mag,
            gcvs.var_type, {"hip_number": gcvs.hip_number, "gaia": gcvs.gaia_id},
        )  # fmt: skip
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
