"""Calibration from frames of a camera that turns while its rows are read: lens and motion."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from shaped import sky_of_stars, slewed_frame

from starcat.cli.calibrations import print_calibration
from starcat.frames.calibration import fit as model
from starcat.frames.calibration.calibrate import Calibration, calibrate_frames
from starcat.frames.calibration.files import starting_camera
from starcat.frames.calibration.fit import COMPLETE, FOCAL, PARAMETERS, values_of
from starcat.geometry.attitude import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    random_attitudes,
    turn_between,
)
from starcat.geometry.camera import Camera
from starcat.geometry.distortion import Distortion
from starcat.geometry.sphere import directions_from_radec, separation
from starcat.matcher.centroids import MeasuredFrame, read_centroid_files
from starcat.matcher.matcher import Matcher
from starcat.pipeline.build import build
from starcat.pipeline.simulation.simulate import Noise
from starcat.pipeline.specs.reading import read_spec

SIZE = (1280, 960)
CAMERA = Camera(*SIZE, fov_x_deg=20.0, distortion=Distortion(k1=-0.3), readout_s=0.1)
NOISE = Noise(0.3, drop_probability=0.05, false_stars=2)
MAX_RATE_DEG_S = 3.0


@pytest.fixture(scope="module")
def stars(sky_of, random_directions):
    """A database for 1280 x 960 px of 20 deg, with 28 stars per frame."""
    return sky_of(random_directions(4000, 5), Camera(*SIZE, fov_x_deg=20.0))


def slewed(stars, count, seed, fastest=MAX_RATE_DEG_S):
    """Return frames, each at another rate, with their attitudes, shears and stretches."""
    generator, frames, motions = np.random.default_rng(seed), [], []
    for k, matrix in enumerate(random_attitudes(count, generator)):
        rate = np.radians(generator.uniform(-fastest, fastest, 3)) * (1.0, 1.0, 0.0)
        one = slewed_frame(sky_of_stars(stars), CAMERA, matrix, rate, NOISE, generator)
        frames.append(MeasuredFrame(f"frame {k}", one.centroids_px, one.mag))
        # A turn about y moves stars along x, one about x along y.
        scale = CAMERA.focal_length_px * CAMERA.readout_s / CAMERA.height_px
        motions.append((matrix, -rate[1] * scale, rate[0] * scale))
    return frames, motions


def calibrated(stars, frames) -> Calibration:
    """Return the calibration of a user who knows the focal length to 5 %, and the readout."""
    focal_px = CAMERA.focal_length_px
    start = Camera(*SIZE, 1.02 * focal_px, readout_s=CAMERA.readout_s)
    return calibrate_frames(Matcher(stars), frames, start, (0.95 * focal_px, 1.05 * focal_px))


def test_lens_and_motion_are_separated(stars, capsys, tmp_path):
    frames, motions = slewed(stars, 12, 1)
    found = calibrated(stars, frames)
    assert found.has_motion
    assert found.n_identified == 12
    assert found.fit.free == (*FOCAL, "k1")
    assert found.fit.noise_px == pytest.approx(0.3, rel=0.15)
    assert found.camera.readout_s == CAMERA.readout_s
    for name in found.fit.free:
        row = PARAMETERS.index(name)
        error = found.fit.values[row] - values_of(CAMERA)[row]
        assert abs(error) < 4.0 * found.fit.errors[name], name
    for frame, (matrix, shear, stretch) in zip(found.frames, motions, strict=True):
        assert frame.shear == pytest.approx(shear, abs=0.003)
        assert frame.stretch == pytest.approx(stretch, abs=0.003)
        rate_deg_s = math.hypot(shear, stretch) * CAMERA.fov_y_deg / CAMERA.readout_s
        assert frame.turn_deg_s == pytest.approx(rate_deg_s, rel=0.05, abs=0.4)
        # The attitude is that of the middle row.
        turn = turn_between(
            quaternion_from_matrix(matrix).tolist(), frame.q_body_from_icrs.tolist()
        )
        assert np.degrees(np.hypot(*turn[:2])) < 0.005
    # Pixels that are not square would move all frames alike: nothing is said of them.
    assert found.axes.free == found.fit.free
    assert found.has_square_pixels
    print_calibration(found, tmp_path / "camera.toml", as_json=False)
    shown = capsys.readouterr()
    assert "deg/s" in shown.out
    assert f"{found.frames[0].stretch:.6g}" in shown.out
    assert "a stretch and a shear of its own" in shown.err
    print_calibration(found, tmp_path / "camera.toml", as_json=True)
    told = json.loads(capsys.readouterr().out)
    told = told[0] if isinstance(told, list) else told
    assert told["frames"][3]["stretch"] == found.frames[3].stretch
    assert told["frames"][3]["turn_deg_s"] == found.frames[3].turn_deg_s


def test_frames_of_a_camera_that_stands_have_no_motion(stars, capsys, tmp_path):
    frames, _ = slewed(stars, 8, 2, fastest=0.0)
    found = calibrated(stars, frames)
    assert not found.has_motion
    assert {frame.stretch for frame in found.frames} == {0.0}
    assert {frame.turn_deg_s for frame in found.frames} == {0.0}
    print_calibration(found, tmp_path / "camera.toml", as_json=False)
    assert "deg/s" not in capsys.readouterr().out


def seen_of(stars, count, seed, move=None):
    """Return stars of frames as a perfect matcher finds them, moved by a function of the frame."""
    generator = np.random.default_rng(seed)
    sky, frames = sky_of_stars(stars), []
    for matrix in random_attitudes(count, generator):
        frame = slewed_frame(sky, CAMERA, matrix, np.zeros(3), Noise(0.3), generator)
        px = frame.centroids_px if move is None else move(frame.centroids_px, generator)
        frames.append((px, frame.star_index, matrix))
    return model.Seen(
        np.repeat(np.arange(count), [len(px) for px, *_ in frames]),
        np.concatenate([px for px, *_ in frames]),
        stars.directions[np.concatenate([star for _, star, _ in frames])],
        np.array([matrix for *_, matrix in frames]),
    )


@pytest.mark.parametrize("seeds", [range(8), pytest.param(range(8, 40), marks=pytest.mark.slow)])
def test_noise_is_not_taken_for_motion(stars, seeds):
    values = values_of(CAMERA)
    for seed in seeds:
        seen = seen_of(stars, 6, seed)
        assert model.with_motion_if_seen(seen, values, SIZE, 0.3).motion is None


def test_pixels_that_are_not_square_are_not_taken_for_motion(stars):
    seen = seen_of(stars, 8, 3, lambda px, _: px * (1.0, 1.01) - (0.0, 4.8))
    assert model.with_motion_if_seen(seen, values_of(CAMERA), SIZE, 0.3).motion is None


def test_a_small_motion_is_seen(stars):
    def moved(px, generator):
        return px + np.outer(px[:, 1] - 480.0, generator.uniform(-3e-3, 3e-3, 2))

    seen = model.with_motion_if_seen(seen_of(stars, 8, 4, moved), values_of(CAMERA), SIZE, 0.3)
    assert seen.motion is not None
    assert 1e-3 < np.abs(seen.motion).max() < 5e-3


def test_still_centroids_are_those_of_the_middle_row(stars):
    motion = np.array([[0.01, 0.02], [-0.02, 0.01]])
    values = values_of(CAMERA)

    left = iter(motion)

    def moved(px, generator):
        shear, stretch = next(left)
        return px + np.outer((px[:, 1] - values[2]) / (1.0 - stretch), [shear, stretch])

    still, moving = seen_of(stars, 2, 5), seen_of(stars, 2, 5, moved)
    again = replace(moving, motion=motion).still_px(values)
    np.testing.assert_allclose(again, still.centroids_px, atol=1e-9)
    fit = model.fit_camera(moving.with_motion(), values, FOCAL, 0.3)
    np.testing.assert_allclose(fit.seen.motion, motion, atol=1e-3)
    assert fit.noise_px == pytest.approx(0.3, rel=0.2)
    assert len(fit.seen.of(np.array([False, True])).motion) == 1


@pytest.mark.real
def test_a_star_sensor_that_was_slewing_is_calibrated(nights, tmp_path):
    """Its lens was not calibrated, its sensor has a rolling shutter, and it turned."""
    folder = nights / "startracker"
    spec = read_spec(folder / "startracker.toml", {"self_test.frames": "5"})
    stars = Matcher.open(build(spec, tmp_path).folder)
    frames = [
        replace(read_centroid_files(path)[0], name=path.stem)
        for path in sorted((folder / "centroids").glob("*.csv"))
    ]
    found = calibrate_frames(stars, frames, *starting_camera(stars.database.camera))
    assert len(frames) == 38
    assert found.n_identified >= 37
    assert found.has_motion
    assert "k1" in found.fit.free
    assert not set(COMPLETE) & set(found.fit.free) - {*FOCAL, "k1", "k2"}
    assert found.fit.values[PARAMETERS.index("k1")] == pytest.approx(-0.115, abs=0.02)
    assert found.fit.noise_px < 0.55
    stretches = np.array([one.stretch for one in found.frames if one.status == "identified"])
    assert stretches.min() < -0.015
    assert stretches.max() > 0.01
    shears = np.array([one.shear for one in found.frames if one.status == "identified"])
    assert np.abs(shears).max() < 0.003
    answers = np.genfromtxt(folder / "answers.csv", delimiter=",", names=True)
    known = directions_from_radec(answers["ra_deg"], answers["dec_deg"])
    boresight = {f"frame_{int(row['frame']):02d}": known[k] for k, row in enumerate(answers)}
    identified = [one for one in found.frames if one.status == "identified"]
    axes = np.array([matrix_from_quaternion(one.q_body_from_icrs)[2] for one in identified])
    expected = np.array([boresight[one.name] for one in identified])
    assert np.degrees(separation(axes, expected)).max() < 0.06
