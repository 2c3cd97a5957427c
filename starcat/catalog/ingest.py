"""Read archive files into one star table: the first stage of every build.

The reader of a layout parses the blocks of a file. The catalog's own module converts the records
to columns of the star table. Stars are then moved to the epoch, and the blocks joined. Every record
is either in the star table, or in the rejected table with one reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa

from starcat.catalog.parts import NAMED_PROBLEMS, IngestOptions, merged, parse_block, read_files
from starcat.catalog.photometry import blend_weights
from starcat.catalog.source import DataSource, data_source, star_sources
from starcat.catalog.source_files import FileFacts, SourceFiles
from starcat.catalog.stars.star_table import (
    add_nearest_neighbours,
    floats_of,
    sort_rows,
    split_by_verdict,
)
from starcat.catalog.stars.verdict import Reason, Verdicts, count_by_reason, rejected_path
from starcat.errors import BuildError, ConfigError
from starcat.progress import Progress, no_progress
from starcat.results import in_record
from starcat.storage.atomic import whole_file
from starcat.storage.parquet import write_parquet
from starcat.storage.schema import product_schema

_PART_ROWS = 8192


@dataclass(frozen=True)
class CatalogPart:
    """Facts about one of several catalogs that are merged into one table."""

    source: str
    files: tuple[FileFacts, ...]
    beyond_read_limit: int

    @classmethod
    def of(cls, read: Ingested) -> CatalogPart:
        """Return the facts about a catalog that was read."""
        return cls(read.source, read.files, read.beyond_read_limit)


@dataclass(frozen=True)
class Ingested:
    """A catalog as a star table.

    Attributes
    ----------
    source : str
        Name of the catalog.
    band : str
        Band of `mag`.
    stars : pa.Table
        Records with a position, by star_id; schema `stars`.
    rejected : pa.Table
        Other records except those beyond the read limit; schema `rejected`.
    files : tuple[FileFacts, ...]
        Files read, in order.
    problems : tuple[str, ...]
        The first malformed records, each with file, line and bytes.
    notes : tuple[str, ...]
        Remarks on the inputs for the user.
    beyond_read_limit : int
        Records that are in neither table.
    parts : tuple[CatalogPart, ...]
        Catalogs that were merged.
    """

    source: str
    band: str
    stars: pa.Table = field(repr=False)
    rejected: pa.Table = field(repr=False)
    files: tuple[FileFacts, ...]
    problems: tuple[str, ...]
    notes: tuple[str, ...] = ()
    beyond_read_limit: int = field(default=0, repr=False)
    parts: tuple[CatalogPart, ...] = field(default=(), repr=False)

    def __repr__(self) -> str:
        """Return the source and the counts in one line."""
        return (
            f"<Ingested {self.source} ({self.band}): {self.rows_read:,} records read, "
            f"{len(self.stars):,} kept, {sum(self.rejected_by_reason.values()):,} rejected>"
        )

    @property
    @in_record()
    def rows_read(self) -> int:
        """Records in all files."""
        return sum(file.rows for file in self.files)

    @property
    @in_record()
    def kept(self) -> int:
        """Records that are stars."""
        return len(self.stars)

    @property
    @in_record(key="rejected")
    def rejected_by_reason(self) -> dict[str, int]:
        """Number of rejected records by reason, in the order of the reasons."""
        return count_by_reason(self.rejected, self.beyond_read_limit)


@dataclass
class StarTables:
    """The tables of a catalog while it is read, part by part."""

    stars: list[pa.Table] = field(default_factory=list)
    rejected: list[pa.Table] = field(default_factory=list)
    counted: int = 0  # records beyond the read limit

    def add(self, stars: pa.Table, rejected: pa.Table | None = None, counted: int = 0) -> None:
        """Add a part."""
        self.stars += [stars] if len(stars) else []
        self.rejected += [rejected] if rejected is not None and len(rejected) else []
        self.counted += counted

    def joined(self) -> tuple[pa.Table, pa.Table]:
        """Return stars and rejected records, sorted.

        If several records have the same star, the record that was read first is kept.
        """
        # Do not combine the chunks: that would hold the whole catalog in memory twice.
        stars = sort_rows(_concatenated("stars", self.stars), _KEYS)
        number = stars["star_id"].to_numpy()
        repeated = np.concatenate([[False], number[1:] == number[:-1]])[: len(number)]
        if repeated.any():
            verdicts = Verdicts(len(stars))
            verdicts.reject(repeated, Reason.duplicate_record)
            stars, again = split_by_verdict(stars, verdicts)
            stars = stars.combine_chunks()
            self.rejected.append(again)
        rejected = _concatenated("rejected", self.rejected).combine_chunks()
        return stars, sort_rows(rejected, _KEYS)


_KEYS = ("star_id", "source_file", "source_line")


def _concatenated(product: str, tables: Sequence[pa.Table]) -> pa.Table:
    return pa.concat_tables(tables or [product_schema(product).arrow_schema.empty_table()])


def ingest_catalog(
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

    The default band is the source's first band. Without an epoch every star stays at its own
    epoch. Records fainter than the read limit are only counted; they do not count as neighbours
    of other stars. Workers are threads; the result does not depend on their number.
    """
    options = ingest_options(source_name, band, epoch_jyear, read_limit_mag)
    files = SourceFiles.find(data_source(source_name), paths)
    tables, facts = StarTables(), []
    problems: list[str] = []
    parse = partial(parse_block, options=options)
    for reading, parts in read_files(files.files, parse, workers, progress):
        for part in merged(parts, _PART_ROWS):
            stars, rejected = part.stars.combine_chunks(), part.rejected.combine_chunks()
            tables.add(stars, rejected, part.counted)
        facts.append(reading.facts)
        problems += reading.named_problems
        files.check_contents(facts)
    return ingested(options, tables, facts, problems, files.notes, workers if neighbours else 0)


def ingested(
    options: IngestOptions,
    tables: StarTables,
    files: Sequence[FileFacts],
    problems: Sequence[str],
    notes: Sequence[str],
    workers: int,
) -> Ingested:
    """Return a catalog that has been read, after checking that no record is missing.

    The workers search for the nearest neighbours; with 0 workers this step is left out.
    """
    stars, rejected = tables.joined()
    product_schema("stars").check(stars)
    product_schema("rejected").check(rejected)
    unmoved = unmoved_epochs(stars, options.epoch_jyear)
    read = Ingested(
        options.source_name,
        options.band,
        add_nearest_neighbours(stars, workers) if workers else stars,
        rejected,
        tuple(files),
        tuple(problems)[:NAMED_PROBLEMS],
        (*notes, *unmoved_note(options.source_name, [unmoved], len(stars), options.epoch_jyear)),
        tables.counted,
    )
    left_out = sum(read.rejected_by_reason.values())
    if read.rows_read != len(stars) + left_out:
        raise BuildError(
            f"{read.rows_read} records read, but {len(stars)} kept and {left_out} "
            "rejected by reason; expected as many",
            where=read.source,
            hint="This is a fault of starcat: report it with the command and the files",
        )
    return read


def ingest_options(
    source_name: str,
    band: str | None,
    epoch_jyear: float | None = None,
    read_limit_mag: float | None = None,
) -> IngestOptions:
    """Return the options for reading a source, after checking that it has stars and the band."""
    source = data_source(source_name)
    if source.kind != "stars":
        raise ConfigError(
            f"{source_name} is not a star catalog",
            key="source",
            value=source_name,
            hint=f"choose one of {', '.join(star_sources())}",
        )
    return IngestOptions(source.name, check_band(source, band), epoch_jyear, read_limit_mag)


def check_band(source: DataSource, band: str | None) -> str:
    """Return the band (by default the source's first), after checking that the source has it."""
    if band is None:
        return source.bands[0]
    if source.archive == "2mass":
        blend_weights(band)
    elif band not in source.bands:
        raise ConfigError(
            f"{source.name} has no band {band!r}; it has {', '.join(source.bands)}",
            key="band",
            value=band,
        )
    return band


NOTABLE_YEARS = 0.005
"""Smaller differences of epochs are not reported: archives state dates with few digits."""


UNMOVED = "have no proper motion and stay"
"""Words of the note that stars are not moved."""


def unmoved_epochs(stars: pa.Table, epoch_jyear: float | None) -> list[float]:
    """Return how many stars are not at the requested epoch, and their first and last epoch."""
    epochs = floats_of(stars, "epoch_jyear")
    if epoch_jyear is None:
        return []
    unmoved = epochs[np.abs(epochs - epoch_jyear) >= NOTABLE_YEARS]
    return [len(unmoved), float(unmoved.min()), float(unmoved.max())] if len(unmoved) else []


def unmoved_note(
    source_name: str, parts: Sequence[Sequence[float]], count: int, epoch_jyear: float | None
) -> tuple[str, ...]:
    """Return a note about the stars of the parts of a catalog that are not at the epoch, if any.

    ``parts`` are results of `unmoved_epochs`, ``count`` is the number of all stars.
    """
    unmoved_parts = [part for part in parts if part]
    if not unmoved_parts or epoch_jyear is None:
        return ()
    unmoved, first, last = zip(*unmoved_parts, strict=True)
    years = " to ".join(sorted({f"{year:.2f}" for year in (min(first), max(last))}))
    return (
        f"{source_name}: {int(sum(unmoved)):,} of {count:,} stars {UNMOVED} at J{years}, not "
        f'J{epoch_jyear:.2f}; a spec with catalog.motions = ["tycho2"] moves them',
    )


def write_star_tables(read: Ingested, output: Path) -> None:
    """Write a star table, and the rejected rows (if there are any) next to it.

    Two files cannot get their names in one step. An earlier star table is removed before the
    rejected rows are replaced, and the new one gets its name last: no table has the rejected rows
    of another run next to it, even if the process is killed.
    """
    beside = rejected_path(output)
    with whole_file(output) as stars:
        write_parquet(read.stars, stars)
        with whole_file(beside) if len(read.rejected) else nullcontext() as rejected:
            if rejected is not None:
                write_parquet(read.rejected, rejected)
            for before in (output, beside):
                if before.is_file():
                    before.unlink()
