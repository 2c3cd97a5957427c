"""Folders of the files that ship with starcat: schemas, data sources, presets, documentation."""

from __future__ import annotations

import os
import tomllib
from functools import cache
from pathlib import Path

PathLike = str | os.PathLike[str]
"""The types that public functions accept as a path."""

_PACKAGE = Path(__file__).resolve().parent


def resource_folder(name: str) -> Path:
    """Return the folder ``schemas``, ``data_sources``, ``docs`` or ``presets``.

    A wheel contains the folders inside the package; a checkout has the first three next to it.

    Examples
    --------
    >>> resource_folder("schemas").name
    'schemas'
    """
    for folder in (_PACKAGE / name, _PACKAGE.parent / name):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"starcat is installed without its folder {name!r}: reinstall it")


@cache
def sources_supplying(what: str) -> tuple[str, ...]:
    """Return the sorted names of the data sources whose file states that they supply something.

    So a new list of variables or doubles is one new file, and no key of a spec has to list it.
    """
    paths = sorted(resource_folder("data_sources").glob("*.toml"))
    contents = {path.stem: tomllib.loads(path.read_text(encoding="utf-8")) for path in paths}
    return tuple(name for name, content in contents.items() if content.get("supplies") == what)
