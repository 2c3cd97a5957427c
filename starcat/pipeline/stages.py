"""The stages of a build, in order, and a description of their work for a spec."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from starcat.catalog.source import data_source
from starcat.catalog.source_files import SourceFiles, locate
from starcat.errors import SourceMissing
from starcat.pipeline.counterparts import find_counterparts
from starcat.pipeline.draft import Inputs, Stage
from starcat.pipeline.finish import (
    describe_database,
    make_products,
    prove_database,
    report_database,
    verify_database,
    write_database,
)
from starcat.pipeline.guide_stars import check_cost, select, thin, tile
from starcat.pipeline.reading import (
    apply_flight_terms,
    apply_span,
    check_inputs,
    merge_catalogs,
    read_catalogs,
)
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.pipeline.supply import (
    list_motions,
    supply_amplitudes,
    supply_doubles,
    supply_motions,
    to_sensor_band,
)

READ = (
    read_catalogs,
    merge_catalogs,
    supply_motions,
    supply_amplitudes,
    supply_doubles,
    to_sensor_band,
    apply_flight_terms,
    apply_span,
)
"""From files to a star table, which an estimate keeps."""

CHOOSE = (select, thin, tile, check_cost)
"""From the star table to guide stars, their fields, and the cost of the remaining stages."""

PRODUCTS = (make_products, list_motions, find_counterparts)
"""From guide stars to products."""

FINISH = (write_database, prove_database, report_database, describe_database, verify_database)
"""From products to a tested database."""

BUILD = (*READ, *CHOOSE, *PRODUCTS, *FINISH)


@dataclass(frozen=True)
class PlannedStage:
    """The work of a stage for a spec."""

    name: str  # name of the stage's function
    title: str  # one or two words
    does: str | None  # None if it has nothing to do for the spec
    # by source: the given inputs, or the files that the build finds
    reads: Mapping[str, tuple[str, ...]]
    missing: Mapping[str, SourceMissing]  # by source: the reason if no files are found


def explain(spec: BuildSpec, inputs: Inputs) -> tuple[PlannedStage, ...]:
    """Return the work of each stage of a build; sources are searched, but not read."""
    check_inputs(spec, inputs)
    return tuple(_planned(each, spec, inputs) for each in BUILD)


def _planned(each: Stage, spec: BuildSpec, inputs: Inputs) -> PlannedStage:
    reads, missing = {}, {}
    for name in each.reads(spec):
        reads[name] = tuple(map(str, inputs.get(name, ())))
        if not reads[name]:
            try:
                files = SourceFiles.find(data_source(name), locate(name, inputs)).files
                reads[name] = tuple(str(file.path) for file in files)
            except SourceMissing as error:
                missing[name] = error
    return PlannedStage(each.name, each.title, each.plan(spec), reads, missing)
