"""Whole builds: what they count, that they repeat byte for byte, and that they can be killed."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import pytest
from drafts import spec_with

from starcat.database.verify import check_database
from starcat.errors import OutputError
from starcat.pipeline.build import Built, build
from starcat.storage.atomic import move_into_place

FILES = {
    "database.h5", "manifest.json", "report/index.html", "rejected.parquet",
    "report/self_test.json", "stars.parquet",
}  # fmt: skip
"""Every database has these; each other product adds a Parquet file."""

LOG = "small-1.0.0.build.json"


def content(folder: Path) -> dict[str, bytes]:
    """Every file except the logs next to databases: their times differ."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != LOG)
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def command(spec: Path, stars: Path, output: Path) -> list[str]:
    run = [sys.executable, "-m", "starcat", "build", str(spec)]
    return [*run, "--input", f"sao={stars}", "-o", str(output)]


# What a build counts ------------------------------------------------------------------------


Event = tuple[str, int, int | None]


@pytest.fixture(scope="module")
def first(tmp_path_factory, sao_lines, small_spec):
    """The small spec, built once, and its progress."""
    folder = tmp_path_factory.mktemp("first")
    (folder / "sao.dat").write_bytes(b"".join([*sao_lines, b"too short\n"]))
    events: list[Event] = []
    built = build(
        spec_with(small_spec), folder / "dist", inputs={"sao": [folder / "sao.dat"]},
        progress=lambda *event: events.append(event),
    )  # fmt: skip
    return built, events


def test_products_hold_what_the_sources_count(first: tuple[Built, list[Event]]) -> None:
    manifest = first[0].manifest
    (source,) = manifest["sources"]
    rows = {name: facts["rows"] for name, facts in manifest["products"].items()}
    assert rows["stars"] == source["kept"]
    assert rows["rejected"] == sum(source["rejected"].values())
    assert rows["boresights"] == 200
    assert source["rejected"]["malformed_record"] == 1
    assert source["rows_read"] == 601 == rows["stars"] + rows["rejected"]
    assert first[0].problems[0].startswith("sao.dat line 601")


def test_files_are_those_of_the_manifest(first: tuple[Built, list[Event]]) -> None:
    built, _ = first
    assert built.outcome == "written"
    assert set(content(built.folder)) == {*built.manifest["files"], "manifest.json"} >= FILES
    assert {facts["parquet"] for facts in built.manifest["products"].values()} == {
        name for name in built.manifest["files"] if name.endswith(".parquet")
    }
    assert json.loads((built.folder / "manifest.json").read_bytes()) == built.manifest
    assert check_database(built.folder).manifest == built.manifest
    assert sorted(os.listdir(built.folder.parent)) == ["small-1.0.0", LOG]


def test_progress_only_goes_forward(first: tuple[Built, list[Event]]) -> None:
    _, events = first
    stages = list(dict.fromkeys(stage for stage, _, _ in events))
    assert (stages[0], stages[-3:]) == ("read sao", ["self-test", "report", "verify"])
    for stage in stages:
        done = [done for name, done, _ in events if name == stage]
        totals = {total for name, _, total in events if name == stage}
        assert done == sorted(done)
        assert len(totals) == 1
        total = totals.pop()
        assert total is None or done[-1] == total


# Byte for byte ------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_same_build_has_the_same_bytes(sao_file: Path, small_spec: str, tmp_path: Path) -> None:
    """Whatever hash seed, folders, time zone, locale, home folder, workers and matplotlibrc are."""
    made = []
    settings = "font.size: 31\naxes.facecolor: red\nsavefig.transparent: True\nsvg.fonttype: none\n"
    for seed, zone, locale in (("1", "UTC", "C"), ("2", "Asia/Tokyo", "C.UTF-8")):
        folder = tmp_path / f"run-{seed}"
        folder.mkdir()
        (folder / "spec.toml").write_text(small_spec)
        (folder / "matplotlibrc").write_text(settings if seed == "2" else "")
        shutil.copy(sao_file, folder)
        environment = {"PYTHONHASHSEED": seed, "TZ": zone, "LC_ALL": locale, "HOME": str(folder)}
        environment["SOURCE_DATE_EPOCH"] = seed
        run = command(folder / "spec.toml", folder / "sao.dat", folder / "dist")
        run += ["--workers", seed]
        subprocess.run(run, cwd=folder, env=os.environ | environment, check=True)
        made.append(content(folder / "dist"))
    assert set(made[0]) >= {f"small-1.0.0/{name}" for name in FILES}
    assert made[0] == made[1]


def test_nothing_of_the_machine_is_in_the_files(first: tuple[Built, list[Event]]) -> None:
    folder = first[0].folder
    host, today = socket.gethostname(), datetime.now(UTC).strftime("%Y-%m-%d")
    secrets = [str(folder.parent), str(Path.home()), str(Path.cwd()), today]
    secrets += [host] if len(host) > 4 else []
    for name, data in content(folder).items():
        for secret in secrets:
            assert secret.encode() not in data, (name, secret)


def test_only_a_damaged_database_is_replaced(first, small_spec, tmp_path):
    dist = Path(shutil.copytree(first[0].folder.parent, tmp_path / "dist"))
    folder, stars = dist / "small-1.0.0", first[0].folder.parents[1] / "sao.dat"

    def outcome() -> str:
        return build(spec_with(small_spec), dist, inputs={"sao": [stars]}, replace=True).outcome

    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    whole = content(folder)
    assert outcome() == "unchanged"
    assert {path: path.stat().st_mtime_ns for path in before} == before
    (folder / "pairs.parquet").unlink()
    (folder / "pairs.parquet").write_bytes(b"PAR1")
    assert outcome() == "replaced"
    assert content(folder) == whole
    assert sorted(os.listdir(dist)) == ["small-1.0.0", LOG]


def foreign_folder(final: Path) -> str:
    final.mkdir()
    (final / "mine.txt").write_text("mine")
    return "has files that starcat did not write: mine.txt"


def foreign_file(final: Path) -> str:
    final.write_text("mine")
    return "is a file; expected a folder or nothing"


def link_to_nothing(final: Path) -> str:
    final.symlink_to("nowhere")
    return "is a symbolic link to nowhere"


@pytest.mark.parametrize("make", [foreign_folder, foreign_file, link_to_nothing])
def test_what_starcat_did_not_write_is_refused_before_the_work(
    make, first, small_spec, tmp_path, monkeypatch
):
    def work(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr("starcat.pipeline.build.run", work)
    words = make(tmp_path / "small-1.0.0")
    stars = first[0].folder.parents[1] / "sao.dat"
    with pytest.raises(OutputError, match=words):
        build(spec_with(small_spec), tmp_path, inputs={"sao": [stars]}, replace=True)
    if make is not foreign_folder:
        with pytest.raises(OutputError, match=words):
            build(spec_with(small_spec), tmp_path, inputs={"sao": [stars]})
    assert os.listdir(tmp_path) == ["small-1.0.0"]


def test_files_that_the_manifest_does_not_list_are_kept(first, small_spec, tmp_path):
    dist = Path(shutil.copytree(first[0].folder.parent, tmp_path / "dist"))
    (dist / "small-1.0.0" / "report" / "mine.txt").write_text("mine")
    stars = first[0].folder.parents[1] / "sao.dat"
    with pytest.raises(OutputError, match=r"did not write: report/mine\.txt\. Nothing was repl"):
        build(spec_with(small_spec), dist, inputs={"sao": [stars]}, replace=True)
    assert (dist / "small-1.0.0" / "report" / "mine.txt").read_text() == "mine"


def test_a_build_whose_log_cannot_be_written_is_complete(first, small_spec, tmp_path):
    (tmp_path / LOG).mkdir()
    stars = first[0].folder.parents[1] / "sao.dat"
    built = build(spec_with(small_spec), tmp_path, inputs={"sao": [stars]})
    assert built.outcome == "written"
    assert f"{tmp_path / LOG}: cannot be written" in built.warnings[-1]


# Stopped in the middle ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def slower(tmp_path_factory, sao_lines, small_spec):
    """Spec, stars, content and seconds of a build that takes long enough to be hit."""
    folder = tmp_path_factory.mktemp("slower")
    spec, stars = folder / "spec.toml", folder / "sao.dat"
    spec.write_text(small_spec.replace("frames = 5", "frames = 40"))
    stars.write_bytes(b"".join(sao_lines))
    began = time.monotonic()
    subprocess.run(command(spec, stars, folder / "dist"), check=True, capture_output=True)
    return spec, stars, content(folder / "dist" / "small-1.0.0"), time.monotonic() - began


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "attempts"), [(signal.SIGKILL, 6), (signal.SIGTERM, 4)], ids=["kill", "terminate"]
)
def test_a_stopped_build_leaves_no_half_database(number, attempts, slower, tmp_path):
    spec, stars, whole, seconds = slower
    generator = random.Random(int(number))
    stopped = 0
    for attempt in range(attempts):
        output = tmp_path / str(attempt)
        output.mkdir()
        run = subprocess.Popen(
            command(spec, stars, output), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        moment = time.monotonic() + generator.uniform(0.1, 0.9) * seconds
        # Most of the time goes into the start; half of the attempts wait for the first file.
        while attempt % 2 and run.poll() is None and not os.listdir(output):
            time.sleep(0.001)
        if attempt % 2:
            moment = time.monotonic() + generator.uniform(0.0, 0.3) * seconds
        time.sleep(max(0.0, moment - time.monotonic()))
        run.send_signal(number)
        _, error = run.communicate(timeout=30)
        assert run.returncode in {0, -number, 128 + number}
        assert b"Traceback" not in error
        stopped += run.returncode != 0
        if (output / "small-1.0.0").exists():
            assert content(output / "small-1.0.0") == whole
        assert all(name.endswith(".partial") for name in os.listdir(output) if name[0] == ".")
    subprocess.run(command(spec, stars, output), check=True, capture_output=True)
    assert content(output / "small-1.0.0") == whole
    assert stopped >= 2


def test_termination_cleans_up(sao_file: Path, small_spec: str, tmp_path: Path) -> None:
    from starcat.cli.interrupts import stop as end_on

    seen: list[list[str]] = []

    def terminate(stage: str, done: int, total: int | None) -> None:
        if stage == "self-test":
            seen.append(os.listdir(tmp_path / "dist"))
            os.kill(os.getpid(), signal.SIGTERM)

    spec = spec_with(small_spec)
    before = signal.signal(signal.SIGTERM, end_on)
    try:
        with pytest.raises(SystemExit) as stop:
            build(spec, tmp_path / "dist", inputs={"sao": [sao_file]}, progress=terminate)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert stop.value.code == 128 + signal.SIGTERM
    assert [len(names) for names in seen] == [1]
    assert not (tmp_path / "dist").exists()


@pytest.mark.slow
def test_two_builds_at_once(slower, tmp_path):
    spec, stars, whole, _ = slower
    both = [
        subprocess.Popen(command(spec, stars, tmp_path), stdout=subprocess.DEVNULL)
        for _ in range(2)
    ]
    assert [run.wait(timeout=30) for run in both] == [0, 0]
    assert content(tmp_path / "small-1.0.0") == whole
    assert sorted(os.listdir(tmp_path)) == ["small-1.0.0", LOG]


def test_replacing_is_undone_if_it_is_interrupted(tmp_path, monkeypatch):
    final, partial = tmp_path / "small-1.0.0", tmp_path / ".small-1.0.0.x.partial"
    for folder in (final, partial):
        folder.mkdir()
        (folder / "manifest.json").write_text(folder.name)
    rename = Path.rename

    def stop_before_the_new(self: Path, target: Path) -> Path:
        if self == partial:
            raise SystemExit(143)
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", stop_before_the_new)
    monkeypatch.setattr("starcat.storage.atomic.exchange_names", lambda *names: False)
    with pytest.raises(SystemExit):
        move_into_place(partial, final, lambda _: ["manifest.json"])
    assert (final / "manifest.json").read_text() == "small-1.0.0"
