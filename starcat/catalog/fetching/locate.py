"""Where the input files of a source are looked for."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.fetching.fetch import cache_folder
from starcat.catalog.readers.files import holds_source
from starcat.catalog.source import data_source
from starcat.errors import SourceMissing

CATALOGS_VARIABLE = "STARCAT_CATALOGS"


def locate(source_name: str, given: Mapping[str, Sequence[Path]]) -> list[Path]:
    """Return the paths to read a source from.

    Parameters
    ----------
    source_name : str
        A name of ``data_sources``.
    given : mapping of str to sequence of Path
        Inputs that the caller named, by source.

    Returns
    -------
    list of Path
        The inputs given for the source; else the first folder that holds it of: the folders
        of the inputs given for other sources, ``$STARCAT_CATALOGS``, the download cache; for
        ``gaia`` at last the embedded sky.

    Raises
    ------
    SourceMissing
        Naming every place that was searched.
    """
    source = data_source(source_name)
    if given.get(source_name):
        return list(given[source_name])
    folders = [path if path.is_dir() else path.parent for paths in given.values() for path in paths]
    if os.environ.get(CATALOGS_VARIABLE):
        folders.append(Path(os.environ[CATALOGS_VARIABLE]))
    folders.append(cache_folder())
    for folder in folders:
        if folder.is_dir() and holds_source(source, folder):
            return [folder]
    if source_name == "gaia":
        return [embedded_sky()]
    searched = ", ".join(dict.fromkeys(str(folder) for folder in folders))
    raise SourceMissing(
        f"{source_name} ({source.title}): no file found in {searched}. Name it with --input "
        f"{source_name}=PATH, set ${CATALOGS_VARIABLE} to the folder that has "
        f"{source.files[0].file_names[-1]}[.gz], or run 'starcat fetch {source_name}'",
        source=source_name,
    )
