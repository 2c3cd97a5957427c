"""Read small files from outside: only regular files, and only up to a stated size.

A name can also lead to a device, a pipe or a socket. Reading one can block without end, and some of
them never end, so every reader of a small file reads it here.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

from starcat.errors import FileMissing, SourceError, reason

CHUNK_BYTES = 1 << 20


def check_regular_file(path: Path) -> None:
    """Raise a `SourceError` if a path exists and is not a regular file; links are followed.

    It is for readers of files of any size, before they open one: opening a pipe can wait for ever.
    """
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return  # the reader itself raises a better error
    _check_mode(mode, path)


def read_regular_file(path: Path, max_bytes: int) -> bytes:
    """Return the content of a regular file.

    Parameters
    ----------
    path : Path
        The file; links are followed.
    max_bytes : int
        The largest size that is read, bytes.

    Returns
    -------
    bytes

    Raises
    ------
    FileMissing
        If there is no such file.
    SourceError
        If it is a folder, a device, a pipe or a socket, if it is larger than ``max_bytes``, or if
        the system refuses to read it.
    """
    try:
        # Without O_NONBLOCK, opening a pipe waits for a process that writes into it.
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    except (FileNotFoundError, NotADirectoryError) as error:
        raise FileMissing("no such file", where=path) from error
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        why = reason(error) if isinstance(error, OSError) else str(error)
        raise SourceError(f"cannot be read ({why})", where=path) from error
    try:
        _check_mode(os.fstat(descriptor).st_mode, path)
    except SourceError:
        os.close(descriptor)
        raise
    with os.fdopen(descriptor, "rb") as file:
        # Not `read(max_bytes)`: Python would allocate as much before it reads.
        parts = [file.read(min(os.fstat(descriptor).st_size, max_bytes) + 1)]
        size = len(parts[0])
        # The size that the system states can be wrong, as in /proc: what arrives is counted.
        while size <= max_bytes and (part := file.read(CHUNK_BYTES)):
            parts.append(part)
            size += len(part)
    if size > max_bytes:
        raise SourceError(
            f"has more than {max_bytes:,} bytes; a file of this kind is smaller", where=path
        )
    return parts[0] if len(parts) == 1 else b"".join(parts)


def _check_mode(mode: int, path: Path) -> None:
    if not stat.S_ISREG(mode):
        what = "a folder" if stat.S_ISDIR(mode) else "not a regular file"
        raise SourceError(f"is {what}", where=path, hint="give a file")
