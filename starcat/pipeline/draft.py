"""What a build knows so far, and the stages that add to it.

A build is a list of stages (`starcat.pipeline.stages`). Each is a function of one `Draft`, which it
changes in place; `run` calls those that have something to do for the spec, in the order of the
list.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import pyarrow as pa

from starcat.artifact.manifest import SourceFacts
from starcat.artifact.writer import Product
from starcat.catalog.ingest import Ingested
from starcat.catalog.sensor_band import InBand
from starcat.catalog.span import Validity
from starcat.errors import BuildError
from starcat.pipeline.cost import Cost
from starcat.pipeline.log import Stopwatch
from starcat.pipeline.report_data import FilterCoverage
from starcat.products.tiling import FieldStars
from starcat.progress import Progress, no_progress
from starcat.report.report import CoverageReport
from starcat.selection.selecting import Selected
from starcat.simulation.selftest import Rates
from starcat.specs.build_spec import BuildSpec

Inputs = Mapping[str, Sequence[Path]]
"""Files, folders or addresses that were given, by source; those of other sources are looked for."""


@dataclass(repr=False, eq=False)
class Draft:
    """A database while it is made.

    The first fields are what a build is asked for. The others are set by stages, in about this
    order; one without a default does not exist before the stage that makes it.
    """

    spec: BuildSpec
    """What is to be built."""
    inputs: Inputs = field(default_factory=dict)
    """What was given to read."""
    workers: int = 2
    """Threads; the database is the same for any number."""
    progress: Progress = no_progress
    """Called when a stage begins, and while sources are read and frames identified."""
    announce: Callable[[Cost], None] | None = None
    """Called with the cost before any product is made."""
    max_memory_bytes: int | None = None
    """Memory that the build may take; by default what the machine has left."""
    refusals: list[BuildError] | None = None
    """Why the spec cannot be built, for an estimate. A build ends at the first reason instead."""
    clock: Stopwatch = field(default_factory=Stopwatch)
    """Seconds that the parts of the build took."""
    notes: dict[str, list[str]] = field(default_factory=dict)
    """What a user should know, by the stage that it is about; stages in their order."""

    paths: dict[str, list[Path]] = field(init=False)
    """Files, folders or addresses of every source of the spec, found."""
    read: list[Ingested] = field(init=False)
    """The star catalogs as they were read; empty when they have been merged."""
    stars: pa.Table = field(init=False)
    """Records with a position (schema ``stars``), by star_id."""
    rejected: pa.Table = field(init=False)
    """Records that reading rejected (schema ``rejected``)."""
    problems: tuple[str, ...] = ()
    """The first malformed records."""
    sources: list[SourceFacts] = field(default_factory=list)
    """What was read, in the order of the manifest, as far as it is known."""
    catalog_bytes: int = field(init=False)
    """Memory that stars and rejected records take before other sources add to them."""
    motions: pa.Table | None = None
    """Where each star's motion is from (schema ``motions``), a row a star; None without the key."""
    in_band: InBand | None = None
    """Magnitudes in the band of the sensor; None where the spec states no response."""

    selected: Selected = field(init=False)
    """Guide stars, every other star with its reason, and what was left after each filter."""
    fields: FieldStars = field(init=False)
    """The tiling of the sphere and the guide stars of each field."""
    rejected_bytes: int | None = None
    """Size of the file of rejected records, where they are not all at hand to be measured."""
    cost: Cost = field(init=False)
    """What the build will cost."""

    products: list[Product] = field(default_factory=list)
    """The products, in the order of the database."""

    folder: Path = field(init=False)
    """Where the database is written, before it has its name."""
    facts: dict[str, dict[str, Any]] = field(init=False)
    """What the manifest says of each product."""
    rates: tuple[Rates, ...] = field(init=False)
    """How many simulated fields were identified."""
    filters: tuple[FilterCoverage, ...] = field(init=False)
    """What each filter of the selection left in the fields."""
    coverage: CoverageReport = field(init=False)
    """How guide stars cover the sphere."""
    validity: Validity | None = None
    """How long positions hold; None where the spec states no span."""
    manifest: dict[str, Any] = field(default_factory=dict)
    """The manifest as it was written; empty before."""

    def note(self, stage: str, *texts: str) -> None:
        """Add notes about what a stage did."""
        self.notes.setdefault(stage, []).extend(texts)

    @property
    def warnings(self) -> tuple[str, ...]:
        """All notes, each once."""
        return tuple(dict.fromkeys(filter(None, chain.from_iterable(self.notes.values()))))

    @property
    def records(self) -> int:
        """Records in all files of the star catalogs."""
        return sum(source.rows_read for source in self.sources if source.role == "stars")

    def product(self, name: str) -> pa.Table:
        """Return the table of a product that has been made."""
        return next(product.table for product in self.products if product.name == name)

    def branch(self, spec: BuildSpec) -> Draft:
        """Return a draft that has the same so far and goes on with another spec."""
        other = copy(self)
        other.spec = spec
        other.notes = {stage: list(texts) for stage, texts in self.notes.items()}
        other.sources, other.products = list(self.sources), list(self.products)
        other.refusals = None if self.refusals is None else list(self.refusals)
        return other


@dataclass(frozen=True)
class Stage:
    """One stage of a build: its function, and what it will do for a spec."""

    change: Callable[[Draft], None]  # what it does
    title: str  # in a word or two
    part: str  # of the build, by which its time is recorded
    plan: Callable[[BuildSpec], str | None]  # what it will do for a spec; None where nothing
    reads: Callable[[BuildSpec], Sequence[str]]  # the sources that it reads for a spec
    is_announced: bool  # whether its title is shown as progress when it begins

    def __call__(self, draft: Draft) -> None:
        """Run the stage on a draft, even if the spec does not ask for it."""
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
    """Run the stages that have something to do for the spec, in order; return the draft."""
    for each in stages:
        draft.notes.setdefault(each.name, [])
        if each.plan(draft.spec) is None:
            continue
        if each.is_announced:
            draft.progress(each.title, 0, None)
        each(draft)
        draft.clock.lap(each.part)
    return draft
