"""Folders for what is on its way, each with a name that nobody can guess."""

from __future__ import annotations

import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from starcat.service.paths import ServicePaths

CHUNK_BYTES = 1 << 18

_UNUSUAL = re.compile(r"[^A-Za-z0-9_-]+", re.ASCII)


@contextmanager
def scratch_folder(paths: ServicePaths) -> Iterator[Path]:
    """Give a new folder, which is removed afterwards."""
    folder = paths.scratch / secrets.token_hex(16)
    folder.mkdir(mode=0o700)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def safe_name(given: str | None, suffixes: tuple[str, ...], default: str) -> str:
    """Return a file name that an upload may be kept under.

    Examples
    --------
    >>> safe_name("../../a b.PNG", (".png",), "frame"), safe_name("x.exe", (".png",), "frame")
    ('a_b.png', 'x_exe')
    >>> safe_name("....", (".png",), "frame")
    'frame'
    """
    name = (given or "").replace("\\", "/").rpartition("/")[2]
    suffix = PurePosixPath(name).suffix.lower()
    known = suffix if suffix in suffixes else ""
    stem = name[: -len(known)] if known else name
    return (_UNUSUAL.sub("_", stem).strip("_")[:80] or default) + known


def sent_once(path: Path) -> tuple[Iterator[bytes], int]:
    """Open a file to be sent, which needs its name no longer."""
    file = path.open("rb")
    return _chunks(file), path.stat().st_size


def _chunks(file: BinaryIO) -> Iterator[bytes]:
    with file:
        while chunk := file.read(CHUNK_BYTES):
            yield chunk
