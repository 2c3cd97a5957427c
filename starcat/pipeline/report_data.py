"""Coverage for the report: by all guide stars, and after each filter of the selection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starcat.arrays import Directions
from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.database.products.coverage import MIN_GUIDE_STARS, Coverage, coverage_from_counts
from starcat.database.products.evenness import evenness_of
from starcat.database.products.tiling import FieldStars, stars_in_fields, tile_radius_rad
from starcat.database.reader import DatabaseFolder
from starcat.pipeline.recipes import field_size, tile_stars
from starcat.pipeline.report.report import CoverageReport, report_coverage
from starcat.pipeline.selection.selecting import Step
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.pipeline.specs.reading import spec_of_database


@dataclass(frozen=True)
class FilterCoverage:
    """The stars that one filter leaves in the fields of the tiling."""

    step: str  # the filter
    stars: int  # stars left
    median_per_field: float  # stars in the field of a boresight
    min_per_field: int
    share_below_4: float  # share of the fields with fewer than 4 stars


def filter_coverages(
    steps: Sequence[Step], fields: FieldStars, spec: BuildSpec
) -> tuple[FilterCoverage, ...]:
    """Count the stars that each filter leaves in the fields of the tiling."""
    counts = {len(steps[-1].directions): fields.count}
    coverages = []
    for step in steps:
        stars = len(step.directions)
        if stars not in counts:
            counts[stars] = tile_stars(step.directions, np.zeros(stars), spec).count
        count = counts[stars]
        share_below_4 = round(float((count < MIN_GUIDE_STARS).mean()), 9)
        median = float(np.median(count))
        coverages.append(FilterCoverage(step.name, stars, median, int(count.min()), share_below_4))
    return tuple(coverages)


def coverage_report(
    coverage: Coverage, fields: FieldStars, directions: Directions, spec: BuildSpec
) -> CoverageReport:
    """Return the coverage by guide stars, from their directions, for a report."""
    size = field_size(spec)
    focal_length_px = spec.camera.camera().focal_length_px
    part = spec.selection.region.footprint
    evenness = evenness_of(
        fields, directions, size, spec.boresights.field, focal_length_px, is_part=part is not None
    )
    return report_coverage(coverage, tile_radius_rad(size), evenness, spec.boresights.count, part)


def database_coverage(database: DatabaseFolder) -> CoverageReport:
    """Return the coverage of a database, from its own boresights and stars."""
    table = database.table("boresights")
    boresights = np.stack([table[name].to_numpy() for name in ("x", "y", "z")], axis=-1)
    counts = table["star_count"].to_numpy()
    spec = spec_of_database(database)
    coverage = coverage_from_counts(boresights, counts, spec.boresights.brightest)
    stars = database.table("stars")
    directions, mag = directions_of(stars), floats_of(stars, "mag")
    fields = stars_in_fields(boresights, directions, mag, field_size(spec), spec.boresights.field)
    return coverage_report(coverage, fields, directions, spec)
