"""One block of an archive file in, its stars and rejected records out; and blocks joined."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from starcat.catalog.archives import gaia, hipparcos, sao, twomass, tycho1, tycho2
from starcat.catalog.plausible import without_impossible
from starcat.catalog.readers.binary import parse_binary
from starcat.catalog.readers.delimited import parse_delimited
from starcat.catalog.readers.files import Block
from starcat.catalog.readers.fixed_width import parse_fixed_width
from starcat.catalog.readers.malformed import malformed_rows
from starcat.catalog.readers.records import Problem, Records
from starcat.catalog.stars import StarBlock, move_to_epoch, sort_rows, table_from_columns
from starcat.catalog.verdict import Reason
from starcat.storage.schema import product_schema

_PARSERS = {
    "fixed_width": parse_fixed_width,
    "delimited": parse_delimited,
    "binary": parse_binary,
}


@dataclass(frozen=True)
class CatalogModule:
    """What ingest needs of a catalog: the columns to parse and what they mean.

    A large catalog also gives the magnitudes by themselves: with a read limit nothing else is
    made of the records beyond it.
    """

    columns: Mapping[str, Sequence[str]]
    stars: Callable[[Records, str], StarBlock]
    magnitudes: Callable[[Records, str], NDArray[np.float64]] | None = None


CATALOGS = {
    "sao": CatalogModule(sao.COLUMNS, sao.stars),
    "hipparcos": CatalogModule(hipparcos.COLUMNS, hipparcos.stars),
    "tycho1": CatalogModule(tycho1.COLUMNS, tycho1.stars),
    "tycho2": CatalogModule(tycho2.COLUMNS, tycho2.stars),
    "2mass": CatalogModule(twomass.COLUMNS, twomass.stars, twomass.magnitudes),
    "gaia": CatalogModule(gaia.COLUMNS, gaia.stars),
}
"""The star catalogs, by the name of their data source."""


@dataclass(frozen=True)
class Reading:
    """How the records of a catalog are read.

    Attributes
    ----------
    source_name : str
        A name of `CATALOGS`.
    band : str
        Band of ``mag``.
    epoch_jyear : float, optional
        Julian year to move positions to; None leaves every star at its own epoch.
    read_limit_mag : float, optional
        Fainter records are counted and not held.
    """

    source_name: str
    band: str
    epoch_jyear: float | None = None
    read_limit_mag: float | None = None


@dataclass(frozen=True)
class Part:
    """One block after parsing.

    Attributes
    ----------
    file_number : int
        Number of the file that it is from.
    rows : int
        Records in it, good and malformed.
    stars, rejected : pyarrow.Table
        Its records, each in one of the two, but those that are only counted.
    problems : list of Problem
        Why records are malformed.
    counted : int
        Records beyond the read limit, which are in neither table.
    """

    file_number: int
    rows: int
    stars: pa.Table
    rejected: pa.Table
    problems: list[Problem]
    counted: int = 0


def parse_block(file_number: int, block: Block, how: Reading) -> Part:
    """Return the stars and the rejected records of a block."""
    layout = block.file.layout
    module = CATALOGS[how.source_name]
    names = list(module.columns[layout.name])
    records = _PARSERS[layout.layout](block.data, layout, names, block.first_line)
    count, limit_mag = len(records), how.read_limit_mag
    if limit_mag is not None and module.magnitudes is not None:
        records = records.where(module.magnitudes(records, how.band) <= limit_mag)
    made, line = module.stars(records, how.band), records.line
    if limit_mag is not None:
        is_held = np.asarray(made.columns["mag"], dtype=np.float64) <= limit_mag
        made, line = made.where(is_held), line[is_held]
    made = without_impossible(made)

    def table_of(some: StarBlock, lines: NDArray[np.int64]) -> pa.Table:
        columns = move_to_epoch(some.columns, how.epoch_jyear)
        columns |= {"catalog": how.source_name, "source_file": file_number, "source_line": lines}
        return table_from_columns("stars", columns, len(lines))

    kept = made.verdicts.is_kept
    if kept.all():
        stars, rejected = table_of(made, line), []
    else:
        stars = table_of(made.where(kept), line[kept])
        out = table_of(made.where(~kept), line[~kept])
        rejected = [reject_rows(out, made.verdicts.reasons)]
    problems = records.problems
    if problems:
        rejected.append(malformed_rows(problems, file_number, how.source_name, how.band))
    empty = product_schema("rejected").arrow_schema.empty_table()
    left_out = pa.concat_tables(rejected) if rejected else empty
    counted = count - len(line)
    return Part(file_number, count + len(problems), stars, left_out, problems, counted)


def reject_rows(stars: pa.Table, reasons: pa.Array) -> pa.Table:
    """Return rows of a star table as rows of a rejected table."""
    schema = product_schema("rejected").arrow_schema
    verdict = {"reason": reasons, "detail": pa.nulls(len(stars), pa.string())}
    columns = [verdict[name] if name in verdict else stars[name] for name in schema.names]
    return pa.Table.from_arrays(columns, schema=schema)


class TablePile:
    """Tables that are to be joined; many small ones are joined as they come, to save memory."""

    def __init__(self, product: str) -> None:
        self._schema = product_schema(product).arrow_schema
        self._done: list[pa.Table] = []
        self._small: list[pa.Table] = []

    def add(self, table: pa.Table) -> None:
        """Put a table on the pile."""
        self._small += [table] if len(table) else []
        if len(self._small) >= 256 or sum(map(len, self._small)) >= _SMALL_ROWS:
            self._join_small()

    def _join_small(self) -> None:
        if len(self._small) > 1:
            self._small = [pa.concat_tables(self._small).combine_chunks()]
        self._done += self._small
        self._small = []

    @property
    def tables(self) -> list[pa.Table]:
        """What is on the pile, in order: at least one table."""
        self._join_small()
        return self._done or [self._schema.empty_table()]


_SMALL_ROWS = 8192


def join_parts(
    stars: Sequence[pa.Table], rejected: Sequence[pa.Table]
) -> tuple[pa.Table, pa.Table]:
    """Join the parts of a catalog, and reject the records whose star was read before."""
    # Chunks stay as they are: joining them would hold the whole catalog in memory twice.
    keys = ["star_id", "source_file", "source_line"]
    joined = sort_rows(pa.concat_tables(stars), keys)
    left_out = list(rejected)
    number = joined["star_id"].to_numpy()
    repeated = np.concatenate([[False], number[1:] == number[:-1]])[: len(number)]
    if repeated.any():
        again = joined.filter(pa.array(repeated))
        reasons = pa.repeat(Reason.duplicate_record.name, len(again))
        left_out.append(reject_rows(again, reasons))
        joined = joined.filter(pa.array(~repeated)).combine_chunks()
    return joined, sort_rows(pa.concat_tables(left_out).combine_chunks(), keys)
