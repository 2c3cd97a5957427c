"""The distribution that only identifies: its files, its dependencies, its messages."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import starcat
from starcat.cli.alone import run_alone

ROOT = Path(__file__).parents[2]
NO_TYPER = ModuleNotFoundError(name="typer")


@pytest.fixture(scope="module")
def frame_file(small_database, tmp_path_factory):
    [made] = starcat.simulate(small_database, seed=7)
    path = tmp_path_factory.mktemp("alone") / "frame.csv"
    path.write_text("x_px,y_px\n" + "".join(f"{x},{y}\n" for x, y in made.centroids_px))
    return path, made


def test_alone_it_identifies_and_says_what_it_lacks(small_database, frame_file, capsys):
    path, made = frame_file
    assert run_alone(["identify", str(small_database), str(path), "--json"], NO_TYPER) == 0
    told = json.loads(capsys.readouterr().out)
    expected = starcat.Matcher.open(small_database).identify(made.centroids_px, fov_error=0.05)
    assert np.allclose(told["q_body_from_icrs"], expected.q_body_from_icrs, atol=1e-6)
    named = [star["star_id"] for star in told["stars"]]
    assert named == list(map(str, expected.stars.star_id))
    assert run_alone(["identify", str(small_database), str(path)], NO_TYPER) == 0
    assert f"frame: identified: {expected.n_matched} of " in capsys.readouterr().out
    assert run_alone(["identify", str(small_database), "none.csv"], NO_TYPER) == 3
    assert "no such file" in capsys.readouterr().err
    assert run_alone(["build", "spec.toml"], NO_TYPER) == 2
    assert "starcat build needs the library 'typer'" in capsys.readouterr().err


def test_alone_it_advises_no_option_that_it_lacks(small_database, tmp_path, capsys):
    places = np.random.default_rng(3).uniform(20.0, 490.0, (9, 2))
    rows = "".join(f"{x:.2f},{y:.2f},5.0\n" for x, y in places)
    (tmp_path / "frame.csv").write_text(f"x_px,y_px,mag\n{rows}")
    assert run_alone(["identify", str(small_database), str(tmp_path / "frame.csv")], NO_TYPER) == 0
    told = capsys.readouterr().out
    assert "; hint: " in told
    assert set(re.findall(r"--[a-z-]+", told)) <= {"--fov-error"}


@pytest.mark.slow
@pytest.mark.timeout(500)
def test_the_matcher_is_installed_with_three_libraries(small_database, frame_file, tmp_path):
    def run(*words, code=0):
        how = {"cwd": tmp_path, "env": environment, "capture_output": True, "text": True}
        done = subprocess.run(words, check=False, **how)
        assert done.returncode == code, done.stderr
        return done

    environment = {name: text for name, text in os.environ.items() if name != "PYTHONPATH"}
    run(sys.executable, "-m", "venv", "new")
    python, command = tmp_path / "new/bin/python", tmp_path / "new/bin/starcat"
    site = Path(run(python, "-c", "import site; print(site.getsitepackages()[0])").stdout.strip())
    before = {path.name for path in site.iterdir()}
    install = ["-m", "pip", "install", "--disable-pip-version-check"]
    told = run(python, *install, ROOT / "packages/matcher")
    assert "ERROR" not in told.stdout + told.stderr
    assert "No broken requirements" in run(python, "-m", "pip", "check").stdout
    sizes = {path.name: bytes_in(path) for path in site.iterdir() if path.name not in before}
    assert sizes["starcat"] < 3e6
    new = {re.split(r"[.-]", name)[0] for name in sizes}
    needed = {"numpy", "h5py", "cffi", "_cffi_backend", "pycparser"}
    assert new <= {"starcat", "starcat_matcher"} | needed
    assert sum(sizes.values()) < 100e6  # numpy and h5py from PyPI are 90 MB of them

    path, made = frame_file
    told = run(command, "identify", small_database, path, "--json").stdout
    assert json.loads(told)["n_matched"] >= 0.9 * made.n_stars
    program = f"import starcat as s; print(s.__file__, s.Matcher.open({str(small_database)!r}))"
    assert str(site) in run(python, "-c", program).stdout
    for lacking in ([command, "build"], [python, "-m", "starcat", "build"]):
        assert run(*lacking, code=2).stderr == (
            "starcat: error: starcat build is not in starcat-matcher, which only identifies stars; "
            "pip uninstall starcat-matcher, then pip install starcat-guide-stars\n"
        )
    assert (
        "starcat.build is not in starcat-matcher"
        in run(python, "-c", "import starcat; starcat.build", code=1).stderr
    )
    program = f"import starcat; starcat.identify_file({str(small_database)!r}, 'a.png')"
    shown = run(python, "-c", program, code=1).stderr
    assert "starcat.identify_file is not in starcat-matcher" in shown


def bytes_in(path: Path) -> int:
    return sum(file.stat().st_size for file in [path, *path.rglob("*")] if file.is_file())
