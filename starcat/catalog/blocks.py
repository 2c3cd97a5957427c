"""One block of an archive file in, its stars and rejected records out; and blocks joined."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

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
        Fainter records are rejected.
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
        Its records, each in one of the two.
    problems : list of Problem
        Why records are malformed.
    """

    file_number: int
    rows: int
    stars: pa.Table
    rejected: pa.Table
    problems: list[Problem]


def parse_block(file_number: int, block: Block, how: Reading) -> Part:
    """Return the stars and the rejected records of a block.

    Parameters
    ----------
    file_number : int
        Number of the block's file among the inputs.
    block : Block
        Whole records.
    how : Reading
        Which catalog, band and epoch.

    Returns
    -------
    Part
        Every record of the block, in the one table or the other.
    """
    layout = block.file.layout
    module = CATALOGS[how.source_name]
    names = list(module.columns[layout.name])
    records = _PARSERS[layout.layout](block.data, layout, names, block.first_line)
    made = without_impossible(module.stars(records, how.band))
    if how.read_limit_mag is not None:
        mag = np.asarray(made.columns["mag"], dtype=np.float64)
        made.verdicts.reject(mag > how.read_limit_mag, Reason.too_faint)
    columns = move_to_epoch(made.columns, how.epoch_jyear)
    columns |= {"catalog": how.source_name, "source_file": file_number}
    columns |= {"source_line": records.line}
    table = table_from_columns("stars", columns, len(records))
    kept = made.verdicts.is_kept
    if kept.all():
        stars, rejected = table, []
    else:
        out = table.filter(pa.array(~kept))
        stars, rejected = table.filter(pa.array(kept)), [reject_rows(out, made.verdicts.reasons)]
    problems = records.problems
    if problems:
        rejected.append(malformed_rows(problems, file_number, how.source_name, how.band))
    empty = product_schema("rejected").arrow_schema.empty_table()
    left_out = pa.concat_tables(rejected) if rejected else empty
    return Part(file_number, len(records) + len(problems), stars, left_out, problems)


def reject_rows(stars: pa.Table, reasons: pa.Array) -> pa.Table:
    """Return rows of a star table as rows of a rejected table.

    Parameters
    ----------
    stars : pyarrow.Table
        Table of the stars schema.
    reasons : pyarrow.Array
        Strings, one a row.

    Returns
    -------
    pyarrow.Table
        Table of the rejected schema.
    """
    schema = product_schema("rejected").arrow_schema
    verdict = {"reason": reasons, "detail": pa.nulls(len(stars), pa.string())}
    columns = [verdict[name] if name in verdict else stars[name] for name in schema.names]
    return pa.Table.from_arrays(columns, schema=schema)


def join_parts(parts: Sequence[Part]) -> tuple[pa.Table, pa.Table]:
    """Join the blocks of a catalog, and reject the records whose star was read before.

    Parameters
    ----------
    parts : sequence of Part
        At least one.

    Returns
    -------
    stars : pyarrow.Table
        Table of the stars schema, by star_id.
    rejected : pyarrow.Table
        Table of the rejected schema, in its order.
    """
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
