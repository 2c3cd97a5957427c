"""A server that is killed again and again loses no job, does none twice, and leaves whole files."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import requests
from services import DATABASE, add_database, until

from starcat.database.verify import verify
from starcat.errors import SourceMissing
from starcat.ship.releases.pulling import pull_release
from starcat.ship.releases.registry import FolderRegistry

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]

KILLS = 5
BUILDS = 4


class Service:
    """A server of a root, as an operator runs it."""

    def __init__(self, root: Path, catalogs: Path) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.root = root
        self.address = f"http://127.0.0.1:{self.port}/api/v1/jobs"
        self._env = {**os.environ, "STARCAT_CATALOGS": str(catalogs)}
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        command = [sys.executable, "-m", "starcat", "serve", "--root", str(self.root)]
        with (self.root / "log.txt").open("ab") as log:
            self.process = subprocess.Popen(
                [*command, "--port", str(self.port)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=self._env,
                start_new_session=True,
            )
        until(lambda: self.answers(), 60.0)

    def answers(self) -> bool:
        assert self.process is not None
        assert self.process.poll() is None, (self.root / "log.txt").read_text()[-2000:]
        try:
            return requests.get(self.address, timeout=10).ok
        except requests.ConnectionError:
            return False

    def end(self, number: int) -> int:
        assert self.process is not None
        self.process.send_signal(number)
        return self.process.wait(60)

    def post(self, **wish: Any) -> dict[str, Any]:
        answer = requests.post(self.address, json=wish, timeout=20)
        assert answer.ok, answer.text
        return answer.json()

    def jobs(self) -> dict[str, dict[str, Any]]:
        answer = requests.get(self.address, timeout=20).json()
        return {job["id"]: job for job in answer["jobs"]}

    def states(self, job: str) -> list[str]:
        events = requests.get(f"{self.address}/{job}/events.json", timeout=20).json()
        return [event["data"]["state"] for event in events if event["kind"] == "state"]

    def processes(self) -> list[int]:
        """Return the processes that were started for this root and still live."""
        numbers = []
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                is_of_root = (
                    str(self._env["STARCAT_CATALOGS"]).encode() in (folder / "environ").read_bytes()
                )
                is_dead = "\nState:\tZ" in (folder / "status").read_text()
            except OSError:
                continue
            if is_of_root and not is_dead and int(folder.name) != os.getpid():
                numbers.append(int(folder.name))
        return numbers


@pytest.fixture
def service(tmp_path: Path, sao_lines: list[bytes]) -> Iterator[Service]:
    if not sys.platform.startswith("linux"):
        pytest.skip("processes are counted as Linux lists them")
    root, catalogs = tmp_path / "service", tmp_path / "catalogs"
    root.mkdir()
    catalogs.mkdir()
    (catalogs / "sao.dat").write_bytes(b"".join(sao_lines))
    (root / "service.toml").write_text('anonymous = "publisher"\nworkers = 2\nshutdown_s = 1.0\n')
    service = Service(root, catalogs)
    yield service
    if service.process is not None and service.process.poll() is None:
        service.process.kill()
        service.process.wait()


def test_five_kills_lose_nothing_and_double_nothing(service, small_spec):
    generator = random.Random(15)
    service.start()
    ids = []
    for number in range(BUILDS):
        version = small_spec.replace('"1.0.0"', f'"1.0.{number}"')
        spec = version.replace("frames = 5", "frames = 400")
        ids.append(service.post(kind="build", spec=spec)["id"])
    for _ in range(KILLS):
        time.sleep(generator.uniform(0.2, 5.0))
        assert service.end(signal.SIGKILL) == -signal.SIGKILL
        # All its child processes end soon, and only work folders may be incomplete.
        until(lambda: not service.processes(), 10.0)
        assert_all_whole(service.root)
        service.start()
        assert set(service.jobs()) == set(ids)
    until(lambda: all(job["state"] == "done" for job in service.jobs().values()), 200.0)
    for job_id, job in service.jobs().items():
        states = service.states(job_id)
        assert states.count("done") == 1
        assert states[-1] == "done"
        assert states.count("running") == job["attempt"] <= KILLS + 1
        assert job["result"] == {"database": job["key"][:16]}
    assert len(assert_all_whole(service.root)) == BUILDS
    assert service.end(signal.SIGTERM) == 0
    assert service.processes() == []
    assert list((service.root / "jobs").glob("*/work")) == []
    assert list(service.root.rglob("*.partial")) == []


def assert_all_whole(root: Path) -> list[Path]:
    """Return the databases; each verifies and is alone in the folder of its id."""
    folders = []
    for folder in (root / "databases").iterdir():
        [database] = [path for path in folder.iterdir() if path.is_dir()]
        assert verify(database).findings == ()
        folders.append(database)
    return folders


def test_a_server_that_is_killed_while_it_publishes_shows_no_half_release(
    service, small_database, tmp_path
):
    add_database(service.root, small_database)
    generator = random.Random(16)
    address = service.address.replace("/jobs", "/releases")

    def publish() -> None:
        with suppress(requests.ConnectionError):
            requests.post(address, json={"database": DATABASE, "note": "first"}, timeout=20)

    for number in range(KILLS):
        service.start()
        asking = threading.Thread(target=publish)
        asking.start()
        time.sleep(generator.uniform(0.0, 0.3))
        assert service.end(signal.SIGKILL) == -signal.SIGKILL
        asking.join()
        assert pulled(service.root, tmp_path / f"killed-{number}") in ([], ["small-1.0.0"])
        service.start()
        again = requests.post(address, json={"database": DATABASE, "note": "again"}, timeout=20)
        assert again.status_code in (200, 201)
        [release] = requests.get(address, timeout=20).json()["releases"]
        assert (release["name"], release["version"]) == ("small", "1.0.0")
        assert pulled(service.root, tmp_path / f"again-{number}") == ["small-1.0.0"]
        assert service.end(signal.SIGTERM) == 0
        shutil.rmtree(service.root / "registry")


def pulled(root: Path, output: Path) -> list[str]:
    """Return the visible releases; each is complete when it is pulled."""
    registry = FolderRegistry(root / "registry")
    try:
        releases = registry.releases()
    except SourceMissing:  # nothing is published yet
        return []
    for release in releases:
        pull_release(registry, release, output)
        assert verify(output / release.title).findings == ()
    return [release.title for release in releases]


def test_a_server_that_stops_leaves_its_jobs_to_the_next(service, small_spec):
    service.start()
    spec = small_spec.replace("frames = 5", "frames = 100000")
    job_id = service.post(kind="build", spec=spec)["id"]
    watching = requests.get(f"{service.address}/{job_id}/events", stream=True, timeout=60)
    until(lambda: service.jobs()[job_id]["stage"] == "self-test", 60.0)
    began_s = time.monotonic()
    assert service.end(signal.SIGTERM) == 0
    assert time.monotonic() - began_s < 20.0
    assert b'"running"' in watching.content  # the stream has ended in good order
    assert service.processes() == []
    service.start()
    until(lambda: service.jobs()[job_id]["state"] == "running", 60.0)
    assert service.states(job_id) == ["queued", "running", "queued", "running"]
    assert requests.post(f"{service.address}/{job_id}/cancel", timeout=20).ok
    until(lambda: service.jobs()[job_id]["state"] == "cancelled", 30.0)


def test_the_records_are_whole_after_each_kill(service, small_spec):
    """Submissions that were answered are remembered, wherever the kill falls."""
    generator = random.Random(3)
    service.start()
    ids: list[str] = []
    for _ in range(3):
        until_s = time.monotonic() + generator.uniform(0.1, 0.6)
        while time.monotonic() < until_s:
            limit = round(2.0 + 0.01 * len(ids), 2)
            wish = {"kind": "ingest", "source": "sao", "read_limit_mag": limit}
            answer = requests.post(service.address, json=wish, timeout=20)
            if answer.status_code == 429:
                break
            ids.append(json.loads(answer.content)["id"])
        service.end(signal.SIGKILL)
        until(lambda: not service.processes(), 10.0)
        service.start()
        assert set(service.jobs()) == set(ids)
