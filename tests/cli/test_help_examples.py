"""The examples in the help of the commands run as printed.

Each runs in a folder with the files of a user: an archive file, and the databases that the other
examples name, built from a small sky so that most of this takes little time.
"""

from __future__ import annotations

import gzip
import json
import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from starcat.cli.options import chosen_spec
from starcat.cli.reference import every_command
from starcat.frames.images.solve_files import answer_file
from starcat.matcher.database import open_database
from starcat.pipeline.build import build
from starcat.pipeline.simulation.simulate import Noise, simulate_frames

Run = Callable[[list[Any]], Any]

COMMANDS = every_command()
NETWORK = {"fetch": "downloads an archive from its servers; test_fetch has servers of its own"}
LASTING = {"serve": "runs until it is ended; test_howto_serve runs and ends it"}
NEEDS = {
    "token list": ("token create",),
    "token revoke": ("token create",),
    "crossmatch": ("ingest",),
    "releases": ("publish",),
    "pull": ("publish",),
    "identify": ("simulate",),
    "keys roles": ("keys new",),
    "keys show": ("keys new", "keys roles"),
    "keys renew": ("keys new", "keys roles"),
}
"""The commands whose examples make what another example reads."""
SLOW = ("build", "rebuild")
"""They build the preset itself, from the whole embedded sky."""


def examples() -> dict[str, str]:
    """The example of each command."""
    found = {}
    for name, command in COMMANDS.items():
        (line,) = re.findall(r"^Example: (.+(?:\n.+)*)", command.help, re.MULTILINE)
        found[name] = " ".join(line.split())
    return found


@pytest.fixture(scope="module")
def workplace(
    tmp_path_factory: pytest.TempPathFactory, small_spec: str, sao_lines: list[bytes]
) -> Path:
    """An archive file, two versions of a database called as in the examples, and frames."""
    folder = tmp_path_factory.mktemp("examples")
    (folder / "sao.dat.gz").write_bytes(gzip.compress(b"".join(sao_lines), mtime=0))
    for version in ("1.0.0", "1.1.0"):
        spec = small_spec.replace('"small"', '"gaia-12deg"').replace("1.0.0", version)
        (folder / "spec.toml").write_text(spec)
        build(
            chosen_spec(folder / "spec.toml", None),
            folder / "dist",
            inputs={"sao": [folder / "sao.dat.gz"]},
        )
    database = open_database(folder / "dist" / "gaia-12deg-1.0.0")
    frames = simulate_frames(
        database.directions, database.camera, 6, Noise(0.2), 1, mag=database.mag
    )
    content = [
        {"centroids_px": frame.centroids_px.tolist(), "mag": frame.mag.tolist()} for frame in frames
    ]
    (folder / "frames.json").write_text(json.dumps(content))
    answers = answer_file(folder / "frames.json", folder / "dist" / "gaia-12deg-1.0.0")
    lines = [json.dumps(answer.content()) for answer in answers]
    (folder / "answers.ndjson").write_text("\n".join(lines))
    return folder


@pytest.fixture
def here(workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the workplace, and in it."""
    folder = tmp_path / "here"
    shutil.copytree(workplace, folder)
    monkeypatch.chdir(folder)
    return folder


def run_example(name: str, starcat: Run) -> Any:
    words = shlex.split(examples()[name])
    assert f"{' '.join(words)} ".startswith(f"starcat {name} ")
    return starcat(words[1:])


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=[pytest.mark.slow] * (n in ("estimate", "evaluate")), id=n)
        for n in COMMANDS
        if n not in (*SLOW, *NETWORK, *LASTING)
    ],
)
def test_an_example_runs_as_printed(name, starcat, here):
    if name == "crossmatch":
        table = ["ingest", "gaia", "-o", "gaia.parquet", "--read-limit-mag", "5"]
        assert starcat(table).code == 0
    for other in NEEDS.get(name, ()):
        assert run_example(other, starcat).code == 0
    run = run_example(name, starcat)
    assert run.code == 0, run.err
    for path in re.findall(r"(?:-o|--picture|--plot) (\S+)", examples()[name]):
        assert (here / path).exists()


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_examples_of_a_whole_build_run_as_printed(starcat, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in SLOW:
        run = run_example(name, starcat)
        assert run.code == 0, run.err


def test_what_is_not_run_is_known_and_still_there():
    assert set(NETWORK) | set(SLOW) | set(LASTING) <= set(COMMANDS)
    assert examples()["fetch"].startswith("starcat fetch ")
