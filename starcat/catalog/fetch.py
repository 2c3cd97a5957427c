"""Download the files of a data source into a folder, complete and checked, or not at all.

Input is a `DataSource` and a folder; output is a `FetchReport`. A download is written to
``<name>.part``, and continues there after an interruption. The complete file is checked and only
then gets its name; a file that fails the checks is kept as ``<name>.rejected``. Processes that
fetch into the same folder at the same time wait for each other, file by file.

pooch provides the cache folder, the digests and FTP; `starcat.storage.download` resumes downloads.
This module tries several addresses for one file, and keeps a file whose digest is wrong. It does
not unpack files, and reads no stars.
"""

from __future__ import annotations

import logging
import secrets
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from starcat.catalog.integrity import (
    ExpectedFile,
    LockEntry,
    check_download,
    expected_files,
    read_lock,
)
from starcat.catalog.source import DataSource
from starcat.errors import DownloadError, OutputError, SourceError
from starcat.progress import Progress, no_progress
from starcat.storage.atomic import locked
from starcat.storage.download import DownloadOptions, beside, download, forget_part, part_of, rename

Status = Literal["downloaded", "resumed", "present"]
"""Whether a file was fetched in one step, continued from an earlier part, or already there."""

_logger = logging.getLogger(__name__)


class FetchedFile(LockEntry):
    """One file in the folder that has passed the checks."""

    path: Path
    status: Status

    @property
    def name(self) -> str:
        """The name of the file in its folder."""
        return self.path.name


@dataclass(frozen=True)
class FetchReport:
    """What `fetch_source` did."""

    source: str
    files: tuple[FetchedFile, ...]  # same order as in the data source


def fetch_source(
    source: DataSource,
    folder: Path,
    *,
    parts: Sequence[str] = (),
    retries: int = 3,
    timeout_s: float = 60.0,
    backoff_s: float = 1.0,
    progress: Progress = no_progress,
) -> FetchReport:
    """Download the files of a source into a folder and check them.

    The number of records of a file in parts is checked when its last part arrives. A file with
    the right digest is not downloaded again. Several processes may fetch into one folder: one of
    them downloads a file, and the others wait for it.
    """
    expected = expected_files(source, parts)
    _make_writable(folder)
    read_lock(folder)
    options = DownloadOptions(retries, timeout_s, backoff_s, progress)
    return FetchReport(source.name, tuple(_fetch_file(file, folder, options) for file in expected))


def _make_writable(folder: Path) -> None:
    """Make the folder and write to it once, before anything is downloaded."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OutputError(
            f"cannot write to the folder {folder}: {error}",
            path=folder,
            hint="Name another folder, or set STARCAT_CACHE",
        ) from error


def _fetch_file(expected: ExpectedFile, folder: Path, options: DownloadOptions) -> FetchedFile:
    """Return the existing file, or else download it from the first address that delivers it.

    Only the process that holds the lock of the file writes its part, which a later run can
    continue. A second process waits for the lock and then finds the file. On file systems without
    locks every process has its own part, which no other process continues.
    """
    mark = folder / f".{expected.names[0]}.fetching"
    with locked(mark) as is_alone:
        try:
            suffix = "" if is_alone else f".{secrets.token_hex(4)}"
            return _present(expected, folder) or _download(expected, folder, suffix, options)
        finally:
            mark.unlink(missing_ok=True)


def _present(expected: ExpectedFile, folder: Path) -> FetchedFile | None:
    path = next((folder / name for name in expected.names if (folder / name).exists()), None)
    if path is None:
        return None
    if not path.is_file():
        raise OutputError(f"{path} is in the way: it is not a file", path=path, hint="Move it")
    try:
        entry = check_download(expected, path, path, url="")
    except SourceError as error:
        error.problem += f" (the file is {path}: move it away to fetch it again)"
        raise
    return FetchedFile(**entry.model_dump(), path=path, status="present")


def _download(
    expected: ExpectedFile, folder: Path, suffix: str, options: DownloadOptions
) -> FetchedFile:
    failures: list[tuple[str, SourceError]] = []
    for name, url in expected.addresses:
        target = beside(folder / name, suffix)
        try:
            status = download(url, target, options)
            return _take_arrived(expected, target, folder / name, url, status)
        except SourceError as error:
            _logger.warning("%s: %s", url, error)
            failures.append((url, error))
            if part_of(target).is_file() and not part_of(target).stat().st_size:
                forget_part(target)  # nothing arrived, so there is nothing to continue
    raise _none_delivered(expected, failures)


def _none_delivered(
    expected: ExpectedFile, failures: Sequence[tuple[str, SourceError]]
) -> SourceError:
    """Return the error for a file that no address delivered.

    If one address delivered a wrong file, its error is returned: it explains more than a failed
    download does.
    """
    wrong = [error for _, error in failures if not isinstance(error, DownloadError)]
    reasons = "\n".join(f"  {url}: {error}" for url, error in failures)
    if not wrong:
        return DownloadError(
            f"{expected.names[0]} came from none of its addresses:\n{reasons}\nTry again later: "
            "partial downloads are kept",
            source=expected.source.name,
            hint="Or put the file there by hand",
        )
    if len(failures) > 1:
        wrong[0].problem += f"\nAll addresses failed:\n{reasons}"
    return wrong[0]


def _take_arrived(
    expected: ExpectedFile, download: Path, path: Path, url: str, status: Status
) -> FetchedFile:
    """Check a downloaded file, then give it its final name or keep it as rejected."""
    part = part_of(download)
    try:
        entry = check_download(expected, part, path, url=url)
    except SourceError as error:
        error.path = beside(path, ".rejected")
        rename(part, error.path)
        forget_part(download)
        error.problem += f" (kept as {error.path})"
        raise
    rename(part, path)
    forget_part(download)
    return FetchedFile(**entry.model_dump() | {"url": url}, path=path, status=status)
