"""The stages that take missing motions, magnitudes and companions from other sources.

Motions and photometry come from counterparts, found by the same cross-identification as the
product ``crossmatch``, one catalog at a time. An entry is moved by its own motion to the epoch of
the star's position and compared there. The star keeps its position and gets the motion, by which
it is moved to the epoch of the build. Photometry is used only from a counterpart that is the
star's only candidate or by far the likeliest.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.catalog.bands.response import Response
from starcat.catalog.doubles import PairTable, join_pairs
from starcat.catalog.ingest import UNMOVED
from starcat.catalog.joins import read_joined
from starcat.catalog.sensor_band import ALONE, InBand, Other, in_sensor_band, other_of
from starcat.catalog.stars.positions import motion_of
from starcat.catalog.stars.proper_motion import propagate
from starcat.catalog.stars.star_table import (
    add_nearest_neighbours,
    directions_of,
    floats_of,
    move_to_epoch,
    rows_of_stars,
    with_columns,
)
from starcat.catalog.stars.verdict import Quality
from starcat.catalog.variability import AmplitudeTable, join_amplitudes, read_amplitudes
from starcat.database.manifest import SourceFacts
from starcat.database.products.motions import JOINED, NO_CANDIDATE, NO_MOTION, OWN_MOTION
from starcat.database.writer import Product
from starcat.geometry.sphere import separation
from starcat.pipeline.counterparts import match_source
from starcat.pipeline.draft import Draft, stage
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.storage.schema import product_schema

OF_ENTRY = (
    "catalog", "counterpart_id", "designation", "separation_arcsec", "delta_mag", "n_candidates",
    "probability",
)  # fmt: skip
"""Columns that the products ``crossmatch`` and ``motions`` have in common."""


def _motions_plan(spec: BuildSpec) -> str | None:
    if not spec.catalog.motions:
        return None
    names = ", ".join(spec.catalog.motions)
    return f"take proper motions from {names}, and move stars to J{spec.middle_jyear:g}"


@stage("motions", "read", _motions_plan, lambda spec: spec.catalog.motions)
def supply_motions(draft: Draft) -> None:
    """Take missing proper motions from other catalogs, and move the stars to the epoch."""
    spec, stars = draft.spec, draft.stars
    entries = _Entries.of(stars)
    for name in spec.catalog.motions:
        entries.note(match_source(name, supply_motions, stars, draft)[1].table)
    moved = _with_motions(stars, entries, spec.middle_jyear)
    draft.motions = entries.table(stars, moved)
    # The notes of the catalogs about unmoved stars are no longer true.
    notes = draft.notes["merge_catalogs"]
    draft.notes["merge_catalogs"] = [note for note in notes if UNMOVED not in note]
    draft.stars = add_nearest_neighbours(moved, draft.workers)
    draft.catalog_bytes = draft.stars.nbytes + draft.rejected.nbytes


def guide_star_motions(draft: Draft) -> list[Product]:
    """Return the motions of guide stars as a product; an empty list if the spec has no motions."""
    if draft.motions is None:
        return []
    guide_stars = draft.selected.guide_stars
    rows = rows_of_stars(guide_stars, draft.stars)
    table = draft.motions.take(pa.array(rows)).combine_chunks()
    star = pa.array(np.arange(len(guide_stars), dtype=np.int32))
    return [Product("motions", table.set_column(0, table.schema.field(0), star))]


@stage(
    "product motions",
    "products",
    lambda spec: "list where each motion is from" if spec.catalog.motions else None,
)
def list_motions(draft: Draft) -> None:
    """List the source of each guide star's motion, and count the stars per catalog."""
    (product,) = guide_star_motions(draft)
    draft.products.append(product)
    table = product.table
    for number, facts in enumerate(draft.sources):
        if facts.role != "motions":
            continue
        is_joined = pc.and_(
            pc.equal(table["outcome"], JOINED), pc.equal(table["catalog"], facts.source)
        )
        way, moved = floats_of(table.filter(is_joined), "moved_arcsec"), None
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


def _join_plan(what: str, names: Sequence[str]) -> str | None:
    return f"take {what} from {', '.join(names)}" if names else None


@stage(
    "amplitudes",
    "read",
    lambda spec: _join_plan("amplitudes of variable stars", spec.selection.variables.join),
    lambda spec: spec.selection.variables.join,
)
def supply_amplitudes(draft: Draft) -> None:
    """Take the amplitudes of variable stars from other sources."""
    for name in draft.spec.selection.variables.join:
        table = read_amplitudes(name, draft.paths[name], draft.progress)
        draft.stars, joined = join_amplitudes(draft.stars, table)
        _record_join(draft, "supply_amplitudes", table, joined)


@stage(
    "doubles",
    "read",
    lambda spec: _join_plan("companions", spec.selection.doubles.join),
    lambda spec: spec.selection.doubles.join,
)
def supply_doubles(draft: Draft) -> None:
    """Take the companions of double stars from other sources, and flag these stars."""
    doubles = draft.spec.selection.doubles
    for name in doubles.join:
        table = read_joined(name, draft.paths[name], draft.progress)
        draft.stars, joined = join_pairs(draft.stars, table, doubles.min_separation_deg)
        _record_join(draft, "supply_doubles", table, joined)


def _record_join(
    draft: Draft, stage_name: str, table: AmplitudeTable | PairTable, joined: int
) -> None:
    """Record how many stars have values of a source, and warn if none has."""
    rows = sum(file.rows for file in table.files)
    facts = (table.source, table.role, table.files, rows, table.kept, table.rejected, joined)
    draft.sources.append(SourceFacts(*facts))
    if not joined:
        draft.note(
            stage_name,
            f"{table.source} says nothing of any star of {draft.spec.catalog.source}: a joined "
            "source knows stars by their numbers in other catalogs or by place. Join a file that "
            "has what these stars have, or leave it out",
        )


def _band_plan(spec: BuildSpec) -> str | None:
    response = spec.camera.response
    if response.name is None:
        return None
    others = f", also from {', '.join(response.photometry)}" if response.photometry else ""
    return f"predict magnitudes in {response.name}{others}"


@stage("photometry", "read", _band_plan, lambda spec: spec.camera.response.photometry)
def to_sensor_band(draft: Draft) -> None:
    """Predict the magnitudes of stars in the band of the sensor."""
    spec, stars = draft.spec, draft.stars
    response = spec.camera.response.response()
    if response is None:
        return
    others: list[Other] = []
    for name in spec.camera.response.photometry:
        others.append(_photometry(name, response, draft))
    draft.in_band = in_sensor_band(stars, spec.catalog.source, response, others)
    # The magnitude differences to neighbours have to be in the sensor's band too.
    draft.stars = add_nearest_neighbours(draft.in_band.stars, draft.workers)
    draft.note(to_sensor_band.name, *_band_notes(draft.in_band, spec))


def _photometry(name: str, response: Response, draft: Draft) -> Other:
    """Return magnitudes predicted from a source, and record the files read in the draft."""
    entries, matches = match_source(name, to_sensor_band, draft.stars, draft)
    best = np.flatnonzero(pc.equal(matches.table["verdict"], "unique"))
    rows = matches.table["star"].to_numpy()[best].astype(np.int64)
    draft.sources[-1] = replace(draft.sources[-1], joined=len(best))
    return other_of(entries.take(pa.array(matches.counterpart[best])), rows, name, response)


def _band_notes(in_band: InBand, spec: BuildSpec) -> tuple[str, ...]:
    notes = []
    alone = in_band.counts.get(f"{in_band.band}{ALONE}", 0)
    if alone:
        notes.append(
            f"{spec.catalog.source}: {alone:,} of {len(in_band.stars):,} stars have neither colour "
            f"nor spectral type; their magnitudes in {in_band.response.name} are those of a star "
            "of the mean colour, with an error to match; camera.response.photometry names catalogs "
            "that know more of them"
        )
    if spec.catalog.read_limit_mag is not None:
        notes.append(
            f"catalog.read_limit_mag {spec.catalog.read_limit_mag:g} is in the catalog's band "
            f"{in_band.band}, the limits of [selection] are in {in_band.response.name}: it has to "
            "be so faint that no star that the sensor sees is left out"
        )
    return tuple(notes)


@dataclass
class _Entries:
    """The entry found for each star so far, with its motion and verdict.

    ``rows`` are rows of all matches so far, -1 for a star without a match.
    """

    outcome: NDArray[np.object_]
    epoch_jyear: Array
    pm_ra: Array
    pm_dec: Array
    rows: NDArray[np.int64]
    matches: list[pa.Table]

    @classmethod
    def of(cls, stars: pa.Table) -> _Entries:
        """Return the state before any catalog is read."""
        pm_ra, pm_dec = (floats_of(stars, f"pm_{way}_mas_yr") for way in ("ra_cosdec", "dec"))
        has_motion = ~(np.isnan(pm_ra) | np.isnan(pm_dec))
        outcome = np.where(has_motion, OWN_MOTION, NO_CANDIDATE).astype(object)
        rows = np.full(len(stars), -1, dtype=np.int64)
        return cls(outcome, floats_of(stars, "epoch_jyear"), pm_ra, pm_dec, rows, [])

    def note(self, matches: pa.Table) -> None:
        """Take the motions of a catalog, and its verdict for stars without an entry so far."""
        best = matches.filter(pc.equal(matches["rank"], 1))
        start = sum(map(len, self.matches))
        self.matches.append(best)
        star = best["star"].to_numpy()
        # The motion at the epoch of the star's position: the entry moves on a straight line.
        motion = propagate(motion_of(best), self.epoch_jyear[star] - floats_of(best, "epoch_jyear"))
        outcome = best["verdict"].to_numpy(zero_copy_only=False).astype(object)
        is_of_other = best["star_rank"].to_numpy() > 1
        outcome[outcome == "none"] = np.where(is_of_other, "taken", "doubtful")[outcome == "none"]
        named = outcome == "unique"
        outcome[named] = np.where(motion.is_known[named], JOINED, NO_MOTION)
        before = self.outcome[star]
        better = (outcome == JOINED) & (before != JOINED) & (before != OWN_MOTION)
        is_new = better | (before == NO_CANDIDATE)
        self.outcome[star[is_new]] = outcome[is_new]
        self.rows[star[is_new]] = start + np.flatnonzero(is_new)
        self.pm_ra[star[better]] = motion.pm_ra_cosdec_mas_yr[better]
        self.pm_dec[star[better]] = motion.pm_dec_mas_yr[better]

    def table(self, stars: pa.Table, moved: pa.Table) -> pa.Table:
        """Return the product: the entry found for each star, and how far the star moved."""
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


def _with_motions(stars: pa.Table, entries: _Entries, epoch_jyear: float) -> pa.Table:
    """Return stars with their motions, moved to an epoch."""
    rows = np.flatnonzero(entries.outcome == JOINED)
    flags = stars["quality_flags"].to_numpy()[rows] & ~np.int32(Quality.NO_PROPER_MOTION)
    moved = move_to_epoch(
        {
            "ra_deg": floats_of(stars, "ra_deg")[rows],
            "dec_deg": floats_of(stars, "dec_deg")[rows],
            "epoch_jyear": entries.epoch_jyear[rows],
            "pm_ra_cosdec_mas_yr": entries.pm_ra[rows],
            "pm_dec_mas_yr": entries.pm_dec[rows],
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
