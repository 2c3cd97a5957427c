"""Estimate the result of a spec without a build: guide stars, fields, files and memory.

An estimate runs the stages of a build up to the guide stars. Reading takes the longest, but it
depends only on a few keys of the spec (`reading_keys`). So the draft after reading can be kept, and
`Draft.branch` continues it for each spec. Stars that are too faint for a spec are only counted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
from pydantic import Field

from starcat.arrays import Array, Mask
from starcat.catalog.stars.region import Region
from starcat.catalog.stars.star_table import floats_of
from starcat.catalog.stars.verdict import count_by_reason
from starcat.database.products.coverage import (
    MIN_GUIDE_STARS,
    CoverageSummary,
    Spread,
    TilingGap,
    field_coverage,
    summarise_coverage,
    tiling_gap,
)
from starcat.database.products.tiling import FieldStars, spiral_points, tile_radius_rad
from starcat.errors import BuildError
from starcat.pipeline.cost import Cost
from starcat.pipeline.draft import Draft, Inputs, run
from starcat.pipeline.guide_stars import (
    MAX_FIELD_STARS,
    check_cost,
    check_tiling,
    select,
    thin,
    tile,
)
from starcat.pipeline.reading import check_sources
from starcat.pipeline.recipes import field_size
from starcat.pipeline.report.report import coverage_warnings
from starcat.pipeline.selection.rules.magnitude import TOO_FAINT
from starcat.pipeline.selection.rules.no_magnitude import NO_MAGNITUDE
from starcat.pipeline.selection.ruleset import ALL_REASONS, Selection
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.pipeline.stages import READ
from starcat.progress import Progress, no_progress

MAX_FIELDS_FOR_GAPS = 50_000
"""With more fields than this, the widest gap is not computed."""


def read_draft(
    spec: BuildSpec, inputs: Inputs, workers: int = 2, progress: Progress = no_progress
) -> Draft:
    """Read the sources of a spec like its build, and keep only the data for estimates."""
    draft = run(Draft(spec, inputs, workers=workers, progress=progress, refusals=[]), READ)
    draft.progress, draft.in_band = no_progress, None
    draft.stars = draft.stars.combine_chunks()
    draft.rejected = draft.rejected.schema.empty_table()
    return draft


def reading_keys(spec: BuildSpec) -> dict[str, Any]:
    """Return the keys of a spec on which the reading of its catalogs depends."""
    content = spec.model_dump(mode="json")
    selection, model = content["selection"], content["products"]["crossmatch"]
    keys = {
        "catalog": content["catalog"],
        "epoch_jyear": content["epoch_jyear"],
        "join": selection["variables"]["join"],
        "observed": selection["observed"],
        "response": content["camera"]["response"],
    }
    if spec.catalog.motions or spec.catalog.merged or spec.camera.response.photometry:
        keys["model"] = {key: model[key] for key in model if key not in ("enabled", "catalogs")}
    if spec.selection.doubles.join:  # the flags depend on the resolution of the sensor
        keys["doubles"] = selection["doubles"]
    return keys


def choose_stars(read: Draft, spec: BuildSpec) -> Draft:
    """Choose the guide stars of a spec like its build, but allow fields with too few stars.

    The returned draft contains only the chosen and the rejected stars, not all stars that were
    read. So it can be kept without them.
    """
    check_sources(spec)  # the catalogs may have been read for a spec with other sources
    draft, mag = read.branch(spec), floats_of(read.stars, "mag")
    bright = np.flatnonzero(_is_bright(mag, spec.selection))
    in_limit = int(np.count_nonzero(mag <= spec.selection.faint_limit_mag))
    check_tiling(in_limit, spec, spec.selection.max_stars_per_field)
    if len(bright) >= MIN_GUIDE_STARS:  # else select() reports the reasons for all stars
        draft.stars = read.stars.take(pa.array(bright)).combine_chunks()
    run(draft, (select, thin))
    check_tiling(len(draft.selected.guide_stars), spec, None)
    for section in spec.products.requested.values():
        count, size = len(draft.selected.guide_stars), field_size(spec)
        try:
            section.check_fields(count, spec.boresights.count, size, MAX_FIELD_STARS)
        except ValueError as error:
            raise BuildError(
                f"{spec.name}: too dense to estimate: {error}", key="boresights.count"
            ) from None
    run(draft, (tile,))
    draft.stars, draft.motions = read.stars.schema.empty_table(), None
    return draft


def _is_bright(mag: Array, selection: Selection) -> Mask:
    """Return the mask of stars bright enough to matter: fainter stars are companions of no star."""
    if selection.neighbours.is_on:
        return mag <= np.inf
    companions = selection.doubles.companion_limit_mag
    return mag <= max(selection.faint_limit_mag, -np.inf if companions is None else companions)


def count_rejected(read: Draft, choice: Draft) -> dict[str, int]:
    """Return the number of records that are not guide stars, by reason, in the reasons' order."""
    mag = floats_of(read.stars, "mag")
    blank = int(np.count_nonzero(~(mag < np.inf)))
    bright = int(np.count_nonzero(_is_bright(mag, choice.spec.selection)))
    totals = dict.fromkeys(ALL_REASONS, 0)
    for counts in (
        *(source.rejected for source in read.sources if source.role == "stars"),
        count_by_reason(choice.selected.rejected, reasons=ALL_REASONS),
        {NO_MAGNITUDE.name: blank, TOO_FAINT.name: len(mag) - bright - blank},
    ):
        for name, count in counts.items():
            totals[name] += count
    return {name: count for name, count in totals.items() if count}


@dataclass(frozen=True)
class WorstField:
    """The field with the fewest stars."""

    boresight: int
    ra_deg: float
    dec_deg: float
    stars: int


@dataclass(frozen=True)
class FieldFigures:
    """Guide stars in the fields of the tiling."""

    count: Annotated[int, Field(description="Boresights.")]
    stars: Spread
    enough_share: Annotated[float, Field(description="Share of the fields with at least 4 stars.")]
    full_share: Annotated[
        float,
        Field(
            description="Share of fields with ``boresights.brightest`` stars, the number for "
            "triangles."
        ),
    ]
    worst: WorstField


@dataclass(frozen=True)
class FilterFigures:
    """The stars that a filter leaves."""

    filter: Annotated[str, Field(examples=["doubles"])]
    stars: Annotated[int, Field(description="Stars of the whole sky that are left.")]


@dataclass(frozen=True)
class EstimateFigures:
    """The estimate of a spec, as REST, the page and ``--json`` show it."""

    guide_stars: Annotated[int, Field(description="Exact number of guide stars.", examples=[6713])]
    fields: FieldFigures
    filters: list[FilterFigures]
    rejected: Annotated[dict[str, int], Field(description="All other records, by reason.")]
    rows: Annotated[
        dict[str, int], Field(description="Rows of each product that is made from them.")
    ]
    files: Annotated[
        dict[str, int],
        Field(description="Bytes of each file; ``report`` is that folder and the manifest."),
    ]
    total_bytes: Annotated[int, Field(description="Of all files.")]
    memory_bytes: Annotated[int, Field(description="Most memory that the build will hold.")]
    refusals: Annotated[
        list[str], Field(description="Why the build will be refused; empty if it will not.")
    ]
    warnings: Annotated[list[str], Field(description="Warnings.")]
    in_words: Annotated[str, Field(description="The line that 'starcat build' prints.")]


@dataclass(frozen=True)
class Estimate:
    """The estimate of a spec."""

    spec: BuildSpec
    cost: Cost  # rows, files and memory
    fields: FieldStars  # the tiling of the guide stars
    filters: tuple[tuple[str, int], ...]  # stars left by each filter
    rejected: Mapping[str, int]  # rejected records by reason
    refusals: tuple[BuildError, ...]  # reasons why the build will be refused
    warnings: tuple[str, ...]  # possible problems

    @cached_property
    def coverage(self) -> CoverageSummary:
        """The distribution of stars over the fields."""
        return summarise_coverage(field_coverage(self.fields, self.spec.boresights.brightest))

    @cached_property
    def figures(self) -> EstimateFigures:
        """The figures that interfaces show."""
        cost, coverage, count = self.cost, self.coverage, self.fields.count
        radec_deg = round(coverage.worst_ra_deg, 6), round(coverage.worst_dec_deg, 6)
        worst = WorstField(coverage.worst_boresight, *radec_deg, coverage.stars.minimum)
        enough_share, full_share = (
            round(float((count >= stars).mean()), 6)
            for stars in (MIN_GUIDE_STARS, self.spec.boresights.brightest)
        )
        return EstimateFigures(
            guide_stars=cost.stars,
            fields=FieldFigures(cost.fields, coverage.stars, enough_share, full_share, worst),
            filters=[FilterFigures(*each) for each in self.filters],
            rejected=dict(self.rejected),
            rows=dict(cost.rows),
            files=dict(cost.files),
            total_bytes=sum(cost.files.values()),
            memory_bytes=cost.memory_bytes,
            refusals=list(map(str, self.refusals)),
            warnings=list(self.warnings),
            in_words=cost.in_words,
        )


def estimate_draft(
    read: Draft, choice: Draft, spec: BuildSpec, max_memory_bytes: int | None = None
) -> Estimate:
    """Estimate the result of a spec from its draft after reading and its chosen stars."""
    draft = choice.branch(spec)
    draft.stars, draft.motions = read.stars, read.motions
    rejected = count_rejected(read, choice)
    draft.rejected_rows = sum(rejected.values())
    draft.max_memory_bytes = max_memory_bytes
    run(draft, (check_cost,))
    # The exposure is not one of `reading_keys`, so the draft can have notes of another exposure.
    draft.notes["apply_flight_terms"] = [*spec.exposure_notes, *spec.exposure_proposal]
    filters = tuple((step.name, len(step.directions)) for step in draft.selected.steps)
    refusals, warnings = tuple(draft.refusals or ()), tuple(draft.warnings)
    estimate = Estimate(spec, draft.cost, draft.fields, filters, rejected, refusals, warnings)
    gap = _widest_gap(spec.boresights.count, spec.selection.region)
    if gap is not None:
        gap = replace(gap, tile_radius_rad=tile_radius_rad(field_size(spec)))
    return replace(estimate, warnings=(*warnings, *coverage_warnings(estimate.coverage, gap)))


@lru_cache
def _widest_gap(boresights: int, region: Region) -> TilingGap | None:
    """Return the widest gap of a tiling; None if it has too many fields to compute it."""
    if boresights > MAX_FIELDS_FOR_GAPS:
        return None
    part = region.footprint
    return tiling_gap(spiral_points(boresights, part), 0.0, boresights, part)


def estimate_spec(
    spec: BuildSpec, inputs: Inputs, workers: int = 2, progress: Progress = no_progress
) -> Estimate:
    """Read the sources of a spec and estimate the result of its build."""
    read = read_draft(spec, inputs, workers, progress)
    return estimate_draft(read, choose_stars(read, spec), spec)
