"""Archive files in, one star table out: the first stage of every build.

Blocks of every file are parsed by the reader of their layout, given their meaning by the
catalog's own module, moved to the epoch and joined. Every record read ends in the star table
or in the rejected table, with one reason.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from starcat.catalog.archives import gaia, hipparcos, sao, twomass, tycho1, tycho2
from starcat.catalog.nearest import add_nearest_neighbours
from starcat.catalog.photometry import blend_weights
from starcat.catalog.readers.binary import parse_binary
from starcat.catalog.readers.delimited import parse_delimited
from starcat.catalog.readers.files import (
    Block,
    DigestReader,
    InputFile,
    find_files,
    map_in_order,
    read_blocks,
)
from starcat.catalog.readers.fixed_width import parse_fixed_width
from starcat.catalog.readers.malformed import check_malformed, malformed_rows, not_this_archive
from starcat.catalog.readers.records import Problem, Records
from starcat.catalog.source import DataSource, data_source
from starcat.catalog.stars import (
    StarBlock,
    floats_of,
    move_to_epoch,
    sort_rows,
    table_from_columns,
)
from starcat.catalog.verdict import Reason
from starcat.errors import ConfigError, SourceMissing
from starcat.progress import Progress, no_progress
from starcat.tables.schema import product_schema

_PARSERS = {
    "fixed_width": parse_fixed_width,
    "delimited": parse_delimited,
    "binary": parse_binary,
}


@dataclass(frozen=True)
class CatalogModule:
    """What ingest needs of a catalog: the columns to parse and what they mean."""

    columns: Mapping[str, Sequence[str]]
    stars: Callable[[Records, str], StarBlock]


CATALOGS = {
    "sao": CatalogModule(sao.COLUMNS, sao.stars),
    "hipparcos": CatalogModule(hipparcos.COLUMNS, hipparcos.stars),
    "tycho1": CatalogModule(tycho1.COLUMNS, tycho1.stars),
    "tycho2": CatalogModule(tycho2.COLUMNS, tycho2.stars),
    "2mass": CatalogModule(twomass.COLUMNS, twomass.stars),
    "gaia": CatalogModule(gaia.COLUMNS, gaia.stars),
}
"""The star catalogs, by the name of their data source."""


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
        Of the rejected schema.

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


@dataclass(frozen=True)
class _Part:
    """One block after parsing."""

    file_number: int
    rows: int
    stars: pa.Table
    rejected: pa.Table
    problems: list[Problem]


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
        Called with ("read <source>", bytes done, bytes in all).

    Returns
    -------
    Ingested
        The tables and what was read.

    Raises
    ------
    ConfigError
        If the source is not a star catalog or has no such band.
    SourceMissing
        If a file is missing.
    ParseError
        If a file is damaged, or not of this archive.
    """
    source = data_source(source_name)
    if source_name not in CATALOGS:
        raise ConfigError(
            f"{source_name} is not a star catalog; choose one of {', '.join(CATALOGS)}",
            key="source",
            value=source_name,
        )
    chosen = check_band(source, band)
    files = find_files(source, paths)
    if not files:
        raise SourceMissing(f"{source_name}: no input files given", source=source_name)

    def parse(item: tuple[int, Block]) -> _Part:
        return _parse_block(*item, source_name, chosen, epoch_jyear, read_limit_mag)

    facts, parts, problems = _read_parts(files, source, parse, workers, progress)
    stars, rejected = _join(parts, source_name, chosen)
    if neighbours:
        stars = add_nearest_neighbours(stars, workers)
    return Ingested(
        source=source_name,
        band=chosen,
        stars=stars,
        rejected=rejected,
        files=facts,
        problems=tuple(f"{files[n].path.name} {problem}" for n, problem in problems[:20]),
        notes=(*missing_files(source, files), *unmoved_stars(source_name, stars, epoch_jyear)),
    )


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
    parse: Callable[[tuple[int, Block]], _Part],
    workers: int,
    progress: Progress,
) -> tuple[tuple[FileFacts, ...], list[_Part], list[tuple[int, Problem]]]:
    """Read all files; return their facts, their parsed blocks and what is malformed in them."""
    facts: list[FileFacts] = []
    parts: list[_Part] = []
    rows = [0] * len(files)
    problems: list[tuple[int, Problem]] = []
    for part in map_in_order(parse, _numbered_blocks(files, source, facts, progress), workers):
        if part.problems and not rows[part.file_number] and part.rows == len(part.problems):
            raise not_this_archive(files[part.file_number], source, part.problems)
        rows[part.file_number] += part.rows
        problems += [(part.file_number, problem) for problem in part.problems]
        parts.append(part)
    check_malformed(files, rows, problems, source)
    counted = (replace(fact, rows=count) for fact, count in zip(facts, rows, strict=True))
    return tuple(counted), parts, problems


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


def _numbered_blocks(
    files: Sequence[InputFile], source: DataSource, facts: list[FileFacts], progress: Progress
) -> Iterator[tuple[int, Block]]:
    total = sum(file.path.stat().st_size for file in files)
    done = 0
    for number, file in enumerate(files):

        def note(raw: DigestReader, name: str = file.path.name) -> None:
            facts.append(FileFacts(name, raw.sha256, raw.bytes_read, 0))

        for block in read_blocks(file, source.name, note):
            yield number, block
            progress(f"read {source.name}", done, total)
        done += file.path.stat().st_size
        progress(f"read {source.name}", done, total)


def _parse_block(
    number: int,
    block: Block,
    source_name: str,
    band: str,
    epoch_jyear: float | None,
    read_limit_mag: float | None,
) -> _Part:
    layout = block.file.layout
    module = CATALOGS[source_name]
    names = list(module.columns[layout.name])
    records = _PARSERS[layout.layout](block.data, layout, names, block.first_line)
    made = module.stars(records, band)
    if read_limit_mag is not None:
        mag = np.asarray(made.columns["mag"], dtype=np.float64)
        made.verdicts.reject(mag > read_limit_mag, Reason.too_faint)
    columns = move_to_epoch(made.columns, epoch_jyear)
    columns |= {"catalog": source_name, "source_file": number, "source_line": records.line}
    table = table_from_columns("stars", columns, len(records))
    kept = made.verdicts.is_kept
    if kept.all():
        stars, rejected = table, []
    else:
        out = table.filter(pa.array(~kept))
        stars, rejected = table.filter(pa.array(kept)), [reject_rows(out, made.verdicts.reasons)]
    if records.problems:
        rejected.append(malformed_rows(records.problems, number, source_name, band))
    empty = product_schema("rejected").arrow_schema.empty_table()
    return _Part(
        number,
        len(records) + len(records.problems),
        stars,
        pa.concat_tables(rejected) if rejected else empty,
        records.problems,
    )


def reject_rows(stars: pa.Table, reasons: pa.Array) -> pa.Table:
    """Return rows of a star table as rows of a rejected table.

    Parameters
    ----------
    stars : pyarrow.Table
        Of the stars schema.
    reasons : pyarrow.Array
        Of strings, one a row.

    Returns
    -------
    pyarrow.Table
        Of the rejected schema.
    """
    schema = product_schema("rejected").arrow_schema
    verdict = {"reason": reasons, "detail": pa.nulls(len(stars), pa.string())}
    columns = [verdict[name] if name in verdict else stars[name] for name in schema.names]
    return pa.Table.from_arrays(columns, schema=schema)


def _join(parts: Sequence[_Part], source_name: str, band: str) -> tuple[pa.Table, pa.Table]:
    """Join the blocks, sorted, and reject the records whose star was read before."""
    # Chunks stay as they are: joining them would hold the whole catalog in memory twice.
    stars = pa.concat_tables([part.stars for part in parts])
    keys = ["star_id", "source_file", "source_line"]
    stars = sort_rows(stars, keys)
    rejected = [part.rejected for part in parts]
    number = stars["star_id"].to_numpy()
    repeated = np.concatenate([[False], number[1:] == number[:-1]])[: len(number)]
    if repeated.any():
        again = stars.filter(pa.array(repeated))
        reasons = pa.repeat(Reason.duplicate_record.name, len(again))
        rejected.append(reject_rows(again, reasons))
        stars = stars.filter(pa.array(~repeated)).combine_chunks()
    return stars, sort_rows(pa.concat_tables(rejected).combine_chunks(), keys)
