"""The star tracker for Basilisk, in an environment that has ``onboard/integrations/basilisk``."""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import starcat
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import directions_from_radec

PAGE = Path(__file__).parents[2] / "docs" / "closed-loop.md"


@pytest.fixture(scope="module")
def python() -> str:
    """The Python that has Basilisk."""
    found = os.environ.get("STARCAT_BASILISK_PYTHON")
    if found is None:
        pytest.skip(
            "set STARCAT_BASILISK_PYTHON to the Python of an environment in which "
            "`pip install ./onboard/integrations/basilisk` was run"
        )
    return found


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An image of the embedded sky."""
    folder = tmp_path_factory.mktemp("loop")
    built = starcat.build(starcat.preset("gaia-12deg"), output=folder)
    starcat.export(built.folder, "onboard", folder / "sky.img")
    return folder / "sky.img"


def run(python: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run it with the package of its environment, not a folder on the path of these tests."""
    kept = {key: text for key, text in os.environ.items() if key != "PYTHONPATH"}
    return subprocess.run(
        [python, *map(str, arguments)], env=kept, capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def fly(python: str, image: Path) -> Callable[..., Path]:
    """Fly; return the folder of the written files."""

    def flown(name: str, *options: str, file: Path = image, error: str = "") -> Path:
        output = image.parent / name
        ran = run(python, "-m", "starcat_basilisk", file, "--output", output, *options)
        assert ran.returncode == (2 if error else 0), ran.stdout[-2000:] + ran.stderr[-2000:]
        assert error in ran.stderr
        return output

    return flown


def rows(folder: Path) -> list[dict[str, Any]]:
    """Return the legs that were flown, and last what they came to together."""
    return list(json.loads((folder / "closed_loop.json").read_text()))


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_an_orbit_has_no_wrong_attitude_and_is_as_documented(fly):
    *legs, whole = rows(fly("orbit"))
    assert whole["wrong"] == 0
    # False centroids at the places of stars that were missed: 1 to 3 an orbit.
    assert whole["stars_misnamed"] < 1e-5 * whole["stars_named"]
    printed = re.search(r"the whole orbit \|(.*)\|", PAGE.read_text())
    assert printed is not None
    frames, _, identified = (int(cell.replace(",", "")) for cell in printed[1].split("|")[:3])
    assert whole["frames"] == frames
    assert f"{whole['dropped']} frames are dropped" in PAGE.read_text()
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


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_bad_arguments_are_named(fly):
    fly("bad", file=PAGE, error="is no image that opens (code -3)")
    fly("bad", file=PAGE.with_suffix(".img"), error="closed-loop.img is not there")
    fly("bad", "--minutes", "nan", error="--minutes is nan; expected")
    fly("bad", "--seed", "-4", error="--seed is -4; expected")


ONE_FRAME = """
import json, sys
from pathlib import Path
from starcat_basilisk.scenario import START, simulate
_, records, tracker = simulate(Path(sys.argv[1]), 0.1)
truth = records.truth
print(json.dumps({
    "start": START, "seconds": truth.times()[-1] * 1e-9,
    "r_m": truth.r_BN_N[-1].tolist(), "v_m_s": truth.v_BN_N[-1].tolist(),
    "sigma": truth.sigma_BN[-1].tolist(),
    "centroids": list(tracker.lastCentroids()), "ids": list(tracker.lastIds()),
}))
"""


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_stars_are_where_starcat_itself_sees_them(python, image):
    """Projection, mounting and aberration of the frames, of which the loop takes the last out."""
    ran = run(python, "-c", ONE_FRAME, image)
    assert ran.returncode == 0, ran.stderr
    seen = json.loads(ran.stdout)
    year, month, day, hour, minute, _ = seen["start"]
    time = datetime(year, month, day, hour, minute) + timedelta(seconds=seen["seconds"])
    observer = starcat.Observer.at(
        time,
        position_km=np.array(seen["r_m"]) / 1000.0,
        velocity_km_s=np.array(seen["v_m_s"]) / 1000.0,
    )
    stars = starcat.open(next(image.parent.glob("gaia-12deg-*/manifest.json")).parent).table(
        "stars"
    )
    row_of = {number: row for row, number in enumerate(stars["star_id"].to_pylist())}
    pairs = [(n, row_of[number]) for n, number in enumerate(seen["ids"]) if number in row_of]
    assert len(pairs) > 8
    frame, rows = np.array(pairs).T
    u = directions_from_radec(stars["ra_deg"].to_numpy()[rows], stars["dec_deg"].to_numpy()[rows])
    # MRPs are the axis times the tangent of a quarter of the angle.
    body = Rotation.from_mrp(seen["sigma"]).as_matrix().T
    camera = body[[1, 2, 0]]
    measured = np.reshape(seen["centroids"], (-1, 3))[frame, :2]
    lens = Camera(1024, 1024, fov_x_deg=12.0)
    off = measured - lens.pixels_from_directions(observer.apparent(u) @ camera.T)
    # Aberration is 0.5 px here; a centroid has 0.06 px and more.
    assert np.abs(np.median(off, axis=0)).max() < 0.1
    assert np.abs(off).max() < 1.0
    without = measured - lens.pixels_from_directions(u @ camera.T)
    assert np.abs(np.median(without, axis=0)).max() > 0.2
