"""Where the input files of a source are looked for."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.fetching.fetch import cache_folder
from starcat.catalog.readers.files import lacking
from starcat.catalog.source import data_source
from starcat.errors import SourceMissing

CATALOGS_VARIABLE = "STARCAT_CATALOGS"


def locate(source_name: str, given: Mapping[str, Sequence[Path]]) -> list[Path]:
    """Return the paths to read a source from."""
    source = data_source(source_name)
    if given.get(source_name):
        return list(given[source_name])
    folders = [path if path.is_dir() else path.parent for paths in given.values() for path in paths]
    if os.environ.get(CATALOGS_VARIABLE):
        folders.append(Path(os.environ[CATALOGS_VARIABLE]))
    folders.append(cache_folder())
    folders = list(dict.fromkeys(folders))
    lacks = {folder: lacking(source, folder) for folder in folders if folder.is_dir()}
    for folder, missing in lacks.items():
        if missing == ():
            return [folder]
    if source_name == "gaia":
        return [embedded_sky()]
    raise SourceMissing(
        f"{source_name} ({source.title}): {_what_is_where(lacks, folders)}. Name it with --input "
        f"{source_name}=PATH, set ${CATALOGS_VARIABLE} to the folder that has "
        f"{source.files[0].file_names[-1]}[.gz], or run 'starcat fetch {source_name}'",
        source=source_name,
    )


def _what_is_where(lacks: Mapping[Path, tuple[str, ...] | None], folders: Sequence[Path]) -> str:
    """Say that no folder has a file of the source, or else what those lack that have some."""
    partly = [f"{folder} lacks {' and '.join(m)}" for folder, m in lacks.items() if m]
    searched = ", ".join(str(folder) for folder in folders if not lacks.get(folder))
    if not partly:
        return f"no file found in {searched}"
    nothing = f"; no file found in {searched}" if searched else ""
    return f"no folder has all of its files: {'; '.join(partly)}{nothing}"
