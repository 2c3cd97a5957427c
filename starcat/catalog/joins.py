"""Find the star of a table that a record of a joined source describes: by number or position.

A number is the star's number in another catalog. A position is for J2000; the stars are moved to
J2000 for the comparison. `variability.py` and `doubles.py` use the contents of the records.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import scipy
from numpy.typing import NDArray

from starcat.arrays import Array, Directions
from starcat.catalog.parts import FileReading, read_files
from starcat.catalog.readers.blocks import Block
from starcat.catalog.readers.delimited import parse_delimited
from starcat.catalog.readers.fixed_width import parse_fixed_width
from starcat.catalog.readers.records import ParsedRecords, number_from_text
from starcat.catalog.source import RANGES, data_source
from starcat.catalog.source_files import FileFacts, SourceFiles
from starcat.catalog.stars.positions import Positions
from starcat.catalog.stars.verdict import Reason
from starcat.geometry.sphere import chord_from_separation
from starcat.progress import Progress, no_progress

MATCH_ARCSEC = 3.0
"""A position belongs to the nearest star within this radius. Positions of double and variable stars
are good to an arcsecond or two; 0.02 % have another Gaia star to G = 12 within it."""

PLACES_JYEAR = 2000.0
"""The epoch of the positions."""

Rows = NDArray[np.int64]


@dataclass(frozen=True)
class Keys:
    """Numbers and positions of the stars of a source; arrays with one row per record."""

    numbers: dict[str, NDArray[np.int64]]
    """By name (``hip_number``, ``hd_number``, ``tyc`` or ``gaia``); 0 if unknown."""
    places: Directions | None = None  # ICRS; NaN if unknown

    def match(self, stars: pa.Table) -> Iterator[tuple[Rows, Rows]]:
        """Yield rows of stars and rows of records about them; the first match of a star counts."""
        for name, keys in self.numbers.items():
            yield _same_number(_star_numbers(stars, name), keys)
        if self.places is not None:
            yield _same_position(stars, self.places)


def _same_position(stars: pa.Table, places: Directions) -> tuple[Rows, Rows]:
    rows = np.flatnonzero(np.isfinite(places).all(axis=1))
    if not len(stars) or not len(rows):
        return rows[:0], rows[:0]
    then = Positions.of(stars).at(PLACES_JYEAR)
    within = float(chord_from_separation(np.radians(MATCH_ARCSEC / 3600.0)))
    chord, star = scipy.spatial.cKDTree(then).query(places[rows], distance_upper_bound=within)
    is_found = np.isfinite(chord)
    return np.asarray(star, dtype=np.int64)[is_found], rows[is_found]


def _star_numbers(stars: pa.Table, key: str) -> NDArray[np.int64]:
    """Return the stars' numbers of a kind; 0 for stars without one."""
    if key in {"hip_number", "hd_number"}:
        return whole_numbers(stars, key)
    archives = {"tyc": ("tycho1", "tycho2"), "gaia": ("gaia", "gaia_dr3_hats")}[key]
    names = pc.unique(stars["catalog"]).to_pylist()
    catalogs = [name for name in names if data_source(name).archive in archives]
    of_kind = np.isin(np.array(stars["catalog"].to_pylist(), dtype=object), catalogs)
    return np.where(of_kind, np.maximum(stars["star_id"].to_numpy(), 0), 0)


def whole_numbers(stars: pa.Table, name: str) -> NDArray[np.int64]:
    """Return a column of whole numbers with 0 for null."""
    return np.array(pc.fill_null(stars[name], 0), dtype=np.int64)


def _same_number(numbers: NDArray[np.int64], keys: NDArray[np.int64]) -> tuple[Rows, Rows]:
    """Return the rows of stars and of records that share a number other than 0."""
    order = np.argsort(keys, kind="stable")
    low = np.searchsorted(keys[order], numbers, side="left")
    high = np.searchsorted(keys[order], numbers, side="right")
    count = np.where(numbers > 0, high - low, 0)
    star = np.repeat(np.arange(len(numbers)), count)
    step = np.arange(len(star)) - np.repeat(np.cumsum(count) - count, count)
    return star, order[np.repeat(low, count) + step]


def with_code(codes: str | None, code: str) -> str:
    """Return codes with one code added, without repetitions."""
    if codes is None:
        return code
    return codes if code in codes.split(";") else f"{codes};{code}"


def read_joined(source_name: str, paths: Sequence[Path], progress: Progress) -> Any:
    """Read a list of variables or doubles with the function that its TOML file names."""
    module, _, name = data_source(source_name).python.partition(":")
    return getattr(importlib.import_module(module), name)(paths, progress)


@dataclass(frozen=True)
class JoinRecords:
    """The records of a joined source, in the order of its files."""

    parts: tuple[ParsedRecords, ...]  # the good records, one part per block
    files: tuple[FileFacts, ...]
    malformed: int

    def rejected(self, **others: int) -> dict[str, int]:
        """Return the counts of rejected records by reason; reasons without records are left out."""
        counts = {Reason.malformed_record.name: self.malformed, **others}
        return {reason: count for reason, count in counts.items() if count}


def read_records(
    source_name: str,
    paths: Sequence[Path],
    columns: Mapping[str, Sequence[str]],
    progress: Progress = no_progress,
) -> JoinRecords:
    """Read the columns of each layout of a joined source."""
    files = SourceFiles.find(data_source(source_name), paths)

    def parse(block: Block) -> ParsedRecords:
        layout = block.file.layout
        if layout.layout == "delimited":
            return parse_delimited(block.data, layout, columns[layout.name], block.first_line)
        data = _padded(block) if layout.trimmed else block.data
        return parse_fixed_width(data, layout, columns[layout.name], block.first_line)

    parts: list[ParsedRecords] = []
    readings: list[FileReading] = []
    for reading, parsed in read_files(files.files, parse, progress=progress):
        parts += parsed
        readings.append(reading)
    facts = tuple(reading.facts for reading in readings)
    files.check_contents(facts)
    return JoinRecords(tuple(parts), facts, sum(reading.malformed for reading in readings))


def _padded(block: Block) -> bytes:
    """Return lines padded to the record length: the archive leaves out blanks at their ends."""
    width = block.file.layout.record_bytes or 0
    lines = block.data.splitlines()
    return b"".join(line.ljust(width)[:width] + b"\n" if line.strip() else b"\n" for line in lines)


def texts_of(values: NDArray[np.bytes_]) -> list[str]:
    """Return fixed-width bytes as trimmed texts."""
    return [value.decode("latin-1").strip() for value in values.tolist()]


def numbers_in(texts: list[str], unit: str = "") -> Array:
    """Return the numbers in texts, NaN for other texts; a limit sign may precede a number."""
    values = np.full(len(texts), np.nan)
    for i, text in enumerate(texts):
        try:
            values[i] = number_from_text(text.lstrip("<>(").encode("latin-1"))
        except ValueError:
            continue
    least, greatest = RANGES.get(unit, (-np.inf, np.inf))
    values[(values < least) | (values > greatest)] = np.nan
    return values
