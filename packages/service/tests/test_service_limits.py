"""Limits of a service: sizes of answers, temporary files, its memory, and visibility of jobs."""

from __future__ import annotations

import errno
import io
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from astropy.table import Table
from cachetools import TTLCache
from fastapi.testclient import TestClient
from services import DATABASE, LOCAL, add_database, client_of

from starcat.errors import OutputError
from starcat.query.session import ABANDONED_S, SCRATCH_PREFIX, open_session
from starcat.releases import publishing
from starcat.releases.publishing import publish_artifact
from starcat.specs.reading import preset
from starcat.workers.messages import ERROR, HEAD, MalformedMessage, error_content, json_content
from starcat.workers.process import WorkerProcess
from starcat_service.api.nova import Solution, Solutions
from starcat_service.catalogs import Catalogs
from starcat_service.estimates import ChildCatalogs
from starcat_service.problems import Problem
from starcat_service.removal import remove_old
from starcat_service.security.request_limits import Buckets
from starcat_service.security.tokens import DAY_S

WIDE = "SELECT repeat('x', 1000) AS v, range AS n FROM range({})"


@pytest.fixture(scope="module")
def client(small_artifact: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    root = tmp_path_factory.mktemp("limits")
    add_database(root, small_artifact)
    with client_of(root, rows_mib=1.0, requests_per_minute=1_000_000) as client:
        yield client


def asked(client: TestClient, query: str, **more: object) -> tuple[int, dict[str, object]]:
    given = {"targets": [DATABASE], "query": query, "max_rows": 100_000, **more}
    answer = client.post("/api/v1/sql", json=given)
    return answer.status_code, answer.json()


# Sizes of answers.


def test_rows_are_limited_in_bytes_and_files_are_not(client):
    assert asked(client, WIDE.format(900))[0] == 200
    # Far above the limit, a little above it, and only above it as JSON is written.
    for query in (WIDE.format(50_000), WIDE.format(1_100), "SELECT repeat('\"', 600000)"):
        status, problem = asked(client, query)
        assert (status, problem["key"]) == (413, "max_rows")
        assert "more than 1 MiB (rows_mib); ask for fewer rows" in str(problem["detail"])
        assert "for a file (format: csv, json, parquet" in str(problem["detail"])
    given = {"targets": [DATABASE], "query": WIDE.format(5_000), "format": "csv"}
    answer = client.post("/api/v1/sql", json=given)
    assert (answer.status_code, answer.headers["x-starcat-rows"]) == (200, "5000")
    assert len(answer.content) > 5_000_000


def test_a_page_says_that_an_answer_is_too_large(client):
    query = "SELECT repeat('x', 2000) FROM range(1000)"
    page = client.get(f"/databases/{DATABASE}/sql", params={"query": query, "rows": 1000})
    assert page.status_code == 413
    assert "more than 1 MiB" in page.text
    assert "</html>" in page.text


def reported(error: Exception) -> tuple[str, bytes]:
    """Return what a worker sends when an error was raised."""
    return ERROR, json_content(error_content(error))


def test_a_format_that_needs_the_table_in_memory_says_which_do_not(client, monkeypatch):
    sandbox = client.app.state.service.sandbox
    monkeypatch.setattr(sandbox, "_answer", lambda worker, request: reported(MemoryError()))
    given = {"targets": [DATABASE], "query": "SELECT 1", "format": "ecsv"}
    answer = client.post("/api/v1/sql", json=given)
    assert answer.status_code == 413
    assert answer.json()["detail"] == (
        "the table takes more memory as ECSV than a request may (1 GiB); choose csv, json, "
        "parquet, votable, which are written row by row, or ask for fewer rows"
    )


@pytest.mark.parametrize(
    "address",
    [
        f"/scs/{DATABASE}?RA=0&DEC=0&SR=180&RESPONSEFORMAT=fits",
        "/tap/sync?QUERY=SELECT TOP 5 * FROM stars&RESPONSEFORMAT=fits",
    ],
)
def test_fits_is_made_outside_of_the_server_process(client, monkeypatch, address):
    sandbox, forms = client.app.state.service.sandbox, []
    convert = sandbox.convert

    def noted(source: Path, target: Path, form: str, *label: object) -> None:
        forms.append(form)
        convert(source, target, form, *label)

    monkeypatch.setattr(sandbox, "convert", noted)
    answer = client.get(address)
    assert answer.status_code == 200
    assert forms == ["fits"]
    assert len(Table.read(io.BytesIO(answer.content), format="fits")) >= 5


def endless() -> None:
    """Write a message that is too long."""
    sys.stdout.buffer.write(HEAD.pack(b"d", 1 << 21))
    sys.stdout.buffer.write(b"x" * (1 << 21))


@pytest.mark.slow
def test_a_worker_that_sends_a_message_without_end_is_not_read(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent)
    worker = WorkerProcess(f"{Path(__file__).stem}:endless", max_bytes=1 << 20)
    with pytest.raises(MalformedMessage, match="at most 1,048,576 are read"):
        worker.receive()
    worker.close()


# Temporary files.


def test_temporary_files_of_queries_are_in_the_root(client):
    service = client.app.state.service
    with service.query_pool.session([service.library.target(DATABASE)]) as session:
        spill = Path(session._engine._opening.spill)
        assert spill.is_relative_to(service.paths.scratch)
        remove_old(service, time.time() + 10 * DAY_S)
        assert spill.is_dir(), "the folder of a session that lives is not old"


def test_what_a_killed_process_left_is_removed_by_the_next_session(small_artifact, tmp_path):
    within = tmp_path / "within"
    within.mkdir()
    program = (
        "import pathlib, sys, time\n"
        "from starcat.query.session import open_session\n"
        f"with open_session([{str(small_artifact)!r}], within=pathlib.Path({str(within)!r})):\n"
        "    print('open', flush=True)\n"
        "    time.sleep(60)\n"
    )
    run = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)
    assert run.stdout is not None
    run.stdout.readline()
    [left] = within.iterdir()
    long_ago = time.time() - 2 * ABANDONED_S
    other, link = within / "other", within / f"{SCRATCH_PREFIX}link"
    other.mkdir()
    link.symlink_to(other)
    os.utime(left, (long_ago, long_ago))
    with open_session([str(small_artifact)], within=within):
        assert left.exists(), "its process lives"
    run.kill()
    run.wait()
    run.stdout.close()
    with open_session([str(small_artifact)], within=within):
        assert not left.exists()
    assert sorted(within.iterdir()) == [other, link]


# Full disks.


def test_a_flight_image_on_a_full_disk_is_reported_as_such(client, monkeypatch):
    """The process of the sandbox reports an OutputError, and that the disk is full."""
    error = OutputError("image.img: cannot be written")
    error.__cause__ = OSError(errno.ENOSPC, "No space left on device")
    sandbox, reply = client.app.state.service.sandbox, reported(error)
    monkeypatch.setattr(sandbox, "_answer", lambda worker, request: reply)
    found = client.get(f"/databases/{DATABASE}/image")
    assert found.status_code == 507


def test_a_publication_that_fails_leaves_no_part(small_artifact, tmp_path, monkeypatch):
    def full(source: Path, blob: object, part: Path) -> None:
        part.write_bytes(b"half of it")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(publishing, "copy_to_part", full)
    with pytest.raises(OutputError):
        publish_artifact(small_artifact, str(tmp_path))
    assert not list(tmp_path.rglob("*.part"))


# Who sees what.


def test_a_query_job_without_a_token_is_seen_by_its_client_only(client):
    other = TestClient(client.app, base_url=LOCAL, client=("192.0.2.7", 4711))
    made = client.post("/tap/async", data={"QUERY": "SELECT 1 FROM stars"}, follow_redirects=False)
    job = made.headers["location"].removeprefix(LOCAL)
    assert job.removeprefix("/tap/async/") in client.get("/tap/async").text
    assert job.removeprefix("/tap/async/") not in other.get("/tap/async").text
    for path in ("", "/phase", "/parameters", "/owner", "/results", "/error"):
        assert other.get(f"{job}{path}").status_code == 404
    for path, data in (
        ("", {"ACTION": "DELETE"}),
        ("/phase", {"PHASE": "ABORT"}),
        ("/parameters", {"QUERY": "SELECT 2"}),
        ("/destruction", {"DESTRUCTION": "2020-01-01T00:00:00Z"}),
        ("/executionduration", {"EXECUTIONDURATION": "1"}),
    ):
        assert other.post(f"{job}{path}", data=data).status_code == 404
    assert other.delete(job).status_code == 404
    asked = {"QUERY": "SELECT * FROM TAP_UPLOAD.t", "UPLOAD": f"t,{LOCAL}{job}/results/result"}
    assert "no job has the id" in other.get("/tap/sync", params=asked).text
    assert client.get(f"{job}/phase").text == "PENDING"
    assert client.delete(job, follow_redirects=False).status_code == 303


# Caches in memory.


class SlowText(str):
    """A key at which another thread is let in."""

    __slots__ = ()

    def __hash__(self) -> int:
        time.sleep(0)
        return str.__hash__(self)


class SlowNumber(int):
    """A key at which another thread is let in."""

    def __hash__(self) -> int:
        time.sleep(0)
        return int.__hash__(self)


def in_threads(work: Callable[[], None]) -> list[Exception]:
    """Run a function in eight threads at the same time; return what they raised."""
    errors: list[Exception] = []

    def run() -> None:
        try:
            work()
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=run) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return errors


def test_results_are_kept_for_many_threads(monkeypatch):
    """Without a lock, a cache that drops entries while others read and write raises KeyError."""
    kept, numbers = Solutions(TTLCache(20, 0.002)), itertools.count()
    monkeypatch.setattr("secrets.randbits", lambda _: SlowNumber(next(numbers)))
    solution = Solution("a.fits", "", {}, "small-1.0.0")

    def work() -> None:
        for _ in range(300):
            kept.get(kept.add(solution))

    assert in_threads(work) == []


def test_buckets_count_what_many_threads_take():
    buckets, waits = Buckets(6000.0, clock=lambda: 0.0), []

    def work() -> None:
        waits.extend(buckets.take(SlowText("a")) for _ in range(1000))

    assert in_threads(work) == []
    assert waits.count(0.0) == 6000


@pytest.mark.slow
def test_estimates_of_the_child_process_are_the_same():
    spec = preset("gaia-12deg", {"selection.faint_limit_mag": "4.5"})
    catalogs, remote = Catalogs(), ChildCatalogs()
    try:
        expected, found = catalogs.estimate(spec), remote.estimate(spec)
        assert found.fields.count.tolist() == expected.fields.count.tolist()
        assert (found.fields.boresights == expected.fields.boresights).all()
        for name in ("spec", "cost", "filters", "rejected", "refusals", "warnings", "files"):
            assert getattr(found, name) == getattr(expected, name)
        assert found.coverage.stars == expected.coverage.stars
        assert remote.enough_limit(spec) == catalogs.enough_limit(spec)
        assert remote.starter("own", spec.camera) == catalogs.starter("own", spec.camera)
        assert remote.known() == catalogs.known()
        # If the process ends, the next request starts a new process.
        child = remote._worker
        assert child is not None
        os.kill(child.pid, signal.SIGKILL)
        child.wait()
        assert remote.estimate(spec).cost == expected.cost
    finally:
        catalogs.close()
        remote.close()


@pytest.mark.slow
def test_a_request_that_waits_for_a_process_that_ends_gets_an_error(monkeypatch):
    remote = ChildCatalogs()
    spec = preset("gaia-12deg", {"selection.faint_limit_mag": "4.5"})
    threading.Timer(1.0, lambda: os.kill(remote._worker.pid, signal.SIGKILL)).start()
    with pytest.raises(Problem, match="ended, as it does without memory") as told:
        remote.estimate(spec)
    assert told.value.status == 503
    remote.close()
