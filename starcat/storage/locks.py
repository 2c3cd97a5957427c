"""Locks between processes, where the system has them.

A lock belongs to the process that holds it and ends with it, however it ends. Windows has no
locks of this kind, and some file systems have none; `locked` says so, and then nothing is shared.
"""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from starcat.errors import reason

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_logger = logging.getLogger(__name__)
_WITHOUT_LINKS = getattr(os, "O_NOFOLLOW", 0)
_WITHOUT_LOCKS = {errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EBADF}


@contextmanager
def locked(path: Path, *, wait: bool = True) -> Iterator[bool]:
    """Hold a lock that ends with the process, however it ends."""
    if fcntl is None:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield False
        return
    while True:
        if not path.is_dir():
            path.parent.mkdir(parents=True, exist_ok=True)
        try:
            flags = os.O_RDONLY if path.is_dir() else os.O_RDWR | os.O_CREAT | _WITHOUT_LINKS
            descriptor = os.open(path, flags, 0o666)
        except FileNotFoundError:  # the one before has removed the folder
            continue
        try:
            is_real = _take(descriptor, path, wait=wait)
            if _is_still(descriptor, path):
                yield is_real
                return
        finally:
            os.close(descriptor)


def _take(descriptor: int, path: Path, *, wait: bool) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError as error:
        if error.errno not in _WITHOUT_LOCKS:
            raise
        _logger.info("%s: going on without a lock (%s)", path, reason(error))
        return False
    return True


def _is_still(descriptor: int, path: Path) -> bool:
    """Return whether the path is the file that was locked, which its last holder may remove."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
