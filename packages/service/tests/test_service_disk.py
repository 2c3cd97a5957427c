"""Disk space: no reader takes what is to be left free, and results of TAP have a quota."""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
import tarfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from services import DATABASE, OTHER, add_database, client_of, until

from starcat.errors import TargetMissing
from starcat_service.api.databases import archive
from starcat_service.quota import folder_bytes
from starcat_service.security.request_limits import GIB

PAIRS = "SELECT a.i AS i, b.j AS j FROM small.pairs AS a, small.pairs AS b"


def run(client: TestClient, query: str, **more: str) -> str:
    """Have a query answered asynchronously; return the id of its job."""
    parameters = {"QUERY": query, "PHASE": "RUN", "RESPONSEFORMAT": "csv", **more}
    answer = client.post("/tap/async", data=parameters, follow_redirects=False)
    assert answer.status_code == 303, answer.text
    job = answer.headers["location"].rpartition("/")[2]
    until(lambda: client.get(f"/tap/async/{job}/phase").text not in ("QUEUED", "EXECUTING"))
    return job


def phase_of(client: TestClient, job: str) -> str:
    answer = client.get(f"/tap/async/{job}/phase")
    return answer.text if answer.status_code == 200 else "gone"


def at(client: TestClient, address: str) -> TestClient:
    return TestClient(client.app, base_url=client.base_url, client=(address, 50_000))


def test_results_of_tap_have_a_quota_and_the_oldest_go_first(own_root: Path) -> None:
    query = f"SELECT TOP 20000 * FROM ({PAIRS}) AS t"
    with client_of(own_root) as client:
        jobs = client.app.state.service.query_jobs
        job = run(client, query)
        size = folder_bytes(jobs.folder(job))
        jobs.delete(job)
    with client_of(own_root, disk_gib=2.7 * size / GIB) as client:
        other, mine = (at(client, f"192.0.2.{number}") for number in (1, 2))
        kept = run(other, "SELECT TOP 3 i, j FROM small.pairs")
        jobs_of_mine = [run(mine, query) for _ in range(4)]
        assert [phase_of(mine, job) for job in jobs_of_mine] == [
            "gone",
            "gone",
            "COMPLETED",
            "COMPLETED",
        ]
        assert phase_of(other, kept) == "COMPLETED", "others keep theirs"
        large = run(mine, query.replace("20000", "80000"))
        assert phase_of(mine, large) == "ERROR"
        assert "(disk_gib); ask for less" in mine.get(f"/tap/async/{large}/error").text


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 120 MiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=120m", "tmpfs", str(folder)]
    if sys.platform != "linux" or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("a disk can be mounted by root of Linux only")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


FREE_GIB = 0.02
SLACK_BYTES = 3 << 20
"""What else is written: records, logs, and a part of each answer in progress."""

LARGE = {"targets": [DATABASE], "query": "SELECT * FROM pairs a, pairs b", "max_rows": 10_000_000}


def attacks(client: TestClient) -> list[Callable[[], object]]:
    """Return ways to fill the disk, one of a reader each."""
    csv = {**LARGE, "format": "csv"}
    sort = f"SELECT * FROM ({PAIRS}) AS t ORDER BY j, i"
    picture = ("frame.png", b"\x89PNG\r\n\x1a\n" + bytes(8 << 20))
    return [
        *[lambda k=k: run(at(client, f"192.0.2.{k}"), PAIRS, MAXREC="10000000") for k in range(4)],
        lambda: client.post("/api/v1/sql", json=csv),
        lambda: client.get("/tap/sync", params={"QUERY": PAIRS, "MAXREC": "10000000"}),
        lambda: client.get("/tap/sync", params={"QUERY": sort, "MAXREC": "10000000"}),
        lambda: client.post(f"/api/v1/identify/{DATABASE}", files={"file": picture}),
        lambda: client.post("/api/v1/releases", json={"database": OTHER}),
    ]


def tried(attack: Callable[[], object]) -> None:
    with suppress(Exception):  # an answer is broken off
        attack()


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_no_request_takes_the_space_that_is_to_be_left_free(
    disk: Path, small_database: Path, database_version: Callable[[str], Path]
) -> None:
    root = disk / "root"
    add_database(root, small_database)
    add_database(root, database_version("1.1.0"), OTHER)
    least = [shutil.disk_usage(disk).free]
    is_over = threading.Event()

    def watch() -> None:
        while not is_over.is_set():
            least.append(shutil.disk_usage(disk).free)
            time.sleep(0.002)

    settings = {"free_gib": FREE_GIB, "anonymous": "publisher", "query_time_s": 60.0}
    with client_of(root, **settings) as client:
        watching = threading.Thread(target=watch)
        watching.start()
        try:
            for _ in range(2):
                threads = [
                    threading.Thread(target=tried, args=(attack,)) for attack in attacks(client)
                ]
                for thread in threads:
                    thread.start()
                for thread in threads:
                    thread.join()
        finally:
            is_over.set()
            watching.join()
        free_bytes = FREE_GIB * GIB
        sys.stdout.write(f"least free: {min(least) / 1e6:.1f} MB of {free_bytes / 1e6:.1f} MB\n")
        assert free_bytes - SLACK_BYTES < min(least) < 1.5 * free_bytes, "it was tried"
        assert client.get(f"/api/v1/databases/{DATABASE}").status_code == 200


def test_publishing_leaves_the_space_that_is_to_be_left_free(
    own_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with client_of(own_root, anonymous="publisher") as client:
        size = client.app.state.service.library.database(DATABASE).manifest["files"]
        total = sum(int(facts["bytes"]) for facts in size.values())
        limits = "starcat_service.security.request_limits.free_gib"
        monkeypatch.setattr(limits, lambda _: 1.0 + 0.9 * total / GIB)
        refused = client.post("/api/v1/releases", json={"database": DATABASE})
        assert refused.status_code == 507, refused.text
        assert "are wanted, and 1 have to be left (free_gib)" in refused.text
        assert not (own_root / "registry" / "index.json").exists()
        monkeypatch.setattr(limits, lambda _: 1.0 + 2.0 * total / GIB)
        assert client.post("/api/v1/releases", json={"database": DATABASE}).status_code == 201
        monkeypatch.setattr(limits, lambda _: 0.5)
        again = client.post("/api/v1/releases", json={"database": DATABASE})
        assert again.status_code == 200, "nothing is written"


# Removal during use.


def test_a_download_that_has_begun_outlasts_the_removal(own_root: Path) -> None:
    with client_of(own_root, anonymous="publisher") as client:
        service = client.app.state.service
        whole = client.get(f"/api/v1/databases/{DATABASE}/archive").content
        begun: Any = archive(DATABASE, service, None)
        assert client.delete(f"/api/v1/databases/{DATABASE}").status_code == 204
        chunks: list[bytes] = []

        async def read() -> None:
            chunks.extend([chunk async for chunk in begun.body_iterator])

        client.portal.call(read)
        assert b"".join(chunks) == whole
        with tarfile.open(fileobj=io.BytesIO(whole)) as tar:
            assert tar.getnames()
        begun.body_iterator = None
        assert not list((own_root / "scratch").glob("links-*"))
        assert client.get(f"/api/v1/databases/{DATABASE}/archive").status_code == 404


def test_a_query_whose_database_is_removed_says_so(own_root: Path) -> None:
    with client_of(own_root, anonymous="publisher") as client:
        service = client.app.state.service
        folder = service.library.database(DATABASE).folder
        pool = service.query_pool

        def ask() -> None:
            with pool.session([folder]) as session:
                folder.rename(own_root / "gone")
                with session.ask("SELECT sum(i) FROM pairs") as running:
                    running.rows(1)

        with pytest.raises(TargetMissing, match=r"small.*: removed while the query ran"):
            ask()
