"""What a build hands to its report: the results of its stages as plain data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc

from starcat.arrays import Directions
from starcat.artifact.manifest import DATABASE_NAME, SourceFacts, software_versions
from starcat.artifact.reader import Artifact
from starcat.artifact.writer import Product
from starcat.catalog.doubles import PairTable
from starcat.catalog.ingest import CatalogPart, Ingested, count_by_reason
from starcat.catalog.sensor_band import InBand
from starcat.catalog.source import map_of
from starcat.catalog.span import Validity
from starcat.catalog.variability import AmplitudeTable
from starcat.pipeline.recipes import field_size, tile_guide_stars
from starcat.products.boresights import FieldStars, tile_sphere
from starcat.products.coverage import MIN_GUIDE_STARS, Coverage, coverage_from_counts
from starcat.products.evenness import evenness_of
from starcat.report.report import (
    CoverageReport,
    count_magnitudes,
    coverage_warnings,
    report_coverage,
)
from starcat.report.sensor_band import band_content
from starcat.selection.rules.neighbours import NeighbourTally
from starcat.selection.ruleset import ALL_REASONS
from starcat.selection.selecting import Selected, Step
from starcat.simulation.selftest import Rates
from starcat.specs.build_spec import BuildSpec
from starcat.stars.star_table import directions_of, floats_of


@dataclass(frozen=True)
class FilterCoverage:
    """What one filter leaves in the fields of the tiling."""

    step: str  # the filter
    stars: int  # stars left
    median_per_field: float  # stars in the field of a boresight
    min_per_field: int
    share_below_4: float  # share of the fields with fewer than 4 stars


def filter_coverages(
    steps: Sequence[Step], fields: FieldStars, spec: BuildSpec
) -> tuple[FilterCoverage, ...]:
    """Count what each filter leaves in the fields of the tiling."""
    counts = {len(steps[-1].directions): fields.count}
    found = []
    for step in steps:
        stars = len(step.directions)
        if stars not in counts:
            wanted, mag = spec.boresights, np.zeros(stars)
            tiled = tile_sphere(wanted.count, step.directions, mag, field_size(spec), wanted.field)
            counts[stars] = tiled.count
        count = counts[stars]
        share_below_4 = round(float((count < MIN_GUIDE_STARS).mean()), 9)
        median = float(np.median(count))
        found.append(FilterCoverage(step.name, stars, median, int(count.min()), share_below_4))
    return tuple(found)


def coverage_report(
    coverage: Coverage, fields: FieldStars, directions: Directions, spec: BuildSpec
) -> CoverageReport:
    """Return what a report says about coverage by the guide stars, whose directions are given."""
    size = field_size(spec)
    focal_length_px = spec.camera.camera().focal_length_px
    evenness = evenness_of(fields, directions, size, spec.boresights.field, focal_length_px)
    reach = 0.5 * float(np.radians(min(size.fov_x_deg, size.fov_y_deg)))
    return report_coverage(coverage, reach, evenness)


def all_source_facts(
    catalog: Ingested,
    selected: Selected,
    joins: Sequence[AmplitudeTable | PairTable],
    joined: Mapping[str, int],
) -> list[SourceFacts]:
    """Return what went into a build as the manifest has it."""
    return [
        *_star_facts(catalog, selected),
        *(
            SourceFacts(
                table.source,
                table.role,
                table.files,
                sum(file.rows for file in table.files),
                table.kept,
                table.rejected,
                joined[table.source],
            )
            for table in joins
        ),
    ]


def _star_facts(catalog: Ingested, selected: Selected) -> list[SourceFacts]:
    """Return what the manifest says of the catalogs that the stars are from."""
    facts = []
    for part in catalog.parts or (CatalogPart.of(catalog),):
        tables = [catalog.rejected, selected.rejected, selected.guide_stars]
        if catalog.parts:
            tables = [t.filter(pc.equal(t["catalog"], part.source)) for t in tables]
        # In the order in which reasons came up.
        rejected = count_by_reason(tables[0], part.beyond_read_limit)
        for reason, count in count_by_reason(tables[1]).items():
            rejected[reason] = rejected.get(reason, 0) + count
        rows = sum(file.rows for file in part.files)
        known = map_of(part.source)
        facts.append(
            SourceFacts(part.source, "stars", part.files, rows, len(tables[2]), rejected, map=known)
        )
    return facts


@dataclass(frozen=True)
class BuildResults:
    """The results of a build's stages."""

    spec: BuildSpec
    sources: Sequence[SourceFacts]  # what went in
    products: Sequence[Product]  # what came out
    facts: Mapping[str, Mapping[str, Any]]  # the same as the manifest has it
    fields: FieldStars  # the tiling of the guide stars
    filters: Sequence[FilterCoverage]  # what each filter left
    rates: Sequence[Rates]  # rates of the self-test
    in_band: InBand | None = None  # where the spec states a response
    neighbours: NeighbourTally | None = None  # what the rule of neighbours decided
    validity: Validity | None = None  # how long it holds, where the spec states a span


def report_content(folder: Path, results: BuildResults, coverage: CoverageReport) -> dict[str, Any]:
    """Return the report of a build as JSON holds it; its files are in the folder."""
    spec, tables = results.spec, {product.name: product.table for product in results.products}
    recorded = spec.recorded()
    products = {
        name: {**facts, "bytes": (folder / facts["parquet"]).stat().st_size}
        for name, facts in results.facts.items()
    }
    sources = [source.as_dict() for source in results.sources]
    found = {name for source in sources for name in source["rejected"]}
    mags = (floats_of(tables[name], "mag") for name in ("stars", "rejected"))
    band = results.in_band
    held = results.validity
    return {
        **{name: recorded[name] for name in ("name", "version", "description")},
        "epoch_jyear": spec.middle_jyear,
        **({} if held is None else {"validity": asdict(held)}),
        "frame": "ICRS",
        "warnings": list(coverage_warnings(coverage.summary, coverage.gap)),
        "sources": sources,
        "reasons": {name: words for name, words in ALL_REASONS.items() if name in found},
        "products": products,
        "database_bytes": (folder / DATABASE_NAME).stat().st_size,
        "filters": [asdict(step) for step in results.filters],
        **({"neighbours": asdict(results.neighbours)} if results.neighbours else {}),
        "coverage": coverage.as_dict(),
        "magnitudes": {"band": str(tables["stars"]["band"][0]), **count_magnitudes(*mags)},
        "self_test": [rates.as_dict() for rates in results.rates],
        **({} if band is None else {"band": band_content(band, spec.selection)}),
        "spec": recorded,
        "software": software_versions(),
    }


def artifact_coverage(artifact: Artifact) -> CoverageReport:
    """Return the coverage of a database, from its own boresights and stars."""
    table = artifact.table("boresights")
    boresights = np.stack([table[name].to_numpy() for name in ("x", "y", "z")], axis=-1)
    counts = table["star_count"].to_numpy()
    coverage = coverage_from_counts(boresights, counts, artifact.spec.boresights.brightest)
    stars = artifact.table("stars")
    fields = tile_guide_stars(stars, artifact.spec)
    return coverage_report(coverage, fields, directions_of(stars), artifact.spec)
