"""Download one file, or continue an earlier attempt.

Input is an address (http, https, ftp) and a path; output is the body in ``<name>.part`` next to
it, which the caller checks and renames. After an interruption a part is continued. For a file
that can change, the server must state that the version is the same; fixed content, such as a blob
named by its digest, is always continued. If a server ignores ranges, the whole file is downloaded.
This module checks sizes, not digests.
"""

from __future__ import annotations

import ftplib
import logging
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Literal, TypeVar
from urllib.parse import urlsplit

import pooch
import requests
from pydantic import BaseModel, ConfigDict
from urllib3.exceptions import HTTPError

from starcat.errors import ChecksumMismatch, ConfigError, DownloadError, OutputError
from starcat.progress import Progress, no_progress
from starcat.version import __version__

Arrival = Literal["downloaded", "resumed"]
"""Downloaded in one step, or continued from an earlier part."""

_logger = logging.getLogger(__name__)
_BLOCK_BYTES = 1 << 18
_LONGEST_WAIT_S = 60.0
_Result = TypeVar("_Result")
SIZE = "[0-9]{1,18}"
"""A number of bytes in a header."""


class NotFound(DownloadError):  # noqa: N818 - the name reads as the fact
    """A file that does not exist on the server."""


@dataclass(frozen=True)
class DownloadOptions:
    """How to download."""

    retries: int = 3  # further attempts after the first has failed
    timeout_s: float = 60.0  # seconds to wait for a connection, and for each block of data
    # seconds before the second attempt; doubled for each further one, up to 60
    backoff_s: float = 1.0
    # called with file name, bytes so far, and total bytes or None
    progress: Progress = no_progress
    # size of content that never changes at its address; a body of another size is refused
    fixed_bytes: int | None = None
    most_bytes: int | None = None  # a longer body is refused


class _PartState(BaseModel):
    """The remote file and its version to which a ``.part`` belongs."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    url: str
    validator: str
    total: int | None

    @property
    def is_fixed(self) -> bool:
        """Whether the file never changes."""
        return not self.validator


class Refused(Exception):  # noqa: N818 - internal: it ends the attempts
    """A refusal that another attempt would not change."""

    def __init__(self, message: str, status: int | None = None) -> None:
        super().__init__(message)
        self.status = status


class Broken(Exception):  # noqa: N818
    """A failure for which another attempt can succeed."""


# The errors of requests are OSErrors.
_WORTH_A_RETRY = (Broken, OSError, HTTPError, EOFError, ftplib.Error)


def is_address(text: str, what: str) -> bool:
    """Return whether a text is an address of HTTP; else it is a path, if it can be one.

    It is only for input of the user of this machine: a service opens no address from a request.
    """
    if "://" not in text:
        return False
    try:
        address = urlsplit(text)
        is_usable = address.scheme in ("http", "https") and bool(address.hostname)
        is_usable &= not (address.query or address.fragment) and address.port != 0
    except ValueError:  # an unpaired bracket, or a port that is not a number
        is_usable = False
    if not is_usable:
        raise ConfigError(
            f"{what} {text!r}: expected a folder, or an address that begins with http:// or "
            "https:// and has no ? or #",
            key=what,
            value=text,
        )
    return True


def download(url: str, path: Path, options: DownloadOptions) -> Arrival:
    """Download an address to ``<name>.part``, with further attempts after short waits."""

    def once() -> Arrival:
        if url.lower().startswith("ftp:"):
            _transfer_ftp(url, path, options)
            return "downloaded"
        return "resumed" if _transfer_http(url, path, options) else "downloaded"

    return persistent(url, once, options)


def persistent(url: str, once: Callable[[], _Result], options: DownloadOptions) -> _Result:
    """Call a function that can fail for a while, with further attempts after short waits."""
    cause: Exception | None = None
    attempts = 1 + max(0, options.retries)
    for attempt in range(attempts):
        if attempt:
            time.sleep(min(options.backoff_s * 2.0 ** (attempt - 1), _LONGEST_WAIT_S))
        try:
            return once()
        except Refused as error:
            kind = NotFound if error.status in (404, 410) else DownloadError
            raise kind(_short(str(error))) from error
        except ftplib.error_perm as error:
            raise DownloadError(_short(str(error))) from error
        except _WORTH_A_RETRY as error:
            _logger.info("%s, attempt %d: %s", url, attempt + 1, error)
            cause = error
    raise DownloadError(f"{_short(_why(cause))} (attempts: {attempts})") from cause


def _why(error: Exception | None) -> str:
    """Return the reason for a missing answer, without object names of the libraries."""
    refused = re.search(r"\[Errno -?\d+\] ([^\"')]+)", str(error))
    if isinstance(error, requests.ConnectionError) and refused:
        return f"the server cannot be reached: {refused[1]}"
    if isinstance(error, requests.Timeout) or "timed out" in str(error):
        return "the server does not answer in time"
    return str(error)


def _transfer_http(url: str, path: Path, options: DownloadOptions) -> bool:
    """Download the missing bytes of a file; return whether an earlier part was continued."""
    state = _part_state(url, path, options)
    there = part_of(path).stat().st_size if state else 0
    if state and there == state.total:
        return True
    headers = {"Range": f"bytes={there}-"} if state else {}
    if state and not state.is_fixed:
        headers |= {"If-Range": state.validator}
    with response_of(url, headers, options) as response:
        if not state or response.status_code not in (206, 416):
            _receive_whole(response, url, path, options)
            return False
        if _continues(response, state, there):
            _receive(response, path, there, state.total, options)
            return True
    _logger.info("%s: the part does not fit what is there now; starting over", url)
    forget_part(path)
    return _transfer_http(url, path, options)


def response_of(
    url: str, headers: Mapping[str, str], options: DownloadOptions
) -> requests.Response:
    """Request a file without compression during the transfer."""
    defaults = {"Accept-Encoding": "identity", "User-Agent": f"starcat/{__version__}"}
    with understood():
        return requests.get(
            url, headers={**defaults, **headers}, stream=True, timeout=options.timeout_s
        )


def _continues(response: requests.Response, state: _PartState, there: int) -> bool:
    """Return whether a partial answer continues the part, in the same version."""
    match = re.fullmatch(
        rf"bytes ({SIZE})-({SIZE})/({SIZE}|\*)", response.headers.get("Content-Range", "").strip()
    )
    if response.status_code != 206 or match is None or int(match[1]) != there:
        return False
    same_total = state.total is None or match[3] in ("*", str(state.total))
    validators = [response.headers.get(key) for key in ("ETag", "Last-Modified")]
    # If a server ignores If-Range, another validator shows that the version differs.
    same_version = state.is_fixed or state.validator in validators or not any(validators)
    return same_total and same_version


def _receive_whole(
    response: requests.Response, url: str, path: Path, options: DownloadOptions
) -> None:
    """Write an answer from the first byte on, and store the validator for later parts."""
    check_status(response, 200)
    packed = response.headers.get("Content-Encoding", "identity") != "identity"
    if packed and not path.name.endswith(".gz"):
        raise Refused("the server packs the body although it was asked not to")
    length = response.headers.get("Content-Length")
    if length is not None and not re.fullmatch(SIZE, length):
        raise Refused(f"the server says that the file has {_short(length)!r} bytes")
    total = options.fixed_bytes if length is None else int(length)
    if options.fixed_bytes not in (None, total):
        raise Refused(f"the server has {total} bytes; expected {options.fixed_bytes}")
    forget_part(path)
    validator = _validator(response)
    if validator and options.fixed_bytes is None:
        _write_state(path, _PartState(url=url, validator=validator, total=total))
    _receive(response, path, 0, total, options)


def check_status(response: requests.Response, expected: int) -> None:
    """Check the status of an answer; `Broken` if the server is busy, so that a retry can help."""
    answer = f"the server answered {response.status_code} {_short(response.reason or '')}"
    if response.status_code >= 500 or response.status_code in (408, 429):
        raise Broken(answer)
    if response.status_code != expected:
        raise Refused(answer, response.status_code)


def _validator(response: requests.Response) -> str | None:
    """Return the validator of the remote file's version; a weak ETag is not one."""
    etag: str | None = response.headers.get("ETag")
    if etag and not etag.startswith("W/"):
        return etag
    return response.headers.get("Last-Modified")


def _receive(
    response: requests.Response, path: Path, there: int, total: int | None, options: DownloadOptions
) -> None:
    """Append a body to the part block by block, and check its length."""
    done = there
    limits = [bytes_ for bytes_ in (total, options.most_bytes) if bytes_ is not None]
    with _appending(part_of(path), path.name, there, total, options.progress) as write:
        try:
            # Use the raw bytes: a .gz is never unpacked, even if its headers suggest it.
            while block := next_block(response):
                if limits and done + len(block) > min(limits):
                    raise Refused(f"the body is longer than {min(limits)} bytes")
                done = write(block)
        except (HTTPError, OSError) as error:
            reason = f"received {done} of {total or 'unknown'} bytes ({type(error).__name__})"
            raise Broken(reason) from error
    if total is not None and done != total:
        raise Broken(f"received {done} of {total} bytes")


def next_block(response: requests.Response) -> bytes:
    """Return the next raw bytes of a body; empty at its end."""
    with understood():
        block: bytes = response.raw.read1(_BLOCK_BYTES, decode_content=False)
    return block


@contextmanager
def understood() -> Iterator[None]:
    """Convert exceptions of the HTTP libraries about malformed answers to `Refused`.

    A broken connection passes unchanged, as another attempt can succeed. Other exceptions, such as
    for a redirect to an invalid address, would occur again.
    """
    try:
        yield
    except _WORTH_A_RETRY:
        raise
    except Exception as error:
        what = f"{type(error).__name__}: {_short(str(error))}"
        raise Refused(f"the server's answer makes no sense ({what})") from error


def _short(text: str) -> str:
    """Return the beginning of a text from a server."""
    return text if len(text) <= 500 else f"{text[:500]}..."


def _transfer_ftp(url: str, path: Path, options: DownloadOptions) -> None:
    """Download a whole file by FTP; an earlier part is not continued."""
    address = urlsplit(url)
    downloader = pooch.FTPDownloader(
        port=address.port or ftplib.FTP_PORT, timeout=options.timeout_s, chunk_size=_BLOCK_BYTES
    )
    # Use another name than for http, whose part is removed only when a whole file exists.
    part = beside(path, ".ftp.part")
    with _output(part):
        part.unlink(missing_ok=True)
    with _appending(part, path.name, 0, None, options.progress) as write:
        target = SimpleNamespace(write=write)
        downloader(f"ftp://{address.hostname}{address.path}", target, None)
    forget_part(path)
    rename(part, part_of(path))


@contextmanager
def _appending(
    part: Path, name: str, there: int, total: int | None, progress: Progress
) -> Iterator[Callable[[bytes], int]]:
    """Open the part; yield a function that appends a block and returns the size of the part.

    It is unbuffered, so that the next attempt has all received bytes. A full disk is not
    a failed attempt: it ends the download.
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
    try:
        yield
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error}", path=path) from error


def beside(path: Path, suffix: str) -> Path:
    """Return the path with a suffix appended to its name."""
    return path.with_name(path.name + suffix)


def part_of(path: Path) -> Path:
    """Return the path of a file's body until it is complete and checked."""
    return beside(path, ".part")


def _part_state(url: str, path: Path, options: DownloadOptions) -> _PartState | None:
    """Return the state of the part; None if it cannot be continued."""
    try:
        size = part_of(path).stat().st_size
        if options.fixed_bytes is not None:
            state = _PartState(url=url, validator="", total=options.fixed_bytes)
            return state if 0 < size <= options.fixed_bytes else None
        state = _PartState.model_validate_json(beside(path, ".part.json").read_bytes())
    except (OSError, ValueError):
        return None
    return state if state.url == url and size > 0 else None


def _write_state(path: Path, state: _PartState) -> None:
    file = beside(path, ".part.json")
    with _output(file):
        file.write_text(state.model_dump_json() + "\n", encoding="utf-8")


def rename(path: Path, target: Path) -> None:
    """Rename a file, and replace a file with that name."""
    with _output(target):
        path.replace(target)


def forget_part(path: Path) -> None:
    """Remove the part of a file, then its state: a state without a part is harmless."""
    for file in (part_of(path), beside(path, ".part.json")):
        with _output(file):
            file.unlink(missing_ok=True)


_CONTENT_RANGE = re.compile(rf"bytes ({SIZE})-({SIZE})/({SIZE})")


class RemoteVersion(BaseModel):
    """The facts that identify a version of a remote file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    size: int  # bytes of the whole file
    etag: str = ""  # ETag as sent by the server, or empty
    modified: str = ""  # Last-Modified as sent by the server, or empty

    def __str__(self) -> str:
        """Return the facts for a message."""
        facts = [f"{self.size:,} bytes", self.etag and f"ETag {self.etag}", self.modified]
        return ", ".join(filter(None, facts))


def fetch_range(
    url: str,
    first: int,
    end: int,
    write: Callable[[int, bytes], None],
    options: DownloadOptions,
    known_version: RemoteVersion | None = None,
) -> RemoteVersion:
    """Download the bytes from ``first`` to ``end`` of a file, or the last ``-first`` bytes.

    A function receives each block with its position. `ChecksumMismatch` if the file no longer has
    the known version.
    """
    version = known_version

    def once() -> RemoteVersion:
        nonlocal first, end, version
        asked = f"bytes={first}" if first < 0 else f"bytes={first}-{end - 1}"
        with response_of(url, {"Range": asked}, options) as response:
            served, begin, stop = _range_of(response)
            if version not in (None, served):
                raise ChecksumMismatch(f"has changed ({served}; it had {version})", where=url)
            expected = (max(0, served.size + first), served.size) if first < 0 else (first, end)
            if (begin, stop) != expected:
                raise Refused(f"the server sends bytes {begin} to {stop} for {asked}")
            version, first, end = served, begin, stop
            while block := next_block(response):
                if first + len(block) > end:
                    raise Refused(f"the body is longer than the {stop - begin} bytes asked for")
                write(first, block)
                first += len(block)
        if first < end:
            raise Broken(f"received {first - begin} of {stop - begin} bytes")
        return served

    try:
        return persistent(url, once, options)
    except DownloadError as error:
        error.at(url)
        raise


def _range_of(response: requests.Response) -> tuple[RemoteVersion, int, int]:
    """Return the version of a partial answer, and its start and end."""
    if response.status_code == 416:
        raise Refused("the file is shorter than it was, or the server has no ranges")
    if response.status_code == 200:
        raise Refused(
            "the server sends the whole file instead of the requested part; download the catalog, "
            "and give its folder"
        )
    check_status(response, 206)
    if response.headers.get("Content-Encoding", "identity") != "identity":
        raise Refused("the server packs the body although it was asked not to")
    header = response.headers.get("Content-Range", "")
    match = _CONTENT_RANGE.fullmatch(header.strip())
    if match is None:
        raise Refused(f"the server describes the part as {header[:100]!r}, not as bytes 0-99/1000")
    begin, last, size = map(int, match.groups())
    headers = response.headers
    version = RemoteVersion(
        size=size, etag=headers.get("ETag", ""), modified=headers.get("Last-Modified", "")
    )
    return version, begin, last + 1
