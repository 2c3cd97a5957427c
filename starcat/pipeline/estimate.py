"""What a spec will give, without building it: guide stars, fields, files, time and memory.

The stars are those of the build, chosen by the same functions from the same tables. What takes
long is reading the catalogs; it depends on a few keys of the spec only, and its result can be kept.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
import pyarrow as pa

from starcat.catalog.ingest import count_by_reason
from starcat.catalog.selection import Selected
from starcat.errors import BuildError
from starcat.geometry.sphere import saff_kuijlaars
from starcat.pipeline.build import Inputs
from starcat.pipeline.catalog_snapshot import SAMPLE_ROWS, CatalogSnapshot, read_snapshot
from starcat.pipeline.cost import Cost, base_memory, check_memory, table_bytes, whole_cost
from starcat.pipeline.guide_stars import (
    MOST_FIELD_STARS,
    check_fields,
    check_tiling,
    depth_notes,
    thinned_stars,
)
from starcat.pipeline.motions import motions_of
from starcat.pipeline.recipes import field_size, tile_guide_stars
from starcat.products.coverage import (
    MIN_GUIDE_STARS,
    CoverageSummary,
    TilingGap,
    field_coverage,
    summarise_coverage,
    tiling_gap,
)
from starcat.products.tiling import FieldStars
from starcat.progress import Progress, no_progress
from starcat.report.report import coverage_warnings
from starcat.specs.build_spec import BuildSpec, Selection
from starcat.stars.star_table import floats_of, reject_rows, sort_rows
from starcat.stars.verdict import Reason
from starcat.storage.schema import product_schema

MOST_FOR_GAPS = 50_000
"""Of more boresights than these the widest gap is not looked for."""


@dataclass(frozen=True)
class Choice:
    """The guide stars of a spec and their fields."""

    # guide stars, and of the others those that were bright enough to be looked at
    selected: Selected
    fields: FieldStars  # the tiling of the guide stars
    rejected: Mapping[str, int]  # all records that are no guide stars, by reason

    @property
    def nbytes(self) -> int:
        """Memory that it takes."""
        tables = (self.selected.guide_stars, self.selected.rejected)
        steps = (step.directions for step in self.selected.steps)
        return int(self.fields.nbytes + sum(each.nbytes for each in (*tables, *steps)))


def choose_stars(read: CatalogSnapshot, spec: BuildSpec) -> Choice:
    """Choose the guide stars of a spec, as its build does; a field may have too few of them."""
    order, mag = read.by_brightness
    bright = np.sort(order[: np.searchsorted(mag, _faintest(spec.selection), side="right")])
    stars = read.stars.take(pa.array(bright)).combine_chunks()
    most = spec.selection.max_stars_per_field
    check_tiling(int(np.searchsorted(mag, spec.selection.faint_limit_mag, "right")), spec, most)
    if len(stars) < MIN_GUIDE_STARS:
        thinned_stars(read.stars, spec)  # says so, in the words of the build
    selected = thinned_stars(stars, spec)
    check_tiling(len(selected.guide_stars), spec, None)
    _check_fields_of_products(len(selected.guide_stars), spec)
    fields = tile_guide_stars(selected.guide_stars, spec)
    blank = len(mag) - int(np.searchsorted(mag, np.inf))
    found = dict.fromkeys((reason.name for reason in Reason), 0)
    for counts in (
        read.rejected,
        count_by_reason(selected.rejected),
        {Reason.no_magnitude.name: blank, Reason.too_faint.name: len(mag) - len(bright) - blank},
    ):
        for name, count in counts.items():
            found[name] += count
    return Choice(selected, fields, {name: count for name, count in found.items() if count})


def _faintest(selection: Selection) -> float:
    """Return the magnitude beyond which a star is too faint, and nobody's companion."""
    if selection.neighbours.is_on:
        return np.inf
    companions = selection.doubles.companion_limit_mag
    return max(selection.faint_limit_mag, -np.inf if companions is None else companions)


def _check_fields_of_products(stars: int, spec: BuildSpec) -> None:
    """Check the same of the products that tile the sphere themselves."""
    for section in spec.products.wanted.values():
        try:
            section.check_fields(stars, spec.boresights.count, field_size(spec), MOST_FIELD_STARS)
        except ValueError as error:
            raise BuildError(f"{spec.name}: too dense to estimate: {error}") from None


@dataclass(frozen=True)
class Estimate:
    """What a spec will give."""

    spec: BuildSpec
    cost: Cost  # rows, files, memory, and the time after reading
    read_seconds: float  # time to read the catalogs
    fields: FieldStars  # the tiling of the guide stars
    coverage: CoverageSummary  # how stars are spread over the fields
    # shares of the fields with at least `MIN_GUIDE_STARS` stars, and with as many as the list of
    # a field is long
    enough_share: float
    full_share: float
    filters: tuple[tuple[str, int], ...]  # the stars that each filter leaves
    rejected: Mapping[str, int]  # all other records, by reason
    refusals: tuple[str, ...]  # why the build will be refused; empty where it will not
    warnings: tuple[str, ...]  # what is worth a second look

    @property
    def build_seconds(self) -> float:
        """Time of the whole build."""
        return self.cost.seconds + self.read_seconds

    @property
    def total_bytes(self) -> int:
        """Size of the database."""
        return sum(self.cost.files.values())

    @property
    def files(self) -> list[tuple[str, int | None, int]]:
        """Name, rows of a product, and bytes of each file."""
        cost, rejected = self.cost, sum(self.rejected.values())
        own = {"stars": cost.stars, "boresights": cost.fields, "rejected": rejected}
        rows = {f"{product}.parquet": count for product, count in {**cost.rows, **own}.items()}
        return [(name, rows.get(name), size) for name, size in cost.files.items()]


def estimate(
    read: CatalogSnapshot, choice: Choice, spec: BuildSpec, max_memory_bytes: int | None = None
) -> Estimate:
    """Estimate what a spec will give."""
    guide_stars, fields = choice.selected.guide_stars, choice.fields
    cost = whole_cost(
        guide_stars,
        fields,
        spec,
        _rejected_bytes(read, choice, spec),
        base_memory(read.held_bytes),
        motions_of(read.stars, read.motions, guide_stars),
    )
    refusals = []
    for check in (
        partial(check_fields, fields, spec),
        partial(check_memory, cost, spec, max_memory_bytes),
    ):
        try:
            check()
        except BuildError as error:
            refusals.append(str(error))
    count = fields.count
    gap = _gap(spec)
    summary = summarise_coverage(field_coverage(fields, spec.boresights.brightest))
    return Estimate(
        spec,
        cost,
        read.seconds,
        fields,
        summary,
        float((count >= MIN_GUIDE_STARS).mean()),
        float((count >= spec.boresights.brightest).mean()),
        tuple((step.name, len(step.directions)) for step in choice.selected.steps),
        choice.rejected,
        tuple(refusals),
        (
            *read.notes,
            *spec.exposure_notes,
            *spec.exposure_proposal,
            *depth_notes(read.stars, spec),
            *coverage_warnings(summary, gap),
        ),
    )


def _rejected_bytes(read: CatalogSnapshot, choice: Choice, spec: BuildSpec) -> int:
    """Return the size of the file of rejected records, of which only some are at hand."""
    seen, mag = choice.selected.rejected, floats_of(read.stars, "mag")
    faint = np.flatnonzero(~(mag <= _faintest(spec.selection)))  # or of no magnitude
    first = max(0, (len(faint) - SAMPLE_ROWS) // 2)
    some = read.stars.take(pa.array(faint[first : first + SAMPLE_ROWS]))
    some = reject_rows(some, pa.repeat(Reason.too_faint.name, len(some)))
    listed = sort_rows(pa.concat_tables([seen, some]), product_schema("rejected").order)
    size = table_bytes(listed, len(seen) + len(faint))
    return size + read.rejected_bytes


def _gap(spec: BuildSpec) -> TilingGap | None:
    """Return the widest gap of a tiling that is not too large to look for it."""
    if spec.boresights.count > MOST_FOR_GAPS:
        return None
    size = field_size(spec)
    radius = 0.5 * float(np.radians(min(size.fov_x_deg, size.fov_y_deg)))
    return replace(_widest_gap(spec.boresights.count), tile_radius_rad=radius)


@lru_cache
def _widest_gap(boresights: int) -> TilingGap:
    return tiling_gap(saff_kuijlaars(boresights), 0.0)


def estimate_spec(
    spec: BuildSpec, inputs: Inputs, workers: int = 2, progress: Progress = no_progress
) -> Estimate:
    """Read the catalogs of a spec and estimate what it will give."""
    read = read_snapshot(spec, inputs, workers, progress)
    return estimate(read, choose_stars(read, spec), spec)
