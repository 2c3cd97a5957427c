"""Drafts of builds after some of their stages, from tables in memory."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from starcat.catalog.ingest import Ingested
from starcat.pipeline.draft import Draft, run
from starcat.pipeline.guide_stars import select, thin, tile
from starcat.pipeline.reading import merge_catalogs
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.pipeline.specs.reading import spec_from_dict


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


def spec_with(text: str, **sections: Any) -> BuildSpec:
    """Return the spec of a TOML text with some of its keys, and keys of its sections, changed."""
    content = tomllib.loads(text)
    for name, keys in sections.items():
        content[name] = {**content.get(name, {}), **keys} if isinstance(keys, dict) else keys
    return spec_from_dict(content, "small.toml")
