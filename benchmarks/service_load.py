"""The memory and the latencies of a service that many people use at the same time.

It starts a server on a folder of its own, has a small database built there, and then lets clients
look at pages, ask SQL and ADQL and estimate specs, each at an address of its own and with a pause
after each request. Two greedy clients send eight cross joins each at the same time, and one more
database is built. Some estimates are for another epoch than all before, so that the catalog is
read again. Printed are the latencies by kind of request, and the largest memory of the server
process (RSS), and of its child processes together (PSS). Expected is a server process below 600 MB.

    python benchmarks/service_load.py --seconds 60 --clients 50
"""

from __future__ import annotations

import asyncio
import json
import os
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "builders"))

from rows import Options, Rows, ended, need
from served import Served, serve
from service import CONE, NEAR, SPEC, Connection, family

from starcat.client import Client

MAX_SERVER_MB = 600.0
"""Memory that the server process may take, megabytes."""

CROSS_JOIN = "SELECT a.i, b.j FROM pairs a, pairs b ORDER BY a.i * b.j"
JOINS_AT_ONCE = 8
LOOK_S = 0.2
EPOCHS = 25
"""Epochs that estimates are made for; the catalog is read once for each."""

WEIGHTS = {"healthz": 12, "read": 54, "sql": 17, "tap": 15, "estimate": 6}
"""How often each kind of request is made."""


@dataclass
class Figures:
    """The measured values."""

    took_ms: dict[str, list[float]] = field(default_factory=lambda: {kind: [] for kind in WEIGHTS})
    errors: Counter[str] = field(default_factory=Counter)
    greedy: Counter[int] = field(default_factory=Counter)  # answers to greedy clients, by status
    server_mb: float = 0.0  # largest memory of the server process
    children_mb: float = 0.0  # largest memory of its child processes together


def resident_mb(process: int) -> float:
    """Return the memory of a process in megabytes; 0 if it has ended."""
    with suppress(OSError, StopIteration):
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) / 1000
    return 0.0


def proportional_mb(process: int) -> float:
    """Return the memory of a process in megabytes; pages that processes share are divided."""
    with suppress(OSError, StopIteration):
        lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("Pss:")) / 1000
    return 0.0


async def watch_memory(process: int, until_s: float, figures: Figures) -> None:
    """Note the largest memory of a process and of its children."""
    while time.monotonic() < until_s:
        server, *children = family(process)
        figures.server_mb = max(figures.server_mb, resident_mb(server))
        figures.children_mb = max(figures.children_mb, sum(map(proportional_mb, children)))
        await asyncio.sleep(LOOK_S)


@dataclass(frozen=True)
class Crowd:
    """Clients of a server."""

    served: Served
    database: str  # id of a database
    until_s: float  # when they stop, by `time.monotonic`
    figures: Figures

    async def person(self, number: int) -> None:
        """Send one request after the other, with pauses of 0.3 to 1.2 s."""
        draw = random.Random(number)
        connection = Connection(self.served.address, f"127.0.2.{number + 1}")
        await asyncio.sleep(draw.uniform(0.0, 1.2))
        while time.monotonic() < self.until_s:
            [kind] = draw.choices(list(WEIGHTS), list(WEIGHTS.values()))
            method, path, body = self.request(kind, draw)
            began_s = time.perf_counter()
            try:
                status, _ = await connection.ask(method, path, body)
                if status != 200:
                    self.figures.errors[f"{kind}: {status}"] += 1
            except (OSError, EOFError, ValueError) as error:
                self.figures.errors[f"{kind}: {type(error).__name__}"] += 1
                connection.close()
            self.figures.took_ms[kind].append(1e3 * (time.perf_counter() - began_s))
            await asyncio.sleep(draw.uniform(0.3, 1.2))
        connection.close()

    def request(self, kind: str, draw: random.Random) -> tuple[str, str, bytes]:
        """Return method, path and body of a request."""
        database_path, ra = f"/databases/{self.database}", draw.uniform(0.0, 360.0)
        dec = float(np.degrees(np.arcsin(draw.uniform(-1.0, 1.0))))
        if kind == "healthz":
            return "GET", "/healthz", b""
        if kind == "sql":
            asked = {"targets": [self.database], "query": CONE.format(ra=ra, dec=dec)}
            return "POST", "/api/v1/sql", json.dumps(asked).encode()
        if kind == "tap":
            # The schema is named because tables of two databases have the same names.
            query = NEAR.replace("FROM stars", "FROM load_0.stars").format(ra, dec)
            return "GET", f"/tap/sync?QUERY={quote(query)}", b""
        if kind == "estimate":
            changes = {"selection.faint_limit_mag": f"{draw.uniform(5.0, 6.0):.2f}"}
            if draw.random() < 0.5:
                changes["epoch_jyear"] = str(2016.0 + draw.randrange(EPOCHS))
            asked = {"preset": "gaia-12deg", "changes": changes}
            return "POST", "/api/v1/specs/estimate", json.dumps(asked).encode()
        pages = (
            "/",
            "/databases",
            database_path,
            f"/api/v1{database_path}",
            "/new",
            f"/api/v1{database_path}/manifest",
        )
        return "GET", draw.choice(pages), b""

    async def greedy(self, number: int) -> None:
        """Send cross joins, several at the same time and without a pause."""
        await asyncio.gather(*(self._joins(number) for _ in range(JOINS_AT_ONCE)))

    async def _joins(self, number: int) -> None:
        connection = Connection(self.served.address, f"127.0.3.{number + 1}")
        body = json.dumps({"targets": [self.database], "query": CROSS_JOIN}).encode()
        with suppress(TimeoutError, OSError, EOFError):
            while (left_s := self.until_s - time.monotonic()) > 0:
                asked = connection.ask("POST", "/api/v1/sql", body)
                status, _ = await asyncio.wait_for(asked, left_s)
                self.figures.greedy[status] += 1
        connection.close()


async def load(crowd: Crowd, people: int, greedy: int, client: Client, source: str) -> str:
    """Let all clients do their work, have a database built meanwhile, and return its job."""

    async def build() -> str:
        return await asyncio.to_thread(client.submit, SPEC.format(number=1, source=source))

    job, *_ = await asyncio.gather(
        build(),
        watch_memory(crowd.served.process.pid, crowd.until_s, crowd.figures),
        *map(crowd.person, range(people)),
        *map(crowd.greedy, range(greedy)),
    )
    return job


def table(took_ms: dict[str, list[float]]) -> Sequence[str]:
    """Return the latencies by kind of request as lines of a table."""
    lines = [f"{'kind':10} {'requests':>9} {'p50 ms':>9} {'p99 ms':>9} {'worst ms':>9}"]
    for kind, took in took_ms.items():
        half, most, worst = np.percentile(took, [50, 99, 100]) if took else (0.0, 0.0, 0.0)
        lines.append(f"{kind:10} {len(took):9} {half:9.0f} {most:9.0f} {worst:9.0f}")
    return lines


def main(rows: Rows) -> None:
    """Run the load and print what was measured."""
    need("fastapi", "uvicorn", "jinja2")
    options = Options(__doc__)
    options.size("--seconds", 60.0, 3.0, "of load")
    options.size("--clients", 50, 5, "at the same time")
    options.size("--greedy", 2, 1, "clients that send cross joins")
    options.size("--rounds", 1, 1, "times that the load is repeated on the same server")
    options.add_argument("--source", default="gaia", help="catalog that databases are built from")
    arguments = options.asked()
    limits = {"requests_per_minute": 10_000_000, "anonymous": "publisher", "jobs_waiting": 100}
    with (
        tempfile.TemporaryDirectory(prefix="starcat-load-") as home,
        serve(Path(home) / "root", Path(home) / "log", **limits) as served,
    ):
        client = Client(served.address)
        print(f"server process after its start: {resident_mb(served.process.pid):.0f} MB")
        database = client.build(SPEC.format(number=0, source=arguments.source))["result"][
            "database"
        ]
        print(f"server process before the load: {resident_mb(served.process.pid):.0f} MB")
        for _ in range(arguments.rounds):
            figures = Figures()
            crowd = Crowd(served, database, time.monotonic() + arguments.seconds, figures)
            job = asyncio.run(
                load(crowd, arguments.clients, arguments.greedy, client, arguments.source)
            )
            print("\n".join(table(figures.took_ms)))
            print(f"answers to greedy clients, by status: {dict(figures.greedy)}")
            print(f"errors: {dict(figures.errors)}; load of the machine: {os.getloadavg()[0]:.1f}")
            after_mb = resident_mb(served.process.pid)
            print(
                f"largest memory: server process {figures.server_mb:.0f} MB (then {after_mb:.0f}), "
                f"its child processes {figures.children_mb:.0f} MB"
            )
            rows.expect(
                arguments.quick or figures.server_mb <= MAX_SERVER_MB,
                f"the server process took {figures.server_mb:.0f} MB, expected {MAX_SERVER_MB:g}",
            )
            # Catalogs for other epochs are read in sequence; a request that waits too long gets
            # status 503 and has to be repeated.
            rows.failed.extend(sorted(set(figures.errors) - {"estimate: 503"}))
            state = client.wait(job)["state"]
            rows.expect(state == "done", f"build {job}: {state}")


if __name__ == "__main__":
    ended(main)
