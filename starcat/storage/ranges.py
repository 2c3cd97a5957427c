"""Some bytes of a file at an address, all of the same version of it.

Every answer says how long the whole file is, and most which version: one that differs from the
first is an error, as is a server that sends other bytes than it was asked for. What was cut off is
asked for again from where it ended. This module writes no file.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import requests
from pydantic import BaseModel, ConfigDict

from starcat.errors import ChecksumMismatch, DownloadError
from starcat.storage.download import (
    SIZE,
    Broken,
    DownloadOptions,
    Refused,
    check_status,
    next_block,
    persistent,
    response_of,
)

_CONTENT_RANGE = re.compile(rf"bytes ({SIZE})-({SIZE})/({SIZE})")


class RemoteVersion(BaseModel):
    """What tells a version of a remote file from others."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    size: int  # bytes of the whole file
    etag: str = ""  # as the server writes it; empty where it says none
    modified: str = ""  # the same of Last-Modified

    def __str__(self) -> str:
        """Return the facts as a message has them."""
        told = [f"{self.size:,} bytes", self.etag and f"ETag {self.etag}", self.modified]
        return ", ".join(filter(None, told))


def fetch_range(
    url: str,
    first: int,
    end: int,
    write: Callable[[int, bytes], None],
    options: DownloadOptions,
    known: RemoteVersion | None = None,
) -> RemoteVersion:
    """Get the bytes from the first up to the end of a range, or as many last ones as -first says.

    What comes is given to a function with its place. `ChecksumMismatch` where the file is not of
    the version that is known.
    """
    version = known

    def once() -> RemoteVersion:
        nonlocal first, end, version
        asked = f"bytes={first}" if first < 0 else f"bytes={first}-{end - 1}"
        with response_of(url, {"Range": asked}, options) as response:
            found, begin, stop = _range_of(response)
            if version not in (None, found):
                raise ChecksumMismatch(f"{url}: has changed ({found}; it had {version})")
            wanted = (max(0, found.size + first), found.size) if first < 0 else (first, end)
            if (begin, stop) != wanted:
                raise Refused(f"the server sends bytes {begin} to {stop} for {asked}")
            version, first, end = found, begin, stop
            while block := next_block(response):
                if first + len(block) > end:
                    raise Refused(f"the body is longer than the {stop - begin} bytes asked for")
                write(first, block)
                first += len(block)
        if first < end:
            raise Broken(f"received {first - begin} of {stop - begin} bytes")
        return found

    try:
        return persistent(url, once, options)
    except DownloadError as error:
        error.args = (f"{url}: {error}",)
        raise


def _range_of(response: requests.Response) -> tuple[RemoteVersion, int, int]:
    """Return of which version a partial answer is, where it begins and where it ends."""
    if response.status_code == 416:
        raise Refused("the file is shorter than it was, or the server has no ranges")
    if response.status_code == 200:
        raise Refused(
            "the server sends the whole file where a part was asked for; download the catalog, "
            "and give its folder"
        )
    check_status(response, 206)
    if response.headers.get("Content-Encoding", "identity") != "identity":
        raise Refused("the server packs the body although it was asked not to")
    told = response.headers.get("Content-Range", "")
    match = _CONTENT_RANGE.fullmatch(told.strip())
    if match is None:
        raise Refused(f"the server describes the part as {told[:100]!r}, not as bytes 0-99/1000")
    begin, last, size = map(int, match.groups())
    headers = response.headers
    version = RemoteVersion(
        size=size, etag=headers.get("ETag", ""), modified=headers.get("Last-Modified", "")
    )
    return version, begin, last + 1
