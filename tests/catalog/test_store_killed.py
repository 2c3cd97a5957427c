"""Stores survive SIGKILL: of a worker of a Dask cluster, and of the whole run, at any moment."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import pytest
from folder_bytes import bytes_of
from twomass_parts import write_part

ROWS = 20_000
PARTS = range(0, 92, 8)
OPTIONS = ["--max-partition-rows", "20000", "--workers", "2"]
BASELINE_S = 60.0


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    folder = tmp_path_factory.mktemp("parts")
    return [write_part(folder, part, ROWS, 1 + part * ROWS) for part in PARTS]


def command(parts: list[Path], folder: Path, *more: str) -> list[str]:
    inputs = [text for part in parts for text in ("--input", str(part))]
    base = [sys.executable, "-m", "starcat", "ingest", "2mass", *inputs, "--to", "hats"]
    return [*base, "-o", str(folder), *OPTIONS, *more]


@contextmanager
def running(arguments: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    """A process with its children in a group of its own, killed at the end."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    process = subprocess.Popen(arguments, start_new_session=True, **quiet)
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


@pytest.fixture(scope="module")
def whole(parts, tmp_path_factory):
    """The bytes of an undisturbed run of processes, and how long it took."""
    folder = tmp_path_factory.mktemp("whole") / "store"
    began = time.monotonic()
    subprocess.run(command(parts, folder), check=True, capture_output=True)
    return bytes_of(folder), time.monotonic() - began


@contextmanager
def dask_cluster(folder: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler on a free port, and two workers that are not started again."""
    bin_folder = Path(sys.executable).parent
    file = folder / "scheduler.json"
    start = [str(bin_folder / "dask"), "scheduler", "--host", "127.0.0.1", "--port", "0"]
    work = [str(bin_folder / "dask"), "worker", "--scheduler-file", str(file), "--nthreads", "1"]
    with ExitStack() as stack:
        options = ["--no-dashboard", "--scheduler-file", str(file)]
        stack.enter_context(running([*start, *options]))
        wait_for(file.is_file)
        workers = [
            stack.enter_context(
                running([*work, "--no-nanny", "--no-dashboard", "--local-directory", str(folder)])
            )
            for _ in range(2)
        ]
        yield json.loads(file.read_text())["address"], workers


def wait_for(is_so) -> None:
    ends = time.monotonic() + BASELINE_S
    while not is_so():
        assert time.monotonic() < ends
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_worker_of_a_cluster_may_be_killed_at_any_moment(parts, whole, tmp_path):
    expected, took_s = whole
    draw = random.Random(12)
    for attempt in range(5):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        with ExitStack() as stack:
            address, workers = stack.enter_context(dask_cluster(folder))
            asked = command(parts, folder / "store", "--scheduler", address)
            process = stack.enter_context(running(asked))
            time.sleep(draw.uniform(0.2, 0.8) * took_s)
            os.killpg(workers[attempt % 2].pid, signal.SIGKILL)
            _, told = process.communicate(timeout=300)
        assert process.returncode == 0, told.decode()
        assert bytes_of(folder / "store") == expected


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_run_may_be_killed_again_and_again(parts, whole, tmp_path):
    expected, took_s = whole
    draw = random.Random(13)
    store = tmp_path / "store"
    kills = 0
    while kills < 10:
        with running(command(parts, store, "--resume")) as process:
            time.sleep(draw.uniform(0.2, 0.7) * took_s)
            kills += process.poll() is None
        if store.exists():  # it was faster: the next one starts anew
            assert bytes_of(store) == expected
            shutil.rmtree(store)
    subprocess.run(command(parts, store, "--resume"), check=True, capture_output=True)
    assert bytes_of(store) == expected
    assert [path.name for path in tmp_path.iterdir()] == ["store"]
