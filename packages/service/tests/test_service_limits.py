"""Limits of a service and its outages: sizes, full disks, lost folders, and who sees a job."""

from __future__ import annotations

import asyncio
import errno
import io
import itertools
import json
import os
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.table import Table
from cachetools import TTLCache
from fastapi.testclient import TestClient
from pictures import png_of
from served import serve
from services import DATABASE, LOCAL, add_database, client_of

from starcat.errors import OutputError, ProductError
from starcat.frames.images.background import subtract_background
from starcat.frames.images.spots import sigma_of_stars
from starcat.pipeline.specs.reading import preset, spec_from_dict
from starcat.query.session import ABANDONED_S, SCRATCH_PREFIX, open_session
from starcat.ship.releases import publishing
from starcat.ship.releases.publishing import publish
from starcat_service.api.nova import Solution, Solutions
from starcat_service.catalogs import Catalogs
from starcat_service.estimates import ChildCatalogs
from starcat_service.problems import Problem, outage_of
from starcat_service.records import Records
from starcat_service.removal import remove_old
from starcat_service.sandbox.messages import ERROR, error_content, json_content
from starcat_service.security.request_limits import Buckets
from starcat_service.security.tokens import DAY_S

WIDE = "SELECT repeat('x', 1000) AS v, range AS n FROM range({})"


def asked(client: TestClient, query: str, **more: object) -> tuple[int, dict[str, object]]:
    question = {"targets": [DATABASE], "query": query, "max_rows": 100_000, **more}
    answer = client.post("/api/v1/sql", json=question)
    return answer.status_code, answer.json()


# Sizes of answers.


def test_rows_are_limited_in_bytes_and_files_are_not(client):
    assert asked(client, WIDE.format(900))[0] == 200
    # Far above the limit, a little above it, and only above it as JSON is written.
    for query in (WIDE.format(9_000), WIDE.format(1_100), "SELECT repeat('\"', 600000)"):
        status, problem = asked(client, query)
        assert (status, problem["key"]) == (413, "max_rows")
        assert "more than 1 MiB (rows_mib); ask for fewer rows" in str(problem["detail"])
        assert "for a file (format: csv, json, parquet" in str(problem["detail"])
    question = {"targets": [DATABASE], "query": WIDE.format(2_000), "format": "csv"}
    answer = client.post("/api/v1/sql", json=question)
    assert (answer.status_code, answer.headers["x-starcat-rows"]) == (200, "2000")
    assert len(answer.content) > 2_000_000


def reported(error: Exception) -> tuple[str, bytes]:
    """Return what a worker sends when an error was raised."""
    return ERROR, json_content(error_content(error))


def test_a_format_that_needs_the_table_in_memory_says_which_do_not(client, monkeypatch):
    sandbox = client.app.state.service.sandbox
    monkeypatch.setattr(sandbox, "_answer", lambda worker, request: reported(MemoryError()))
    question = {"targets": [DATABASE], "query": "SELECT 1", "format": "ecsv"}
    answer = client.post("/api/v1/sql", json=question)
    assert answer.status_code == 413
    assert answer.json()["detail"] == (
        "the table takes more memory as ECSV than a request may (1 GiB); choose csv, json, "
        "parquet, votable, which are written row by row, or ask for fewer rows"
    )


@pytest.mark.parametrize(
    "address",
    [
        f"/scs/{DATABASE}?RA=0&DEC=0&SR=180&RESPONSEFORMAT=fits",
        "/tap/sync?QUERY=SELECT TOP 5 * FROM small.stars&RESPONSEFORMAT=fits",
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


# Temporary files.


def test_temporary_files_of_queries_are_in_the_root(client):
    service = client.app.state.service
    with service.query_pool.session([service.library.target(DATABASE)]) as session:
        spill = Path(session._engine._opening.spill)
        assert spill.is_relative_to(service.paths.scratch)
        remove_old(service, time.time() + 10 * DAY_S)
        assert spill.is_dir(), "the folder of a session that lives is not old"


def test_what_a_killed_process_left_is_removed_by_the_next_session(small_database, tmp_path):
    within = tmp_path / "within"
    within.mkdir()
    program = (
        "import pathlib, sys, time\n"
        "from starcat.query.session import open_session\n"
        f"with open_session([{str(small_database)!r}], within=pathlib.Path({str(within)!r})):\n"
        "    print('open', flush=True)\n"
        "    time.sleep(60)\n"
    )
    run = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)
    assert run.stdout is not None
    run.stdout.readline()
    [abandoned] = within.iterdir()
    long_ago = time.time() - 2 * ABANDONED_S
    other, link = within / "other", within / f"{SCRATCH_PREFIX}link"
    other.mkdir()
    link.symlink_to(other)
    os.utime(abandoned, (long_ago, long_ago))
    with open_session([str(small_database)], within=within):
        assert abandoned.exists(), "its process lives"
    run.kill()
    run.wait()
    run.stdout.close()
    with open_session([str(small_database)], within=within):
        assert not abandoned.exists()
    assert sorted(within.iterdir()) == [other, link]


# Full disks.


def test_a_flight_image_on_a_full_disk_is_reported_as_such(client, monkeypatch):
    """The process of the sandbox reports an OutputError, and that the disk is full."""
    error = OutputError("image.img: cannot be written")
    error.__cause__ = OSError(errno.ENOSPC, "No space left on device")
    sandbox, reply = client.app.state.service.sandbox, reported(error)
    monkeypatch.setattr(sandbox, "_answer", lambda worker, request: reply)
    answer = client.get(f"/databases/{DATABASE}/image")
    assert answer.status_code == 507


def test_a_publication_that_fails_leaves_no_part(small_database, tmp_path, monkeypatch):
    def full(source: Path, blob: object, part: Path) -> None:
        part.write_bytes(b"half of it")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(publishing, "copy_to_part", full)
    with pytest.raises(OutputError):
        publish(small_database, str(tmp_path))
    assert not list(tmp_path.rglob("*.part"))


# Who sees what.


def test_a_query_job_without_a_token_is_seen_by_its_client_only(client):
    other = TestClient(client.app, base_url=LOCAL, client=("192.0.2.7", 4711))
    answer = client.post(
        "/tap/async", data={"QUERY": "SELECT 1 FROM stars"}, follow_redirects=False
    )
    job = answer.headers["location"].removeprefix(LOCAL)
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
    """A key whose comparison lets another thread run."""

    __slots__ = ()

    def __hash__(self) -> int:
        time.sleep(0)
        return str.__hash__(self)


class SlowNumber(int):
    """A key whose comparison lets another thread run."""

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
        for _ in range(50):
            kept.get(kept.add(solution))

    assert in_threads(work) == []


def test_buckets_count_what_many_threads_take():
    buckets, waits = Buckets(600.0, clock=lambda: 0.0), []

    def work() -> None:
        waits.extend(buckets.take(SlowText("a")) for _ in range(100))

    assert in_threads(work) == []
    assert waits.count(0.0) == 600


@pytest.mark.slow
def test_estimates_of_the_child_process_are_the_same():
    spec = preset("gaia-12deg", {"selection.faint_limit_mag": "4.5"})
    catalogs, remote = Catalogs(), ChildCatalogs(wait_s=100.0)
    try:
        expected, estimate = catalogs.estimate(spec), asyncio.run(remote.estimate(spec))
        assert estimate.fields.count.tolist() == expected.fields.count.tolist()
        assert (estimate.fields.boresights == expected.fields.boresights).all()
        for name in ("spec", "cost", "filters", "rejected", "refusals", "warnings"):
            assert getattr(estimate, name) == getattr(expected, name)
        assert estimate.figures == expected.figures
        assert asyncio.run(remote.enough_limit(spec)) == catalogs.enough_limit(spec)
        starter = asyncio.run(remote.starter("own", spec.camera))
        assert starter == catalogs.starter("own", spec.camera)
        assert remote.catalogs_read() == catalogs.catalogs_read()
        # If the process ends, the next request starts a new process.
        child = remote._worker
        assert child is not None
        os.kill(child.pid, signal.SIGKILL)
        child.wait()
        assert asyncio.run(remote.estimate(spec)).cost == expected.cost
    finally:
        catalogs.close()
        remote.close()


@pytest.mark.slow
def test_a_request_that_waits_for_a_process_that_ends_gets_an_error(monkeypatch):
    remote = ChildCatalogs()
    spec = preset("gaia-12deg", {"selection.faint_limit_mag": "4.5"})
    threading.Timer(1.0, lambda: os.kill(remote._worker.pid, signal.SIGKILL)).start()
    with pytest.raises(Problem, match="ended, as it does without memory") as caught:
        asyncio.run(remote.estimate(spec))
    assert caught.value.status == 503
    remote.close()


# Outages: full disks, damaged records, folders that are gone, odd uploads.

QUESTION = {"targets": [DATABASE], "query": "SELECT count(*) FROM stars"}
IDENTIFY = f"/api/v1/identify/{DATABASE}"
ARCHIVE = f"/api/v1/databases/{DATABASE}/archive"


# Full disks.


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 48 MiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=48m", "tmpfs", str(folder)]
    if sys.platform != "linux" or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("a disk can be mounted by root of Linux only")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(folder: Path) -> None:
    free_bytes = shutil.disk_usage(folder).free
    with (folder / "filler").open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, free_bytes)


def picture_of(image: Any) -> bytes:
    rows = b"".join(b"\0" + row.tobytes() for row in image)
    return png_of(image.shape[1], image.shape[0], rows)


BLACK = np.zeros((64, 64), np.uint8)


@pytest.mark.slow
def test_a_full_disk_is_reported_whatever_is_to_be_left_free(small_disk, small_database):
    root = small_disk / "root"
    add_database(root, small_database)
    with client_of(root, free_gib=0.0, anonymous="publisher") as client:
        assert client.get("/readyz").status_code == 200
        fill(small_disk)
        ready = client.get("/readyz")
        assert ready.status_code == 503
        assert any(
            "GiB free" in reason or "is full" in reason for reason in ready.json()["reasons"]
        )
        file = {"file": ("frame.png", picture_of(BLACK))}
        csv = {**QUESTION, "format": "csv"}
        for answer in (
            client.post(IDENTIFY, files=file),
            client.post("/tap/async", data={"QUERY": "SELECT 1"}),
            client.post("/api/v1/sql", json=csv),
        ):
            assert answer.status_code == 507, answer.text
        assert client.get(f"/api/v1/databases/{DATABASE}").status_code == 200
        (small_disk / "filler").unlink()
        assert client.get("/readyz").status_code == 200
        assert client.post("/api/v1/sql", json=csv).status_code == 200


OUTAGES = [
    (OSError(errno.ENOSPC, "No space left on device"), 507),
    (OSError(errno.EDQUOT, "Disk quota exceeded"), 507),
    (sqlite3.OperationalError("database or disk is full"), 507),
    (sqlite3.DatabaseError("database disk image is malformed"), 503),
    (OSError(errno.EIO, "Input/output error"), None),
    (ValueError("anything"), None),
]


@pytest.mark.parametrize(("error", "status"), OUTAGES)
def test_what_is_no_defect_of_starcat_has_a_status_of_its_own(tmp_path, error, status):
    outage = outage_of(error, tmp_path)
    assert (outage.status if outage else None) == status
    wrapped = OutputError("cannot be written", path=tmp_path)
    wrapped.__cause__ = error
    assert (outage := outage_of(wrapped, tmp_path)) is None or outage.status == status


# Records.


def test_damaged_records_are_named_with_the_backup_at_the_start(tmp_path):
    (tmp_path / "records.sqlite").write_bytes(b"no database at all" * 1000)
    with pytest.raises(
        ProductError, match=r"records.sqlite cannot be used .*last backup"
    ) as caught:
        Records(tmp_path / "records.sqlite")
    assert str(tmp_path / "records.sqlite") in str(caught.value)


@pytest.mark.slow
def test_damaged_records_are_reported_while_the_service_runs(own_root):
    with client_of(own_root) as client:
        assert client.get("/readyz").status_code == 200
        other = sqlite3.connect(own_root / "records.sqlite")
        other.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        other.close()
        size = (own_root / "records.sqlite").stat().st_size
        (own_root / "records.sqlite").write_bytes(b"x" * size)
        ready = client.get("/readyz")
        assert ready.status_code == 503
        assert "records.sqlite cannot be used" in ready.text
        assert "backup" in ready.text
        for path in ("/api/v1/jobs", "/tap/async", "/jobs"):
            answer = client.get(path)
            assert answer.status_code == 503, path
            assert "records.sqlite" in answer.text
        signed = client.get("/api/v1/databases", headers={"Authorization": "Bearer starcat_x"})
        assert signed.status_code == 503


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_root_that_is_gone_is_reported(own_root):
    with client_of(own_root, anonymous="publisher") as client:
        assert client.get("/readyz").status_code == 200
        shutil.move(own_root, own_root.with_name("elsewhere"))
        ready = client.get("/readyz")
        assert ready.status_code == 503
        assert "the folder of the service is gone" in ready.text
        file = {"file": ("frame.png", picture_of(BLACK))}
        answers = [
            client.post(IDENTIFY, files=file),
            client.post("/api/v1/sql", json={**QUESTION, "format": "csv"}),
            client.post("/tap/async", data={"QUERY": "SELECT 1"}),
            client.get("/tap/tables"),
            client.get("/api/v1/databases"),
        ]
        assert 500 not in [answer.status_code for answer in answers]
        shutil.move(own_root.with_name("elsewhere"), own_root)
        assert client.get("/readyz").status_code == 200


# Uploads.


@pytest.mark.slow
def test_an_interrupted_upload_is_no_defect(own_root, tmp_path):
    part = b'--edge\r\nContent-Disposition: form-data; name="file"; filename="f.png"\r\n\r\nxx'
    kinds = ["multipart/form-data; boundary=edge", "application/json"]
    with serve(own_root, tmp_path / "log") as served:
        for path in (IDENTIFY, "/tap/sync", "/identify"):
            for kind in kinds:
                with socket.create_connection(("127.0.0.1", served.port), 10.0) as line:
                    head = (
                        f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: {kind}\r\n"
                        "Content-Length: 5000\r\n\r\n"
                    )
                    line.sendall(head.encode() + part)
                    time.sleep(0.1)
        assert served.raw("GET", "/healthz").status == 200
        time.sleep(0.3)
        lines = [
            json.loads(line) for line in served.log.read_text().splitlines() if line[:1] == "{"
        ]
    assert [line for line in lines if line["level"] == "error"] == []


def two_spots(*sigmas: float) -> Any:
    y, x = np.mgrid[0:512, 0:512]
    image = np.random.default_rng(5).normal(100.0, 2.0, (512, 512))
    for k, sigma in enumerate(sigmas):
        image += 9000.0 * np.exp(-((x - 80 - 150 * k) ** 2 + (y - 90) ** 2) / (2 * sigma**2))
    return np.clip(image / 40.0, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("sigmas", [(1.0, 3.5), (1.2, 2.4), (0.9, 2.0, 4.0)])
def test_spots_of_different_widths_have_a_width(sigmas):
    levels = subtract_background(two_spots(*sigmas).astype(np.float64))
    places = np.array([(80.5 + 150 * k, 90.5) for k in range(len(sigmas))])
    sigma_px = sigma_of_stars(levels, places, np.arange(9.0, 0.0, -1.0)[: len(places)])
    assert 0.5 < sigma_px < 5.0


# Archives.


def test_an_archive_follows_no_link_and_has_what_the_manifest_says(own_root, tmp_path):
    secret = tmp_path / "secret"
    [stars] = own_root.glob("databases/*/*/stars.parquet")
    secret.write_bytes(stars.read_bytes())
    with client_of(own_root) as client:
        assert client.get(ARCHIVE).status_code == 200
        content = stars.read_bytes()
        stars.unlink()
        stars.symlink_to(secret)
        answer = client.get(ARCHIVE)
        assert (answer.status_code, "stars.parquet" in answer.text) == (404, True)
        stars.unlink()
        stars.write_bytes(content[:-1])
        answer = client.get(ARCHIVE)
        assert (answer.status_code, "the manifest says" in answer.text) == (422, True)
        stars.unlink()
        assert client.get(ARCHIVE).status_code == 404


# A full disk.


FULL_JOBS = """
import json, resource, signal, sys
from starcat_service.jobs.work import Order, _do_job, _problem_of

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
spec = json.loads(sys.argv[2])
for limit_bytes in (100_000, 700_000):  # a table, and a part of database.h5
    order = Order(
        sys.argv[1], "0" * 32, "build", "1" * 64, {"spec": spec}, 2 << 30, None, 1
    )
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, resource.RLIM_INFINITY))
    try:
        _do_job(order, lambda *_: None, lambda *_: None)
    except Exception as error:
        print(_problem_of(error, order)["detail"])
"""


def test_a_worker_whose_disk_is_full_reports_it_and_goes_on(tmp_path, archive, small_spec):
    spec = spec_from_dict(tomllib.loads(small_spec), "small.toml").recorded()
    ran = subprocess.run(
        [sys.executable, "-c", FULL_JOBS, str(tmp_path), json.dumps(spec)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (ran.returncode, ran.stderr) == (0, "")
    lines = ran.stdout.splitlines()
    assert len(lines) == 2
    assert all("writing failed (File too large); nothing was left there" in line for line in lines)
