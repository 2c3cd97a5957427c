"""An artifact put onto the shelf of a service, as a job does that built it."""

from __future__ import annotations

import shutil
from pathlib import Path

DATABASE = "0123456789abcdef"


def shelve(root: Path, artifact: Path, database: str = DATABASE) -> Path:
    """Copy an artifact onto the shelf.

    Parameters
    ----------
    root : Path
        Folder of the service.
    artifact : Path
        Folder of the artifact.
    database : str
        Sixteen hexadecimal digits.

    Returns
    -------
    Path
        Its folder on the shelf.
    """
    folder = root / "databases" / database / artifact.name
    shutil.copytree(artifact, folder, copy_function=shutil.copyfile)
    return folder
