"""Jobs whose messages go through Redis, which may come and go."""

from __future__ import annotations

import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi")

from fastapi.testclient import TestClient
from redis import Redis
from redis.exceptions import ConnectionError as NoConnection

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
