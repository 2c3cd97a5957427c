"""Attitude errors of a camera that stands still, measured against the rotation of the Earth."""

from __future__ import annotations

import csv
import json
from datetime import UTC, datetime, timedelta

import erfa
import numpy as np
import pytest
from astropy.io import fits

from starcat.errors import CalibrationError, ConfigError
from starcat.frames.calibration.calibrate import calibrate_frames
from starcat.frames.calibration.earth_rotation import earth_rotation, times_of_frames
from starcat.frames.calibration.files import measured_frames, names_of_files
from starcat.frames.sky.observer import Observer
from starcat.geometry.attitude import matrix_from_radec_roll
from starcat.geometry.camera import Camera
from starcat.matcher.centroids import MeasuredFrame, write_centroids
from starcat.matcher.matcher import Matcher

START = datetime(2026, 11, 22, 2, 0, 0, tzinfo=UTC)
NOISE_PX = 0.3
PLACES = (matrix_from_radec_roll(40.0, 30.0, 10.0), matrix_from_radec_roll(120.0, 55.0, -70.0))
"""Attitudes that the camera had against the ground."""


def night(database, rate_arcsec_s=15.041067, count=14):
    """Frames of one camera that stood twice, and the time of each; a second of noise is none."""
    generator, frames, times = np.random.default_rng(4), [], {}
    for n in range(count):
        time = START + timedelta(seconds=37.0 * n)
        observer, turn = Observer.at(time), np.radians(rate_arcsec_s * 37.0 * n / 3600.0)
        spin = np.array(
            [[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
        )
        # Precession and nutation give the pole of the Earth.
        attitude = PLACES[n // (count // 2)] @ spin @ erfa.pnm06a(*observer.tt_jd)
        body = observer.apparent(database.directions) @ attitude.T
        px = database.camera.pixels_from_directions(body)
        inside = database.camera.contains(px)
        px = px[inside] + generator.normal(scale=NOISE_PX, size=(int(inside.sum()), 2))
        frames.append(MeasuredFrame(f"photo {n}", px, database.mag[inside]))
        times[f"photo {n}"] = time
    return frames, times


@pytest.fixture(scope="module")
def database(sky_of, random_directions):
    return sky_of(random_directions(4000, 5), Camera(1280, 960, fov_x_deg=20.0))


def calibrated(database, frames):
    camera = database.camera
    return calibrate_frames(Matcher(database), frames, camera, (0.99 * camera.focal_length_px,
                            1.01 * camera.focal_length_px))  # fmt: skip


def test_errors_are_those_of_the_centroids_and_the_earth_turns_as_it_does(database):
    frames, times = night(database)
    calibration = calibrated(database, frames)
    found = earth_rotation(calibration, times)
    assert (len(found.frames), found.n_sets) == (14, 2)
    np.testing.assert_allclose(found.rms_arcsec, found.expected_arcsec, rtol=0.5)
    assert 0.4 < found.chi2 < 1.8
    assert found.within >= 13
    assert abs(found.rate_arcsec_s - 15.041067) < 4.0 * found.rate_error_arcsec_s < 0.5
    with pytest.raises(CalibrationError, match="0 of 14 identified frames have a time"):
        earth_rotation(calibration, {})
    alone = {name: times[name] for name in ("photo 0", "photo 13")}
    with pytest.raises(CalibrationError, match="looked elsewhere in each of 2 frames"):
        earth_rotation(calibration, alone)


def test_a_mount_that_drifts_is_seen_in_the_rate(database):
    frames, times = night(database, rate_arcsec_s=14.5)
    found = earth_rotation(calibrated(database, frames), times)
    assert found.rate_arcsec_s == pytest.approx(14.5, abs=4.0 * found.rate_error_arcsec_s)
    assert found.about_pole_arcsec > 5.0 * max(found.expected_arcsec[:2])


def test_times_are_of_a_table_with_a_line_a_frame(tmp_path):
    table = tmp_path / "times.csv"
    table.write_text("frame,time\nphoto 0,2026-11-22T02:00:00\nphoto 1,2026-11-22T03:00:00+01:00\n")
    assert times_of_frames([], table) == {"photo 0": START, "photo 1": START}
    table.write_text("frame,time\nphoto 0,yesterday\n")
    with pytest.raises(ConfigError, match="line 2: time is 'yesterday'"):
        times_of_frames([], table)
    with pytest.raises(ConfigError, match="no frame has its time in it"):
        times_of_frames([], None)
    hdu = fits.PrimaryHDU(np.zeros((8, 8), np.uint16))
    hdu.header["DATE-OBS"] = "2026-03-01"
    hdu.writeto(tmp_path / "day.fits")
    with pytest.raises(ConfigError, match=r"day\.fits: DATE-OBS is '2026-03-01', a date without"):
        times_of_frames([tmp_path / "day.fits"], None)


def test_the_command_prints_the_errors_and_json_has_them(starcat, small_database, tmp_path, capsys):
    database = Matcher.open(small_database).database
    frames, times = night(database, count=6)
    paths = []
    for n, frame in enumerate(frames):
        paths.append(tmp_path / f"photo {n}.csv")
        write_centroids(frame.centroids_px, paths[-1], frame.mag)
    with (tmp_path / "times.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["frame", "time"])
        rows.writerows((name, time.isoformat()) for name, time in times.items())
    asked = ["calibrate", small_database, *paths, "-o", tmp_path / "camera.toml",
             "--earth-rotation", "--times", tmp_path / "times.csv"]  # fmt: skip
    run = starcat(asked)
    assert run.code == 0, run.err
    assert "Against the rotation of the Earth" in run.out
    said = json.loads(starcat([*asked, "--json", "--replace"]).out)["earth_rotation"]
    assert len(said["frames"]) == 6


def test_pictures_of_one_name_in_two_folders_keep_their_times(tmp_path):
    paths = [tmp_path / night / "img_1.fits" for night in ("a", "b")]
    heads = [{"DATE-OBS": "2026-03-01T20:00:00"}, {"DATE-OBS": "2026-03-01", "UT": "23:00:00.5"}]
    for path, head in zip(paths, heads, strict=True):
        path.parent.mkdir()
        hdu = fits.PrimaryHDU(np.zeros((64, 64), np.uint16) + np.eye(64, dtype=np.uint16))
        hdu.header.update(head)
        hdu.writeto(path)
    found = times_of_frames(paths, None)
    assert [time.isoformat() for time in found.values()] == [
        "2026-03-01T20:00:00+00:00", "2026-03-01T23:00:00.500000+00:00",
    ]  # fmt: skip
    assert list(found) == names_of_files(paths) == [str(path.with_suffix("")) for path in paths]
    measured, _ = measured_frames(paths)
    assert [frame.name for frame in measured] == list(found)
    assert names_of_files([paths[0], tmp_path / "img_2.csv"]) == ["img_1", "img_2"]
