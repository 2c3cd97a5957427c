"""Get the files of a data source into a folder, whole and checked, or not at all.

Input is a `DataSource` and a folder; output is a `FetchReport`. A body goes to
``<name>.part``, is continued there after an interruption, is checked on arrival and only
then gets its name; a file that fails the checks is kept as ``<name>.rejected``.

pooch gives the cache folder, the digests and FTP. Continuing a download, several addresses
for one file and keeping a file whose digest is wrong are beyond it, and so are done here.
This module does not unpack, and reads no star.
"""

from __future__ import annotations

import ftplib
import logging
import os
import re
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Literal
from urllib.parse import urlsplit

import pooch
import requests
from pydantic import BaseModel, ConfigDict
from urllib3.exceptions import HTTPError

from starcat import __version__
from starcat.catalog.arrival import (
    ExpectedFile,
    LockEntry,
    examine,
    expected_files,
    read_lock,
)
from starcat.catalog.source import DataSource
from starcat.errors import DownloadError, OutputError, SourceError
from starcat.progress import Progress, no_progress

Status = Literal["downloaded", "resumed", "present"]
"""Fetched in one go; continued from an earlier part; already in the folder."""

_logger = logging.getLogger(__name__)
_BLOCK_BYTES = 1 << 18
_LONGEST_WAIT_S = 60.0


@dataclass(frozen=True)
class FetchedFile:
    """One file that is in the folder and is what it should be.

    Attributes
    ----------
    name : str
        File name.
    path : Path
        Where it is.
    bytes : int
        Size as published, that is before unpacking.
    sha256 : str
        Digest.
    rows : int
        Records.
    url : str
        Where it came from; empty for a file that somebody put there by hand.
    status : {"downloaded", "resumed", "present"}
        What was done.
    """

    name: str
    path: Path
    bytes: int
    sha256: str
    rows: int
    url: str
    status: Status


@dataclass(frozen=True)
class FetchReport:
    """What `fetch_source` did.

    Attributes
    ----------
    source : str
        Name of the data source.
    files : tuple of FetchedFile
        In the order of the data source.
    """

    source: str
    files: tuple[FetchedFile, ...]


@dataclass(frozen=True)
class _Options:
    retries: int
    timeout_s: float
    backoff_s: float
    progress: Progress


class _PartState(BaseModel):
    """Which version of which remote file a ``.part`` is the beginning of."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    url: str
    validator: str
    total: int | None


class _Refused(Exception):  # noqa: N818 - not an error of its own: it ends the attempts
    """The server's answer will be the same next time."""


class _Broken(Exception):  # noqa: N818
    """The answer may be better next time."""


# The errors of requests are OSErrors.
_WORTH_A_RETRY = (_Broken, OSError, HTTPError, EOFError, ftplib.Error)


def cache_folder() -> Path:
    """Return the folder that downloads go to by default.

    Returns
    -------
    Path
        ``$STARCAT_CACHE`` if it is set, else the cache folder of the operating system. It
        need not exist.
    """
    chosen = os.environ.get("STARCAT_CACHE")
    return Path(chosen).expanduser() if chosen else Path(pooch.os_cache("starcat"))


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
    """Get the files of a source into a folder and check them.

    Parameters
    ----------
    source : DataSource
        What to get.
    folder : Path
        Where to; made if need be.
    parts : sequence of str
        Of the files in several parts, only these; empty for all. Single files always come.
    retries : int
        Further attempts at an address after the first has failed, before the next address.
    timeout_s : float
        Seconds to wait for a connection, and for each block of data.
    backoff_s : float
        Seconds before the second attempt; doubled for each further one, up to 60.
    progress : Progress
        Called with file name, bytes there are, and bytes in all or None.

    Returns
    -------
    FetchReport
        Every file, with its digest, records and what was done.

    Raises
    ------
    ConfigError
        If a part is unknown or an address is not http, https or ftp.
    SourceMissing
        If the source has no address.
    OutputError
        If the folder cannot be written to.
    DownloadError
        If a file came from none of its addresses.
    ChecksumMismatch
        If a file has another digest than the one committed or recorded at its first arrival.
    ParseError
        If the number of records or the length of one is wrong.
    SourceError
        If a gzip file or the lock file is damaged.

    Notes
    -----
    The number of records of a file in parts is checked when its last part arrives. A file
    with the right digest is not asked for again.
    """
    wanted = expected_files(source, parts)
    _make_writable(folder)
    read_lock(folder)
    options = _Options(max(0, retries), timeout_s, backoff_s, progress)
    return FetchReport(source.name, tuple(_fetch_file(file, folder, options) for file in wanted))


def _make_writable(folder: Path) -> None:
    """Make the folder and try it out, before anything is downloaded."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OutputError(
            f"cannot write to the folder {folder}: {error}. Name another one, or set "
            "STARCAT_CACHE.",
            path=folder,
        ) from error


def _fetch_file(expected: ExpectedFile, folder: Path, options: _Options) -> FetchedFile:
    """Take the file that is there, or else the first address that delivers."""
    for name in expected.names:
        if (folder / name).exists():
            return _take_present(expected, folder / name)
    failures: list[tuple[str, SourceError]] = []
    for name, url in expected.addresses:
        try:
            status = _download(url, folder / name, options)
            return _take_arrived(expected, folder / name, url, status)
        except SourceError as error:
            _logger.warning("%s: %s", url, error)
            failures.append((url, error))
    raise _none_delivered(expected, failures)


def _none_delivered(
    expected: ExpectedFile, failures: Sequence[tuple[str, SourceError]]
) -> SourceError:
    """Sum up why: a file that came and was wrong says more than one that did not come."""
    wrong = [error for _, error in failures if not isinstance(error, DownloadError)]
    reasons = "\n".join(f"  {url}: {error}" for url, error in failures)
    if not wrong:
        return DownloadError(
            f"{expected.names[0]} came from none of its addresses:\n{reasons}\n"
            "Try again later: what has arrived is kept. Or put the file there by hand.",
            source=expected.source.name,
        )
    if len(failures) > 1:
        wrong[0].args = (f"{wrong[0]}\nAll addresses failed:\n{reasons}",)
    return wrong[0]


def _take_present(expected: ExpectedFile, path: Path) -> FetchedFile:
    """Check a file that is in the folder; it is left as it is."""
    if not path.is_file():
        raise OutputError(f"{path} is in the way: it is not a file. Move it.", path=path)
    try:
        entry = examine(expected, path, path, url="")
    except SourceError as error:
        error.args = (f"{error} The file is {path}: move it away to fetch it again.",)
        raise
    return _fetched(path, entry, entry.url, "present")


def _take_arrived(expected: ExpectedFile, path: Path, url: str, status: Status) -> FetchedFile:
    """Check a file that has come, then give it its name or set it aside."""
    part = _part(path)
    try:
        entry = examine(expected, part, path, url=url)
    except SourceError as error:
        error.path = _beside(path, ".rejected")
        _rename(part, error.path)
        _forget(path)
        error.args = (f"{str(error).rstrip('.')}. The file is kept as {error.path}.",)
        raise
    _rename(part, path)
    _forget(path)
    return _fetched(path, entry, url, status)


def _fetched(path: Path, entry: LockEntry, url: str, status: Status) -> FetchedFile:
    return FetchedFile(path.name, path, entry.bytes, entry.sha256, entry.rows, url, status)


def _download(url: str, path: Path, options: _Options) -> Status:
    """Bring one address to ``<name>.part``, trying again after a short wait."""
    reason: Exception | None = None
    for attempt in range(1 + options.retries):
        if attempt:
            time.sleep(min(options.backoff_s * 2.0 ** (attempt - 1), _LONGEST_WAIT_S))
        try:
            if urlsplit(url).scheme == "ftp":
                _transfer_ftp(url, path, options)
                return "downloaded"
            return "resumed" if _transfer_http(url, path, options) else "downloaded"
        except (_Refused, ftplib.error_perm) as error:
            raise DownloadError(f"{error}") from error
        except _WORTH_A_RETRY as error:
            _logger.info("%s, attempt %d: %s", url, attempt + 1, error)
            reason = error
    raise DownloadError(f"{reason} (attempts: {1 + options.retries})") from reason


def _transfer_http(url: str, path: Path, options: _Options) -> bool:
    """Get what is missing of a file; tell whether an earlier part was continued."""
    state = _part_state(url, path)
    there = _part(path).stat().st_size if state else 0
    if state and there == state.total:
        return True
    headers = {"Accept-Encoding": "identity", "User-Agent": f"starcat/{__version__}"}
    if state:
        headers |= {"Range": f"bytes={there}-", "If-Range": state.validator}
    with requests.get(url, headers=headers, stream=True, timeout=options.timeout_s) as response:
        if not state or response.status_code not in (206, 416):
            _receive_whole(response, url, path, options)
            return False
        if _continues(response, state, there):
            _receive(response, path, there, state.total, options)
            return True
    _logger.info("%s: the part does not fit what is there now; starting over", url)
    _forget(path)
    return _transfer_http(url, path, options)


def _continues(response: requests.Response, state: _PartState, there: int) -> bool:
    """Tell whether a partial answer begins where the part ends, in the same version."""
    found = re.fullmatch(
        r"bytes (\d+)-(\d+)/(\d+|\*)", response.headers.get("Content-Range", "").strip()
    )
    if response.status_code != 206 or found is None or int(found[1]) != there:
        return False
    same_total = state.total is None or found[3] in ("*", str(state.total))
    validators = [response.headers.get(key) for key in ("ETag", "Last-Modified")]
    # A server that ignores If-Range gives itself away by another validator.
    return same_total and (state.validator in validators or not any(validators))


def _receive_whole(response: requests.Response, url: str, path: Path, options: _Options) -> None:
    """Take an answer that begins at the first byte, noting what a later part must match."""
    answer = f"the server answered {response.status_code} {response.reason}"
    if response.status_code >= 500 or response.status_code in (408, 429):
        raise _Broken(answer)
    if response.status_code != 200:
        raise _Refused(answer)
    packed = response.headers.get("Content-Encoding", "identity") != "identity"
    if packed and not path.name.endswith(".gz"):
        raise _Refused("the server packs the body although it was asked not to")
    length = response.headers.get("Content-Length", "")
    total = int(length) if length.isdecimal() else None
    validator = _validator(response)
    _forget(path)
    if validator:
        _write_state(path, _PartState(url=url, validator=validator, total=total))
    _receive(response, path, 0, total, options)


def _validator(response: requests.Response) -> str | None:
    """Return what names the version of the remote file; a weak ETag does not."""
    etag: str | None = response.headers.get("ETag")
    if etag and not etag.startswith("W/"):
        return etag
    return response.headers.get("Last-Modified")


def _receive(
    response: requests.Response, path: Path, there: int, total: int | None, options: _Options
) -> None:
    """Append a body to the part as it comes, and see that all of it came."""
    done = there
    with _appending(_part(path), path.name, there, total, options.progress) as write:
        try:
            # As sent: a .gz is not unpacked, whatever its headers say.
            while block := response.raw.read1(_BLOCK_BYTES, decode_content=False):
                done = write(block)
        except (HTTPError, OSError) as error:
            reason = f"received {done} of {total or 'unknown'} bytes ({type(error).__name__})"
            raise _Broken(reason) from error
    if total is not None and done != total:
        raise _Broken(f"received {done} of {total} bytes")


def _transfer_ftp(url: str, path: Path, options: _Options) -> None:
    """Get a whole file by FTP; an earlier part is not continued."""
    address = urlsplit(url)
    downloader = pooch.FTPDownloader(
        port=address.port or ftplib.FTP_PORT, timeout=options.timeout_s, chunk_size=_BLOCK_BYTES
    )
    # Beside the part of an http address, which is dropped only when there is a whole file.
    part = _beside(path, ".ftp.part")
    with _output(part):
        part.unlink(missing_ok=True)
    with _appending(part, path.name, 0, None, options.progress) as write:
        target = SimpleNamespace(write=write)
        downloader(f"ftp://{address.hostname}{address.path}", target, None)
    _forget(path)
    _rename(part, _part(path))


@contextmanager
def _appending(
    part: Path, name: str, there: int, total: int | None, progress: Progress
) -> Iterator[Callable[[bytes], int]]:
    """Open the part; yield a function that appends a block and returns the bytes there are.

    Unbuffered: what has come is there for the next attempt, whatever happens. A full disk is
    no failed download, and ends it.
    """
    done = there

    def write(block: bytes) -> int:
        nonlocal done
        with _output(part):
            rest = memoryview(block)
            while rest:
                rest = rest[stream.write(rest) :]
        done += len(block)
        progress(name, done, total)
        return done

    with _output(part):
        stream = part.open("ab", buffering=0)
    progress(name, there, total)
    with stream:
        yield write
        os.fsync(stream.fileno())


@contextmanager
def _output(path: Path) -> Iterator[None]:
    """Turn a failure to write into the error that says so."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error}", path=path) from error


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)


def _part(path: Path) -> Path:
    return _beside(path, ".part")


def _part_state(url: str, path: Path) -> _PartState | None:
    """Read what the part is the beginning of; None where it cannot be continued."""
    try:
        state = _PartState.model_validate_json(_beside(path, ".part.json").read_bytes())
        size = _part(path).stat().st_size
    except (OSError, ValueError):
        return None
    return state if state.url == url and size > 0 else None


def _write_state(path: Path, state: _PartState) -> None:
    file = _beside(path, ".part.json")
    with _output(file):
        file.write_text(state.model_dump_json() + "\n", encoding="utf-8")


def _rename(path: Path, target: Path) -> None:
    with _output(target):
        path.replace(target)


def _forget(path: Path) -> None:
    """Drop the part, then its state: a state without a part is harmless."""
    for file in (_part(path), _beside(path, ".part.json")):
        with _output(file):
            file.unlink(missing_ok=True)
