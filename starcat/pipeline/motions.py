"""Proper motions for stars whose own catalog has none, from other catalogs.

Each star is matched with the entries of a catalog by the cross-identification of the product
``crossmatch``: an entry is moved by its own motion to the epoch of the star's position and
compared there. The star keeps its position and gets the motion, which takes it to the epoch of
the build.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.artifact.other_catalogs import JOINED, NO_CANDIDATE, NO_MOTION, OWN_MOTION
from starcat.artifact.writer import Product
from starcat.catalog.ingest import unmoved_stars
from starcat.geometry.sphere import separation
from starcat.pipeline.counterparts import match_source
from starcat.pipeline.draft import Draft, stage
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


def _motions_plan(spec: BuildSpec) -> str | None:
    names = ", ".join(spec.catalog.motions)
    return f"take proper motions from {names}, and move stars to J{spec.middle_jyear:g}"


@stage(
    "motions",
    "read",
    lambda spec: _motions_plan(spec) if spec.catalog.motions else None,
    lambda spec: spec.catalog.motions,
)
def supply_motions(draft: Draft) -> None:
    """Give stars without a proper motion that of other catalogs, and move them to the epoch."""
    spec, stars = draft.spec, draft.stars
    found = _Found.of(stars)
    for name in spec.catalog.motions:
        found.note(match_source(name, supply_motions, stars, draft))
    moved = _with_motions(stars, found, spec.middle_jyear)
    draft.motions = found.table(stars, moved)
    # What reading said of stars that stay behind is no longer so.
    stale = unmoved_stars(spec.catalog.source, stars, spec.middle_jyear)
    notes = draft.notes["merge_catalogs"]
    draft.notes["merge_catalogs"] = [note for note in notes if note not in stale]
    draft.stars = add_nearest_neighbours(moved, draft.workers)
    draft.catalog_bytes = draft.stars.nbytes + draft.rejected.nbytes


def guide_star_motions(draft: Draft) -> list[Product]:
    """Return the motions of guide stars as a product; none where the spec asks for no motions."""
    if draft.motions is None:
        return []
    number = draft.stars["star_id"].to_numpy()
    guide_stars = draft.selected.guide_stars
    rows = np.searchsorted(number, guide_stars["star_id"].to_numpy())
    table = draft.motions.take(pa.array(rows)).combine_chunks()
    own = pa.array(np.arange(len(guide_stars), dtype=np.int32))
    return [Product("motions", table.set_column(0, table.schema.field(0), own), in_database=False)]


@stage(
    "product motions",
    "products",
    lambda spec: "list where each motion is from" if spec.catalog.motions else None,
)
def list_motions(draft: Draft) -> None:
    """List where the motions of guide stars are from, and count the stars of each catalog."""
    (product,) = guide_star_motions(draft)
    draft.products.append(product)
    table = product.table
    for number, facts in enumerate(draft.sources):
        if facts.role != "motions":
            continue
        own = pc.and_(pc.equal(table["outcome"], JOINED), pc.equal(table["catalog"], facts.source))
        way, moved = floats_of(table.filter(own), "moved_arcsec"), None
        if len(way):
            largest, median = float(way.max()), float(np.median(way))
            moved = {"median": round(median, 6), "largest": round(largest, 6)}
        draft.sources[number] = replace(facts, joined=len(way), moved_arcsec=moved)
    counts, spec = Counter(table["outcome"].to_pylist()), draft.spec
    unmoved = sorted(counts.keys() - {JOINED, OWN_MOTION})
    if unmoved:
        reasons = ", ".join(f"{name} {counts[name]:,}" for name in unmoved)
        draft.note(
            "supply_motions",
            f"{spec.catalog.source}: {sum(counts[name] for name in unmoved):,} of "
            f"{counts.total():,} guide stars have no motion in {', '.join(spec.catalog.motions)} "
            f"and are not moved to J{spec.middle_jyear:g} ({reasons}); the product motions lists "
            "them",
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
