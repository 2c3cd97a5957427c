"""Where the files that ship with starcat are: schemas, data sources, presets, documentation."""

from __future__ import annotations

import os
from pathlib import Path

PathLike = str | os.PathLike[str]
"""What public functions take for a path."""

_PACKAGE = Path(__file__).resolve().parent


def resource_folder(name: str) -> Path:
    """Return the folder ``schemas``, ``data_sources``, ``docs`` or ``presets``.

    A wheel carries the folders inside the package; a checkout has the first three beside it.

    Examples
    --------
    >>> resource_folder("schemas").name
    'schemas'
    """
    for folder in (_PACKAGE / name, _PACKAGE.parent / name):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"starcat is installed without its folder {name!r}: reinstall it")
