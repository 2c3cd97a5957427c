"""Files that several processes may write at once, and that a killed process leaves half done.

A part belongs to the process that holds its lock (`starcat.storage.atomic`) until it ends.
"""

from __future__ import annotations

import errno
import logging
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from starcat.errors import ProductError, reason
from starcat.progress import Progress, no_progress
from starcat.ship.releases.tree import Blob
from starcat.storage.atomic import file_sha256

_logger = logging.getLogger(__name__)
_BLOCK_BYTES = 1 << 20
_WITHOUT_LINKS = getattr(os, "O_NOFOLLOW", 0)
_WITHOUT_WAITING = getattr(os, "O_NONBLOCK", 0)
_AS_BYTES = getattr(os, "O_BINARY", 0)
"""Flags for opening files. On Windows some are missing, so links are checked before opening."""


def copy_to_part(
    source: Path, blob: Blob, part: Path, progress: Progress = no_progress, stage: str = "copy"
) -> None:
    """Copy a file, or continue an earlier copy, and check the result."""
    with _reading(source, blob) as reader:
        for goes_on in (True, False):
            _refuse_links(part)
            writer = os.open(part, os.O_RDWR | os.O_CREAT | _WITHOUT_LINKS | _AS_BYTES, 0o666)
            try:
                there = os.fstat(writer).st_size
                if not goes_on or there > blob.bytes:
                    os.ftruncate(writer, there := 0)
                _copy_rest(reader, writer, there, blob, partial(progress, stage))
                os.fsync(writer)
            finally:
                os.close(writer)
            digest = file_sha256(part)
            if digest == blob.sha256:
                return
    part.unlink(missing_ok=True)
    raise damaged_file(source, f"its sha256 begins with {digest[:12]}; expected {blob.sha256[:12]}")


@contextmanager
def _reading(source: Path, blob: Blob) -> Iterator[int]:
    try:
        reader = _opened(source)
    except OSError as error:
        words = {errno.ELOOP: "a symbolic link; expected a file", errno.ENOENT: "missing"}
        what = words.get(error.errno or 0, f"cannot be read ({reason(error)})")
        raise damaged_file(source, what) from error
    try:
        facts = os.fstat(reader)
        if not stat.S_ISREG(facts.st_mode):
            raise damaged_file(source, "not a file")
        if facts.st_size != blob.bytes:
            raise damaged_file(source, f"{facts.st_size} bytes; expected {blob.bytes}")
        yield reader
    finally:
        os.close(reader)


def read_small(path: Path, most_bytes: int) -> bytes:
    """Return the content of a regular file of limited size; raise for links and pipes."""
    reader = _opened(path)
    with os.fdopen(reader, "rb") as file:
        if not stat.S_ISREG(os.fstat(reader).st_mode):
            raise damaged_file(path, "not a file; the registry is damaged")
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise damaged_file(path, f"longer than {most_bytes} bytes; the registry is damaged")
    return data


def _opened(path: Path) -> int:
    """Open a file for reading, without following a link, and without blocking at a pipe."""
    _refuse_links(path)
    return os.open(path, os.O_RDONLY | _WITHOUT_LINKS | _WITHOUT_WAITING | _AS_BYTES)


def _refuse_links(path: Path) -> None:
    """Refuse a symbolic link, if the system cannot refuse it on opening."""
    if not _WITHOUT_LINKS and path.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))


def _copy_rest(
    reader: int, writer: int, there: int, blob: Blob, done: Callable[[int, int], None]
) -> None:
    """Copy the missing bytes, but not more than the blob's size, in case the file grows."""
    for descriptor in (reader, writer):
        os.lseek(descriptor, there, os.SEEK_SET)
    done(there, blob.bytes)
    while block := os.read(reader, min(_BLOCK_BYTES, blob.bytes - there)):
        rest = memoryview(block)
        while rest:
            rest = rest[os.write(writer, rest) :]
        there += len(block)
        done(there, blob.bytes)


def check_blob(path: Path, blob: Blob) -> None:
    """Check the content of a file in a registry, without copying it."""
    whole = path.is_file() and not path.is_symlink() and path.stat().st_size == blob.bytes
    if not whole or file_sha256(path) != blob.sha256:
        raise damaged_file(
            path,
            "not the content that its name says. The registry is damaged: remove that blob and "
            "publish again",
        )


def damaged_file(path: Path, what: str) -> ProductError:
    """Return the error for a damaged file of a registry."""
    return ProductError(what, where=path)
