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
from numpy.typing import NDArray

from starcat.artifact.manifest import SourceFacts
from starcat.artifact.writer import Product
from starcat.catalog.ingest import Ingested
from starcat.catalog.source import map_of
from starcat.errors import ConfigError, ParseError, SchemaError, SourceMissing
from starcat.pipeline.draft import Draft, Stage, stage
from starcat.products.crossmatch import (
    NEEDED,
    Crossmatch,
    counterparts_of,
    matched_rows,
    moving_stars,
    table_from_matches,
)
from starcat.products.match_figures import ARCSEC, MatchModel
from starcat.products.match_stars import VERDICTS, candidate_pairs, crossmatch
from starcat.selection.merging import MERGED
from starcat.selection.selecting import Selected
from starcat.specs.build_spec import BuildSpec
from starcat.stars.star_table import rows_of_stars, sort_rows
from starcat.storage.schema import product_schema
from starcat.store.layout import check_has_columns, is_store, parquet_file
from starcat.store.reading import read_catalog


def model_from_spec(wanted: Crossmatch) -> MatchModel:
    """Return the model of errors of a spec."""
    error = wanted.position_error_arcsec
    return MatchModel(
        position_error_rad=None if error is None else error * ARCSEC,
        unknown_motion_rad_yr=wanted.unknown_motion_mas_yr * 1e-3 * ARCSEC,
        outlier_share=wanted.outlier_share,
        expected_delta_mag=wanted.expected_delta_mag,
        colour_spread_mag=wanted.colour_spread_mag,
        completeness=wanted.completeness,
        ambiguous_odds=wanted.ambiguous_odds,
        min_probability=wanted.min_probability,
    )


@dataclass(frozen=True)
class Summary:
    """The result of a cross-identification of two catalogs in numbers."""

    stars: int
    counterparts: int
    radius_arcsec: float  # largest separation of a candidate
    matched: int  # stars with a counterpart, ambiguous ones included
    unmatched: int  # stars without a counterpart
    verdicts: dict[str, int]  # stars by the verdict on their likeliest candidate
    no_candidate: int  # stars without a candidate within the radius
    mutual: int  # stars that are their likeliest candidate's likeliest star
    median_separation_arcsec: float | None  # over the matched stars; None if there are none
    median_delta_mag: float | None
    # Parameters of the odds, given or measured:
    position_error_arcsec: float
    expected_delta_mag: float
    completeness: float


def match_tables(
    stars: pa.Table, counterparts: pa.Table, wanted: Crossmatch
) -> tuple[pa.Table, Summary]:
    """Find the counterparts of one star table in another."""
    radius = wanted.radius_arcsec * ARCSEC
    model = model_from_spec(wanted)
    found = crossmatch(moving_stars(stars), moving_stars(counterparts), radius, model)
    table = table_from_matches(found, counterparts)
    rows, first = matched_rows(table), found.rank == 1
    delta_mag = found.delta_mag[rows]
    return table, Summary(
        stars=len(stars),
        counterparts=len(counterparts),
        radius_arcsec=wanted.radius_arcsec,
        matched=len(rows),
        unmatched=len(stars) - len(rows),
        verdicts={name: found.count(name) for name in VERDICTS if name != "other"},
        no_candidate=len(stars) - int(first.sum()),
        mutual=int((first & (found.star_rank == 1)).sum()),
        median_separation_arcsec=_median(found.separation_rad[rows] / ARCSEC),
        median_delta_mag=_median(delta_mag[~np.isnan(delta_mag)]),
        position_error_arcsec=round(found.odds.position_error_rad / ARCSEC, 6),
        expected_delta_mag=round(found.odds.delta_mag, 6),
        completeness=round(found.odds.completeness, 6),
    )


def _median(values: NDArray[np.float64]) -> float | None:
    return round(float(np.median(values)), 6) if len(values) else None


def with_rivals(stars: pa.Table, selected: Selected, radius_rad: float) -> pa.Table:
    """Return guide stars, followed by rejected stars that can own the same counterparts.

    A component of a double star that is not a guide star is still the better match for its own
    entry in the other catalog. Stars that were merged into a guide star are part of it.
    """
    guide_stars = selected.guide_stars.select(NEEDED)
    apart = pc.not_equal(selected.rejected["reason"], MERGED.name)
    rows = rows_of_stars(selected.rejected.filter(apart), stars)
    others = stars.select(NEEDED).take(pa.array(np.unique(rows[rows >= 0])))
    near = candidate_pairs(moving_stars(guide_stars), moving_stars(others), 2.0 * radius_rad)
    rivals = others.take(pa.array(np.unique(near.counterpart))).cast(guide_stars.schema)
    return pa.concat_tables([guide_stars, rivals])


def _crossmatch_plan(spec: BuildSpec) -> str | None:
    wanted = spec.products.crossmatch
    return f"find counterparts in {', '.join(wanted.catalogs)}" if wanted.enabled else None


@stage(
    "product crossmatch",
    "products",
    _crossmatch_plan,
    lambda spec: spec.products.crossmatch.catalogs if spec.products.crossmatch.enabled else (),
)
def find_counterparts(draft: Draft) -> None:
    """Find the counterparts of guide stars in other catalogs."""
    wanted, selected = draft.spec.products.crossmatch, draft.selected
    both = with_rivals(draft.stars, selected, wanted.radius_arcsec * ARCSEC)
    tables = []
    for name in wanted.catalogs:
        matches = match_source(name, find_counterparts, both, draft)
        tables.append(matches.filter(pc.less(matches["star"], len(selected.guide_stars))))
        joined = counterparts_of(tables[-1], name)
        draft.sources[-1] = replace(draft.sources[-1], joined=joined)
    order = product_schema("crossmatch").order
    table = sort_rows(pa.concat_tables(tables), order).combine_chunks()
    draft.products.append(Product("crossmatch", table))


def match_source(name: str, by: Stage, stars: pa.Table, draft: Draft) -> pa.Table:
    """Return the candidates for stars in a source, and record the files read in the draft.

    The catalog itself is dropped, as two catalogs may not fit into memory.
    """
    read, matches = read_and_match(name, by, stars, draft)
    draft.sources.append(source_facts(read, by.title.removeprefix("product ")))
    draft.note(by.name, *read.notes)
    return matches


def read_and_match(
    name: str, by: Stage, stars: pa.Table, draft: Draft
) -> tuple[Ingested, pa.Table]:
    """Return a source, read to the depth that the spec needs, and the candidates for stars."""
    wanted = draft.spec.products.crossmatch
    read = read_catalog(
        name,
        draft.paths[name],
        read_limit_mag=wanted.read_limit_mag,
        neighbours=False,
        workers=draft.workers,
        progress=draft.progress,
    )
    draft.progress(by.title, 0, None)
    return read, match_tables(stars, read.stars, wanted)[0]


def source_facts(read: Ingested, role: str) -> SourceFacts:
    """Return the facts for the manifest about a catalog whose stars are all used."""
    rejected = read.rejected_by_reason
    counted = (read.rows_read, len(read.stars), rejected)
    return SourceFacts(read.source, role, read.files, *counted, map=map_of(read.source))


def match_files(a: Path, b: Path, wanted: Crossmatch) -> tuple[pa.Table, Summary]:
    """Find the counterparts of the stars of one file in another."""
    stars, counterparts = read_star_table(a), read_star_table(b)
    table, summary = match_tables(stars, counterparts, wanted)
    return with_own_names(table, stars), summary


def with_own_names(table: pa.Table, stars: pa.Table) -> pa.Table:
    """Return counterparts with the number and the name of their star in front."""
    own = stars.select(["star_id", "designation"]).take(table["star"].combine_chunks())
    columns = [own["star_id"], own["designation"], *table.columns]
    known = product_schema("stars").arrow_schema
    names = [known.field("star_id"), known.field("designation").with_name("star_designation")]
    schema = pa.schema([*names, *product_schema("crossmatch").arrow_schema])
    return pa.Table.from_arrays(columns, schema=schema)


def read_star_table(path: Path) -> pa.Table:
    """Read the columns of a star table that a cross-identification needs."""
    hint = "give a star table, as 'starcat ingest' writes it"
    if is_store(path):
        raise ConfigError(
            f"{path}: is a catalog store; crossmatch reads star tables",
            hint="Use crossmatch() of 'starcat sql' for pairs within a radius, or LSDB, which "
            "opens the folder",
        )
    if not path.exists():
        raise SourceMissing(f"{path}: no such file", path=path, hint=hint)
    with parquet_file(path, ParseError, hint) as file:
        check_has_columns(path, file.schema_arrow.names, NEEDED, hint)
        table = file.read(list(NEEDED))
    check_star_columns(table, path)
    return table


def check_star_columns(table: pa.Table, path: Path) -> None:
    """Check the types of columns, and that every star has a number and a position."""
    for column in product_schema("stars").columns:
        if column.name not in NEEDED or column.name not in table.column_names:
            continue
        values, kind = table[column.name], column.arrow_field.type
        blank = values.null_count
        if column.dtype == "float64" and values.type == kind and not column.nullable:
            blank += pc.sum(pc.invert(pc.is_finite(values))).as_py() or 0
        if values.type != kind or (blank and not column.nullable):
            found = f"{values.type}" if values.type != kind else f"{blank} rows without a value"
            raise SchemaError(
                f"{path}: {column.name}: found {found}; a star table has {kind} in every row",
                product="stars",
                field=column.name,
                found=found,
                expected=str(kind),
                hint="Make it with 'starcat ingest'",
            )
