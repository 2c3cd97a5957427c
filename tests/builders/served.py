"""A server of the service in its own process, on a port that is free, ended in good order."""

from __future__ import annotations

import http.client
import json
import signal
import socketserver
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

END_S = 30.0


@dataclass(frozen=True)
class Answer:
    """What a server said."""

    status: int
    headers: Mapping[str, str]
    body: bytes

    @property
    def text(self) -> str:
        return self.body.decode("utf-8", "replace")


@dataclass(frozen=True)
class Served:
    """A server that runs."""

    address: str  # without a slash at its end
    root: Path
    process: subprocess.Popen[str]
    log: Path  # what it writes to stderr

    @property
    def port(self) -> int:
        return urlsplit(self.address).port or 0

    def raw(
        self,
        method: str,
        target: str,
        headers: Mapping[str, str] | None = None,
        body: bytes | None = None,
        timeout_s: float = 20.0,
    ) -> Answer:
        """Send a request letter by letter: nothing is put in order on the way, as clients do."""
        all_headers = {"Host": f"127.0.0.1:{self.port}", **(headers or {})}
        if body is not None:
            all_headers.setdefault("Content-Length", str(len(body)))
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=timeout_s)
        try:
            connection.putrequest(method, target, skip_host=True, skip_accept_encoding=True)
            for name, value in all_headers.items():
                connection.putheader(name, value)
            connection.endheaders()
            if body:
                connection.send(body)
            answer = connection.getresponse()
            return Answer(
                answer.status,
                {name.lower(): value for name, value in answer.getheaders()},
                answer.read() if method != "HEAD" else b"",
            )
        finally:
            connection.close()


@contextmanager
def in_background(server: socketserver.BaseServer) -> Iterator[None]:
    """Let a server of this process answer from a thread until the context ends."""
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        thread.join()


@contextmanager
def serve(
    root: Path, log: Path, program: str | None = None, **settings: object
) -> Iterator[Served]:
    """Run ``starcat serve`` until the context ends; it has to end with 0 then.

    ``settings`` are what ``service.toml`` is to say, ``log`` is the file for its stderr. With
    ``program``, Python runs this text, which changes the server before it runs it.
    """
    root.mkdir(parents=True, exist_ok=True)
    lines = [f"{name} = {json.dumps(value)}" for name, value in settings.items()]
    (root / "service.toml").write_text("\n".join(lines) + "\n")
    start = ["-m", "starcat"] if program is None else ["-c", program]
    command = [sys.executable, *start, "serve", "--root", root, "--port", "0", "--json"]
    with log.open("w") as errors:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
    try:
        assert process.stdout is not None
        address = json.loads(process.stdout.readline() or "{}")
        assert address, log.read_text()
        yield Served(address["address"].rstrip("/"), root, process, log)
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
        finally:
            if process.stdout is not None:
                process.stdout.close()
    assert process.returncode == 0, log.read_text()[-4000:]
