"""The stages of a build, in order: from a spec and archive files to a database.

Each stage is a plain function of the results before it; the last ones write into a partial
folder, read it back, identify simulated fields with it and only then give it its name.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import replace as changed
from pathlib import Path
from typing import Any

import pyarrow as pa

from starcat.artifact.verify import check_artifact
from starcat.artifact.writer import Product, write_manifest, write_products
from starcat.catalog.doubles import PairTable, read_wds
from starcat.catalog.ingest import Ingested
from starcat.catalog.observed import with_observed
from starcat.catalog.source_files import locate
from starcat.catalog.span import validity, with_span
from starcat.catalog.variability import AmplitudeTable, read_amplitudes
from starcat.errors import BuildError, ConfigError
from starcat.matcher.matcher import Matcher
from starcat.pipeline.acceptance import advice_without_magnitudes, check_rates
from starcat.pipeline.cost import Cost, check_memory, estimate_cost
from starcat.pipeline.counterparts import match_catalogs
from starcat.pipeline.guide_stars import depth_notes, select_stars
from starcat.pipeline.log import Stopwatch, write_build_log
from starcat.pipeline.merged import read_merged
from starcat.pipeline.motions import join_motions, motion_notes, motion_sources, motions_of
from starcat.pipeline.recipes import (
    RECIPES,
    ProductInputs,
    boresight_product,
    level_product,
    make_product,
)
from starcat.pipeline.report_data import (
    BuildResults,
    FilterCoverage,
    all_source_facts,
    coverage_report,
    filter_coverages,
    report_content,
)
from starcat.pipeline.sensor_band import in_band_of
from starcat.products.boresights import FieldStars
from starcat.products.coverage import field_coverage
from starcat.progress import Progress, no_progress
from starcat.report.report import CoverageReport, coverage_warnings, write_report
from starcat.selection.selecting import Selected
from starcat.simulation.selftest import Rates, self_test
from starcat.specs.build_spec import BuildSpec
from starcat.stars.star_table import directions_of, sort_rows
from starcat.storage.atomic import Outcome, move_into_place, whole_folder
from starcat.storage.schema import product_schema

Inputs = Mapping[str, Sequence[Path]]

JoinTable = AmplitudeTable | PairTable

WITHOUT_MAGNITUDES = 50
"""So many frames of each kind are also identified without magnitudes, at the most: where that is
hopeless, each takes half a second."""

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Built:
    """A finished build."""

    folder: Path  # the database
    outcome: Outcome  # "written", "unchanged", "replaced": What happened to the folder
    manifest: dict[str, Any]  # manifest of the database
    filters: tuple[FilterCoverage, ...]  # what each filter left
    coverage: CoverageReport  # coverage by the guide stars
    # rates of the self-test: clean and hard frames, and the same without magnitudes
    rates: tuple[Rates, ...]
    problems: tuple[str, ...]  # the first malformed records
    warnings: tuple[str, ...]  # what is worth a second look, such as holes of the tiling
    times_s: dict[str, float]  # seconds by stage

    def __repr__(self) -> str:
        """Return the database and how it identifies in one line."""
        clean, hard = self.rates[:2]
        stars = self.manifest["products"]["stars"]["rows"]
        return (
            f"<Built {self.folder} ({self.outcome}): {stars:,} guide stars, identified "
            f"{clean.identified_share:.1%} of clean and {hard.identified_share:.1%} of hard fields>"
        )


def build(
    spec: BuildSpec,
    inputs: Inputs,
    output: Path,
    *,
    replace: bool = False,
    workers: int = 2,
    progress: Progress = no_progress,
    announce: Callable[[Cost], None] | None = None,
    max_memory_bytes: int | None = None,
) -> Built:
    """Build a database."""
    final = output / f"{spec.name}-{spec.version}"
    clock = Stopwatch()

    def check_cost(cost: Cost) -> None:
        if announce is not None:
            announce(cost)
        check_memory(cost, spec, max_memory_bytes)

    with whole_folder(final) as partial:
        made = _make(partial, spec, inputs, workers, check_cost, clock, progress)
        progress("verify", 0, None)
        check_artifact(partial)
        try:
            check_rates(made.rates, spec, made.coverage.gap)
        except BuildError as error:
            raise BuildError(str(error), built=made, fields=error.fields) from None
        outcome = move_into_place(partial, final, replace=replace)
        clock.lap("verify")
    write_build_log(final, outcome, clock.times_s)
    return changed(made, folder=final, outcome=outcome, times_s=clock.times_s)


def _make(
    partial: Path,
    spec: BuildSpec,
    inputs: Inputs,
    workers: int,
    check_cost: Callable[[Cost], None],
    clock: Stopwatch,
    progress: Progress,
) -> Built:
    """Go through all stages up to the manifest, in a folder that has no name yet."""
    catalog, joins = read_sources(spec, inputs, workers, progress)
    motions = join_motions(catalog, spec, inputs, workers, progress)
    catalog = motions.catalog
    stars, joined = join_all(catalog.stars, joins, spec)
    in_band = in_band_of(stars, spec, inputs, workers, progress)
    stars = with_observed(in_band.stars, spec.selection.observed)
    stars = with_span(stars, spec.span_jyear)
    clock.lap("read")
    selected, fields = select_stars(stars, spec)
    moved = motions_of(catalog.stars, motions.table, selected.guide_stars)
    check_cost(estimate_cost(catalog, selected, fields, spec, moved))
    clock.lap("select")
    products = make_products(spec, catalog, selected, fields, progress)
    products += moved
    matched = match_catalogs(stars, selected, spec, inputs, workers, progress)
    products += matched.products
    clock.lap("products")
    facts = write_products(partial, products, database_facts(spec))
    clock.lap("write")
    rates = run_self_test(partial, spec, progress)
    clock.lap("self-test")
    progress("report", 0, None)
    star_source, *others = all_source_facts(catalog, selected, joins, joined)
    sources = [star_source, *motion_sources(motions, products), *others]
    sources += [*in_band.sources, *matched.sources]
    filters = filter_coverages(selected.steps, fields, spec)
    own = (spec, sources, products, facts, fields, filters, rates)
    held = validity(selected.guide_stars, spec.span_jyear)
    results = BuildResults(*own, in_band.made, selected.neighbours, held)
    report = report_build(partial, results)
    clock.lap("report")
    manifest = write_manifest(partial, spec.recorded(), sources, facts)
    told = dict.fromkeys(
        (
            *catalog.notes,
            *motion_notes(spec, products),
            *join_notes(joined, spec),
            *in_band.notes,
            *spec.exposure_notes,
            str(held or ""),
            *depth_notes(stars, spec),
            *matched.notes,
            *coverage_warnings(report.summary, report.gap),
            advice_without_magnitudes(rates, spec),
        )
    )
    warnings = tuple(filter(None, told))
    problems = catalog.problems
    return Built(partial, "written", manifest, filters, report, rates, problems, warnings, {})


def read_sources(
    spec: BuildSpec, inputs: Inputs, workers: int, progress: Progress
) -> tuple[Ingested, list[JoinTable]]:
    """Read the star catalog and the sources of amplitudes and doubles."""
    check_inputs(spec, inputs)
    # All inputs are found before any is read: a missing one is known at once.
    paths = {name: locate(name, inputs) for name in spec.sources}
    catalog = read_merged(
        spec.catalog.catalogs,
        paths,
        spec.products.crossmatch,
        band=spec.catalog.band,
        epoch_jyear=spec.middle_jyear,
        read_limit_mag=spec.catalog.read_limit_mag,
        neighbours=not spec.catalog.motions,  # found where the stars will be
        workers=workers,
        progress=progress,
    )
    selection, tables = spec.selection, list[JoinTable]()
    tables += [read_amplitudes(name, paths[name], progress) for name in selection.variables.join]
    tables += [read_wds(paths[name], progress) for name in selection.doubles.join]
    return catalog, tables


def check_inputs(spec: BuildSpec, inputs: Inputs) -> None:
    """Check that the spec uses every source that an input is given for."""
    for name in inputs:
        if name not in spec.sources:
            item = f'inputs["{name}"]'
            raise ConfigError(
                f"{item}: {spec.name} does not read {name} but "
                f"{', '.join(spec.sources)}; choose another preset or spec, or leave the input out",
                key="input",
                value=name,
                fields=(item,),
            )


def join_all(
    stars: pa.Table, tables: Sequence[JoinTable], spec: BuildSpec
) -> tuple[pa.Table, dict[str, int]]:
    """Join amplitudes and doubles to a star table."""
    joined: dict[str, int] = {}
    for table in tables:
        stars, joined[table.source] = table.join(stars, spec.selection)
    return stars, joined


def join_notes(joined: Mapping[str, int], spec: BuildSpec) -> tuple[str, ...]:
    """Return a note for each joined source that says nothing of any star."""
    return tuple(
        f"{name} says nothing of any star of {spec.catalog.source}: a joined source knows stars by "
        "their numbers in other catalogs or by place. Join a file that has what these stars have, "
        "or leave it out"
        for name, count in joined.items()
        if not count
    )


def report_build(folder: Path, results: BuildResults) -> CoverageReport:
    """Write the report of a build."""
    spec = results.spec
    counted = field_coverage(results.fields, spec.boresights.brightest)
    stars = next(each.table for each in results.products if each.name == "stars")
    coverage = coverage_report(counted, results.fields, directions_of(stars), spec)
    content = report_content(folder, results, coverage)
    (folder / "report").mkdir()
    write_report(folder / "report", content, coverage, results.in_band)
    for warning in content["warnings"]:
        _logger.warning("%s-%s: %s", spec.name, spec.version, warning)
    return coverage


def make_products(
    spec: BuildSpec,
    catalog: Ingested,
    selected: Selected,
    fields: FieldStars,
    progress: Progress = no_progress,
) -> list[Product]:
    """Compute the products of a database."""
    rejected = pa.concat_tables([catalog.rejected, selected.rejected]).combine_chunks()
    order = product_schema("rejected").order
    products = [
        Product("stars", selected.guide_stars),
        Product("rejected", sort_rows(rejected, order), in_database=False),
        boresight_product(fields, spec.boresights.brightest),
    ]
    product_inputs = ProductInputs(directions_of(selected.guide_stars), fields, spec)
    for name in RECIPES:
        if getattr(spec.products, name).enabled:
            progress(f"product {name}", 0, None)
            products.append(make_product(name, product_inputs))
    if spec.products.levels.enabled:
        progress("product levels", 0, None)
        products.append(level_product(selected.guide_stars, spec))
    return products


def database_facts(spec: BuildSpec) -> dict[str, str | float]:
    """Return the attributes of the database as a whole."""
    camera = spec.camera.camera()
    size = {"width_px": camera.width_px, "height_px": camera.height_px}
    content = spec.recorded()
    return {
        "name": spec.name,
        "version": spec.version,
        "frame": "ICRS",
        "epoch_jyear": spec.middle_jyear,
        "camera": json.dumps({**size, "focal_length_px": camera.focal_length_px}, sort_keys=True),
        "spec": json.dumps(content, sort_keys=True),
    }


def run_self_test(folder: Path, spec: BuildSpec, progress: Progress) -> tuple[Rates, ...]:
    """Identify simulated fields with a database."""
    test = spec.self_test
    matcher = Matcher.open(folder, None, tolerance_px=max(0.5, 4.0 * test.noise_px), engine="numpy")
    return self_test(
        matcher,
        test.frames,
        test.noise_px,
        test.seed,
        progress,
        noise_mag=test.noise_mag,
        without_magnitudes=WITHOUT_MAGNITUDES,
    )
