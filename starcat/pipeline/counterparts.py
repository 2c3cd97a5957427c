"""Cross-identification of star tables: of a build's guide stars, and of two files.

Counterparts are read at their own epochs, where their positions are most precise, one catalog at
a time. Only rows that are possible counterparts of some star stay in memory.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from starcat.catalog.source import map_of
from starcat.catalog.stars.positions import Positions
from starcat.catalog.stars.star_table import rows_of_stars, sort_rows
from starcat.catalog.store.layout import check_has_columns, is_store, parquet_file
from starcat.catalog.store.reading import read_catalog
from starcat.database.manifest import SourceFacts
from starcat.database.products.crossmatch import (
    ARCSEC,
    NEEDED,
    NUMBERS,
    VERDICTS,
    Crossmatch,
    Matches,
    candidate_pairs,
    counterparts_of,
    crossmatch,
    matched_rows,
)
from starcat.database.writer import Product
from starcat.errors import ConfigError, ParseError, SourceMissing
from starcat.pipeline.draft import Draft, Stage, stage
from starcat.pipeline.selection.merging import MERGED
from starcat.pipeline.selection.selecting import Selected
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.storage.schema import product_schema


@dataclass(frozen=True)
class Summary:
    """The result of a cross-identification of two catalogs in numbers."""

    stars: int
    counterparts: int
    radius_arcsec: float  # largest separation of a candidate
    matched: int  # stars with a counterpart, ambiguous ones included
    unmatched: int  # stars without a counterpart
    verdicts: dict[str, int]  # matched stars by the verdict on their counterpart
    no_candidate: int  # stars without a candidate within the radius
    mutual: int  # stars that are their likeliest candidate's likeliest star
    median_separation_arcsec: float | None  # over the matched stars; None if there are none
    median_delta_mag: float | None
    # Parameters of the odds, given or measured:
    position_error_arcsec: float
    expected_delta_mag: float
    completeness: float


def match_tables(
    stars: pa.Table, counterparts: pa.Table, options: Crossmatch
) -> tuple[pa.Table, Summary]:
    """Find the counterparts of one star table in another."""
    matches = crossmatch(stars, counterparts, options)
    best = matches.table.filter(pc.equal(matches.table["rank"], 1))
    matched = matches.table.take(matched_rows(matches.table))
    verdicts = matched["verdict"].to_pylist()
    return matches.table, Summary(
        stars=len(stars),
        counterparts=len(counterparts),
        radius_arcsec=options.radius_arcsec,
        matched=len(matched),
        unmatched=len(stars) - len(matched),
        verdicts={name: verdicts.count(name) for name in VERDICTS if name != "none"},
        no_candidate=len(stars) - len(best),
        mutual=int((best["star_rank"].to_numpy() == 1).sum()),
        median_separation_arcsec=_median(matched["separation_arcsec"]),
        median_delta_mag=_median(matched["delta_mag"].drop_null()),
        position_error_arcsec=round(matches.position_error_arcsec, 6),
        expected_delta_mag=round(matches.expected_delta_mag, 6),
        completeness=round(matches.completeness, 6),
    )


def _median(values: pa.ChunkedArray) -> float | None:
    return round(float(np.median(values.to_numpy())), 6) if len(values) else None


def with_rivals(stars: pa.Table, selected: Selected, radius_rad: float) -> pa.Table:
    """Return guide stars, followed by rejected stars that can own the same counterparts.

    A component of a double star that is not a guide star is still the better match for its own
    entry in the other catalog. Stars that were merged into a guide star are part of it.
    """
    guide_stars = selected.guide_stars.select([*NEEDED, *NUMBERS])
    apart = pc.not_equal(selected.rejected["reason"], MERGED.name)
    rows = rows_of_stars(selected.rejected.filter(apart), stars)
    others = stars.select(guide_stars.column_names).take(pa.array(np.unique(rows[rows >= 0])))
    positions = Positions.of(guide_stars), Positions.of(others)
    near = candidate_pairs(*positions, 2.0 * radius_rad)[1]
    rivals = others.take(pa.array(np.unique(near))).cast(guide_stars.schema)
    return pa.concat_tables([guide_stars, rivals])


def _crossmatch_plan(spec: BuildSpec) -> str | None:
    section = spec.products.crossmatch
    return f"find counterparts in {', '.join(section.catalogs)}" if section.enabled else None


@stage(
    "product crossmatch",
    "products",
    _crossmatch_plan,
    lambda spec: spec.products.crossmatch.catalogs if spec.products.crossmatch.enabled else (),
)
def find_counterparts(draft: Draft) -> None:
    """Find the counterparts of guide stars in other catalogs."""
    options, selected = draft.spec.products.crossmatch, draft.selected
    both = with_rivals(draft.stars, selected, options.radius_arcsec * ARCSEC)
    tables = []
    for name in options.catalogs:
        _, matches = match_source(name, find_counterparts, both, draft)
        is_guide_star = pc.less(matches.table["star"], len(selected.guide_stars))
        tables.append(matches.table.filter(is_guide_star))
        joined = counterparts_of(tables[-1], name)
        draft.sources[-1] = replace(draft.sources[-1], joined=joined)
    order = product_schema("crossmatch").order
    table = sort_rows(pa.concat_tables(tables), order).combine_chunks()
    draft.products.append(Product("crossmatch", table))


def match_source(name: str, by: Stage, stars: pa.Table, draft: Draft) -> tuple[pa.Table, Matches]:
    """Return the stars of a source, read to the depth of the spec, and the candidates for stars.

    The draft records the files that were read.
    """
    options = draft.spec.products.crossmatch
    read = read_catalog(
        name,
        draft.paths[name],
        read_limit_mag=options.read_limit_mag,
        neighbours=False,
        workers=draft.workers,
        progress=draft.progress,
    )
    draft.progress(by.title, 0, None)
    role, counted = by.title.removeprefix("product "), (read.rows_read, len(read.stars))
    rejected, table_map = read.rejected_by_reason, map_of(read.source)
    facts = SourceFacts(read.source, role, read.files, *counted, rejected, map=table_map)
    draft.sources.append(facts)
    draft.note(by.name, *read.notes)
    return read.stars, crossmatch(stars, read.stars, options)


def match_files(a: Path, b: Path, options: Crossmatch) -> tuple[pa.Table, Summary]:
    """Find the counterparts of the stars of one file in another, with the names of the stars."""
    stars, counterparts = read_star_table(a), read_star_table(b)
    table, summary = match_tables(stars, counterparts, options)
    identity = stars.select(["star_id", "designation"]).take(table["star"].combine_chunks())
    star_schema = product_schema("stars").arrow_schema
    names = [
        star_schema.field("star_id"),
        star_schema.field("designation").with_name("star_designation"),
    ]
    schema = pa.schema([*names, *table.schema])
    return pa.Table.from_arrays([*identity.columns, *table.columns], schema=schema), summary


def read_star_table(path: Path) -> pa.Table:
    """Read the columns of a star table that a cross-identification needs."""
    hint = "give a star table, as 'starcat ingest' writes it"
    if is_store(path):
        raise ConfigError(
            "is a catalog store; crossmatch reads star tables",
            where=path,
            hint="Use crossmatch() of 'starcat sql' for pairs within a radius, or LSDB, which "
            "opens the folder",
        )
    if not path.exists():
        raise SourceMissing("no such file", where=path, hint=hint)
    with parquet_file(path, ParseError, hint) as file:
        names = file.schema_arrow.names
        check_has_columns(path, names, NEEDED, hint)
        table = file.read([*NEEDED, *(name for name in NUMBERS if name in names)])
    product_schema("stars").check_values(table, str(path), hint, must_be_finite=True)
    return table
