"""Killed publishers and pullers, and many at once: half a version is never visible.

The processes are real and die by SIGKILL. One interpreter that has everything imported forks
them, so that a run is work and not start-up. A reader that shares no code with starcat looks
at the registry after each kill.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from folder_bytes import bytes_of
from registry_files import serving

import starcat

pytestmark = pytest.mark.slow

WORKERS = """
import errno, fcntl, json, os, signal, sys, time, traceback
from pathlib import Path
import starcat.database.verify
from starcat.ship.releases import lockfile
from starcat.ship.releases.publishing import publish

def refuse(*_):
    raise OSError(errno.ENOLCK, "No locks available")

steps = 0

def die_at(last):
    def hook(event, _):
        global steps
        # Before each step that changes what is on the disk, and many more.
        if event.partition(".")[0] in ("open", "os", "shutil", "fcntl") and event != "os.kill":
            steps += 1
            if steps == last:
                os.kill(os.getpid(), signal.SIGKILL)
    sys.addaudithook(hook)

def work(order):
    if order["without_locks"]:
        fcntl.flock = refuse
    die_at(order["die_at"])
    if order["publish"]:
        done = publish(Path(order["publish"]), order["registry"])
    else:
        done = lockfile.pull(order["pull"], order["registry"], Path(order["output"]),
                           lock=Path(order["output"] + ".lock"))
    if order["count_to"]:
        count = steps
        Path(order["count_to"]).write_text(str(count))
    return done.outcome

for line in sys.stdin:
    order = json.loads(line)
    if "wait" in order:
        print(json.dumps(os.waitpid(order["wait"], 0)[1]), flush=True)
        continue
    pid = os.fork()
    if not pid:
        code = 1
        try:
            code = {"published": 0, "pulled": 0, "unchanged": 3}[work(order)]
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    print(json.dumps(pid), flush=True)
"""

DONE = {0, 3}
"""Exit codes of a worker that has done its work, or found it done."""


@dataclass
class Workers:
    """Starts processes that publish and pull."""

    process: subprocess.Popen[str]

    def ask(self, **order: Any) -> int:
        assert self.process.stdin
        assert self.process.stdout
        self.process.stdin.write(json.dumps(order) + "\n")
        self.process.stdin.flush()
        return int(json.loads(self.process.stdout.readline()))

    def start(self, **order: Any) -> int:
        """Start a worker and return its process."""
        nothing = dict.fromkeys(("publish", "output", "die_at", "without_locks", "count_to"))
        return self.ask(**nothing | order)

    def wait(self, pid: int) -> int:
        """Return an exit code, or minus a signal."""
        return os.waitstatus_to_exitcode(self.ask(wait=pid))

    def run(self, **order: Any) -> int:
        return self.wait(self.start(**order))


@pytest.fixture(scope="module")
def workers() -> Iterator[Workers]:
    package = Path(starcat.__file__).parents[1]
    environment = os.environ | {
        "PYTHONPATH": str(package),
        "NO_PROXY": "127.0.0.1",
        "OMP_NUM_THREADS": "1",
    }
    with subprocess.Popen(
        [sys.executable, "-c", WORKERS],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    ) as process:
        yield Workers(process)
        assert process.stdin
        process.stdin.close()


# The reader ---------------------------------------------------------------------------------


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@dataclass
class Reader:
    """Reads a registry as any user can, and records the versions that were out."""

    registry: Path
    known: dict[str, dict[str, Any]] = field(default_factory=dict)
    sound: set[str] = field(default_factory=set)

    def look(self) -> set[str]:
        """Return the versions that are listed, after seeing that each is complete."""
        index = self.registry / "index.json"
        listed = json.loads(index.read_bytes())["releases"] if index.exists() else []
        found = {f"{entry['name']}@{entry['version']}": entry for entry in listed}
        assert len(found) == len(listed)
        # Nothing that was out is gone, or another thing now.
        assert {key: found.get(key) for key in self.known} == self.known
        self.known = found
        blobs = {path.name: path for path in self.registry.glob("blobs/sha256/*/*")}
        for name in blobs.keys() - self.sound:
            assert digest(blobs[name]) == name, "a blob at its final name is not what it should be"
        self.sound = set(blobs)
        for path in self.registry.glob("versions/*/*.json"):
            self.check(json.loads(path.read_bytes()), blobs)
        for entry in listed:
            record = self.registry / "versions" / entry["name"] / f"{entry['version']}.json"
            assert json.loads(record.read_bytes()) == entry
        return set(found)

    def check(self, entry: dict[str, Any], blobs: dict[str, Path]) -> None:
        manifest = blobs[entry["manifest"]["sha256"]]
        assert manifest.stat().st_size == entry["manifest"]["bytes"]
        for facts in json.loads(manifest.read_bytes())["files"].values():
            assert blobs[facts["sha256"]].stat().st_size == facts["bytes"]


def check_output(output: Path, database: Path) -> bool:
    """Return whether the database is at its final name; it is whole or not there at all."""
    final = output / database.name
    if not final.exists():
        return False
    assert bytes_of(final) == bytes_of(database)
    return True


def seen(output: Path) -> set[str]:
    return {path.name for path in output.glob("*") if not path.name.startswith(".")}


# A kill at every step -----------------------------------------------------------------------


def some_steps(folder: Path, run: Callable[[int], int], points: int = 100) -> list[int]:
    """Return steps of a run, the first and the last among them."""
    assert run(0) == 0
    last = int((folder / "steps").read_text())
    assert last > 100
    return sorted({1 + k * (last - 1) // points for k in range(points + 1)})


@pytest.mark.timeout(600)
def test_a_publisher_killed_between_any_two_steps(workers, database_version, tmp_path):
    before, database = str(database_version("1.0.1")), str(database_version("1.0.2"))
    count = str(tmp_path / "steps")
    workers.run(publish=before, registry=str(tmp_path / "clean"))

    def run(step: int) -> int:
        shutil.rmtree(tmp_path / "registry", ignore_errors=True)
        shutil.copytree(tmp_path / "clean", tmp_path / "registry")
        registry = str(tmp_path / "registry")
        code = workers.run(publish=database, registry=registry, die_at=step, count_to=count)
        assert code in (-signal.SIGKILL, 0)
        there = Reader(tmp_path / "registry").look()
        assert there - {"small@1.0.2"} == {"small@1.0.1"}
        return code

    for step in some_steps(tmp_path, run):
        assert run(step) == -signal.SIGKILL
        assert workers.run(publish=database, registry=str(tmp_path / "registry")) in DONE
        assert Reader(tmp_path / "registry").look() == {"small@1.0.1", "small@1.0.2"}
        assert [*(tmp_path / "registry/.incoming").glob("*.part")] == []


@pytest.mark.timeout(600)
@pytest.mark.parametrize(("is_behind_an_address", "points"), [(False, 100), (True, 25)])
def test_a_pull_killed_between_any_two_steps(
    workers, database_version, tmp_path, is_behind_an_address, points
):
    database, output, count = database_version("1.0.1"), tmp_path / "out", str(tmp_path / "steps")
    registry = tmp_path / "registry"
    workers.run(publish=str(database), registry=str(registry))
    order = {"pull": "small", "output": str(output)}

    def run(step: int) -> int:
        shutil.rmtree(output, ignore_errors=True)
        (tmp_path / "out.lock").unlink(missing_ok=True)
        code = workers.run(**order, die_at=step, count_to=count)
        assert code in (-signal.SIGKILL, 0)
        assert seen(output) == ({database.name} if check_output(output, database) else set())
        return code

    with serving(registry) as server:
        order["registry"] = server.url("") if is_behind_an_address else str(registry)
        for step in some_steps(tmp_path, run, points):
            assert run(step) == -signal.SIGKILL
            assert workers.run(**order) in DONE
            assert check_output(output, database)
            assert {path.name for path in output.iterdir()} == {database.name}
            assert json.loads((tmp_path / "out.lock").read_bytes())["artifacts"]


# Many at once -------------------------------------------------------------------------------


@pytest.mark.parametrize("without_locks", [False, True])
def test_publishers_at_once_lose_nothing(workers, database_version, tmp_path, without_locks):
    keys = {"registry": str(tmp_path / "registry"), "without_locks": without_locks}
    databases = [database_version(f"2.0.{k}") for k in range(4)]
    pids = [workers.start(publish=str(a), **keys) for a in databases for _ in range(2)]
    codes = [workers.wait(pid) for pid in pids]
    assert set(codes) <= DONE
    # Of two that publish the same, one does.
    assert sorted(codes) == [0] * 4 + [3] * 4
    assert Reader(tmp_path / "registry").look() == {f"small@2.0.{k}" for k in range(4)}
    assert [*(tmp_path / "registry/.incoming").iterdir()] == []


def test_publishers_at_once_of_which_some_are_killed(workers, database_version, tmp_path):
    registry, dice = str(tmp_path / "registry"), random.Random(3)
    for k in range(4):
        mine, others = database_version(f"3.{k}.0"), database_version(f"3.{k}.1")
        killed = workers.start(publish=str(mine), registry=registry, die_at=dice.randint(50, 400))
        pids = [workers.start(publish=str(a), registry=registry) for a in (mine, others)]
        assert {workers.wait(pid) for pid in pids} <= DONE
        assert workers.wait(killed) in {-signal.SIGKILL, *DONE}
        there = Reader(tmp_path / "registry").look()
        assert {f"small@3.{k}.0", f"small@3.{k}.1"} <= there


def test_pulls_at_once_into_one_folder(workers, database_version, tmp_path):
    registry, output = str(tmp_path / "registry"), tmp_path / "out"
    database = database_version("2.0.0")
    workers.run(publish=str(database), registry=registry)
    order = {"pull": "small", "registry": registry, "output": str(output)}
    killed = workers.start(**order, die_at=150)
    pids = [workers.start(**order) for _ in range(4)]
    codes = [workers.wait(pid) for pid in pids]
    assert sorted(codes) == [0, 3, 3, 3]
    assert workers.wait(killed) in {-signal.SIGKILL, 3}
    assert check_output(output, database)
    assert {path.name for path in output.iterdir()} == {database.name}


def test_pins_of_pulls_at_once_are_all_kept(workers, database_version, tmp_path):
    registry = tmp_path / "registry"
    workers.run(publish=str(database_version("2.0.0")), registry=str(registry))
    order = {"pull": "small", "registry": str(registry), "output": str(tmp_path / "out")}
    pids = [workers.start(**order) for _ in range(4)]
    assert {workers.wait(pid) for pid in pids} <= DONE
    (pin,) = json.loads((tmp_path / "out.lock").read_bytes())["artifacts"]
    assert pin["version"] == "2.0.0"
    assert not [*tmp_path.glob(".out.lock*")]
