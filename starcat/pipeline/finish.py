"""The stages that make products, and that write, test, report and verify the database."""

from __future__ import annotations

import json
import logging
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from starcat.catalog.span import validity
from starcat.catalog.stars.star_table import directions_of, floats_of, sort_rejected
from starcat.catalog.stars.verdict import count_by_reason
from starcat.database.manifest import DATABASE_NAME, SourceFacts, software_versions
from starcat.database.products.coverage import field_coverage
from starcat.database.products.table import PRODUCTS
from starcat.database.verify import check_database
from starcat.database.writer import Product, write_manifest, write_products
from starcat.matcher.matcher import Matcher
from starcat.matcher.settings import Engine
from starcat.pipeline.acceptance import advice_without_magnitudes, check_rates
from starcat.pipeline.draft import Draft, stage
from starcat.pipeline.recipes import make_product, product_inputs, recipe_names
from starcat.pipeline.report.report import count_magnitudes, coverage_warnings, write_report
from starcat.pipeline.report.sensor_band import band_content
from starcat.pipeline.report_data import coverage_report, filter_coverages
from starcat.pipeline.selection.ruleset import ALL_REASONS
from starcat.pipeline.simulation.selftest import Rates, self_test
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.progress import Progress
from starcat.results import to_dict

MAX_FRAMES_WITHOUT_MAGNITUDES = 50
"""Frames of each kind to identify without magnitudes as well. There are few, because a frame that
cannot be identified without magnitudes takes half a second."""

_logger = logging.getLogger(__name__)


def _products_task(spec: BuildSpec) -> str:
    names = (name for name, kind in PRODUCTS.items() if kind.make is not None)
    enabled = [name for name in names if name in spec.products.requested]
    return f"make {', '.join(('stars', 'rejected', 'boresights', *enabled))}"


@stage("products", "products", _products_task)
def make_products(draft: Draft) -> None:
    """Make the products that need only guide stars and their fields."""
    spec, selected, fields = draft.spec, draft.selected, draft.fields
    rejected = pa.concat_tables([draft.rejected, selected.rejected]).combine_chunks()
    draft.sources = [_with_guide_stars(facts, draft) for facts in draft.sources]
    draft.products += [
        Product("stars", selected.guide_stars),
        Product("rejected", sort_rejected(rejected)),
    ]
    inputs = product_inputs(selected.guide_stars, fields, spec)
    for name in recipe_names(inputs):
        draft.progress(f"product {name}", 0, None)
        draft.products.append(make_product(name, inputs))


def _with_guide_stars(facts: SourceFacts, draft: Draft) -> SourceFacts:
    """Return the facts for the manifest about a source, after the selection."""
    if facts.role != "stars":
        return facts
    tables = [draft.selected.guide_stars, draft.selected.rejected]
    if draft.spec.catalog.merged:
        tables = [table.filter(pc.equal(table["catalog"], facts.source)) for table in tables]
    rejected = dict(facts.rejected)  # keeps the order in which reasons first occurred
    for reason, count in count_by_reason(tables[1], reasons=ALL_REASONS).items():
        rejected[reason] = rejected.get(reason, 0) + count
    return replace(facts, kept=len(tables[0]), rejected=rejected)


@stage("write", "write", lambda spec: "write database.h5 and a Parquet file of each product")
def write_database(draft: Draft) -> None:
    """Write the database and a Parquet file of each product."""
    draft.facts = write_products(draft.folder, draft.products, database_facts(draft.spec))


def database_facts(spec: BuildSpec) -> dict[str, str | float]:
    """Return the attributes of the whole database."""
    camera = spec.camera.camera()
    facts: dict[str, float] = {"width_px": camera.width_px, "height_px": camera.height_px}
    facts |= {"focal_length_px": camera.focal_length_px}
    if camera.readout_s is not None:
        facts |= {"readout_s": camera.readout_s}
    content = spec.recorded()
    return {
        "name": spec.name,
        "version": spec.version,
        "frame": "ICRS",
        "epoch_jyear": spec.middle_jyear,
        "camera": json.dumps(facts, sort_keys=True),
        "spec": json.dumps(content, sort_keys=True),
    }


def _test_plan(spec: BuildSpec) -> str:
    return f"identify {spec.self_test.frames:,} clean and as many hard simulated fields"


@stage("self-test", "self-test", _test_plan)
def prove_database(draft: Draft) -> None:
    """Identify simulated fields with the written database."""
    draft.rates = run_self_test(draft.folder, draft.spec, draft.progress)


def run_self_test(
    folder: Path, spec: BuildSpec, progress: Progress, engine: Engine = "auto"
) -> tuple[Rates, ...]:
    """Identify simulated fields with a database.

    Both engines give the same rates, so that the manifest does not depend on a compiler.
    """
    test = spec.self_test
    matcher = Matcher.open(folder, tolerance_px=max(0.5, 4.0 * test.noise_px), engine=engine)
    return self_test(
        matcher,
        test.frames,
        test.noise_px,
        test.seed,
        progress,
        noise_mag=test.noise_mag,
        without_magnitudes=MAX_FRAMES_WITHOUT_MAGNITUDES,
        part=spec.selection.region.footprint,
    )


@stage(
    "report",
    "report",
    lambda spec: "write the page, plots and figures of report/",
    is_announced=True,
)
def report_database(draft: Draft) -> None:
    """Write the report of the build."""
    spec, fields, guide_stars = draft.spec, draft.fields, draft.selected.guide_stars
    draft.validity = validity(guide_stars, spec.span_jyear)
    draft.note("apply_span", str(draft.validity or ""))
    draft.filters = filter_coverages(draft.selected.steps, fields, spec)
    counted = field_coverage(fields, spec.boresights.brightest)
    draft.coverage = coverage_report(counted, fields, directions_of(guide_stars), spec)
    content = report_content(draft)
    folder = draft.folder / "report"
    folder.mkdir()
    write_report(folder, content, draft.coverage, draft.in_band)
    for warning in content["warnings"]:
        _logger.warning("%s-%s: %s", spec.name, spec.version, warning)
    advice = advice_without_magnitudes(draft.rates, spec)
    draft.note("report_database", *content["warnings"], advice or "")


@stage("manifest", "verify", lambda spec: "write manifest.json with digests of all files")
def describe_database(draft: Draft) -> None:
    """Write the manifest."""
    recorded = draft.spec.recorded()
    draft.manifest = write_manifest(draft.folder, recorded, draft.sources, draft.facts)


@stage(
    "verify",
    "verify",
    lambda spec: "read all files again and check them, and the self-test",
    is_announced=True,
)
def verify_database(draft: Draft) -> None:
    """Check every file, and check that enough simulated fields were identified."""
    check_database(draft.folder)
    check_rates(draft.rates, draft.spec, draft.coverage.gap)


def report_content(draft: Draft) -> dict[str, Any]:
    """Return the report of a build as values for JSON, after the products are written."""
    spec, coverage = draft.spec, draft.coverage
    recorded = spec.recorded()
    products = {
        name: {**facts, "bytes": (draft.folder / facts["parquet"]).stat().st_size}
        for name, facts in draft.facts.items()
    }
    sources = [to_dict(source) for source in draft.sources]
    reasons = {name for source in sources for name in source["rejected"]}
    mags = (floats_of(draft.product(name), "mag") for name in ("stars", "rejected"))
    band, validity, tally = draft.in_band, draft.validity, draft.selected.neighbours
    return {
        **{name: recorded[name] for name in ("name", "version", "description")},
        "epoch_jyear": spec.middle_jyear,
        **({} if validity is None else {"validity": asdict(validity)}),
        "frame": "ICRS",
        "warnings": list(coverage_warnings(coverage.summary, coverage.gap)),
        "sources": sources,
        "reasons": {name: words for name, words in ALL_REASONS.items() if name in reasons},
        "products": products,
        "database_bytes": (draft.folder / DATABASE_NAME).stat().st_size,
        "filters": [asdict(step) for step in draft.filters],
        **({"neighbours": asdict(tally)} if tally else {}),
        "coverage": coverage.as_dict(),
        "magnitudes": {"band": str(draft.product("stars")["band"][0]), **count_magnitudes(*mags)},
        "self_test": [to_dict(rates) for rates in draft.rates],
        **({} if band is None else {"band": band_content(band, spec.selection)}),
        "spec": recorded,
        "software": software_versions(),
    }
