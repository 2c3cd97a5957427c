"""Files that starcat can make again, in the user's cache folder.

A kept file has a name that determines its content, so an existing file is never written again.
Each kind of file has a folder with a limit, in which the files that were not used for the longest
time are removed first. A cache that cannot be read or written is not an error: nothing is kept.
"""

from __future__ import annotations

import logging
import mmap
import os
import sys
from contextlib import suppress
from pathlib import Path

from starcat.errors import reason
from starcat.storage.atomic import placed

_logger = logging.getLogger(__name__)


def cache_folder() -> Path:
    """Return the folder of downloads and kept files: ``$STARCAT_CACHE``, or the system's."""
    folder = os.environ.get("STARCAT_CACHE")
    if folder:
        return Path(folder).expanduser()
    home = Path.home()
    if sys.platform == "win32":
        local = os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local"
        return Path(local) / "starcat" / "starcat" / "Cache"
    if sys.platform == "darwin":
        return home / "Library" / "Caches" / "starcat"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "starcat"


def map_kept(folder: str, name: str) -> mmap.mmap | None:
    """Return a kept file as memory, and note its use; None if it is not there."""
    try:
        path = cache_folder() / folder / name
        with path.open("rb") as file:
            mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError, RuntimeError):  # an empty file; a user without a home
        return None
    with suppress(OSError):
        os.utime(path)
    return mapped


def keep(folder: str, name: str, data: bytes, max_bytes: int) -> bool:
    """Keep a file, and return whether that succeeded.

    Other files of the folder are removed until all of them have at most ``max_bytes``.
    """
    try:
        path = cache_folder() / folder / name
        if len(data) > max_bytes:
            return False
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_oldest(path.parent, max_bytes - len(data))
        with placed(path) as partial:
            partial.write_bytes(data)
    except (OSError, RuntimeError) as error:
        why = reason(error) if isinstance(error, OSError) else str(error)
        _logger.info("%s cannot be kept (%s)", name, why)
        return False
    return True


def remove_kept(folder: str, name: str) -> None:
    """Remove a file whose content is not as it was written."""
    with suppress(OSError, RuntimeError):
        (cache_folder() / folder / name).unlink()


def _remove_oldest(folder: Path, max_bytes: int) -> None:
    """Remove files of a folder, unfinished ones included, until it has at most ``max_bytes``."""
    files = []
    for path in folder.iterdir():
        with suppress(OSError):  # another process has just removed it
            status = path.stat()
            files.append((status.st_mtime_ns, path.name, status.st_size, path))
    total = sum(size for _, _, size, _ in files)
    for _, _, size, path in sorted(files):
        if total <= max_bytes:
            return
        with suppress(OSError):  # Windows removes no file that is open
            path.unlink()
            total -= size
