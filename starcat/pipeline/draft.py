"""The intermediate state of a build, and the stages that extend it.

A build is a list of stages (`starcat.pipeline.stages`). Each stage is a function that changes one
`Draft` in place. `run` calls the stages in the order of the list, and skips stages that have
nothing to do for the spec.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import pyarrow as pa

from starcat.catalog.ingest import Ingested
from starcat.catalog.sensor_band import InBand
from starcat.catalog.span import Validity
from starcat.database.manifest import SourceFacts
from starcat.database.products.tiling import FieldStars
from starcat.database.writer import Product
from starcat.errors import BuildError
from starcat.pipeline.cost import Cost
from starcat.pipeline.log import Stopwatch
from starcat.pipeline.report.report import CoverageReport
from starcat.pipeline.report_data import FilterCoverage
from starcat.pipeline.selection.selecting import Selected
from starcat.pipeline.simulation.selftest import Rates
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.progress import Progress, no_progress

Inputs = Mapping[str, Sequence[Path]]
"""Given files, folders or addresses by source; for other sources starcat searches for the files."""


@dataclass(repr=False, eq=False)
class Draft:
    """A database during its build.

    The first fields are the arguments of a build. Stages set the other fields, in about this
    order; a field without a default does not exist before its stage.
    """

    spec: BuildSpec
    """The spec of the database."""
    inputs: Inputs = field(default_factory=dict)
    """The given inputs."""
    workers: int = 2
    """Number of threads; the database does not depend on it."""
    progress: Progress = no_progress
    """Called when a stage begins, and during reading and identification."""
    announce: Callable[[Cost], None] | None = None
    """Called with the cost before any product is made."""
    max_memory_bytes: int | None = None
    """Memory limit of the build; by default the free memory of the machine."""
    refusals: list[BuildError] | None = None
    """Reasons why the spec cannot be built; for estimates. A build raises the first reason."""
    clock: Stopwatch = field(default_factory=Stopwatch)
    """Seconds by part of the build."""
    notes: dict[str, list[str]] = field(default_factory=dict)
    """Notes for the user by stage, in the order of the stages."""

    paths: dict[str, list[Path]] = field(init=False)
    """Files, folders or addresses found for every source of the spec."""
    read: list[Ingested] = field(init=False)
    """The star catalogs after reading; empty after they are merged."""
    stars: pa.Table = field(init=False)
    """Records with a position (schema ``stars``), by star_id."""
    rejected: pa.Table = field(init=False)
    """Records that reading rejected (schema ``rejected``)."""
    problems: tuple[str, ...] = ()
    """The first malformed records."""
    sources: list[SourceFacts] = field(default_factory=list)
    """Facts about the sources read so far, in the order of the manifest."""
    catalog_bytes: int = field(init=False)
    """Memory of stars and rejected records before other sources add columns."""
    motions: pa.Table | None = None
    """Origin of each star's motion (schema ``motions``), one row per star; None without the key."""
    in_band: InBand | None = None
    """Magnitudes in the band of the sensor; None if the spec states no response."""

    selected: Selected = field(init=False)
    """Guide stars, every other star with its reason, and the stars left after each filter."""
    fields: FieldStars = field(init=False)
    """The tiling of the sphere and the guide stars of each field."""
    rejected_rows: int | None = None
    """Number of rejected records, if not all records are in memory to count them."""
    cost: Cost = field(init=False)
    """Estimated cost of the build."""

    products: list[Product] = field(default_factory=list)
    """The products, in the order of the database."""

    folder: Path = field(init=False)
    """Temporary folder in which the database is written."""
    facts: dict[str, dict[str, Any]] = field(init=False)
    """Facts for the manifest about each product."""
    rates: tuple[Rates, ...] = field(init=False)
    """Identification rates of simulated fields."""
    filters: tuple[FilterCoverage, ...] = field(init=False)
    """Stars in the fields after each filter of the selection."""
    coverage: CoverageReport = field(init=False)
    """Coverage of the sphere by guide stars."""
    validity: Validity | None = None
    """Validity of the positions; None if the spec states no span."""
    manifest: dict[str, Any] = field(default_factory=dict)
    """The written manifest; empty before."""

    def note(self, stage: str, *texts: str) -> None:
        """Add notes of a stage."""
        self.notes.setdefault(stage, []).extend(texts)

    @property
    def warnings(self) -> tuple[str, ...]:
        """All notes, without duplicates."""
        return tuple(dict.fromkeys(filter(None, chain.from_iterable(self.notes.values()))))

    @property
    def records(self) -> int:
        """Records in all files of the star catalogs."""
        return sum(source.rows_read for source in self.sources if source.role == "stars")

    def product(self, name: str) -> pa.Table:
        """Return the table of a finished product."""
        return next(product.table for product in self.products if product.name == name)

    def branch(self, spec: BuildSpec) -> Draft:
        """Return a copy of the draft that continues with another spec."""
        other = copy(self)
        other.spec = spec
        other.notes = {stage: list(texts) for stage, texts in self.notes.items()}
        other.sources, other.products = list(self.sources), list(self.products)
        other.refusals = None if self.refusals is None else list(self.refusals)
        return other


@dataclass(frozen=True)
class Stage:
    """One stage of a build: its function, and a description of its work for a spec."""

    change: Callable[[Draft], None]  # the function
    title: str  # one or two words
    part: str  # part of the build for which its time is recorded
    plan: Callable[[BuildSpec], str | None]  # describes its work for a spec; None: nothing to do
    reads: Callable[[BuildSpec], Sequence[str]]  # sources that it reads for a spec
    is_announced: bool  # True: its title is shown as progress when it begins

    def __call__(self, draft: Draft) -> None:
        """Run the stage on a draft, even if the spec does not require it."""
        self.change(draft)

    @property
    def name(self) -> str:
        """The name of the function."""
        return self.change.__name__

    @property
    def summary(self) -> str:
        """The first line of the docstring of the function."""
        return (self.change.__doc__ or "").partition("\n")[0]


def stage(
    title: str,
    part: str,
    plan: Callable[[BuildSpec], str | None],
    reads: Callable[[BuildSpec], Sequence[str]] = lambda spec: (),
    *,
    is_announced: bool = False,
) -> Callable[[Callable[[Draft], None]], Stage]:
    """Make a function of a draft a stage."""
    return lambda change: Stage(change, title, part, plan, reads, is_announced)


def run(draft: Draft, stages: Sequence[Stage]) -> Draft:
    """Run all stages that the spec requires, in order; return the draft."""
    for each in stages:
        draft.notes.setdefault(each.name, [])
        if each.plan(draft.spec) is None:
            continue
        if each.is_announced:
            draft.progress(each.title, 0, None)
        each(draft)
        draft.clock.lap(each.part)
    return draft
