"""Archive files in, one star table out: the first stage of every build.

Blocks of every file are parsed by the reader of their layout, given their meaning by the
catalog's own module, moved to the epoch and joined. Every record read ends in the star table
or in the rejected table, with one reason.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from starcat.catalog.blocks import CATALOGS, Part, Reading, join_parts, parse_block
from starcat.catalog.nearest import add_nearest_neighbours
from starcat.catalog.photometry import blend_weights
from starcat.catalog.readers.files import (
    Block,
    DigestReader,
    InputFile,
    find_files,
    map_in_order,
    read_blocks,
)
from starcat.catalog.readers.malformed import check_malformed, not_this_archive
from starcat.catalog.readers.records import Problem
from starcat.catalog.source import DataSource, data_source
from starcat.catalog.stars import floats_of
from starcat.catalog.verdict import Reason
from starcat.errors import ConfigError, SourceMissing
from starcat.progress import Progress, no_progress
from starcat.tables.schema import product_schema


@dataclass(frozen=True)
class FileFacts:
    """One input file as the manifest records it.

    Attributes
    ----------
    name : str
        File name without its folder.
    sha256 : str
        Digest of the file as it lies on disk.
    bytes, rows : int
        Its size and the records read from it.
    """

    name: str
    sha256: str
    bytes: int
    rows: int


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
        All other records; schema ``rejected``.
    files : tuple of FileFacts
        What was read, in order.
    problems : tuple of str
        The first malformed records, each with file, line and bytes.
    notes : tuple of str
        What a user should know of the inputs: optional files that are missing.
    """

    source: str
    band: str
    stars: pa.Table
    rejected: pa.Table
    files: tuple[FileFacts, ...]
    problems: tuple[str, ...]
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """Return source and counts in one line."""
        return (
            f"<Ingested {self.source} ({self.band}): {self.rows_read:,} records read, "
            f"{len(self.stars):,} kept, {len(self.rejected):,} rejected>"
        )

    @property
    def rows_read(self) -> int:
        """Records in all files."""
        return sum(file.rows for file in self.files)

    @property
    def rejected_by_reason(self) -> dict[str, int]:
        """Number of rejected records by reason, in the order of the reasons."""
        return count_by_reason(self.rejected)


def count_by_reason(rejected: pa.Table) -> dict[str, int]:
    """Return how many rows of a rejected table each reason has.

    Parameters
    ----------
    rejected : pyarrow.Table
        Table of the rejected schema.

    Returns
    -------
    dict of str to int
        In the order in which the reasons are tried.
    """
    counted = {
        entry["values"]: entry["counts"]
        for entry in pc.value_counts(rejected["reason"]).to_pylist()
    }
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
    """Read a star catalog into a star table.

    Parameters
    ----------
    source_name : str
        A star catalog of ``data_sources``.
    paths : sequence of Path
        Its files or the folders that hold them.
    band : str, optional
        Band of ``mag``; the source's first by default.
    epoch_jyear : float, optional
        Julian year to move positions to; by default every star stays at its own epoch.
    read_limit_mag : float, optional
        Records fainter than this are rejected while reading and are nobody's neighbour: for
        catalogs that do not fit into memory.
    neighbours : bool, default True
        Whether to find each star's nearest neighbour.
    workers : int, default 2
        Threads; the result is the same for any number.
    progress : Progress
        Called with ("read <source>", bytes done, bytes in all) after every block.

    Returns
    -------
    Ingested
        The tables, which follow their schemas, and what was read.

    Raises
    ------
    ConfigError
        If the source is not a star catalog or has no such band.
    SourceError
        If a file is missing, damaged, or not of this archive.
    """
    source = star_catalog(source_name)
    how = Reading(source_name, check_band(source, band), epoch_jyear, read_limit_mag)
    files = given_files(source, paths)
    facts, parts, problems = _read_parts(files, source, how, workers, progress)
    stars, rejected = join_parts(parts)
    stars = add_nearest_neighbours(stars, workers) if neighbours else stars
    product_schema("stars").check(stars)
    product_schema("rejected").check(rejected)
    notes = (*missing_files(source, files), *unmoved_stars(source_name, stars, epoch_jyear))
    return Ingested(source_name, how.band, stars, rejected, facts, problems, notes)


def star_catalog(source_name: str) -> DataSource:
    """Return a data source that is a star catalog.

    Parameters
    ----------
    source_name : str
        Name of a source.

    Returns
    -------
    DataSource
        The source.

    Raises
    ------
    ConfigError
        If there is no such source, or it has no stars.
    """
    source = data_source(source_name)
    if source_name not in CATALOGS:
        raise ConfigError(
            f"{source_name} is not a star catalog; choose one of {', '.join(CATALOGS)}",
            key="source",
            value=source_name,
        )
    return source


def given_files(source: DataSource, paths: Sequence[Path]) -> list[InputFile]:
    """Return the files of a source.

    Parameters
    ----------
    source : DataSource
        What is read.
    paths : sequence of Path
        Files, or folders that hold them.

    Returns
    -------
    list of InputFile
        At least one, in reading order.

    Raises
    ------
    SourceMissing
        If there is none, or one is missing.
    """
    files = find_files(source, paths)
    if not files:
        raise SourceMissing(f"{source.name}: no input files given", source=source.name)
    return files


def unmoved_stars(source_name: str, stars: pa.Table, epoch_jyear: float | None) -> tuple[str, ...]:
    """Return a note where most stars of a catalog are not at the epoch that was asked for.

    Parameters
    ----------
    source_name : str
        The catalog.
    stars : pyarrow.Table
        Its star table.
    epoch_jyear : float, optional
        Julian year that was asked for.

    Returns
    -------
    tuple of str
        How many stars stay at which epochs, having no proper motion; empty for a few.
    """
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
    """Return a note for each optional file of a source that is not among the inputs.

    Parameters
    ----------
    source : DataSource
        What is read.
    files : sequence of InputFile
        What it is read from.

    Returns
    -------
    tuple of str
        Naming the file and what is in it.
    """
    given = {file.layout.name for file in files}
    return tuple(
        f"{source.name}: {layout.file_names[0]} is not among the inputs ({layout.description})"
        for layout in source.files
        if layout.optional and layout.name not in given
    )


def _read_parts(
    files: Sequence[InputFile],
    source: DataSource,
    how: Reading,
    workers: int,
    progress: Progress,
) -> tuple[tuple[FileFacts, ...], list[Part], tuple[str, ...]]:
    """Read all files; return their facts, their parsed blocks and what is malformed in them."""
    facts: list[FileFacts] = []
    parts: list[Part] = []
    rows = [0] * len(files)
    problems: list[tuple[int, Problem]] = []

    def parse(numbered: tuple[int, Block]) -> Part:
        return parse_block(*numbered, how)

    for part in map_in_order(parse, numbered_blocks(files, source, facts, progress), workers):
        if part.problems and not rows[part.file_number] and part.rows == len(part.problems):
            raise not_this_archive(files[part.file_number], source, part.problems)
        rows[part.file_number] += part.rows
        problems += [(part.file_number, problem) for problem in part.problems]
        parts.append(part)
    check_malformed(files, rows, problems, source)
    counted = (replace(fact, rows=count) for fact, count in zip(facts, rows, strict=True))
    first = tuple(f"{files[n].path.name} {problem}" for n, problem in problems[:20])
    return tuple(counted), parts, first


def check_band(source: DataSource, band: str | None) -> str:
    """Return the band to use, after checking that the source has it.

    Parameters
    ----------
    source : DataSource
        The catalog.
    band : str, optional
        What was asked for.

    Returns
    -------
    str
        The band; the source's first where none was asked for.

    Raises
    ------
    ConfigError
        If the source has no such band.
    """
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


def numbered_blocks(
    files: Sequence[InputFile], source: DataSource, facts: list[FileFacts], progress: Progress
) -> Iterator[tuple[int, Block]]:
    """Read the blocks of all files of a source, and report how far that is.

    Parameters
    ----------
    files : sequence of InputFile
        In reading order.
    source : DataSource
        What they are.
    facts : list of FileFacts
        Each file is appended when it has been read to its end, with 0 for its rows.
    progress : Progress
        Called with ("read <source>", bytes done, bytes in all): bytes as they lie on disk.

    Yields
    ------
    file_number : int
        Number of the file.
    block : Block
        Its next records.
    """
    stage = f"read {source.name}"
    sizes = [file.path.stat().st_size for file in files]
    for number, file in enumerate(files):
        before = sum(sizes[:number])

        def note(raw: DigestReader, name: str = file.path.name) -> None:
            facts.append(FileFacts(name, raw.sha256, raw.bytes_read, 0))

        for block in read_blocks(file, source.name, note):
            progress(stage, before + block.bytes_read, sum(sizes))
            yield number, block
        progress(stage, before + sizes[number], sum(sizes))
