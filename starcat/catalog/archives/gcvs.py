"""General Catalogue of Variable Stars: amplitudes by Hipparcos or Gaia number.

The table names a star by one number: up to six digits are a Hipparcos number, more are a
Gaia DR3 source id. Magnitude flag 1 says that the "minimum" is an amplitude itself.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from starcat.catalog.file_parts import BytesRead, FileBlocks, FileFacts
from starcat.catalog.readers.delimited import parse_delimited
from starcat.catalog.readers.files import find_files
from starcat.catalog.readers.records import Records, number_from_text
from starcat.catalog.repeats import check_contents, check_names
from starcat.catalog.source import RANGES, data_source
from starcat.catalog.verdict import Reason
from starcat.progress import Progress, no_progress

COLUMNS = ("star_ref", "var_type", "mag_max", "mag_flag", "mag_min")

_DIGITS = re.compile(r"[0-9]{1,19}")
_LARGEST_HIP = 999_999


@dataclass(frozen=True)
class Gcvs:
    """Variable stars of the catalogue, all arrays of shape (M,).

    Attributes
    ----------
    files : tuple of FileFacts
        What was read.
    rejected : dict of str to int
        Records that could not be used, by reason: malformed ones, and those without a number.
    hip_number, gaia_id : ndarray of int64
        The star's number; 0 where it is known by the other.
    amplitude_mag : ndarray of float64
        NaN where the catalogue states none; a lower bound where the minimum is a limit.
    var_type : ndarray of object
        Type of variability, such as ``EA`` or ``M``; None where blank.
    """

    files: tuple[FileFacts, ...]
    rejected: dict[str, int]
    hip_number: NDArray[np.int64]
    gaia_id: NDArray[np.int64]
    amplitude_mag: NDArray[np.float64]
    var_type: NDArray[np.object_]


def read_gcvs(paths: Sequence[Path], progress: Progress = no_progress) -> Gcvs:
    """Read the variable-star catalogue."""
    source = data_source("gcvs")
    files = find_files(source, paths)
    check_names(files, source)
    read = BytesRead(files, source.name, progress)
    parts: list[Records] = []
    every = [FileBlocks(file, source, read.teller(n)) for n, file in enumerate(files)]
    for blocks in every:
        for block in blocks:
            records = parse_delimited(block.data, block.file.layout, COLUMNS, block.first_line)
            blocks.add(len(records) + len(records.problems), records.problems)
            parts.append(records)
    facts = tuple(blocks.facts for blocks in every)
    check_contents(files, facts, source)
    malformed = sum(blocks.malformed for blocks in every)
    rejected = {Reason.malformed_record.name: malformed} if malformed else {}
    return _from_records(parts, facts, rejected)


def _from_records(
    parts: Sequence[Records], files: tuple[FileFacts, ...], rejected: dict[str, int]
) -> Gcvs:
    def text(name: str) -> list[str]:
        return [value.decode("latin-1").strip() for part in parts for value in part[name].tolist()]

    number = np.array([_star_number(ref) for ref in text("star_ref")], dtype=np.int64)
    is_known = number > 0
    if not is_known.all():
        rejected = {**rejected, Reason.no_identity.name: int(np.count_nonzero(~is_known))}
    brightest, faintest = (_magnitudes(text(name)) for name in ("mag_max", "mag_min"))
    flag = np.concatenate([np.asarray(part["mag_flag"], dtype=np.float64) for part in parts])
    # A few records contradict themselves: an "amplitude" fainter than the maximum is a
    # magnitude after all, and a minimum brighter than the maximum says nothing.
    is_amplitude = (flag == 1) & ~(faintest > brightest)
    amplitude = np.where(is_amplitude, faintest, faintest - brightest)
    amplitude[amplitude < 0.0] = np.nan
    is_hip = number <= _LARGEST_HIP
    var_type = np.array([kind or None for kind in text("var_type")], dtype=object)
    return Gcvs(
        files,
        rejected,
        np.where(is_hip, number, 0)[is_known],
        np.where(is_hip, 0, number)[is_known],
        amplitude[is_known],
        var_type[is_known],
    )


def _star_number(text: str) -> int:
    """Return the number that names a star; 0 where the text is none."""
    number = int(text) if _DIGITS.fullmatch(text) else 0
    return number if number < 2**63 else 0


def _magnitudes(texts: list[str]) -> NDArray[np.float64]:
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
