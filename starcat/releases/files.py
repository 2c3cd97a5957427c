"""Files that several processes may write at once, and that a killed one leaves half done.

A part belongs to who holds its lock, which ends with the process. Not every file system has
locks; `locked` says so, and then nothing is shared.
"""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import secrets
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from starcat.errors import OutputError, ProductError, reason
from starcat.progress import Progress, no_progress
from starcat.releases.tree import Blob
from starcat.storage.digests import file_sha256

_logger = logging.getLogger(__name__)
_BLOCK_BYTES = 1 << 20
_WITHOUT_LOCKS = {errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EBADF}
_WRITING_FAILED = {
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EROFS,
    errno.EACCES,
    errno.EPERM,
    errno.ENOTDIR,
    errno.EEXIST,
}


@contextmanager
def locked(path: Path) -> Iterator[bool]:
    """Hold a lock that ends with the process, however it ends.

    Parameters
    ----------
    path : Path
        A folder, or a file that is made if need be, with its folder.

    Yields
    ------
    bool
        Whether nobody else holds it; False where the file system has no locks.
    """
    while True:
        if not path.is_dir():
            path.parent.mkdir(parents=True, exist_ok=True)
        try:
            flags = os.O_RDONLY if path.is_dir() else os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW
            descriptor = os.open(path, flags, 0o666)
        except FileNotFoundError:  # the one before has removed the folder
            continue
        try:
            is_real = _wait_for(descriptor, path)
            if _is_still(descriptor, path):
                yield is_real
                return
        finally:
            os.close(descriptor)


def _wait_for(descriptor: int, path: Path) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
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


@contextmanager
def writing(folder: Path, advice: str) -> Iterator[None]:
    """Turn a refusal of the operating system into the error that says so.

    Parameters
    ----------
    folder : Path
        Where something is written.
    advice : str
        What to do.

    Yields
    ------
    None
        To the work.

    Raises
    ------
    OutputError
        If the folder cannot be written to, or the disk is full.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in _WRITING_FAILED:
            raise
        raise OutputError(
            f"{folder}: writing failed ({reason(error)}); {advice}", path=folder
        ) from error


def copy_to_part(
    source: Path, blob: Blob, part: Path, progress: Progress = no_progress, stage: str = "copy"
) -> None:
    """Copy a file, going on where an earlier copy ended, and check what has been written.

    Parameters
    ----------
    source : Path
        The file.
    blob : Blob
        What it should hold.
    part : Path
        Where to; whole and on disk afterwards. Dropped if it is wrong.
    progress : Progress
        Called with (stage, bytes there are, bytes in all).
    stage : str
        For ``progress``.

    Raises
    ------
    ProductError
        If the source is missing, is a symbolic link, or holds something else.
    """
    with _reading(source, blob) as reader:
        for goes_on in (True, False):
            writer = os.open(part, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
            try:
                there = os.fstat(writer).st_size
                if not goes_on or there > blob.bytes:
                    os.ftruncate(writer, there := 0)
                _copy_rest(reader, writer, there, lambda done: progress(stage, done, blob.bytes))
                os.fsync(writer)
            finally:
                os.close(writer)
            digest = file_sha256(part)
            if digest == blob.sha256:
                return
    part.unlink(missing_ok=True)
    raise damaged(source, f"its sha256 begins with {digest[:12]}; expected {blob.sha256[:12]}")


@contextmanager
def _reading(source: Path, blob: Blob) -> Iterator[int]:
    try:
        # Without waiting, should it be a pipe.
        reader = os.open(source, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError as error:
        known = {errno.ELOOP: "a symbolic link; expected a file", errno.ENOENT: "missing"}
        what = known.get(error.errno or 0, f"cannot be read ({reason(error)})")
        raise damaged(source, what) from error
    try:
        facts = os.fstat(reader)
        if not stat.S_ISREG(facts.st_mode):
            raise damaged(source, "not a file")
        if facts.st_size != blob.bytes:
            raise damaged(source, f"{facts.st_size} bytes; expected {blob.bytes}")
        yield reader
    finally:
        os.close(reader)


def _copy_rest(reader: int, writer: int, there: int, done: Callable[[int], None]) -> None:
    done(there)
    while block := os.pread(reader, _BLOCK_BYTES, there):
        written = os.pwrite(writer, block, there)
        there += written
        done(there)


def damaged(path: Path, what: str) -> ProductError:
    """Return the error about a file that is not what it should be.

    Parameters
    ----------
    path : Path
        The file.
    what : str
        What was found and what was expected.

    Returns
    -------
    ProductError
        To be raised.
    """
    return ProductError(f"{path}: {what}", path=path)


def write_new(path: Path, data: bytes) -> None:
    """Write a file that is on disk when this returns.

    Parameters
    ----------
    path : Path
        Must not exist.
    data : bytes
        All of it.
    """
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    with os.fdopen(descriptor, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def replace_file(path: Path, data: bytes, beside: Path) -> None:
    """Give a file other content, at once and for good.

    Parameters
    ----------
    path : Path
        The file.
    data : bytes
        All of it.
    beside : Path
        Folder of the same file system for what is not finished.
    """
    new = unique(beside, path.name)
    try:
        write_new(new, data)
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)
    sync_folder(path.parent)


def unique(folder: Path, name: str) -> Path:
    """Return a path that nobody else uses.

    Parameters
    ----------
    folder : Path
        Where.
    name : str
        What it begins with, after a dot.

    Returns
    -------
    Path
        Of no file.
    """
    return folder / f".{name}.{secrets.token_hex(8)}"


def sync_folder(folder: Path) -> None:
    """Have the names in a folder on disk.

    Parameters
    ----------
    folder : Path
        Whose names changed.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Make a folder whose name is on disk, and those above it.

    Parameters
    ----------
    folder : Path
        May exist.
    """
    if not folder.is_dir():
        make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
        sync_folder(folder.parent)
