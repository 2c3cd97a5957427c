"""The stages that read: catalogs, flight data, and the errors of positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pyarrow.compute as pc

from starcat.catalog.bands.response import shipped_names
from starcat.catalog.ingest import CatalogPart, Ingested, check_band
from starcat.catalog.source import check_supplies, data_source, map_of
from starcat.catalog.source_files import locate
from starcat.catalog.span import with_span
from starcat.catalog.stars.verdict import count_by_reason
from starcat.catalog.store.reading import read_catalog
from starcat.database.manifest import SourceFacts
from starcat.errors import ConfigError
from starcat.pipeline.draft import Draft, Inputs, stage
from starcat.pipeline.merging import merged_catalog
from starcat.pipeline.observed import with_observed
from starcat.pipeline.selection.rules.distrust import Observed
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.progress import Progress, no_progress


def _read_plan(spec: BuildSpec) -> str:
    limit = spec.catalog.read_limit_mag
    depth = "whole" if limit is None else f"down to {limit:g} mag"
    return f"read {', '.join(spec.catalog.catalogs)} {depth}, positions at J{spec.middle_jyear:g}"


def _merge_plan(spec: BuildSpec) -> str:
    first, *others = spec.catalog.catalogs
    if not others:
        return f"take the stars of {first}"
    return f"take the stars of {first}, and those of {', '.join(others)} that it lacks"


@stage("read catalogs", "read", _read_plan, lambda spec: spec.catalog.catalogs)
def read_catalogs(draft: Draft) -> None:
    """Find the files of all sources, and read the star catalogs.

    A missing source raises an error before any source is read.
    """
    spec = draft.spec
    check_inputs(spec, draft.inputs)
    draft.paths = {name: locate(name, draft.inputs) for name in spec.sources}
    draft.read = read_all(
        spec.catalog.catalogs,
        draft.paths,
        band=spec.catalog.band,
        epoch_jyear=spec.middle_jyear,
        read_limit_mag=spec.catalog.read_limit_mag,
        neighbours=not spec.catalog.motions,  # else searched after the stars are moved
        workers=draft.workers,
        progress=draft.progress,
    )


@stage("merge", "read", _merge_plan, is_announced=True)
def merge_catalogs(draft: Draft) -> None:
    """Merge the star catalogs into one table with one row per star."""
    spec = draft.spec
    neighbours = not spec.catalog.motions
    whole = merged_catalog(
        draft.read, spec.products.crossmatch, draft.workers, neighbours=neighbours
    )
    draft.read = []
    draft.stars, draft.rejected, draft.problems = whole.stars, whole.rejected, whole.problems
    draft.catalog_bytes = whole.stars.nbytes + whole.rejected.nbytes
    draft.note("merge_catalogs", *whole.notes)
    for part in whole.parts or (CatalogPart.of(whole),):
        stars, rejected = (
            table.filter(pc.equal(table["catalog"], part.source)) if whole.parts else table
            for table in (whole.stars, whole.rejected)
        )
        rows = sum(file.rows for file in part.files)
        reasons = count_by_reason(rejected, part.beyond_read_limit)
        facts = SourceFacts(part.source, "stars", part.files, rows, len(stars), reasons)
        draft.sources.append(replace(facts, map=map_of(part.source)))


def _flight_plan(spec: BuildSpec) -> str | None:
    done = []
    if spec.selection.observed != Observed():
        done.append("correct magnitudes by what was observed in flight")
    if spec.exposure_notes:
        done.append("compare limits with the exposure")
    return ", ".join(done) or None


@stage("flight terms", "read", _flight_plan)
def apply_flight_terms(draft: Draft) -> None:
    """Correct magnitudes by observations in flight, and note the limits due to the exposure."""
    draft.stars = with_observed(draft.stars, draft.spec.selection.observed)
    draft.note("apply_flight_terms", *draft.spec.exposure_notes)


def _span_plan(spec: BuildSpec) -> str:
    begin, end = spec.span_jyear
    if begin == end:
        return f"compute the errors of positions at J{begin:g}"
    return f"compute errors and drifts of positions from J{begin:g} to J{end:g}"


@stage("span", "read", _span_plan)
def apply_span(draft: Draft) -> None:
    """Compute the errors of positions at both ends of the span, and the drift of each star."""
    draft.stars = with_span(draft.stars, draft.spec.span_jyear)


def check_sources(spec: BuildSpec) -> None:
    """Check that every source supplies what the spec takes from it."""
    first, *others = spec.catalog.catalogs
    check_supplies(first, "stars", "catalog.source")
    for name in others:
        check_supplies(name, "stars", "catalog.merged")
    band = _band_of_spec(spec)
    for name in others:
        _check_convertible(name, data_source(name).bands[0], band)
    for name in spec.catalog.motions:
        check_supplies(name, "motions", "catalog.motions")
    for name in spec.camera.response.photometry:
        check_supplies(name, "stars", "camera.response.photometry")
    for name in spec.products.crossmatch.catalogs if spec.products.crossmatch.enabled else ():
        check_supplies(name, "stars", "products.crossmatch.catalogs")


def _band_of_spec(spec: BuildSpec) -> str:
    """Return the band of the magnitudes of a spec, after checking that its catalog has it."""
    source = data_source(spec.catalog.source)
    try:
        return check_band(source, spec.catalog.band)
    except ConfigError as error:
        raise ConfigError(
            str(error), where="catalog.band", key="catalog.band", value=spec.catalog.band
        ) from error


def _check_convertible(source: str, source_band: str, band: str) -> None:
    """Check that magnitudes of a source in its own band can be converted to a band."""
    if source_band != band and band not in shipped_names():
        raise ConfigError(
            f"the passband of {band!r} is unknown, so the magnitudes of {source} in "
            f"{source_band} cannot be converted to it",
            where="catalog.band",
            key="catalog.band",
            value=band,
            hint="choose a band that 'starcat bands' lists",
        )


def check_inputs(spec: BuildSpec, inputs: Inputs) -> None:
    """Check the sources of a spec, and that the spec uses every input."""
    check_sources(spec)
    for name in inputs:
        if name not in spec.sources:
            raise ConfigError(
                f"{spec.name} does not read {name} but {', '.join(spec.sources)}",
                parameter=f"inputs[{name}]",
                hint=("choose another preset or spec", "leave the input out"),
            )


def read_all(
    names: Sequence[str],
    paths: Mapping[str, Sequence[Path]],
    *,
    band: str | None = None,
    epoch_jyear: float | None = None,
    read_limit_mag: float | None = None,
    neighbours: bool = True,
    workers: int = 2,
    progress: Progress = no_progress,
) -> list[Ingested]:
    """Read several catalogs for a merge, in the order of preference.

    The band is a band of the first catalog; the read limit is in each catalog's own band. Nearest
    neighbours are searched only if there is just one catalog.
    """
    return [
        read_catalog(
            name,
            paths[name],
            band=None if number else band,
            epoch_jyear=epoch_jyear,
            read_limit_mag=read_limit_mag,
            neighbours=neighbours and len(names) == 1,
            workers=workers,
            progress=progress,
        )
        for number, name in enumerate(names)
    ]
