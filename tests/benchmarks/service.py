"""A service under load: clients that ask, read, download and look at a job, all at the same time.

It starts a server on a free port with a folder of its own, has a database built there, and then
lets every client send one request after the other, with a pause between them as a page or a script
has one. ``--builds`` queues so many builds meanwhile. Latency is measured from the first byte that
is sent to the last that has arrived, with a new connection only where the server closed the last.

    python tests/benchmarks/service.py --seconds 60 --clients 50 --builds 4
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import random
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "builders"))

from rows import Options, Rows, ended, need
from served import Served, serve

from starcat.client import Client

SPEC = """
name = "load-{number}"
version = "1.0.0"
epoch_jyear = 2026.0
catalog.source = "{source}"
selection.faint_limit_mag = 6.0
camera = {{ width_px = 512, height_px = 512, fov_x_deg = 20.0 }}
boresights.count = 800
self_test = {{ frames = 20, min_identified = 0.5 }}
"""

CONE = "SELECT designation, ra_deg, dec_deg, mag FROM cone({ra:.4f}, {dec:.4f}, 5) ORDER BY mag"

MAX_MS = {"query": 500.0, "manifest": 50.0, "file": 50.0, "status": 50.0}
"""What 99 of 100 requests may take at most."""


@dataclass
class Found:
    """What the clients measured.

    Attributes
    ----------
    took_ms : dict of str to list of float
        By kind of request.
    errors : list of str
        What was not as it should be.
    """

    took_ms: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in MAX_MS})
    errors: list[str] = field(default_factory=list)


class Connection:
    """A connection that is kept; HTTP/1.1 with nothing that costs time.

    Parameters
    ----------
    address : str
        Of the server.
    """

    def __init__(self, address: str) -> None:
        parts = urlsplit(address)
        self._host, self._port = parts.hostname or "", parts.port or 80
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def ask(self, method: str, path: str, body: bytes = b"") -> tuple[int, bytes]:
        """Send a request, and return status and content of the answer."""
        if self._streams is None:
            self._streams = await asyncio.open_connection(self._host, self._port)
        reader, writer = self._streams
        head = (
            f"{method} {path} HTTP/1.1\r\nHost: {self._host}:{self._port}\r\n"
            f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
        )
        writer.write(head.encode() + body)
        lines = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").split("\r\n")
        headers = dict(line.lower().split(": ", 1) for line in lines[1:] if line)
        content = await reader.readexactly(int(headers.get("content-length", 0)))
        if headers.get("connection") == "close":
            self.close()
        return int(lines[0].split()[1]), content

    def close(self) -> None:
        """Close it; the next request opens another."""
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None


@dataclass(frozen=True)
class Load:
    """What the clients do.

    Attributes
    ----------
    served : Served
        The server.
    database, job : str
        Ids of the database, and of the job that built it.
    files : list of (str, str)
        Paths and digests of its files.
    pause_s : float
        Mean pause between two requests of a client.
    ends_at : float
        When, by the clock of `time.monotonic`.
    """

    served: Served
    database: str
    job: str
    files: list[tuple[str, str]]
    pause_s: float
    ends_at: float

    async def client(self, number: int, found: Found) -> None:
        """Be one client."""
        draw = random.Random(number)
        connection = Connection(self.served.address)
        kinds = list(MAX_MS)
        await asyncio.sleep(draw.uniform(0.0, self.pause_s))
        while time.monotonic() < self.ends_at:
            kind = draw.choice(kinds)
            began = time.perf_counter()
            try:
                told = await self._one(kind, draw, connection)
            except (OSError, EOFError, ValueError) as error:
                told = f"{type(error).__name__}: {error}"
                connection.close()
            found.took_ms[kind].append(1e3 * (time.perf_counter() - began))
            if told:
                found.errors.append(f"{kind}: {told}")
            await asyncio.sleep(draw.uniform(0.0, 2.0 * self.pause_s))
        connection.close()

    async def _one(self, kind: str, draw: random.Random, connection: Connection) -> str:
        """Do one request, and return what is wrong with the answer."""
        where = f"/api/v1/databases/{self.database}"
        if kind == "query":
            dec = float(np.degrees(np.arcsin(draw.uniform(-1.0, 1.0))))
            text = CONE.format(ra=draw.uniform(0.0, 360.0), dec=dec)
            asked = json.dumps({"targets": [self.database], "query": text}).encode()
            status, content = await connection.ask("POST", "/api/v1/sql", asked)
            return (
                "" if status == 200 and "rows" in json.loads(content) else f"{status} {content!r}"
            )
        if kind == "file":
            name, digest = draw.choice(self.files)
            status, content = await connection.ask("GET", f"{where}/files/{name}")
            is_right = status == 200 and hashlib.sha256(content).hexdigest() == digest
            return "" if is_right else f"{status} {name}"
        path = f"{where}/manifest" if kind == "manifest" else f"/api/v1/jobs/{self.job}"
        status, content = await connection.ask("GET", path)
        return "" if status == 200 and json.loads(content) else f"{status} {content!r}"


async def run(load: Load, clients: int, meanwhile: Callable[[], Awaitable[None]]) -> Found:
    """Let the clients do what they do.

    Parameters
    ----------
    load : Load
        What they do.
    clients : int
        How many.
    meanwhile : coroutine function
        What happens beside them.

    Returns
    -------
    Found
        What they measured.
    """
    found = Found()
    await asyncio.gather(*(load.client(number, found) for number in range(clients)), meanwhile())
    return found


def memory_mib(process: int) -> float:
    """Return the memory of a process and of those that it started, each page counted once."""
    total = 0.0
    for one in family(process):
        with suppress(OSError):
            lines = Path(f"/proc/{one}/smaps_rollup").read_text().splitlines()
            total += next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total / 1024


def family(process: int) -> Iterator[int]:
    """Give a process and all that descend from it."""
    yield process
    for path in Path(f"/proc/{process}/task").glob("*/children"):
        with suppress(OSError):
            for child in map(int, path.read_text().split()):
                yield from family(child)


def report(rows: Rows, found: Found, seconds: float, *, is_quick: bool) -> None:
    """Print what was measured; the quick form judges no times."""
    print(f"{'kind':10} {'requests':>9} {'a second':>9} {'p50 ms':>8} {'p99 ms':>8} {'worst':>8}")
    for kind, took in found.took_ms.items():
        half, most, worst = np.percentile(took, [50, 99, 100]) if took else (0.0, 0.0, 0.0)
        is_fast = is_quick or most <= MAX_MS[kind]
        rows.expect(is_fast, f"{kind}: 99 % in {most:.0f} ms, asked {MAX_MS[kind]:g} ms")
        rows.expect(len(took) > 0, f"{kind}: no request was sent")
        rate = len(took) / seconds
        print(f"{kind:10} {len(took):9} {rate:9.1f} {half:8.1f} {most:8.1f} {worst:8.1f}")
    print(f"errors: {len(found.errors)}")
    rows.failed.extend(found.errors)


def main(rows: Rows) -> None:
    """Run the load and print what it gave."""
    need("fastapi", "uvicorn", "jinja2")
    options = Options(__doc__)
    options.size("--seconds", 60.0, 3.0, "of load")
    options.size("--clients", 50, 5, "at the same time")
    options.size("--pause-s", 0.5, 0.1, "between two requests, mean")
    options.size("--builds", 0, 1, "builds that are queued meanwhile")
    options.add_argument("--source", default="gaia", help="catalog that databases are built from")
    options.add_argument(
        "--largest-mib", type=float, default=1.0, help="files of this size at most"
    )
    given = options.asked()
    limits = {"requests_per_minute": 10_000_000, "anonymous": "publisher", "jobs_waiting": 100}
    with (
        tempfile.TemporaryDirectory(prefix="starcat-load-") as home,
        serve(Path(home) / "root", Path(home) / "log", **limits) as served,
    ):
        client = Client(served.address)
        job = client.build(SPEC.format(number=0, source=given.source))
        database = job["result"]["database"]
        listed = client.files(database)
        most = given.largest_mib * 2**20
        files = [(one["path"], one["sha256"]) for one in listed if one["bytes"] <= most]
        client.sql([database], CONE.format(ra=0, dec=0))
        queued: list[str] = []

        async def meanwhile() -> None:
            for number in range(1, given.builds + 1):
                spec = SPEC.format(number=number, source=given.source)
                queued.append(await asyncio.to_thread(client.submit, spec))

        before = memory_mib(served.process.pid)
        ends_at = time.monotonic() + given.seconds
        load = Load(served, database, job["id"], files, given.pause_s, ends_at)
        report(
            rows,
            asyncio.run(run(load, given.clients, meanwhile)),
            given.seconds,
            is_quick=given.quick,
        )
        for one in queued:
            state = client.wait(one)["state"]
            print(f"build {one}: {state}")
            rows.expect(state == "done", f"build {one}: {state}")
        after = memory_mib(served.process.pid)
        print(f"memory of the server and its processes: {before:.0f} MiB before, {after:.0f} after")


if __name__ == "__main__":
    ended(main)
