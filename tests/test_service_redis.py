"""Jobs whose messages go through Redis, which may come and go, to workers on other machines."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi")

import requests
from fastapi.testclient import TestClient
from redis import Redis
from redis.exceptions import ConnectionError as NoConnection

from starcat.artifact.verify import verify_artifact
from starcat.service.app import make_app
from starcat.service.jobs import pool
from starcat.service.settings import Settings

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(120),
    pytest.mark.skipif(
        shutil.which("redis-server") is None, reason="redis-server is not installed"
    ),
]

JOBS = "/api/v1/jobs"


class Server:
    """A Redis of this test only, which keeps nothing."""

    def __init__(self, folder: Path) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.url = f"redis://127.0.0.1:{self.port}/0"
        self._folder = folder
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        command = ["redis-server", "--port", str(self.port), "--bind", "127.0.0.1", "--save", ""]
        self._process = subprocess.Popen(
            [*command, "--dir", str(self._folder)], stdout=subprocess.DEVNULL
        )
        until(self._answers)

    def _answers(self) -> bool:
        with suppress(NoConnection), Redis.from_url(self.url) as redis:
            return bool(redis.ping())
        return False

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


def until(is_so: Callable[[], bool], seconds: float = 60.0) -> None:
    until_s = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < until_s
        time.sleep(0.05)


@pytest.fixture
def redis_server(tmp_path: Path) -> Iterator[Server]:
    server = Server(tmp_path)
    server.start()
    yield server
    server.kill()


def test_jobs_outlast_their_messages(
    redis_server: Server,
    tmp_path: Path,
    sao_lines: list[bytes],
    small_spec: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "sao.dat").write_bytes(b"".join(sao_lines))
    monkeypatch.setenv("STARCAT_CATALOGS", str(tmp_path))
    monkeypatch.setattr(pool, "LOOK_S", 0.5)
    settings = Settings(
        root=tmp_path / "service", anonymous="publisher", queue_url=redis_server.url
    )
    with TestClient(make_app(settings), base_url="http://127.0.0.1") as client:

        def submit(version: str) -> str:
            spec = small_spec.replace("1.0.0", version)
            return str(client.post(JOBS, json={"kind": "build", "spec": spec}).json()["id"])

        def job(job_id: str) -> dict[str, Any]:
            return dict(client.get(f"{JOBS}/{job_id}").json())

        first = submit("1.0.0")
        until(lambda: job(first)["state"] == "done")
        redis_server.kill()
        second = submit("1.0.1")
        time.sleep(1.5)
        assert job(second)["state"] == "queued"
        redis_server.start()
        until(lambda: job(second)["state"] == "done")
        assert job(second)["attempt"] == 1


@pytest.fixture
def catalogs(tmp_path: Path, sao_lines: list[bytes], monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "sao.dat").write_bytes(b"".join(sao_lines))
    monkeypatch.setenv("STARCAT_CATALOGS", str(tmp_path))
    return tmp_path


@pytest.fixture
def away(redis_server: Server, catalogs: Path) -> Iterator[Away]:
    away = Away(redis_server, catalogs)
    yield away
    away.end()


class Away:
    """A service without workers of its own, and workers that reach it by its address only."""

    def __init__(self, redis: Server, folder: Path) -> None:
        self._folder, self._redis = folder, redis
        self.root = folder / "service"
        self.root.mkdir()
        content = ["workers = 0", "worker_silence_s = 3.0", f'queue_url = "{redis.url}"']
        (self.root / "service.toml").write_text("\n".join([*content, 'anonymous = "builder"']))
        self._processes: list[subprocess.Popen[bytes]] = []
        made = self._ran("token", "create", "far", "--role", "publisher", "--json")
        self._token = str(json.loads(made)["token"])
        with socket.create_server(("127.0.0.1", 0)) as free:
            self._port = free.getsockname()[1]
        self.address = f"http://127.0.0.1:{self._port}"
        self._start("serve", "--root", str(self.root), "--port", str(self._port))
        until(lambda: self._answers())

    def _ran(self, *arguments: str) -> bytes:
        command = [sys.executable, "-m", "starcat", *arguments, "--root", str(self.root)]
        return subprocess.run(command, check=True, capture_output=True, timeout=60).stdout

    def _answers(self) -> bool:
        with suppress(requests.ConnectionError):
            return requests.get(f"{self.address}/healthz", timeout=10).ok
        return False

    def _start(self, *arguments: str, **env: str) -> subprocess.Popen[bytes]:
        with (self._folder / "log.txt").open("ab") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "starcat", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={**os.environ, **env},
            )
        self._processes.append(process)
        return process

    def worker(self, name: str) -> subprocess.Popen[bytes]:
        """Start a worker with a folder of its own."""
        where = ["--server", self.address, "--queue", self._redis.url]
        root = self._folder / name
        root.mkdir(exist_ok=True)
        (root / "service.toml").write_text("shutdown_s = 0.5\n")
        return self._start("work", *where, "--root", str(root), STARCAT_TOKEN=self._token)

    def submit(self, spec: str) -> str:
        wish = {"kind": "build", "spec": spec}
        return str(requests.post(f"{self.address}{JOBS}", json=wish, timeout=20).json()["id"])

    def job(self, job_id: str) -> dict[str, Any]:
        return dict(requests.get(f"{self.address}{JOBS}/{job_id}", timeout=20).json())

    def states(self, job_id: str) -> list[str]:
        address = f"{self.address}{JOBS}/{job_id}/events.json"
        events = requests.get(address, timeout=20).json()
        return [event["data"]["state"] for event in events if event["kind"] == "state"]

    def end(self) -> None:
        for process in reversed(self._processes):
            if process.poll() is None:
                process.kill()
            process.wait()


def test_another_machine_builds_what_this_one_serves(away: Away, small_spec: str) -> None:
    job_id = away.submit(small_spec)
    worker = away.worker("one")
    until(lambda: away.job(job_id)["state"] in ("done", "failed"))
    job = away.job(job_id)
    assert job["state"] == "done", job
    assert job["stage"] == "verify"
    [artifact] = (away.root / "databases" / job["result"]["database"]).glob("small-*.0/")
    assert verify_artifact(artifact).findings == ()
    assert list((away.root / "scratch").iterdir()) == []
    assert list((away.root.parent / "one" / "databases").iterdir()) == []
    worker.terminate()
    assert worker.wait(20) == 0


def test_a_worker_that_is_lost_loses_no_job(away: Away, small_spec: str) -> None:
    job_id = away.submit(small_spec.replace("frames = 5", "frames = 1500"))
    lost = away.worker("lost")
    until(lambda: away.job(job_id)["stage"] == "self-test")
    lost.kill()
    lost.wait()
    away.worker("other")
    until(lambda: away.job(job_id)["state"] in ("done", "failed"), 90.0)
    assert away.states(job_id) == ["queued", "running", "queued", "running", "done"]


def test_a_worker_with_other_catalogs_builds_nothing(
    away: Away, small_spec: str, catalogs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = catalogs / "elsewhere"
    other.mkdir()
    (other / "sao.dat").write_bytes((catalogs / "sao.dat").read_bytes()[:-1000])
    monkeypatch.setenv("STARCAT_CATALOGS", str(other))
    away.worker("other")
    job_id = away.submit(small_spec)
    log = catalogs / "log.txt"
    until(lambda: "the catalogs of this machine" in log.read_text())
    assert away.states(job_id) == ["queued"]
