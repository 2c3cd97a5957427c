"""The star tracker for Basilisk, in an environment that has Basilisk and ``onboard/basilisk``."""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import starcat

PAGE = Path(__file__).parents[1] / "docs" / "closed-loop.md"


@pytest.fixture(scope="module")
def fly(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Fly with an image of the embedded sky; returns the folder of what was written."""
    python = os.environ.get("STARCAT_BASILISK_PYTHON")
    if python is None:
        pytest.skip(
            "set STARCAT_BASILISK_PYTHON to the Python of an environment in which "
            "`pip install ./onboard/basilisk` was run"
        )
    folder = tmp_path_factory.mktemp("loop")
    built = starcat.build(starcat.preset("gaia-12deg"), output=folder)
    image = folder / "sky.img"
    starcat.export(built.folder, "onboard", image)

    def flown(name: str, *options: str) -> Path:
        command = [python, "-m", "starcat_basilisk", image, "--output", folder / name, *options]
        # The package of the environment, not a folder on the path of these tests.
        kept = {key: text for key, text in os.environ.items() if key != "PYTHONPATH"}
        ran = subprocess.run(command, cwd=folder, env=kept, capture_output=True, text=True)
        assert ran.returncode == 0, ran.stdout[-2000:] + ran.stderr[-2000:]
        return folder / name

    return flown


def rows(folder: Path) -> list[dict[str, Any]]:
    """Return the legs that were flown, and last what they came to together."""
    return list(json.loads((folder / "closed_loop.json").read_text()))


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_an_orbit_has_no_wrong_attitude_and_is_as_documented(fly):
    *legs, whole = rows(fly("orbit"))
    assert whole["wrong"] == whole["stars_misnamed"] == 0
    printed = re.search(r"the whole orbit \|(.*)\|", PAGE.read_text())
    assert printed is not None
    frames, dropped, _, identified = (
        int(cell.replace(",", "")) for cell in printed[1].split("|")[:4]
    )
    assert whole["frames"] == frames
    assert whole["dropped"] == dropped
    # Other processors round otherwise, and the loop goes its own way from there on.
    assert whole["identified"] == pytest.approx(identified, rel=0.01)
    assert whole["across_rms_arcsec"] < 2.0
    assert whole["in_stated_noise"] == pytest.approx(1.0, abs=0.1)
    moon = next(leg for leg in legs if "Moon through" in leg["name"])
    assert moon["identified"] > 0.95 * moon["frames"]
    assert sum(legs[5]["withheld"].values()) > 3000  # the Earth fills the field


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_same_seed_gives_the_same_bytes(fly):
    once, again, other = (
        fly(name, "--minutes", "3", "--seed", seed)
        for name, seed in (("once", "1"), ("again", "1"), ("other", "2"))
    )
    for name in ("closed_loop.json", "closed_loop.svg"):
        assert (once / name).read_bytes() == (again / name).read_bytes()
        assert (once / name).read_bytes() != (other / name).read_bytes()


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_every_frame_is_found_without_a_prior_too(fly):
    (tumbling,) = rows(fly("lost", "--minutes", "1.9", "--without-prior"))[:-1]
    assert tumbling["tracked_percent"] == 0.0
    assert tumbling["wrong"] == 0
    assert tumbling["identified"] > 0.95 * tumbling["frames"]
