"""Write files and folders so that the final name has the complete content or does not exist.

An unfinished file has a hidden name in the same folder, ``.<name>.*.partial``, so that the last
step is a rename within one file system. A file that must survive a power cut is synchronised to
disk before that step, and its folder after it.
"""

from __future__ import annotations

import errno
import filecmp
import hashlib
import json
import logging
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from starcat.errors import OutputError, reason


def file_sha256(path: Path) -> str:
    """Return the digest of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def json_bytes(content: Any) -> bytes:
    """Return a value as JSON with sorted keys; the same value gives the same bytes."""
    text = json.dumps(content, indent=2, sort_keys=True, ensure_ascii=False, allow_nan=False)
    return text.encode() + b"\n"


try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_logger = logging.getLogger(__name__)
_WITHOUT_LINKS = getattr(os, "O_NOFOLLOW", 0)
_WITHOUT_LOCKS = {errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EBADF}


@contextmanager
def locked(path: Path, *, wait: bool = True) -> Iterator[bool]:
    """Hold a lock; the operating system releases it when the process ends in any way."""
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
        except FileNotFoundError:  # the previous holder has removed the folder
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
    """Return whether the path is still the locked file: the last holder may have removed it."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def state_folder() -> Path:
    """Return the folder; it may not exist yet."""
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(state) / "starcat"


Outcome = Literal["written", "unchanged", "replaced"]

READ_ONLY = 0o444
"""Mode of the files in a folder after `move_into_place`."""

_WRITING_FAILED = {
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS),
    *(errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EEXIST),
}


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary file to write to; it gets its final name at the end."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with placed(path) as partial:
            yield partial
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({reason(error)}); choose another output",
            path=path,
            fields=("output",),
        ) from error


def write_file(path: Path, data: bytes) -> None:
    """Write a small file in one step."""
    try:
        path.write_bytes(data)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({reason(error)})", path=path) from error


@contextmanager
def placed(path: Path, beside: Path | None = None) -> Iterator[Path]:
    """Yield a file to write to, which gets its name at the end; OSErrors pass unchanged."""
    partial = unique(beside or path.parent, path.name)
    try:
        yield partial
        partial.replace(path)
    finally:
        with suppress(OSError):  # without the folder there is nothing to remove
            partial.unlink(missing_ok=True)


def remove_partial(folder: Path) -> None:
    """Remove unfinished files of killed processes in a folder and its subfolders."""
    for path in sorted(folder.rglob(".*.partial")):
        path.unlink()


def replace_file(path: Path, data: bytes, beside: Path) -> None:
    """Replace the content of a file in one step, synchronised to disk."""
    with placed(path, beside) as new:
        new.write_bytes(data)
        sync_to_disk(new)
    sync_to_disk(path.parent)


@contextmanager
def whole_folder(final: Path) -> Iterator[Path]:
    """Yield a folder to write into, next to the final folder, and remove it afterwards.

    The process holds a lock of the folder. Unlocked folders for the same name were left by killed
    processes, and are removed first.
    """
    is_new = not final.parent.exists()
    with ExitStack() as held:
        try:
            final.parent.mkdir(parents=True, exist_ok=True)
            with locked(final.parent):  # so that no process finds the folder before it is locked
                _remove_abandoned(final)
                made = Path(
                    tempfile.mkdtemp(prefix=f".{final.name}.", suffix=".partial", dir=final.parent)
                )
                held.enter_context(locked(made))
        except OSError as error:
            raise OutputError(
                f"{final.parent}: cannot write there ({reason(error)}); choose another folder "
                "with output",
                path=final.parent,
                fields=("output",),
            ) from error
        try:
            made.chmod(0o755)
            with writing(final.parent, "nothing was left there"):
                yield made
        finally:
            shutil.rmtree(made, ignore_errors=True)
            if is_new:
                with suppress(OSError):  # it is not empty
                    final.parent.rmdir()


def _remove_abandoned(final: Path) -> None:
    for path in final.parent.glob(f".{final.name}.*.partial"):
        # A folder that `move_into_place` has put aside may be the only copy of the old database.
        if path.name.endswith(".old.partial") or not path.is_dir() or path.is_symlink():
            continue
        with suppress(OSError), locked(path, wait=False) as is_certain:
            if is_certain:
                _logger.info("%s: removed; the process that wrote it was killed", path)
                shutil.rmtree(path, ignore_errors=True)


@contextmanager
def writing(folder: Path, advice: str, fields: tuple[str, ...] = ()) -> Iterator[None]:
    """Convert an OSError to an `OutputError` with advice.

    The advice is the end of the message; ``fields`` are the parameters in it.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in _WRITING_FAILED:
            raise
        raise OutputError(
            f"{folder}: writing failed ({reason(error)}); {advice}", path=folder, fields=fields
        ) from error


def move_into_place(partial: Path, final: Path, *, replace: bool) -> Outcome:
    """Give a complete folder its final name, and make its files read-only."""
    for path in sorted(partial.rglob("*")):
        if path.is_file():
            path.chmod(READ_ONLY)
            sync_to_disk(path)
    if not final.exists() and _rename(partial, final):
        return "written"
    if _holds_all(final, partial):
        return "unchanged"
    if not replace:
        raise another_is_there(final)
    aside = partial.with_name(f"{partial.name}.old.partial")
    try:
        final.rename(aside)
        partial.rename(final)
    except BaseException:  # a signal between both steps must not leave the name empty
        if aside.exists() and not final.exists():
            aside.rename(final)
        raise
    shutil.rmtree(aside, ignore_errors=True)
    return "replaced"


def another_is_there(final: Path) -> OutputError:
    """Return the error for a folder whose name another database has."""
    return OutputError(
        f"{final} already exists and differs; raise the version in the spec, choose another "
        "output, or pass replace=True",
        path=final,
        fields=("output", "replace=True"),
    )


def _rename(partial: Path, final: Path) -> bool:
    """Rename; return False if another process has just taken the name."""
    try:
        partial.rename(final)
    except OSError:
        if final.exists():
            return False
        raise
    return True


def _holds_all(final: Path, partial: Path) -> bool:
    """Return whether the old folder has every file of the new folder with the same bytes."""
    names = [path.relative_to(partial) for path in partial.rglob("*") if path.is_file()]
    return all(
        (final / name).is_file() and filecmp.cmp(final / name, partial / name, shallow=False)
        for name in names
    )


def unique(folder: Path, name: str) -> Path:
    """Return a unique hidden path."""
    return folder / f".{name}.{secrets.token_hex(8)}.partial"


def sync_to_disk(path: Path) -> None:
    """Synchronise the content of a file, or the names in a folder, to disk."""
    if os.name == "nt":  # Windows synchronises only open files, and no folders
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Make a folder and its parents, and synchronise their names to disk."""
    if not folder.is_dir():
        make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
        sync_to_disk(folder.parent)
