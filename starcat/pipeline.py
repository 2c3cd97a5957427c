"""The stages of a build, in order: from a spec and archive files to an artifact.

Each stage is a plain function of the results before it; the last ones write into a partial
folder, read it back, identify simulated fields with it and only then give it its name.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from starcat.artifact.content import json_bytes
from starcat.artifact.manifest import SourceFacts
from starcat.artifact.reader import check_artifact
from starcat.artifact.writer import (
    Outcome,
    Product,
    partial_folder,
    publish,
    write_manifest,
    write_products,
)
from starcat.catalog.ingest import Ingested, count_by_reason, ingest
from starcat.catalog.locate import locate
from starcat.catalog.selection import Selected, Step, select_guide_stars
from starcat.catalog.stars import directions_of, floats_of, sort_rows
from starcat.catalog.variability import AmplitudeTable, join_amplitudes, read_amplitudes
from starcat.errors import BuildError, ConfigError
from starcat.evaluation.selftest import Rates, self_test
from starcat.matcher.matcher import Matcher
from starcat.products.boresights import FieldStars, tile_sphere
from starcat.products.pairs import find_pairs
from starcat.progress import Progress, no_progress
from starcat.schema import product_schema
from starcat.spec import BuildSpec
from starcat.sphere import radec_from_directions

MIN_GUIDE_STARS = 4
"""Fewer than these cannot be identified by anything."""

Inputs = Mapping[str, Sequence[Path]]


@dataclass(frozen=True)
class Coverage:
    """What one filter leaves in the fields of the tiling.

    Attributes
    ----------
    step : str
        The filter.
    stars : int
        Stars left.
    median_per_field, min_per_field : float
        Stars in the field of a boresight.
    share_below_4 : float
        Share of the fields with fewer than 4 stars.
    """

    step: str
    stars: int
    median_per_field: float
    min_per_field: int
    share_below_4: float


@dataclass(frozen=True)
class Built:
    """A finished build.

    Attributes
    ----------
    folder : Path
        The artifact.
    outcome : {"written", "unchanged", "replaced"}
        What happened to the folder.
    manifest : dict
        Of the artifact.
    coverage : tuple of Coverage
        What each filter left.
    rates : tuple of Rates
        Of the self-test: clean and hard frames.
    problems : tuple of str
        The first malformed records.
    """

    folder: Path
    outcome: Outcome
    manifest: dict[str, Any]
    coverage: tuple[Coverage, ...]
    rates: tuple[Rates, Rates]
    problems: tuple[str, ...]


def build(
    spec: BuildSpec,
    inputs: Inputs,
    output: Path,
    *,
    replace: bool = False,
    progress: Progress = no_progress,
) -> Built:
    """Build an artifact.

    Parameters
    ----------
    spec : BuildSpec
        Everything that the database depends on.
    inputs : mapping of str to sequence of Path
        Input files or folders by source; others are looked for (`locate`).
    output : Path
        Folder that the artifact's own folder is made in.
    replace : bool, default False
        Whether a different artifact of the same name and version may be replaced.
    progress : Progress
        Called with (stage, done, total).

    Returns
    -------
    Built
        The artifact and what is worth telling about it.

    Raises
    ------
    ConfigError, SourceError
        If the spec or an input cannot be used.
    BuildError
        If no stars are left, or the database cannot identify its own fields.
    OutputError
        If the output cannot be written, or another artifact is there.
    """
    final = output / f"{spec.name}-{spec.version}"
    with partial_folder(final) as partial:
        catalog, amplitudes = read_sources(spec, inputs, progress)
        stars, joined = _join_all(catalog.stars, amplitudes)
        selected = select_guide_stars(stars, spec.selection)
        check_guide_stars(selected, spec)
        progress("products", 0, None)
        fields = _tile(selected.guide_stars, spec)
        products = make_products(spec, catalog, selected, fields)
        facts = write_products(partial, products, database_facts(spec))
        rates = run_self_test(partial, spec, progress)
        report = partial / "report"
        report.mkdir()
        results = [rate.as_dict() for rate in rates]
        (report / "self_test.json").write_bytes(json_bytes(results))
        sources = _source_facts(catalog, selected, amplitudes, joined)
        manifest = write_manifest(partial, spec.model_dump(mode="json"), sources, facts)
        progress("verify", 0, None)
        check_artifact(partial)
        check_rates(rates, spec)
        outcome = publish(partial, final, replace=replace)
    coverage = tuple(_coverage(step, spec) for step in selected.steps)
    return Built(final, outcome, manifest, coverage, rates, catalog.problems)


def read_sources(
    spec: BuildSpec, inputs: Inputs, progress: Progress
) -> tuple[Ingested, list[AmplitudeTable]]:
    """Read the star catalog and the sources of amplitudes.

    Parameters
    ----------
    spec : BuildSpec
        Which sources, and the epoch.
    inputs : mapping of str to sequence of Path
        As for `build`.
    progress : Progress
        Passed on.

    Returns
    -------
    catalog : Ingested
        The star table, at the epoch of the spec.
    amplitudes : list of AmplitudeTable
        In the order of the spec.
    """
    joins = spec.selection.variables.join
    check_inputs(spec, inputs)
    # All inputs are found before any is read: a missing one is known at once.
    paths = {name: locate(name, inputs) for name in (spec.catalog.source, *joins)}
    catalog = ingest(
        spec.catalog.source,
        paths[spec.catalog.source],
        band=spec.catalog.band,
        epoch_jyear=spec.epoch_jyear,
        read_limit_mag=spec.catalog.read_limit_mag,
        progress=progress,
    )
    return catalog, [read_amplitudes(name, paths[name], progress) for name in joins]


def check_inputs(spec: BuildSpec, inputs: Inputs) -> None:
    """Check that the spec uses every source that an input is given for.

    Parameters
    ----------
    spec : BuildSpec
        Which sources.
    inputs : mapping of str to sequence of Path
        As for `build`.

    Raises
    ------
    ConfigError
        Naming the source that would be ignored.
    """
    used = (spec.catalog.source, *spec.selection.variables.join)
    for name in inputs:
        if name not in used:
            raise ConfigError(
                f"--input {name}=...: {spec.name} does not read {name} but {', '.join(used)}; "
                "choose another preset or spec, or leave the input out",
                key="input",
                value=name,
            )


def _join_all(
    stars: pa.Table, amplitudes: Sequence[AmplitudeTable]
) -> tuple[pa.Table, dict[str, int]]:
    joined: dict[str, int] = {}
    for table in amplitudes:
        stars, joined[table.source] = join_amplitudes(stars, table)
    return stars, joined


def check_guide_stars(selected: Selected, spec: BuildSpec) -> None:
    """Check that the selection left stars to build from.

    Parameters
    ----------
    selected : Selected
        The selection.
    spec : BuildSpec
        For the message.

    Raises
    ------
    BuildError
        If fewer than 4 stars are left, with the reasons of the others.
    """
    left = len(selected.guide_stars)
    if left < MIN_GUIDE_STARS:
        counts = count_by_reason(selected.rejected)
        reasons = ", ".join(f"{name} {count}" for name, count in counts.items()) or "none read"
        raise BuildError(
            f"{spec.name}: {left} guide stars left of {len(selected.rejected) + left}; at least "
            f"{MIN_GUIDE_STARS} are needed. Rejected: {reasons}. Check the limits of [selection]"
        )


def _tile(guide_stars: pa.Table, spec: BuildSpec) -> FieldStars:
    return tile_sphere(
        spec.boresights.count,
        directions_of(guide_stars),
        floats_of(guide_stars, "mag"),
        spec.camera.camera(),
        spec.boresights.field,
    )


def make_products(
    spec: BuildSpec, catalog: Ingested, selected: Selected, fields: FieldStars
) -> list[Product]:
    """Compute the products of an artifact.

    Parameters
    ----------
    spec : BuildSpec
        Which products, and their parameters.
    catalog : Ingested
        Records rejected while reading.
    selected : Selected
        Guide stars, and stars rejected by the selection.
    fields : FieldStars
        The tiling of the guide stars.

    Returns
    -------
    list of Product
        In the order of the database.
    """
    rejected = pa.concat_tables([catalog.rejected, selected.rejected]).combine_chunks()
    order = product_schema("rejected").order
    return [
        Product("stars", selected.guide_stars),
        Product("rejected", sort_rows(rejected, order), in_database=False),
        boresight_product(fields, spec.boresights.brightest),
        pair_product(selected.guide_stars, spec),
    ]


def boresight_product(fields: FieldStars, brightest: int) -> Product:
    """Return the boresights as a product.

    Parameters
    ----------
    fields : FieldStars
        The tiling.
    brightest : int
        Length of each field's list of stars.

    Returns
    -------
    Product
        One row a boresight.
    """
    ra_deg, dec_deg = radec_from_directions(fields.boresights)
    offsets, star_index = fields.brightest(brightest)
    lists = pa.ListArray.from_arrays(pa.array(offsets, pa.int32()), pa.array(star_index))
    columns = [
        np.arange(len(fields.boresights), dtype=np.int32),
        ra_deg,
        dec_deg,
        *(np.ascontiguousarray(fields.boresights[:, k]) for k in range(3)),
        fields.count.astype(np.int32),
    ]
    schema = product_schema("boresights").arrow_schema
    arrays = [*(pa.array(values) for values in columns), lists.cast(schema.field("brightest").type)]
    return Product("boresights", pa.Table.from_arrays(arrays, schema=schema))


def pair_product(guide_stars: pa.Table, spec: BuildSpec) -> Product:
    """Return the star pairs as a product.

    Parameters
    ----------
    guide_stars : pyarrow.Table
        Of the stars schema.
    spec : BuildSpec
        Range of separations; the field's diagonal where none is given.

    Returns
    -------
    Product
        One row a pair, with its K-vector.
    """
    wanted = spec.products.pairs
    most = spec.camera.camera().diagonal_rad
    if wanted.max_separation_deg is not None:
        most = np.radians(wanted.max_separation_deg)
    pairs = find_pairs(directions_of(guide_stars), np.radians(wanted.min_separation_deg), most)
    schema = product_schema("pairs").arrow_schema
    arrays = [pa.array(values) for values in (pairs.i, pairs.j, pairs.separation_rad)]
    return Product("pairs", pa.Table.from_arrays(arrays, schema=schema), pairs.kvector)


def database_facts(spec: BuildSpec) -> dict[str, str | float]:
    """Return the attributes of the database as a whole.

    Parameters
    ----------
    spec : BuildSpec
        The build.

    Returns
    -------
    dict of str to str or float
        Name, version, frame, epoch, camera and the whole spec as JSON.
    """
    camera = spec.camera.camera()
    size = {"width_px": camera.width_px, "height_px": camera.height_px}
    content = spec.model_dump(mode="json")
    return {
        "name": spec.name,
        "version": spec.version,
        "frame": "ICRS",
        "epoch_jyear": spec.epoch_jyear,
        "camera": json.dumps({**size, "focal_length_px": camera.focal_length_px}, sort_keys=True),
        "spec": json.dumps(content, sort_keys=True),
    }


def run_self_test(folder: Path, spec: BuildSpec, progress: Progress) -> tuple[Rates, Rates]:
    """Identify simulated fields with a database.

    Parameters
    ----------
    folder : Path
        With ``database.h5``.
    spec : BuildSpec
        How many fields, their noise and seed.
    progress : Progress
        Passed on.

    Returns
    -------
    clean, hard : Rates
        How they fared.
    """
    test = spec.self_test
    matcher = Matcher.open(folder, tolerance_px=max(0.5, 4.0 * test.noise_px))
    return self_test(matcher, test.frames, test.noise_px, test.seed, progress)


def check_rates(rates: tuple[Rates, Rates], spec: BuildSpec) -> None:
    """Check that a database identifies its own fields.

    Parameters
    ----------
    rates : tuple of Rates
        Of the self-test.
    spec : BuildSpec
        ``self_test.min_identified``.

    Raises
    ------
    BuildError
        If the clean frames fall short, or any answer was wrong.
    """
    clean = rates[0]
    if clean.identified_share < spec.self_test.min_identified:
        raise BuildError(
            f"{spec.name}: the database identifies {clean.identified} of {clean.identifiable} "
            f"simulated fields with at least 4 stars ({clean.frames} in all); "
            f"self_test.min_identified asks for {spec.self_test.min_identified:.1%}. A fainter "
            "faint_limit_mag or a wider camera gives more stars a field"
        )
    wrong = sum(rate.wrong for rate in rates)
    if wrong:
        raise BuildError(f"{spec.name}: {wrong} simulated fields got a wrong answer")


def _source_facts(
    catalog: Ingested,
    selected: Selected,
    amplitudes: Sequence[AmplitudeTable],
    joined: Mapping[str, int],
) -> list[SourceFacts]:
    rejected = {**catalog.rejected_by_reason, **count_by_reason(selected.rejected)}
    for reason in catalog.rejected_by_reason.keys() & count_by_reason(selected.rejected).keys():
        rejected[reason] += catalog.rejected_by_reason[reason]
    facts = [
        SourceFacts(
            catalog.source,
            "stars",
            catalog.files,
            catalog.rows_read,
            len(selected.guide_stars),
            rejected,
        )
    ]
    for table in amplitudes:
        read = sum(file.rows for file in table.files)
        facts.append(
            SourceFacts(
                table.source,
                "variability",
                table.files,
                read,
                table.kept,
                table.rejected,
                joined[table.source],
            )
        )
    return facts


def _coverage(step: Step, spec: BuildSpec) -> Coverage:
    fields = tile_sphere(
        spec.boresights.count,
        step.directions,
        np.zeros(len(step.directions)),
        spec.camera.camera(),
        spec.boresights.field,
    )
    count = fields.count
    return Coverage(
        step.name,
        len(step.directions),
        float(np.median(count)),
        int(count.min()),
        float((count < MIN_GUIDE_STARS).mean()),
    )
