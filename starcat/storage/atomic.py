"""Write files and folders so that the final name has the complete content or does not exist.

An unfinished file has a hidden name in the same folder, ``.<name>.*.partial``, so that the last
step is a rename within one file system. A folder that replaces another exchanges names with it in
one step, so that at any moment one of the two has the final name. A file that must survive a power
cut is synchronised to disk before the last step, and its folder after it.
"""

from __future__ import annotations

import errno
import filecmp
import glob
import hashlib
import json
import logging
import os
import secrets
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
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
            is_real = _acquire_lock(descriptor, path, wait=wait)
            if _is_still(descriptor, path):
                yield is_real
                return
        finally:
            os.close(descriptor)


def _acquire_lock(descriptor: int, path: Path, *, wait: bool) -> bool:
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
    """Return whether the path is still the locked file: the last holder can have removed it."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def state_folder() -> Path:
    """Return the folder of the user's state, such as queues of jobs; it may not exist yet."""
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
            f"cannot be written ({reason(error)})", where=path, hint="choose another {output}"
        ) from error


def write_file(path: Path, data: bytes) -> None:
    """Write a small file, which gets its name when it is complete."""
    try:
        with placed(path) as partial:
            partial.write_bytes(data)
    except OSError as error:
        raise OutputError(f"cannot be written ({reason(error)})", where=path) from error


@contextmanager
def placed(path: Path, beside: Path | None = None) -> Iterator[Path]:
    """Yield a file to write to, which gets its name at the end; OSErrors pass unchanged.

    A device or a pipe, such as ``/dev/stdout``, has its name already and is written itself.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        yield path
        return
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
    with ExitStack() as locks:
        try:
            final.parent.mkdir(parents=True, exist_ok=True)
            with locked(final.parent):  # so that no process finds the folder before it is locked
                remove_abandoned(final)
                partial = Path(
                    tempfile.mkdtemp(prefix=f".{final.name}.", suffix=".partial", dir=final.parent)
                )
                locks.enter_context(locked(partial))
        except OSError as error:
            raise OutputError(
                f"cannot write there ({reason(error)})",
                where=final.parent,
                hint="choose another folder with {output}",
            ) from error
        try:
            partial.chmod(0o755)
            with writing(final.parent, "nothing was left there"):
                yield partial
        except OutputError as error:
            _name_final(error, partial, final)
            raise
        finally:
            shutil.rmtree(partial, ignore_errors=True)
            if is_new:
                with suppress(OSError):  # it is not empty
                    final.parent.rmdir()


def _name_final(error: OutputError, partial: Path, final: Path) -> None:
    """State the final name of a folder in an error about a file of the unfinished one."""
    if error.path is not None and error.path == error.where and partial in error.path.parents:
        error.problem = f"{error.path.relative_to(partial).as_posix()}: {error.problem}"
        error.where = error.path = final


def remove_abandoned(final: Path) -> None:
    """Remove what killed processes have left of a folder; the caller holds the parent's lock.

    If a killed process has put the folder aside and nothing has its name, it gets its name back.
    """
    for path in sorted(final.parent.glob(f".{glob.escape(final.name)}.*.partial")):
        if not path.is_dir() or path.is_symlink():
            continue
        with suppress(OSError), locked(path, wait=False) as is_certain:
            if not is_certain:
                continue
            if path.name.endswith(_ASIDE) and _is_free(final):
                path.rename(final)
                _logger.info("%s: has its name again; the process that replaced it ended", final)
                continue
            _logger.info("%s: removed; the process that wrote it was killed", path)
            shutil.rmtree(path, ignore_errors=True)


@contextmanager
def writing(folder: Path, hint: str) -> Iterator[None]:
    """Convert an OSError to an `OutputError` with a hint."""
    try:
        yield
    except OSError as error:
        if error.errno not in _WRITING_FAILED:
            raise
        raise OutputError(f"writing failed ({reason(error)})", where=folder, hint=hint) from error


ListFiles = Callable[[Path], Iterable[str]]
"""Returns the names, relative to a folder, of the files in it that starcat wrote."""

_ASIDE = ".old.partial"
"""End of the hidden name of a folder that is being replaced by a system that exchanges no names."""

_EXCHANGE, _HERE = 2, -100
"""``RENAME_EXCHANGE`` and ``AT_FDCWD`` of Linux."""

_WITHOUT_EXCHANGE = {errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP}

MAX_NAMED = 3
"""Number of files that a message names."""


def move_into_place(partial: Path, final: Path, replace: ListFiles | None = None) -> Outcome:
    """Give a complete folder its final name, and make its files read-only.

    A different folder of this name is refused. With ``replace``, which lists the files of such a
    folder that starcat wrote, it is replaced if it has no other files; at any moment one of the
    two folders has the name, also if the process is killed.
    """
    for path in sorted(partial.rglob("*"), reverse=True):  # a folder after its files
        if path.is_file():
            path.chmod(READ_ONLY)
        sync_to_disk(path)
    sync_to_disk(partial)
    check_final(final, replace)
    if _is_free(final) and _rename(partial, final):
        sync_to_disk(final.parent)
        return "written"
    if _holds_all(final, partial):
        return "unchanged"
    if replace is None:
        raise another_is_there(final)
    replace_folder(partial, final)
    return "replaced"


def replace_folder(partial: Path, final: Path) -> None:
    """Give a complete folder the name of another folder, and remove the other."""
    if exchange_names(partial, final):
        old = partial
    else:
        old = final.with_name(f".{final.name}.{secrets.token_hex(8)}{_ASIDE}")
        with locked(final.parent):  # so that no process finds the old folder between both steps
            _rename_both(final, old, partial)
    sync_to_disk(final.parent)
    shutil.rmtree(old, ignore_errors=True)


def check_final(final: Path, replace: ListFiles | None = None) -> None:
    """Raise if a folder cannot get a final name, whatever it contains.

    Links are kept, as are files that starcat did not write.
    """
    if final.is_symlink() and (replace is not None or not final.exists()):
        what = f"is a symbolic link to {os.readlink(final)}; expected a folder or nothing"
        raise _not_replaced(final, what, "Remove the link")
    if not final.exists():
        return
    if not final.is_dir():
        raise _not_replaced(final, "is a file; expected a folder or nothing", "Move it away")
    if replace is None:
        return
    written = set(replace(final))
    others = [
        name
        for path in sorted(final.rglob("*"))
        if (path.is_symlink() or not path.is_dir())
        and (name := path.relative_to(final).as_posix()) not in written
    ]
    if others:
        more = f" and {len(others) - MAX_NAMED:,} more" if len(others) > MAX_NAMED else ""
        named = ", ".join(others[:MAX_NAMED])
        what = f"has files that starcat did not write: {named}{more}"
        raise _not_replaced(final, what, "Move them away")


def _not_replaced(final: Path, what: str, advice: str) -> OutputError:
    return OutputError(
        f"{final} {what}. Nothing was replaced",
        path=final,
        hint=(advice, "choose another {output}"),
    )


def exchange_names(first: Path, second: Path) -> bool:
    """Exchange the names of two files or folders in one step, if the system can.

    Returns
    -------
    bool
        False if the system, or the file system, cannot do that; then nothing has changed.
    """
    if sys.platform != "linux":
        return False
    import ctypes

    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if rename is None:  # another C library
        return False
    if rename(_HERE, os.fsencode(first), _HERE, os.fsencode(second), _EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in _WITHOUT_EXCHANGE:
        return False
    raise OSError(number, os.strerror(number), str(first), None, str(second))


def _rename_both(final: Path, old: Path, partial: Path) -> None:
    try:
        final.rename(old)
        partial.rename(final)
    except BaseException:  # a signal between both steps must not leave the name empty
        if old.exists() and not final.exists():
            old.rename(final)
        raise


def _is_free(final: Path) -> bool:
    """Return whether a folder can get a name: nothing has it, or an empty folder."""
    if not os.path.lexists(final):
        return True
    return final.is_dir() and not final.is_symlink() and not any(final.iterdir())


def another_is_there(final: Path) -> OutputError:
    """Return the error for a folder whose name another database has."""
    return OutputError(
        f"{final} already exists and differs",
        path=final,
        hint=("raise the version in the spec", "choose another {output}", "pass {replace:True}"),
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
