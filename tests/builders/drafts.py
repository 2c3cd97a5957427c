"""Drafts of builds after some of their stages, from tables in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pyarrow as pa

from starcat.catalog.ingest import Ingested
from starcat.pipeline.draft import Draft, run
from starcat.pipeline.guide_stars import select, thin, tile
from starcat.pipeline.reading import merge_catalogs
from starcat.specs.build_spec import BuildSpec


def merged(
    catalog: Ingested, spec: BuildSpec, inputs: Mapping[str, Sequence[Path]], workers: int = 2
) -> Draft:
    """Return a draft that has read a catalog and has the files of other sources."""
    draft = Draft(spec, inputs, workers)
    draft.read = [catalog]
    draft.paths = {name: list(paths) for name, paths in inputs.items()}
    return run(draft, (merge_catalogs,))


def chosen(stars: pa.Table, spec: BuildSpec) -> Draft:
    """Return a draft that has chosen guide stars, and has their fields."""
    draft = Draft(spec)
    draft.stars = stars
    return run(draft, (select, thin, tile))
