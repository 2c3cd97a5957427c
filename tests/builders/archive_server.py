"""A local file server that can misbehave as the servers of archives do."""

from __future__ import annotations

import gzip
import hashlib
import re
import threading
import time
from dataclasses import dataclass, field
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


@dataclass
class Remote:
    """A file on the server; the lists are used up, one item for each request."""

    body: bytes
    ranges: bool = True
    heeds_if_range: bool = True
    validators: tuple[str, ...] = ("ETag",)
    validates_206: bool = True
    shift_206: int = 0
    says_length: bool = True
    encoding: str | None = None
    statuses: list[int] = field(default_factory=list)
    cut_after: list[int] = field(default_factory=list)
    stall: threading.Event | None = None
    stalls: int = 1_000_000
    changes_to: bytes | None = None
    """What the file becomes after the first answer."""
    pause_s: float = 0.0
    """Before each 4,096 bytes."""
    total_206: str | None = None
    """The total size that Content-Range states instead of the true size."""

    @property
    def version(self) -> dict[str, str]:
        """The headers that name this version of the file."""
        digest = sha256(self.body)[:16]
        known = {
            "ETag": f'"{digest}"',
            "weak ETag": f'W/"{digest}"',
            "Last-Modified": f"Thu, 01 Jan 2026 00:00:{int(digest[:2], 16) % 60:02d} GMT",
        }
        return {key.removeprefix("weak "): known[key] for key in self.validators}


@dataclass
class Request:
    path: str
    range: str | None
    if_range: str | None
    encodings: str | None
    status: int = 0
    sent: int = 0


class Handler(BaseHTTPRequestHandler):
    server: Archive

    def do_GET(self) -> None:
        keys = ("Range", "If-Range", "Accept-Encoding")
        request = Request(self.path, *(self.headers[key] for key in keys))
        self.server.requests.append(request)
        remote = self.server.remotes.get(unquote(self.path.partition("?")[0]))
        if remote is None or remote.statuses:
            request.status = remote.statuses.pop(0) if remote else 404
            self.send_error(request.status)
            return
        if remote.changes_to is not None and request.path in self.server.answered:
            remote.body = remote.changes_to
        self.server.answered.add(request.path)
        span = self._span(remote, request)
        if span and span[0] >= len(remote.body) > 0:
            request.status = 416
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(remote.body)}")
            self.end_headers()
            return
        self._answer(remote, request, span)

    def _span(self, remote: Remote, request: Request) -> tuple[int, int] | None:
        """Return the requested bytes of the file; None if the whole file is requested."""
        asked = re.fullmatch(r"bytes=(\d*)-(\d*)", request.range or "")
        strong = [value for value in remote.version.values() if not value.startswith("W/")]
        fits = request.if_range in (None, *strong) or not remote.heeds_if_range
        if not asked or not fits or not remote.ranges:
            return None
        size = len(remote.body)
        if not asked[1]:
            return max(0, size - int(asked[2])), size
        stop = min(size, int(asked[2]) + 1) if asked[2] else size
        return int(asked[1]) - remote.shift_206, stop

    def _answer(self, remote: Remote, request: Request, span: tuple[int, int] | None) -> None:
        start, stop = span or (0, len(remote.body))
        rest = remote.body[start:stop]
        request.status = 206 if span else 200
        self.send_response(request.status)
        for key, value in remote.version.items():
            if remote.validates_206 or not span:
                self.send_header(key, value)
        if remote.encoding:
            self.send_header("Content-Encoding", remote.encoding)
        if remote.says_length:
            self.send_header("Content-Length", str(len(rest)))
        if span:
            total = remote.total_206 or len(remote.body)
            self.send_header("Content-Range", f"bytes {start}-{stop - 1}/{total}")
        self.end_headers()
        if remote.cut_after:
            rest = rest[: remote.cut_after.pop(0)]
        for place in range(0, len(rest), 4096) if remote.pause_s else ():
            time.sleep(remote.pause_s)
            self.wfile.write(rest[place : place + 4096])
        request.sent = len(rest)  # before the client can have all of it, and asks
        if not remote.pause_s:
            self.wfile.write(rest)
        if remote.stall and remote.stalls:
            remote.stalls -= 1
            self.wfile.flush()
            remote.stall.wait(20)

    def log_message(self, *_: object) -> None:
        pass


class Archive(ThreadingHTTPServer):
    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.remotes: dict[str, Remote] = {}
        self.requests: list[Request] = []
        self.answered: set[str] = set()

    def url(self, path: str) -> str:
        return f"http://127.0.0.1:{self.server_port}{path}"

    def serve(self, path: str, body: bytes, **keys: Any) -> str:
        self.remotes[path] = Remote(body, **keys)
        return self.url(path)

    def serve_folder(self, prefix: str, folder: Path) -> str:
        """Serve the files of a folder, which have to be there now."""
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                self.serve(f"{prefix}/{path.relative_to(folder).as_posix()}", path.read_bytes())
        return self.url(prefix)

    def handle_error(self, *_: object) -> None:
        """Say nothing: a client that was killed is part of the tests."""


@dataclass
class Fault:
    """What happens once to a request whose method and path are found."""

    where: str  # a regular expression of "METHOD path"
    status: int = 0  # in place of the answer
    cut: int | None = None  # bytes of the body that arrive
    wait_s: float = 0.0
    swap: tuple[bytes, bytes] = (b"", b"")  # in the answer's body, and in the request's
    times: int = 1
    is_packed: bool = False  # by gzip, although the request did not ask for it


class RelayHandler(BaseHTTPRequestHandler):
    server: Relay

    def _relay(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        what = f"{self.command} {self.path} {body.decode('latin-1')}"
        self.server.seen.append(what)
        fault = next((f for f in self.server.faults if f.times and re.search(f.where, what)), None)
        if fault is not None:
            fault.times -= 1
            time.sleep(fault.wait_s)
            if fault.status:
                self.send_error(fault.status)
                return
            body = body.replace(*fault.swap) if fault.swap[0] else body
        connection = HTTPConnection("127.0.0.1", self.server.target, timeout=30)
        connection.request(self.command, self.path, body or None, dict(self.headers))
        answer = connection.getresponse()
        data = answer.read()
        connection.close()
        if fault is not None:
            data = data.replace(*fault.swap) if fault.swap[0] else data
            data = gzip.compress(data) if fault.is_packed else data
        self.send_response(answer.status)
        for key, value in answer.getheaders():
            if key.lower() not in ("content-length", "transfer-encoding", "connection"):
                self.send_header(key, value)
        self.send_header("Content-Length", str(len(data)))
        if fault is not None and fault.is_packed:
            self.send_header("Content-Encoding", "gzip")
        self.end_headers()
        self.wfile.write(data if fault is None or fault.cut is None else data[: fault.cut])

    def do_GET(self) -> None:
        self._relay()

    def do_POST(self) -> None:
        self._relay()

    def do_DELETE(self) -> None:
        self._relay()

    def log_message(self, *_: object) -> None:
        pass


class Relay(ThreadingHTTPServer):
    """Passes requests on to a server of this machine, and does to some what networks do."""

    def __init__(self, target: int) -> None:
        super().__init__(("127.0.0.1", 0), RelayHandler)
        self.target = target
        self.faults: list[Fault] = []
        self.seen: list[str] = []

    def url(self, path: str) -> str:
        return f"http://127.0.0.1:{self.server_port}{path}"

    def handle_error(self, *_: object) -> None:
        """Say nothing: a client that goes away is part of the tests."""
