"""Limits of requests: their size, their form, their body, and their frequency."""

from __future__ import annotations

import asyncio
import math
import re
import shutil
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import unquote_to_bytes

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.types import Message, Receive, Scope

from starcat.errors import QueryLimitError
from starcat_service.problems import Problem
from starcat_service.settings import Role, ServiceSettings

MAX_HEADERS, MAX_HEADER_BYTES, MAX_TARGET_BYTES = 100, 32_768, 16_384

CONTROL = re.compile(r"[\x00-\x1f\x7f]")
UPWARDS = re.compile(r"(^|[/\\])\.{1,2}($|[/\\])")
METHODS = ("GET", "HEAD", "OPTIONS", "POST", "PUT", "PATCH", "DELETE")

TEXT_MIB = 1.0
"""Size of a form or of JSON at most: larger content is a file, and can be uploaded."""

TEXTS = ("application/json", "application/x-www-form-urlencoded", "text/")
MIB, GIB = 2**20, 2**30

CHECKED = ("/api/upload",)
"""Paths that take files without a token in a header: the body has a session, and the handler checks
it before it reads the file. On other paths such a body has at most `TEXT_MIB`."""

MIN_FREE_GIB = 0.01
"""Least free space, also if ``free_gib`` is less: records and unfinished answers need it."""

FILLING = ("/tap/async",)
"""Paths where a POST makes files that stay on the disk; jobs check their space themselves."""

CONNECTIONS = 1_000
"""Connections at the same time; with more, the server answers that it is busy."""

OWN_CONNECTIONS = CONNECTIONS // 5
"""Connections of one address, and requests of one user, at the same time."""

MAX_BUCKETS = 10_000
"""Largest number of keys; with more, the keys that were unused for longest are dropped."""


class Buckets:
    """A bucket for each key: full at first; each request takes one; it is refilled steadily."""

    def __init__(self, per_minute: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_s = per_minute / 60.0
        self._size = per_minute
        self._clock = clock
        self._levels: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._lock = threading.Lock()

    def take(self, key: str) -> float:
        """Take one out of the bucket of a key."""
        with self._lock:  # some handlers run in threads
            now_s = self._clock()
            level, then_s = self._levels.pop(key, (self._size, now_s))
            level = min(self._size, level + (now_s - then_s) * self._per_s)
            wait_s = 0.0 if level >= 1.0 else (1.0 - level) / self._per_s
            self._levels[key] = (level if wait_s else level - 1.0), now_s
            if len(self._levels) > MAX_BUCKETS:
                self._levels.popitem(last=False)
            return wait_s


class Shares:
    """Number of requests of each user that are being answered, and its limit."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._running: Counter[str] = Counter()

    @contextmanager
    def counted(self, who: str) -> Iterator[None]:
        """Count a request while it is answered; raise a `Problem` if there are too many."""
        if self._running[who] >= self._most:
            raise Problem(
                429,
                f"{self._most} of your requests are being answered; ask again when some are",
                headers=later(1.0),
            )
        self._running[who] += 1
        try:
            yield
        finally:
            self._running[who] -= 1
            if not self._running[who]:
                del self._running[who]


def later(wait_s: float) -> Mapping[str, str]:
    """Return the header with the seconds after which to ask again, at least one."""
    return {"Retry-After": str(max(1, math.ceil(wait_s)))}


def client_ip(scope: Scope) -> str:
    """Return the address that a request came from, or 'unknown'."""
    client = HTTPConnection(scope).client
    return client.host if client is not None else "unknown"


def check_shape(scope: Scope) -> None:
    """Refuse requests that are too long, contain control characters, or lead out of folders."""
    headers: list[tuple[bytes, bytes]] = scope["headers"]
    path, query = scope["path"], scope["query_string"]
    if scope["method"] not in METHODS:
        allowed = ", ".join(METHODS)
        raise Problem(
            405, f"the method is none of {allowed}; use one of them", headers={"Allow": allowed}
        )
    if len(scope.get("raw_path") or b"") + len(query) > MAX_TARGET_BYTES:
        raise Problem(
            414, f"the address has more than {MAX_TARGET_BYTES:,} bytes; send a long query by POST"
        )
    size = sum(len(name) + len(value) for name, value in headers)
    if len(headers) > MAX_HEADERS or size > MAX_HEADER_BYTES:
        raise Problem(
            431,
            f"the request has {len(headers)} headers of {size:,} bytes; at most {MAX_HEADERS} of "
            f"{MAX_HEADER_BYTES:,} bytes together are taken",
        )
    if CONTROL.search(path) or UPWARDS.search(path) or "\\" in path:
        raise Problem(
            400, "the path holds '.', '..', a backslash or a control character; send a plain one"
        )
    has_control = any(b"\x00" in value or b"\n" in value or b"\r" in value for _, value in headers)
    if has_control or b"\x00" in unquote_to_bytes(query):
        raise Problem(
            400, "the query or a header has a character that is not allowed there; remove it"
        )


class BodyLimits:
    """Limits of the size of a body, of the time to receive it, and of the free disk space."""

    def __init__(self, settings: ServiceSettings) -> None:
        self.settings = settings

    def limited(self, scope: Scope, receive: Receive) -> Receive:
        """Return a function that receives a body up to the limits."""
        if scope["method"] in ("GET", "HEAD", "OPTIONS"):
            return receive
        headers = Headers(scope=scope)
        kind = headers.get("content-type", "").strip().lower()
        most_mib = self.settings.upload_mib
        principal = scope.get("state", {}).get("principal")
        if getattr(principal, "role", None) == Role.NONE and scope["path"] not in CHECKED:
            most_mib = min(TEXT_MIB, most_mib)
        most = round(MIB * (min(TEXT_MIB, most_mib) if kind.startswith(TEXTS) else most_mib))
        length = headers.get("content-length")
        if length is not None and not (length.isascii() and length.isdigit()):
            raise Problem(400, "the header Content-Length is not a number")
        if length is not None and int(length) > most:
            raise Problem(413, request_too_large(most))
        fills = kind.startswith("multipart/") or scope["path"].startswith(FILLING)
        if fills and scope["method"] != "DELETE":
            check_disk(self.settings)
            receive = _while_disk_is_free(receive, self.settings)
        return _limited(receive, most, self.settings.upload_time_s)


_reserved: Counter[Path] = Counter()  # bytes, by the root of a service


_reserving = threading.Lock()


@contextmanager
def reserved(settings: ServiceSettings, size_bytes: int) -> Iterator[None]:
    """Keep space on the disk meanwhile for files that another process may write."""
    with _reserving:
        _reserved[settings.root] += size_bytes
    try:
        yield
    finally:
        with _reserving:
            _reserved[settings.root] -= size_bytes


@contextmanager
def room_for(settings: ServiceSettings, size_bytes: int) -> Iterator[None]:
    """Keep space on the disk for data that are written meanwhile; raise `NoRoom` without it."""
    with _reserving:
        check_disk(settings, size_bytes)
        _reserved[settings.root] += size_bytes
    try:
        yield
    finally:
        with _reserving:
            _reserved[settings.root] -= size_bytes


def reserved_bytes(settings: ServiceSettings) -> int:
    """Return the space that is reserved."""
    return _reserved[settings.root]


class NoRoom(Problem, QueryLimitError):  # noqa: N818 - the name reads as the fact
    """The disk is nearly full; an answer in progress ends with this message."""


def check_disk(settings: ServiceSettings, more_bytes: int = 0) -> None:
    """Refuse requests that would add data to a disk that is, or would be, nearly full.

    Data of a size leaves the space that is `reserved`.
    """
    short = disk_shortage(settings, more_bytes + reserved_bytes(settings) if more_bytes else 0)
    if short is not None:
        raise NoRoom(507, short)


def disk_shortage(settings: ServiceSettings, more_bytes: int = 0) -> str | None:
    """Return the message for a disk that is nearly full, or would be with more bytes."""
    free, least = free_gib(settings.root), max(settings.free_gib, MIN_FREE_GIB)
    if free - more_bytes / GIB >= least:
        return None
    need = f", {more_bytes / GIB:.2f} are wanted" if more_bytes else ""
    return (
        f"the disk of the service has {free:.2f} GiB free{need}, and {least:g} have to be left "
        "(free_gib); remove unused databases or results, or ask the operator"
    )


def spare_gib(settings: ServiceSettings) -> float:
    """Return the space that may still be used of the disk, GiB."""
    return free_gib(settings.root) - max(settings.free_gib, MIN_FREE_GIB)


def free_gib(folder: Path) -> float:
    """Return the free space on the disk of a folder, GiB."""
    return shutil.disk_usage(folder).free / GIB


def request_too_large(most: int) -> str:
    """Return the message for a body that is too large."""
    return f"the body has more than {most / MIB:g} MiB, which is the most that is taken; send less"


def _while_disk_is_free(receive: Receive, settings: ServiceSettings) -> Receive:
    """Return a receive function that refuses the rest of a body when the disk is nearly full."""

    async def receive_checked() -> Message:
        message = await receive()
        short = disk_shortage(settings)
        if short is not None:
            raise HTTPException(507, short, {"Connection": "close"})
        return message

    return receive_checked


def _limited(receive: Receive, most: int, time_s: float) -> Receive:
    """Return a receive function with limits of size and time around another one.

    Its errors reach the client like any other refusal of a handler.
    """
    got, is_whole, until_s = 0, False, asyncio.get_running_loop().time() + time_s

    async def receive_limited() -> Message:
        nonlocal got, is_whole
        if is_whole:  # only the end of the connection can follow, at any time
            return await receive()
        try:
            async with asyncio.timeout_at(until_s):
                message = await receive()
        except TimeoutError:
            raise HTTPException(
                408,
                f"the body took more than {time_s:g} s to arrive; send less, or on a faster line",
                {"Connection": "close"},
            ) from None
        if message["type"] != "http.request":
            return message
        got += len(message.get("body", b""))
        is_whole = not message.get("more_body", False)
        if got > most:
            raise HTTPException(413, request_too_large(most), {"Connection": "close"})
        return message

    return receive_limited
