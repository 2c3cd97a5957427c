"""Read an archive file part by part: blocks are parsed in order, and the whole file is checked.

Every record of a block is in the stars of its part, in the rejected records with one reason, or
counted as beyond the read limit. Only a few blocks of a file are in memory at a time.
`starcat.catalog.ingest` joins the files.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from operator import itemgetter
from typing import Protocol, TypeVar, cast

import numpy as np
import pyarrow as pa

from starcat.arrays import Array
from starcat.catalog.archives.mapped import MappedTable, needed_columns, records_of
from starcat.catalog.readers.blocks import Block, DigestReader, read_blocks
from starcat.catalog.readers.delimited import parse_delimited
from starcat.catalog.readers.fixed_width import parse_binary, parse_fixed_width
from starcat.catalog.readers.records import MalformedRecord, ParsedRecords
from starcat.catalog.readers.tables import read_tables
from starcat.catalog.source import data_source
from starcat.catalog.source_files import FileFacts, InputFile
from starcat.catalog.stars.star_table import (
    Columns,
    move_to_epoch,
    split_by_verdict,
    table_from_columns,
)
from starcat.catalog.stars.verdict import Reason, Verdicts
from starcat.catalog.table_map import ArchiveMap
from starcat.errors import ParseError, SourceError
from starcat.progress import Progress, no_progress
from starcat.threads import map_in_order

_PARSERS = {"fixed_width": parse_fixed_width, "delimited": parse_delimited, "binary": parse_binary}

NAMED_PROBLEMS = 20
"""Number of malformed records of a file that are listed; further ones are only counted."""

MAX_MALFORMED_FRACTION = 0.01
"""Above this share of malformed records (and more than 10 of them) a file is refused."""

_MAX_BLOCKS, _MAX_REJECTED = 256, 1 << 18
"""Most blocks, and most rejected records, that are joined into one part."""

RANGES = {
    "star_id": (-(2.0**63), 2.0**63 - 1024.0),
    "ra_deg": (0.0, 360.0),
    "dec_deg": (-90.0, 90.0),
    "epoch_jyear": (1800.0, 2200.0),
    "pm_ra_cosdec_mas_yr": (-100_000.0, 100_000.0),
    "pm_dec_mas_yr": (-100_000.0, 100_000.0),
    "mag": (-30.0, 100.0),
    "second_mag": (-30.0, 100.0),
}
"""Smallest and largest value of the columns of a star, both included. Barnard's star, the fastest
known star, moves 10,400 mas/yr."""


class Archive(Protocol):
    """The interface of a catalog's module, which gives its records their meaning."""

    @property
    def COLUMNS(self) -> Mapping[str, Sequence[str]]:  # noqa: N802
        """Columns to parse, by layout."""

    def magnitudes(self, records: ParsedRecords, band: str, /) -> Array:
        """Return the magnitudes of records; records beyond a read limit are not read further."""

    def stars(self, records: ParsedRecords, band: str, verdicts: Verdicts, /) -> Columns:
        """Return the star-table columns of records, and reject records that are not stars."""


def archive_of(source_name: str) -> Archive:
    """Return the module that gives an archive's records their meaning; its TOML file names it."""
    module: object = importlib.import_module(data_source(source_name).python)
    return cast(Archive, module)


@dataclass(frozen=True)
class IngestOptions:
    """Options for reading a catalog."""

    source_name: str  # name of a star catalog
    band: str  # band of `mag`
    epoch_jyear: float | None = None  # None: every star stays at its own epoch
    read_limit_mag: float | None = None  # fainter records are only counted


@dataclass(frozen=True)
class FilePart:
    """One parsed block, or several joined blocks."""

    rows: int  # records in it, good and malformed
    stars: pa.Table
    rejected: pa.Table
    problems: list[MalformedRecord]  # malformed records with reasons
    counted: int = 0  # records beyond the read limit, which are in neither table


def parse_block(block: Block, options: IngestOptions) -> FilePart:
    """Return the stars and the rejected records of a block."""
    number, band = block.file.number, options.band
    catalog, records = _records(block, options)
    rows, counted = records.rows, 0
    if options.read_limit_mag is not None:
        is_in_limit = catalog.magnitudes(records, band) <= options.read_limit_mag
        counted = len(records) - int(np.count_nonzero(is_in_limit))
        records = records.where(is_in_limit)
    verdicts = Verdicts(len(records))
    columns = check_ranges(catalog.stars(records, band, verdicts), verdicts)
    columns = move_to_epoch(columns, options.epoch_jyear)
    columns |= {"catalog": options.source_name, "source_file": number, "source_line": records.line}
    table = table_from_columns("stars", columns, len(records))
    stars, rejected = split_by_verdict(table, verdicts)
    if records.problems:
        malformed = _malformed_rows(records.problems, number, options)
        rejected = pa.concat_tables([rejected, malformed])
    return FilePart(rows, stars, rejected, records.problems, counted)


def _records(block: Block, options: IngestOptions) -> tuple[Archive, ParsedRecords]:
    """Return the module of a block's catalog and the block's records."""
    layout = block.file.layout
    if (table := layout.table) is not None and block.rows is not None:
        records = records_of(table, block.rows, block.file)
        if isinstance(table, ArchiveMap):
            return archive_of(table.archive), records
        return MappedTable(table, {}), records
    catalog = archive_of(options.source_name)
    parse = _PARSERS[layout.layout]
    return catalog, parse(block.data, layout, catalog.COLUMNS[layout.name], block.first_line)


def check_ranges(columns: Columns, verdicts: Verdicts) -> Columns:
    """Reject records without a position, or with values that no star can have.

    The readers have already refused fields outside the limits of the layout. This function checks
    the values computed from the fields. A right ascension of 360 deg becomes 0.
    """
    numbers = {
        name: np.asarray(columns[name], dtype=np.float64) for name in RANGES if name in columns
    }
    for name in ("ra_deg", "dec_deg", "epoch_jyear"):
        verdicts.reject(np.isnan(numbers[name]), Reason.no_position)
    for name, values in numbers.items():
        least, greatest = RANGES[name]
        verdicts.reject((values < least) | (values > greatest), Reason.impossible_value)
    return {**columns, "ra_deg": np.where(numbers["ra_deg"] == 360.0, 0.0, numbers["ra_deg"])}


def _malformed_rows(
    problems: Sequence[MalformedRecord], number: int, options: IngestOptions
) -> pa.Table:
    columns: Columns = {
        "catalog": options.source_name,
        "band": options.band,
        "source_file": number,
        "source_line": np.array([problem.line for problem in problems]),
        "reason": Reason.malformed_record.name,
        "detail": pa.array([str(problem) for problem in problems]),
    }
    return table_from_columns("rejected", columns, len(problems))


_Parsed = TypeVar("_Parsed", FilePart, ParsedRecords)


class FileReading:
    """One file during reading, with the counts so far."""

    def __init__(self, file: InputFile) -> None:
        self.file = file
        self.rows = self.malformed = 0
        self.problems: list[MalformedRecord] = []  # the first `NAMED_PROBLEMS`
        self._digest: DigestReader | None = None

    def blocks(self) -> Iterator[Block]:
        """Read the file from its beginning to its end."""
        table = self.file.layout.table
        if table is None:
            return read_blocks(self.file, self._end)
        choose_columns = partial(needed_columns, table, where=self.file.path.name)
        return (
            Block(self.file, b"", 1, rows=r)
            for r in read_tables(self.file, choose_columns, self._end)
        )

    def _end(self, digest: DigestReader) -> None:
        self._digest = digest

    def add(self, part: _Parsed) -> _Parsed:
        """Count the records of the next block; raise if the first block has no good record."""
        problems = part.problems
        if problems and not self.rows and part.rows == len(problems):
            count, source, layout = len(problems), self.file.source, self.file.layout
            if layout.table is not None:
                message = f"the map of {source} fits none of the first {count} rows: {problems[0]}"
                raise self._error(message, problems[0])
            raise self._error(
                f"none of the first {count} records is a record of {source} ({layout.name}): "
                f"{problems[0]}. Is this the right archive?",
                problems[0],
            )
        self.rows += part.rows
        self.malformed += len(problems)
        self.problems += problems[: NAMED_PROBLEMS - len(self.problems)]
        return part

    @property
    def facts(self) -> FileFacts:
        """Facts for the manifest about a file that was read to its end.

        `ParseError` if it has no records, or if more than 10 records and 1 % are malformed.
        """
        path, digest = self.file.path, self._digest
        if digest is None:
            raise SourceError("not read to its end", where=path)
        if not self.rows:
            raise self._error(
                f"no record in the file; expected records of {self.file.source} "
                f"({self.file.layout.name}). Is this the right archive?"
            )
        if self.malformed > 10 and self.malformed > MAX_MALFORMED_FRACTION * self.rows:
            raise self._error(
                f"{self.malformed} of {self.rows} records are malformed; at most "
                f"{MAX_MALFORMED_FRACTION:.0%} may be. The first: {self.problems[0]}",
                self.problems[0],
            )
        return FileFacts(path.name, digest.sha256, digest.bytes_read, self.rows)

    @property
    def named_problems(self) -> tuple[str, ...]:
        """The first malformed records, each with file, line and bytes."""
        return tuple(f"{self.file.path.name} {problem}" for problem in self.problems)

    def _error(self, what: str, first: MalformedRecord | None = None) -> ParseError:
        if first is None:
            return self.file.error(what)
        position = {"line": first.line, "byte_range": first.byte_range, "field": first.field}
        return self.file.error(what, **position)


def read_files(
    files: Sequence[InputFile],
    parse: Callable[[Block], _Parsed],
    workers: int = 0,
    progress: Progress = no_progress,
) -> Iterator[tuple[FileReading, Iterator[_Parsed]]]:
    """Yield each file with its parsed blocks, in order.

    Workers are threads that parse blocks while this thread reads, even blocks of the next file.
    With 0 workers this thread does both.
    """

    def parse_one(item: tuple[FileReading, Block]) -> tuple[FileReading, _Parsed]:
        return item[0], parse(item[1])

    pairs = map_in_order(parse_one, _blocks_of_all(files, progress), workers)
    for reading, group in groupby(pairs, key=itemgetter(0)):
        yield reading, (reading.add(part) for _, part in group)


def _blocks_of_all(
    files: Sequence[InputFile], progress: Progress
) -> Iterator[tuple[FileReading, Block]]:
    sizes = [file.path.stat().st_size for file in files]
    for number, file in enumerate(files):
        before, stage, reading = sum(sizes[:number]), f"read {file.source}", FileReading(file)
        for block in reading.blocks():
            progress(stage, before + block.bytes_read, sum(sizes))
            yield reading, block
        progress(stage, before + sizes[number], sum(sizes))


def merged(parts: Iterable[FilePart], rows: int) -> Iterator[FilePart]:
    """Join blocks until a part has about ``rows`` stars; few of a block are within a read limit."""
    waiting: list[FilePart] = []
    for part in parts:
        waiting.append(part)
        stars, rejected = (sum(len(table) for table in tables) for tables in _tables(waiting))
        if stars >= rows or rejected >= _MAX_REJECTED or len(waiting) >= _MAX_BLOCKS:
            yield _joined(waiting)
            waiting = []
    if waiting:
        yield _joined(waiting)


def _tables(parts: Sequence[FilePart]) -> tuple[list[pa.Table], list[pa.Table]]:
    return [part.stars for part in parts], [part.rejected for part in parts]


def _joined(parts: Sequence[FilePart]) -> FilePart:
    if len(parts) == 1:
        return parts[0]
    stars, rejected = (pa.concat_tables(tables) for tables in _tables(parts))
    return FilePart(
        sum(part.rows for part in parts),
        stars,
        rejected,
        [problem for part in parts for problem in part.problems],
        sum(part.counted for part in parts),
    )
