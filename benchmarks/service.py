"""A service under load: clients that ask, read, download and look at a job, all at the same time.

It starts a server on a free port with its own folder, has a database built there, and then lets
every client send requests in sequence, with a pause between them like a page or a script. Each
client has its own address, which counts as one user of the service, or all share one address
(``--one-address``). ``--builds`` queues this many builds meanwhile. ``--greedy`` clients send
queries without end, several at a time and without a pause. Latency is measured from the first byte
sent to the last byte received, with a new connection only if the server closed the previous
connection.

    python benchmarks/service.py --seconds 60 --clients 50 --builds 4
    python benchmarks/service.py --warm-s 15 --clients 48 --greedy 2 --pause-s 2
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote, urlsplit

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "builders"))

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

NEAR = "SELECT TOP 100 * FROM stars WHERE 1 = CONTAINS(POINT(ra_deg, dec_deg), CIRCLE({}, {}, 5))"

ENDLESS = (
    "SELECT sum(a.i * b.j + c.i) FROM pairs a, pairs b, pairs c",
    "SELECT sleep_ms(25000)",
    "WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM r) SELECT max(n) FROM r",
    "SELECT a.i, b.j FROM pairs a, pairs b ORDER BY a.i * b.j",
)
"""What greedy clients ask."""

AT_ONCE = 3
"""How many of them a greedy client has on the way."""

MAX_MS = {
    "query": 500.0, "tap": 500.0, "cone": 500.0, "manifest": 50.0, "file": 50.0, "status": 50.0,
}  # fmt: skip
"""Limits for 99 of 100 requests; requests without a query are judged without greedy clients."""


@dataclass
class Figures:
    """What the clients measured.

    Attributes
    ----------
    took_ms : dict of str to list of float
        By kind of request.
    errors : list of str
        What was not as it should be.
    greedy : Counter of int
        Statuses of the answers to greedy clients.
    """

    took_ms: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in MAX_MS})
    errors: list[str] = field(default_factory=list)
    greedy: Counter[int] = field(default_factory=Counter)


class Connection:
    """A connection that is kept; HTTP/1.1 with nothing that costs time.

    Parameters
    ----------
    address : str
        Of the server.
    local_ip : str
        Of the client.
    """

    def __init__(self, address: str, local_ip: str = "127.0.0.1") -> None:
        parts = urlsplit(address)
        self._local_ip = local_ip
        self._host, self._port = parts.hostname or "", parts.port or 80
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def ask(self, method: str, path: str, body: bytes = b"") -> tuple[int, bytes]:
        """Send a request, and return status and content of the answer."""
        if self._streams is None:
            self._streams = await asyncio.open_connection(
                self._host, self._port, local_addr=(self._local_ip, 0)
            )
        reader, writer = self._streams
        head = (
            f"{method} {path} HTTP/1.1\r\nHost: {self._host}:{self._port}\r\n"
            f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
        )
        writer.write(head.encode() + body)
        lines = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").split("\r\n")
        headers = dict(line.lower().split(": ", 1) for line in lines[1:] if line)
        content = b""
        if headers.get("transfer-encoding") == "chunked":
            while size := int(await reader.readline(), 16):
                content += (await reader.readexactly(size + 2))[:-2]
            await reader.readline()
        else:
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
    begins_at, ends_at : float
        From when on times are noted, and until when; by the clock of `time.monotonic`.
    is_one_address : bool
        Whether all clients have the same address.
    """

    served: Served
    database: str
    job: str
    files: list[tuple[str, str]]
    pause_s: float
    begins_at: float
    ends_at: float
    is_one_address: bool = False

    async def client(self, number: int, figures: Figures) -> None:
        """Be one client."""
        draw = random.Random(number)
        connection = Connection(self.served.address, self.address(number))
        kinds = list(MAX_MS)
        await asyncio.sleep(draw.uniform(0.0, self.pause_s))
        while time.monotonic() < self.ends_at:
            kind = draw.choice(kinds)
            began = time.perf_counter()
            try:
                problem = await self._send(kind, draw, connection)
            except (OSError, EOFError, ValueError) as error:
                problem = f"{type(error).__name__}: {error}"
                connection.close()
            if time.monotonic() > self.begins_at:
                figures.took_ms[kind].append(1e3 * (time.perf_counter() - began))
            if problem:
                figures.errors.append(f"{kind}: {problem}")
            await asyncio.sleep(draw.uniform(0.0, 2.0 * self.pause_s))
        connection.close()

    def address(self, number: int) -> str:
        """Return the address of a client."""
        return "127.0.0.1" if self.is_one_address else f"127.0.1.{number + 1}"

    async def greedy(self, number: int, figures: Figures) -> None:
        """Be a client that asks for all it can get."""
        local_ip = self.address(number)
        await asyncio.gather(*(self._greed(first, local_ip, figures) for first in range(AT_ONCE)))

    async def _greed(self, number: int, local_ip: str, figures: Figures) -> None:
        connection = Connection(self.served.address, local_ip)
        with suppress(TimeoutError):
            while (remaining_s := self.ends_at - time.monotonic()) > 0:
                body = {"targets": [self.database], "query": ENDLESS[number % len(ENDLESS)]}
                asked = connection.ask("POST", "/api/v1/sql", json.dumps(body).encode())
                status, content = await asyncio.wait_for(asked, remaining_s)
                figures.greedy[status] += 1
                if status >= 500:
                    figures.errors.append(f"greedy: {status} {content!r}")
                number += 1
        connection.close()

    async def _send(self, kind: str, draw: random.Random, connection: Connection) -> str:
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
        if kind in ("tap", "cone"):
            ra, sine = draw.uniform(0.0, 360.0), draw.uniform(-1.0, 1.0)
            dec = float(np.degrees(np.arcsin(sine)))
            path = f"/scs/{self.database}?RA={ra:.4f}&DEC={dec:.4f}&SR=5"
            if kind == "tap":
                path = f"/tap/sync?QUERY={quote(NEAR.format(round(ra, 4), round(dec, 4)))}"
            status, content = await connection.ask("GET", path)
            is_whole = b"</VOTABLE>" in content and b'value="ERROR"' not in content
            return "" if status == 200 and is_whole else f"{status} {content[:200]!r}"
        if kind == "file":
            name, digest = draw.choice(self.files)
            status, content = await connection.ask("GET", f"{where}/files/{name}")
            is_right = status == 200 and hashlib.sha256(content).hexdigest() == digest
            return "" if is_right else f"{status} {name}"
        path = f"{where}/manifest" if kind == "manifest" else f"/api/v1/jobs/{self.job}"
        status, content = await connection.ask("GET", path)
        return "" if status == 200 and json.loads(content) else f"{status} {content!r}"


async def run(
    load: Load, clients: int, greedy: int, meanwhile: Callable[[], Awaitable[None]]
) -> Figures:
    """Let the clients do what they do.

    Parameters
    ----------
    load : Load
        What they do.
    clients : int
        How many.
    greedy : int
        How many more that are greedy.
    meanwhile : coroutine function
        What happens beside them.

    Returns
    -------
    Figures
        What they measured.
    """
    figures = Figures()
    await asyncio.gather(
        *(load.client(number, figures) for number in range(clients)),
        *(load.greedy(clients + number, figures) for number in range(greedy)),
        meanwhile(),
    )
    return figures


def memory_mib(process: int) -> float:
    """Return the memory of a process and of its child processes, each page counted once."""
    total = 0.0
    for number in family(process):
        with suppress(OSError):
            lines = Path(f"/proc/{number}/smaps_rollup").read_text().splitlines()
            total += next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total / 1024


def family(process: int) -> Iterator[int]:
    """Give a process and all that descend from it."""
    yield process
    for path in Path(f"/proc/{process}/task").glob("*/children"):
        with suppress(OSError):
            for child in map(int, path.read_text().split()):
                yield from family(child)


def report(
    rows: Rows, figures: Figures, seconds: float, *, is_quick: bool, has_greedy: bool = False
) -> None:
    """Print what was measured; the quick form judges no times."""
    print(f"{'kind':10} {'requests':>9} {'a second':>9} {'p50 ms':>8} {'p99 ms':>8} {'worst':>8}")
    for kind, took in figures.took_ms.items():
        half, most, worst = np.percentile(took, [50, 99, 100]) if took else (0.0, 0.0, 0.0)
        is_fast = is_quick or most <= (500.0 if has_greedy else MAX_MS[kind])
        rows.expect(is_fast, f"{kind}: 99 % took {most:.0f} ms, which is too long")
        rows.expect(is_quick or len(took) > 0, f"{kind}: no request was sent")
        rate = len(took) / seconds
        print(f"{kind:10} {len(took):9} {rate:9.1f} {half:8.1f} {most:8.1f} {worst:8.1f}")
    print(f"errors: {len(figures.errors)}; load of the machine: {os.getloadavg()[0]:.1f}")
    if has_greedy:
        print(f"answers to greedy clients, by status: {dict(figures.greedy)}")
    rows.failed.extend(figures.errors)


def main(rows: Rows) -> None:
    """Run the load and print what it gave."""
    need("fastapi", "uvicorn", "jinja2")
    options = Options(__doc__)
    options.size("--seconds", 60.0, 3.0, "of load")
    options.size("--warm-s", 5.0, 2.0, "of load before times are noted: processes are started")
    options.size("--clients", 50, 5, "at the same time")
    options.size("--pause-s", 0.5, 0.1, "between two requests, mean")
    options.size("--builds", 0, 1, "builds that are queued meanwhile")
    options.size("--greedy", 0, 2, "clients that ask what has no end")
    options.add_argument("--one-address", action="store_true", help="of all, greedy or not")
    options.add_argument("--source", default="gaia", help="catalog that databases are built from")
    options.add_argument(
        "--largest-mib", type=float, default=1.0, help="files of this size at most"
    )
    arguments = options.asked()
    limits = {"requests_per_minute": 10_000_000, "anonymous": "publisher", "jobs_waiting": 100}
    with (
        tempfile.TemporaryDirectory(prefix="starcat-load-") as home,
        serve(Path(home) / "root", Path(home) / "log", **limits) as served,
    ):
        client = Client(served.address)
        job = client.build(SPEC.format(number=0, source=arguments.source))
        database = job["result"]["database"]
        listed = client.files(database)
        most = arguments.largest_mib * 2**20
        files = [(file["path"], file["sha256"]) for file in listed if file["bytes"] <= most]
        client.sql([database], CONE.format(ra=0, dec=0))
        queued: list[str] = []

        async def meanwhile() -> None:
            for number in range(1, arguments.builds + 1):
                spec = SPEC.format(number=number, source=arguments.source)
                queued.append(await asyncio.to_thread(client.submit, spec))

        before = memory_mib(served.process.pid)
        begins_at = time.monotonic() + arguments.warm_s
        ends_at = begins_at + arguments.seconds
        load = Load(
            served,
            database,
            job["id"],
            files,
            arguments.pause_s,
            begins_at,
            ends_at,
            arguments.one_address,
        )
        figures = asyncio.run(run(load, arguments.clients, arguments.greedy, meanwhile))
        report(
            rows,
            figures,
            arguments.seconds,
            is_quick=arguments.quick,
            has_greedy=arguments.greedy > 0,
        )
        for queued_id in queued:
            state = client.wait(queued_id)["state"]
            print(f"build {queued_id}: {state}")
            rows.expect(state == "done", f"build {queued_id}: {state}")
        after = memory_mib(served.process.pid)
        print(f"memory of the server and its processes: {before:.0f} MiB before, {after:.0f} after")


if __name__ == "__main__":
    ended(main)
