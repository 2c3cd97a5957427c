"""Archive files in, one star table out: the first stage of every build.

Blocks of every file are parsed by the reader of their layout, given their meaning by the
catalog's own module, moved to the epoch and joined. Every record read ends in the star table
or in the rejected table, with one reason.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Event

import pyarrow as pa
import pyarrow.compute as pc

from starcat.catalog.blocks import CATALOGS, Reading, TablePile, join_parts
from starcat.catalog.file_parts import NAMED_PROBLEMS, BytesRead, FileFacts, FileReading
from starcat.catalog.nearest import add_nearest_neighbours
from starcat.catalog.photometry import blend_weights
from starcat.catalog.readers.files import InputFile, find_files
from starcat.catalog.repeats import check_contents, check_names
from starcat.catalog.source import DataSource, data_source
from starcat.catalog.stars import floats_of
from starcat.catalog.verdict import Reason
from starcat.errors import BuildError, ConfigError, SourceMissing
from starcat.progress import Progress, no_progress
from starcat.storage.schema import product_schema


@dataclass(frozen=True)
class Ingested:
    """A catalog as a star table.

    Attributes
    ----------
    source : str
        Name of the data source.
    band : str
        Band of ``mag``.
    stars : pyarrow.Table
        Records with a position, by star_id; schema ``stars``.
    rejected : pyarrow.Table
        All other records but those beyond the read limit; schema ``rejected``.
    files : tuple of FileFacts
        What was read, in order.
    problems : tuple of str
        The first malformed records, each with file, line and bytes.
    notes : tuple of str
        What a user should know of the inputs: optional files that are missing.
    beyond_read_limit : int
        Records fainter than the read limit, which are in neither table.
    """

    source: str
    band: str
    stars: pa.Table
    rejected: pa.Table
    files: tuple[FileFacts, ...]
    problems: tuple[str, ...]
    notes: tuple[str, ...] = ()
    beyond_read_limit: int = 0

    def __repr__(self) -> str:
        """Return source and counts in one line."""
        return (
            f"<Ingested {self.source} ({self.band}): {self.rows_read:,} records read, "
            f"{len(self.stars):,} kept, {sum(self.rejected_by_reason.values()):,} rejected>"
        )

    @property
    def rows_read(self) -> int:
        """Records in all files."""
        return sum(file.rows for file in self.files)

    @property
    def rejected_by_reason(self) -> dict[str, int]:
        """Number of rejected records by reason, in the order of the reasons."""
        return count_by_reason(self.rejected, self.beyond_read_limit)


def count_by_reason(rejected: pa.Table, beyond_read_limit: int = 0) -> dict[str, int]:
    """Return how many rows of a rejected table each reason has."""
    counted = {
        entry["values"]: entry["counts"]
        for entry in pc.value_counts(rejected["reason"]).to_pylist()
    }
    if beyond_read_limit:
        counted[Reason.beyond_read_limit.name] = beyond_read_limit
    return {reason.name: counted[reason.name] for reason in Reason if reason.name in counted}


def ingest(
    source_name: str,
    paths: Sequence[Path],
    *,
    band: str | None = None,
    epoch_jyear: float | None = None,
    read_limit_mag: float | None = None,
    neighbours: bool = True,
    workers: int = 2,
    progress: Progress = no_progress,
) -> Ingested:
    """Read a star catalog into a star table."""
    source = star_catalog(source_name)
    how = Reading(source_name, check_band(source, band), epoch_jyear, read_limit_mag)
    files = given_files(source, paths)
    gathered: list[_Gathered] = []
    for each in _read_files(files, source, how, workers, progress):
        gathered.append(each)
        check_contents(files[: len(gathered)], [one.facts for one in gathered], source)
    stars, rejected = join_parts(
        [table for each in gathered for table in each.stars],
        [table for each in gathered for table in each.rejected],
    )
    stars = add_nearest_neighbours(stars, workers) if neighbours else stars
    product_schema("stars").check(stars)
    product_schema("rejected").check(rejected)
    notes = (*missing_files(source, files), *unmoved_stars(source_name, stars, epoch_jyear))
    read = Ingested(
        source_name,
        how.band,
        stars,
        rejected,
        tuple(each.facts for each in gathered),
        tuple(problem for each in gathered for problem in each.problems)[:NAMED_PROBLEMS],
        notes,
        sum(each.counted for each in gathered),
    )
    check_balance(read)
    return read


def check_balance(read: Ingested) -> None:
    """Check that every record read is kept or rejected."""
    rejected = sum(read.rejected_by_reason.values())
    if read.rows_read != len(read.stars) + rejected:
        raise BuildError(
            f"{read.source}: {read.rows_read} records read, but {len(read.stars)} kept and "
            f"{rejected} rejected by reason; expected as many. This is a fault of starcat: report "
            "it with the command and the files"
        )


def star_catalog(source_name: str) -> DataSource:
    """Return a data source that is a star catalog."""
    source = data_source(source_name)
    if source_name not in CATALOGS:
        raise ConfigError(
            f"{source_name} is not a star catalog; choose one of {', '.join(CATALOGS)}",
            key="source",
            value=source_name,
        )
    return source


def given_files(source: DataSource, paths: Sequence[Path]) -> list[InputFile]:
    """Return the files of a source."""
    files = find_files(source, paths)
    if not files:
        raise SourceMissing(f"{source.name}: no input files given", source=source.name)
    check_names(files, source)
    return files


def unmoved_stars(source_name: str, stars: pa.Table, epoch_jyear: float | None) -> tuple[str, ...]:
    """Return a note where most stars of a catalog are not at the epoch that was asked for."""
    epochs = floats_of(stars, "epoch_jyear")
    unmoved = epochs[epochs != epoch_jyear] if epoch_jyear is not None else epochs[:0]
    if 2 * len(unmoved) <= len(epochs):
        return ()
    years = " to ".join(f"{year:g}" for year in sorted({unmoved.min(), unmoved.max()}))
    return (
        f"{source_name}: {len(unmoved):,} of {len(epochs):,} stars have no proper motion and stay "
        f"at J{years}, not J{epoch_jyear:g}",
    )


def missing_files(source: DataSource, files: Sequence[InputFile]) -> tuple[str, ...]:
    """Return a note for each optional file of a source that is not among the inputs."""
    given = {file.layout.name for file in files}
    return tuple(
        f"{source.name}: {layout.file_names[0]} is not among the inputs ({layout.description})"
        for layout in source.files
        if layout.optional and layout.name not in given
    )


@dataclass(frozen=True)
class _Gathered:
    """What one file has given."""

    facts: FileFacts
    stars: list[pa.Table]
    rejected: list[pa.Table]
    counted: int
    problems: tuple[str, ...]


def _gather(reading: FileReading, stop: Event | None = None) -> _Gathered:
    """Read a file; give up between two blocks when asked to stop."""
    stars, rejected, counted = TablePile("stars"), TablePile("rejected"), 0
    for part in reading:
        stars.add(part.stars)
        rejected.add(part.rejected)
        counted += part.counted
        if stop is not None and stop.is_set():
            raise CancelledError
    return _Gathered(reading.facts, stars.tables, rejected.tables, counted, reading.problems)


def _read_files(
    files: Sequence[InputFile],
    source: DataSource,
    how: Reading,
    workers: int,
    progress: Progress,
) -> Iterator[_Gathered]:
    """Read all files, in order: side by side where each is small beside all of them."""
    read = BytesRead(files, source.name, progress)
    sizes = [file.path.stat().st_size for file in files]
    if workers < 2 or max(sizes) * workers > sum(sizes):
        for n, file in enumerate(files):
            tell = read.teller(n)
            yield _gather(FileReading(file, n, source, how, workers=workers, on_bytes=tell))
        return
    stop = Event()
    with ThreadPoolExecutor(workers) as pool:
        readings = (
            FileReading(file, n, source, how, on_bytes=partial(read.note, n))
            for n, file in enumerate(files)
        )
        pending = deque(pool.submit(_gather, reading, stop) for reading in readings)
        try:
            while pending:
                while not wait([pending[0]], timeout=_TELL_EVERY_S).done:
                    read.tell()
                read.tell()
                yield pending.popleft().result()
        finally:
            stop.set()
            for future in pending:
                future.cancel()


_TELL_EVERY_S = 0.1


def check_band(source: DataSource, band: str | None) -> str:
    """Return the band to use, after checking that the source has it."""
    if band is None:
        return source.bands[0]
    if source.name == "2mass":
        blend_weights(band)
    elif band not in source.bands:
        raise ConfigError(
            f"{source.name} has no band {band!r}; it has {', '.join(source.bands)}",
            key="band",
            value=band,
        )
    return band
