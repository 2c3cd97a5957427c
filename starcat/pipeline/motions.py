"""Proper motions for stars whose own catalog has none, from other catalogs.

Each star is matched with the entries of a catalog by the cross-identification of the product
``crossmatch``: an entry is moved by its own motion to the epoch of the star's position and
compared there. The star keeps its position and gets the motion, which takes it to the epoch of
the build.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.artifact.manifest import SourceFacts
from starcat.artifact.writer import Product
from starcat.catalog.ingest import Ingested, unmoved_stars
from starcat.geometry.sphere import separation
from starcat.pipeline.counterparts import match_source
from starcat.products.motions import JOINED, NO_CANDIDATE, NO_MOTION, OWN_MOTION
from starcat.progress import Progress, no_progress
from starcat.specs.build_spec import BuildSpec
from starcat.stars.proper_motion import Motion, propagate
from starcat.stars.star_table import (
    add_nearest_neighbours,
    directions_of,
    floats_of,
    move_to_epoch,
    with_columns,
)
from starcat.stars.verdict import Quality
from starcat.storage.schema import product_schema

OF_ENTRY = (
    "catalog", "counterpart_id", "designation", "separation_arcsec", "delta_mag", "n_candidates",
    "probability",
)  # fmt: skip
"""Columns of the crossmatch product that the product ``motions`` has too."""


@dataclass(frozen=True)
class JoinedMotions:
    """What became of the motions of a catalog's stars."""

    catalog: Ingested  # the catalog; its stars have their motions and are at the epoch of the build
    # rows of the schema ``motions`` for all its stars, in their order; None where the spec asks for
    # no motions
    table: pa.Table | None = None
    # the catalogs that motions were looked for in; ``joined`` counts all stars
    sources: tuple[SourceFacts, ...] = ()


def join_motions(
    catalog: Ingested,
    spec: BuildSpec,
    inputs: Mapping[str, Sequence[Path]],
    workers: int = 2,
    progress: Progress = no_progress,
) -> JoinedMotions:
    """Give the stars that have no proper motion those of other catalogs."""
    if not spec.catalog.motions:
        return JoinedMotions(catalog)
    wanted, stars = spec.products.crossmatch, catalog.stars
    found = _Found.of(stars)
    sources: list[SourceFacts] = []
    told: list[str] = []
    for name in spec.catalog.motions:
        facts, notes, matches = match_source(
            name, "motions", stars, wanted, inputs, workers, progress
        )
        found.note(matches)
        sources.append(facts)
        told += notes
    moved = _with_motions(stars, found, spec.middle_jyear)
    table = found.table(stars, moved)
    # What reading said of stars that stay behind is no longer so.
    stale = unmoved_stars(catalog.source, stars, spec.middle_jyear)
    told = [*(note for note in catalog.notes if note not in stale), *told]
    moved = add_nearest_neighbours(moved, workers)
    return JoinedMotions(replace(catalog, stars=moved, notes=tuple(told)), table, tuple(sources))


def motions_of(
    stars: pa.Table, motions: pa.Table | None, guide_stars: pa.Table
) -> tuple[Product, ...]:
    """Return the rows of guide stars in a table of the motions of all stars, as a product."""
    if motions is None:
        return ()
    number = stars["star_id"].to_numpy()
    rows = np.searchsorted(number, guide_stars["star_id"].to_numpy())
    table = motions.take(pa.array(rows)).combine_chunks()
    own = pa.array(np.arange(len(guide_stars), dtype=np.int32))
    table = table.set_column(0, table.schema.field(0), own)
    return (Product("motions", table, in_database=False),)


def motion_sources(joined: JoinedMotions, products: Sequence[Product]) -> list[SourceFacts]:
    """Return what the manifest says of the catalogs of motions."""
    facts = []
    for source in joined.sources:
        table = next(product.table for product in products if product.name == "motions")
        own = pc.and_(pc.equal(table["outcome"], JOINED), pc.equal(table["catalog"], source.source))
        way = floats_of(table.filter(own), "moved_arcsec")
        moved = None
        if len(way):
            largest, median = float(way.max()), float(np.median(way))
            moved = {"median": round(median, 6), "largest": round(largest, 6)}
        facts.append(replace(source, joined=len(way), moved_arcsec=moved))
    return facts


def motion_notes(spec: BuildSpec, products: Sequence[Product]) -> tuple[str, ...]:
    """Return a note where guide stars stay at the epoch of their catalog."""
    outcomes = [p.table["outcome"].to_pylist() for p in products if p.name == "motions"]
    if not outcomes:
        return ()
    counts = Counter(outcomes[0])
    unmoved = sorted(counts.keys() - {JOINED, OWN_MOTION})
    if not unmoved:
        return ()
    reasons = ", ".join(f"{name} {counts[name]:,}" for name in unmoved)
    return (
        f"{spec.catalog.source}: {sum(counts[name] for name in unmoved):,} of {counts.total():,} "
        f"guide stars have no motion in {', '.join(spec.catalog.motions)} and are not moved to "
        f"J{spec.middle_jyear:g} ({reasons}); the product motions lists them",
    )


@dataclass
class _Found:
    """The entry that each star has so far, its motion and what is said of it.

    ``rows`` are rows of all matches so far, -1 where a star has none.
    """

    outcome: NDArray[np.object_]
    epoch_jyear: Array
    pm_ra: Array
    pm_dec: Array
    rows: NDArray[np.int64]
    matches: list[pa.Table]

    @classmethod
    def of(cls, stars: pa.Table) -> _Found:
        """Return what is known before any catalog has been read."""
        pm_ra, pm_dec = (floats_of(stars, f"pm_{way}_mas_yr") for way in ("ra_cosdec", "dec"))
        own = ~(np.isnan(pm_ra) | np.isnan(pm_dec))
        outcome = np.where(own, OWN_MOTION, NO_CANDIDATE).astype(object)
        rows = np.full(len(stars), -1, dtype=np.int64)
        return cls(outcome, floats_of(stars, "epoch_jyear"), pm_ra, pm_dec, rows, [])

    def note(self, matches: pa.Table) -> None:
        """Take the motions that a catalog has, and its verdict on stars that none had so far."""
        best = matches.filter(pc.equal(matches["rank"], 1))
        start = sum(map(len, self.matches))
        self.matches.append(best)
        star = best["star"].to_numpy()
        motion = Motion(
            *(floats_of(best, name) for name in ("ra_deg", "dec_deg")),
            *(floats_of(best, f"pm_{way}_mas_yr") for way in ("ra_cosdec", "dec")),
        )
        # The motion at the epoch of the star's position, as its straight line has it there.
        motion = propagate(motion, self.epoch_jyear[star] - floats_of(best, "epoch_jyear"))
        known = ~(np.isnan(motion.pm_ra_cosdec_mas_yr) | np.isnan(motion.pm_dec_mas_yr))
        outcome = best["verdict"].to_numpy(zero_copy_only=False).astype(object)
        named = (outcome == "unique") | (outcome == "best")
        outcome[named] = np.where(known[named], JOINED, NO_MOTION)
        before = self.outcome[star]
        better = (outcome == JOINED) & (before != JOINED) & (before != OWN_MOTION)
        chosen = better | (before == NO_CANDIDATE)
        self.outcome[star[chosen]] = outcome[chosen]
        self.rows[star[chosen]] = start + np.flatnonzero(chosen)
        self.pm_ra[star[better]] = motion.pm_ra_cosdec_mas_yr[better]
        self.pm_dec[star[better]] = motion.pm_dec_mas_yr[better]

    def table(self, stars: pa.Table, moved: pa.Table) -> pa.Table:
        """Return what was found for stars and how far each moved, as the product has it."""
        schema = product_schema("motions").arrow_schema
        entries = pa.concat_tables([table.select(OF_ENTRY) for table in self.matches])
        entries = entries.take(pa.array(self.rows, mask=self.rows < 0))
        way = np.degrees(separation(directions_of(stars), directions_of(moved))) * 3600.0
        columns = {name: entries[name] for name in OF_ENTRY}
        columns |= {
            "star": pa.array(np.arange(len(stars), dtype=np.int32)),
            "outcome": pa.array(self.outcome, pa.string()),
            "n_candidates": pc.fill_null(entries["n_candidates"], 0),
            "from_jyear": pa.array(self.epoch_jyear),
            "moved_arcsec": pa.array(way, mask=self.outcome != JOINED),
        }
        arrays = [columns[field.name].cast(field.type) for field in schema]
        return pa.Table.from_arrays(arrays, schema=schema)


def _with_motions(stars: pa.Table, found: _Found, epoch_jyear: float) -> pa.Table:
    """Return stars with the motions that were found for them, moved to an epoch."""
    rows = np.flatnonzero(found.outcome == JOINED)
    flags = stars["quality_flags"].to_numpy()[rows] & ~np.int32(Quality.NO_PROPER_MOTION)
    moved = move_to_epoch(
        {
            "ra_deg": floats_of(stars, "ra_deg")[rows],
            "dec_deg": floats_of(stars, "dec_deg")[rows],
            "epoch_jyear": found.epoch_jyear[rows],
            "pm_ra_cosdec_mas_yr": found.pm_ra[rows],
            "pm_dec_mas_yr": found.pm_dec[rows],
            "quality_flags": flags,
        },
        epoch_jyear,
    )
    columns = {}
    for name, values in moved.items():
        before = stars[name].to_numpy() if name == "quality_flags" else floats_of(stars, name)
        columns[name] = before.copy()
        columns[name][rows] = values
    return with_columns(stars, columns)
