"""``starcat-astap``: called as ASTAP is, it writes and returns what its callers expect."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS
from rendered import picture_of

from starcat.cli.astap import run_astap
from starcat.geometry.attitude import radec_roll_from_matrix
from starcat.matcher.database import open_database
from starcat.pipeline.simulation.simulate import Noise, simulate_frames


@pytest.fixture(scope="module")
def shot(small_database):
    """A frame with many stars of the small database, and its camera."""
    known = open_database(small_database)
    noise = Noise(noise_px=0.05)
    frames = simulate_frames(known.directions, known.camera, 10, noise, 5, known.mag)
    return max(frames, key=lambda one: len(one.mag)), known.camera


def keys_of(path: Path) -> dict[str, str]:
    return dict(line.split("=", 1) for line in path.read_text().splitlines())


@pytest.mark.parametrize(("fov_deg", "form"), [("0", "-wcs"), ("own", "-log")])
def test_a_picture_is_solved_into_the_files_that_programs_read(
    fov_deg, form, shot, small_database, tmp_path
):
    frame, camera = shot
    (tmp_path / "a.fits").write_bytes(picture_of(frame, camera))
    given = f"{camera.fov_y_deg:.2f}" if fov_deg == "own" else fov_deg
    options = ["-f", str(tmp_path / "a.fits"), "-fov", given, "-r", "180", "-z", "0", "-s", "500"]
    code = run_astap([*options, "-d", str(small_database), "-o", str(tmp_path / "out"), form])
    assert code == 0
    keys = keys_of(tmp_path / "out.ini")
    assert keys["PLTSOLVD"] == "T"
    ra_deg, dec_deg, _ = radec_roll_from_matrix(frame.matrix)
    truth = SkyCoord(ra_deg, dec_deg, unit="deg")
    lines = "" if form == "-wcs" else "\r\n"
    header = fits.Header.fromstring((tmp_path / "out.wcs").read_bytes().decode(), sep=lines)
    for cards in (header, {name: float(keys[name]) for name in header if name in keys}):
        assert np.hypot(cards["CD1_1"], cards["CD2_1"]) == pytest.approx(abs(cards["CDELT1"]))
        middle = [[0.5 * camera.width_px + 0.5, 0.5 * camera.height_px + 0.5]]
        found = WCS(header, naxis=2).all_pix2world(middle, 1)[0]
        assert truth.separation(SkyCoord(*found, unit="deg")).arcsec < 60
        turned = np.degrees(np.arctan2(-cards["CD1_2"], cards["CD2_2"]))
        assert cards["CROTA2"] == pytest.approx(turned)


@pytest.mark.parametrize(
    ("name", "database", "code", "said"),
    [
        ("dark.fits", "small", 2, "fewer than 4"),
        ("none.fits", "small", 16, "none.fits"),
        ("dark.fits", "", 32, "-d"),
        ("dark.fits", "missing", 32, "missing"),
        ("dark.fits", "broken", 33, "broken"),
    ],
)
def test_what_fails_has_its_code_and_its_reason(
    name, database, code, said, shot, small_database, tmp_path, monkeypatch
):
    monkeypatch.delenv("STARCAT_DATABASE", raising=False)
    image = np.random.default_rng(1).normal(100.0, 5.0, (512, 512)).astype(np.float32)
    fits.PrimaryHDU(image).writeto(tmp_path / "dark.fits")
    shutil.copytree(small_database, tmp_path / "broken")
    (tmp_path / "broken" / "manifest.json").chmod(0o644)
    (tmp_path / "broken" / "manifest.json").write_text("{}")
    folder = str(small_database if database == "small" else database and tmp_path / database)
    assert run_astap(["-f", str(tmp_path / name), "-d", folder]) == code
    keys = keys_of(tmp_path / f"{Path(name).stem}.ini")
    assert keys["PLTSOLVD"] == "F"
    assert said in keys["ERROR"]
    assert not (tmp_path / "dark.wcs").exists()
