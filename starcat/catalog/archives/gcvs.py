"""General Catalogue of Variable Stars: amplitudes by Hipparcos or Gaia number.

The table names a star by one number: up to six digits are a Hipparcos number, more are a
Gaia DR3 source id. Magnitude flag 1 says that the "minimum" is an amplitude itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from starcat.catalog.ingest import FileFacts
from starcat.catalog.readers.delimited import parse_delimited
from starcat.catalog.readers.files import DigestReader, find_files, read_blocks
from starcat.catalog.readers.malformed import check_malformed, not_this_archive
from starcat.catalog.readers.records import Problem, Records
from starcat.catalog.source import data_source
from starcat.catalog.verdict import Reason
from starcat.progress import Progress, no_progress

COLUMNS = ("star_ref", "var_type", "mag_max", "mag_flag", "mag_min")


@dataclass(frozen=True)
class Gcvs:
    """Variable stars of the catalogue, all arrays of shape (M,).

    Attributes
    ----------
    files : tuple of FileFacts
        What was read.
    rejected : dict of str to int
        Records that could not be used, by reason.
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
    """Read the variable-star catalogue.

    Parameters
    ----------
    paths : sequence of Path
        Its file or the folder that holds it.
    progress : Progress
        Called with ("read gcvs", blocks done, None).

    Returns
    -------
    Gcvs
        One row a record.

    Raises
    ------
    SourceMissing, ParseError
        If the file is missing, damaged or of another archive.
    """
    source = data_source("gcvs")
    files = find_files(source, paths)
    facts: list[FileFacts] = []
    parts: list[Records] = []
    problems: list[tuple[int, Problem]] = []
    rows = [0] * len(files)
    for number, file in enumerate(files):

        def note(raw: DigestReader, name: str = file.path.name) -> None:
            facts.append(FileFacts(name, raw.sha256, raw.bytes_read, 0))

        for block in read_blocks(file, source.name, note):
            records = parse_delimited(block.data, file.layout, COLUMNS, block.first_line)
            if not len(records) and not rows[number] and records.problems:
                raise not_this_archive(file, source, records.problems)
            rows[number] += len(records) + len(records.problems)
            problems += [(number, problem) for problem in records.problems]
            parts.append(records)
            progress("read gcvs", len(parts), None)
    check_malformed(files, rows, problems, source)
    filled = [FileFacts(f.name, f.sha256, f.bytes, n) for f, n in zip(facts, rows, strict=True)]
    rejected = {Reason.malformed_record.name: len(problems)} if problems else {}
    return _from_records(parts, tuple(filled), rejected)


def _from_records(
    parts: Sequence[Records], files: tuple[FileFacts, ...], rejected: dict[str, int]
) -> Gcvs:
    def text(name: str) -> list[str]:
        return [value.decode("latin-1").strip() for part in parts for value in part[name].tolist()]

    number = np.array(
        [int(ref) if ref.isdigit() else 0 for ref in text("star_ref")], dtype=np.int64
    )
    brightest, faintest = (_numbers(text(name)) for name in ("mag_max", "mag_min"))
    flag = np.concatenate([np.asarray(part["mag_flag"], dtype=np.float64) for part in parts])
    # A few records contradict themselves: an "amplitude" fainter than the maximum is a
    # magnitude after all, and a minimum brighter than the maximum says nothing.
    is_amplitude = (flag == 1) & ~(faintest > brightest)
    amplitude = np.where(is_amplitude, faintest, faintest - brightest)
    amplitude[amplitude < 0.0] = np.nan
    is_hip = number < 1_000_000
    return Gcvs(
        files,
        rejected,
        np.where(is_hip, number, 0),
        np.where(is_hip, 0, number),
        amplitude,
        np.array([kind or None for kind in text("var_type")], dtype=object),
    )


def _numbers(texts: list[str]) -> NDArray[np.float64]:
    """Return magnitudes; a limit sign leaves the number that it stands before."""
    values = np.full(len(texts), np.nan)
    for i, value in enumerate(texts):
        try:
            values[i] = float(value.lstrip("<>("))
        except ValueError:
            continue
    return values
