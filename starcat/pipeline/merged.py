"""Several catalogs as one: the stars of the first, and of each later one those that it lacks.

A record that is the counterpart of a star is rejected with the reason ``counterpart``, and so is
the likeliest of several that may be it (``ambiguous_counterpart``). The others near a star stay
stars of their own: as close pairs they are left to the rules of the selection. Every value of a
row is from its ``catalog``; a magnitude that was in another band is in that of the first catalog,
and ``mag_source`` says from what it was made.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from starcat.bands.response import shipped, shipped_names
from starcat.catalog.ingest import CatalogPart, Ingested
from starcat.catalog.sensor_band import in_sensor_band
from starcat.errors import ConfigError
from starcat.pipeline.counterparts import match_tables
from starcat.products.crossmatch import Crossmatch, matched_stars
from starcat.progress import Progress, no_progress
from starcat.stars.star_table import add_nearest_neighbours, reject_rows, sort_rows, with_columns
from starcat.stars.verdict import Reason
from starcat.storage.schema import product_schema
from starcat.store.reading import read_catalog


def read_merged(
    names: Sequence[str],
    paths: Mapping[str, Sequence[Path]],
    wanted: Crossmatch,
    *,
    band: str | None = None,
    epoch_jyear: float | None = None,
    read_limit_mag: float | None = None,
    neighbours: bool = True,
    workers: int = 2,
    progress: Progress = no_progress,
) -> Ingested:
    """Read several catalogs, the better one first, as one with a row a star.

    The band is that of the first; the read limit is in each catalog's own.
    """
    limits = {"epoch_jyear": epoch_jyear, "read_limit_mag": read_limit_mag}
    whole: Ingested | None = None
    for name in names:
        own = {**limits, "band": None if whole else band, "workers": workers}
        alone = neighbours and len(names) == 1
        read = read_catalog(name, paths[name], **own, neighbours=alone, progress=progress)
        progress("merge", 0, None)
        whole = read if whole is None else _joined(whole, read, wanted)
    if whole is None:
        raise ValueError("names is empty; expected the names of catalogs")
    if not whole.parts or not neighbours:
        return whole
    return replace(whole, stars=add_nearest_neighbours(whole.stars, workers))


def _joined(whole: Ingested, read: Ingested, wanted: Crossmatch) -> Ingested:
    """Return a catalog with the stars of another that it lacks."""
    own = _in_band(read, whole.band)
    matches = match_tables(whole.stars, own, wanted)[0]
    added, again = _split(whole.stars, own, matches.take(pa.array(matched_stars(matches))))
    stars = pa.concat_tables([whole.stars, added])
    _check_numbers(whole, read, stars)
    rejected = pa.concat_tables([whole.rejected, read.rejected, again]).combine_chunks()
    return replace(
        whole,
        stars=sort_rows(stars, ("star_id",)).combine_chunks(),
        rejected=sort_rows(rejected, product_schema("rejected").order),
        files=(*whole.files, *read.files),
        problems=(*whole.problems, *read.problems),
        notes=(*whole.notes, *read.notes),
        beyond_read_limit=whole.beyond_read_limit + read.beyond_read_limit,
        parts=(*(whole.parts or (CatalogPart.of(whole),)), CatalogPart.of(read)),
    )


def _in_band(read: Ingested, band: str) -> pa.Table:
    """Return the stars of a catalog with their magnitudes in a band."""
    if read.band == band or not len(read.stars):
        return read.stars
    if band not in shipped_names():
        raise ConfigError(
            f"catalog.band: the passband of {band!r} is unknown, so the magnitudes of "
            f"{read.source} in {read.band} cannot be taken to it; "
            "choose a band that 'starcat bands' lists",
            key="catalog.band",
            value=band,
        )
    made = in_sensor_band(read.stars, read.source, shipped(band)).stars
    told = pc.binary_join_element_wise(read.source, made["mag_source"], " ")
    return with_columns(made, {"band": band, "mag_source": told})


def _split(stars: pa.Table, own: pa.Table, matches: pa.Table) -> tuple[pa.Table, pa.Table]:
    """Return the rows of a catalog that are no star's counterpart, and those that are, rejected."""
    # A record may be that of two stars, which its catalog does not tell apart: the first is named.
    order = np.lexsort((matches["star_rank"].to_numpy(), matches["counterpart_id"].to_numpy()))
    matches = matches.take(pa.array(order))
    number, first = np.unique(matches["counterpart_id"].to_numpy(), return_index=True)
    matches = matches.take(pa.array(first))
    is_again = np.isin(own["star_id"].to_numpy(), number)
    again = sort_rows(own.filter(pa.array(is_again)), ("star_id",))
    ambiguous = pc.equal(matches["verdict"], "ambiguous")
    reasons = pc.if_else(
        ambiguous, Reason.ambiguous_counterpart.name, Reason.counterpart.name
    ).cast(pa.string())
    rejected = reject_rows(again, reasons)
    names = stars["designation"].take(matches["star"].combine_chunks()).to_pylist()
    apart = matches["separation_arcsec"].to_pylist()
    detail = [f"{name}, {angle:.3f} arcsec" for name, angle in zip(names, apart, strict=True)]
    rejected = with_columns(rejected, {"detail": pa.array(detail, pa.string())})
    return own.filter(pa.array(~is_again)), rejected


def _check_numbers(whole: Ingested, read: Ingested, stars: pa.Table) -> None:
    number = np.sort(stars["star_id"].to_numpy())
    twice = number[1:][number[1:] == number[:-1]]
    if len(twice):
        names = " and ".join(part.source for part in whole.parts or (whole,))
        raise ConfigError(
            f"catalog.merged: {read.source} and {names} number stars alike ({len(twice):,} "
            f"numbers, such as {twice[0]}); star_id would not tell them apart. Merge catalogs "
            "whose numbers differ, such as hipparcos, tycho2 and gaia",
            key="catalog.merged",
            value=read.source,
        )
