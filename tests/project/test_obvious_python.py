"""What a user of Python tries first: frames, results, tables, units and seeds."""

from __future__ import annotations

import inspect
import json
import pickle
import sys

import astropy.units as u
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import starcat
from starcat.cli.main import app
from starcat.errors import ConfigError, NotIdentifiedError


@pytest.fixture(scope="module")
def matcher(small_database):
    return starcat.Matcher.open(small_database)


@pytest.fixture(scope="module")
def frames(small_database):
    return starcat.simulate(small_database, 6, seed=7)


@pytest.fixture(scope="module")
def dark(matcher):
    """The result of a frame that is not identified."""
    return matcher.identify([[1.0, 2.0], [30.0, 40.0], [500.0, 60.0], [70.0, 400.0]])


@pytest.fixture(scope="module")
def centroid_file(frames, tmp_path_factory):
    path = tmp_path_factory.mktemp("frames") / "first.json"
    content = {"centroids_px": frames[0].centroids_px.tolist(), "mag": frames[0].mag.tolist()}
    path.write_text(json.dumps(content))
    return path


def run(*words: object) -> str:
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    return done.stdout


def test_a_frame_is_identified_as_it_comes(matcher, frames, centroid_file):
    first, expected = frames[0], matcher.identify(frames[0].centroids_px, mag=frames[0].mag)
    assert expected.ok
    [measured] = starcat.read_frames(centroid_file)
    for frame in (first, measured, expected.frame):
        found = matcher.identify(frame)
        assert found.star_index.tolist() == expected.star_index.tolist()
        assert found.frame.mag.tolist() == first.mag.tolist()
    assert (
        matcher.identify(first, mag=first.mag + 1.0).frame.mag.tolist() == (first.mag + 1).tolist()
    )
    many = matcher.identify_many([first, measured, expected.frame])
    assert [one.star_index.tolist() for one in many] == [expected.star_index.tolist()] * 3
    followed = list(starcat.Tracker(matcher).follow([first, measured]))
    assert [one.origin for one in followed] == ["lost_in_space", "tracking"]
    for wrong in (frames, starcat.read_frames(centroid_file)):
        with pytest.raises(TypeError, match=f"list with {len(wrong)} frames; give one of them"):
            matcher.identify(wrong)


def test_the_rotation_turns_sky_into_camera(matcher, frames, dark):
    found = matcher.identify(frames[0])
    v_icrs = np.array(matcher.database.directions[found.star_index[found.star_index >= 0]])
    v_body = found.rotation().apply(v_icrs)
    assert np.abs(v_body - v_icrs @ found.matrix.T).max() < 1e-15
    px = matcher.database.camera.pixels_from_directions(v_body)
    seen = frames[0].centroids_px[found.star_index >= 0]
    assert np.abs(px - seen).max() < 5.0  # ten standard deviations of the noise
    apart = found.rotation() * Rotation.from_quat(found.q_body_from_icrs)
    assert apart.magnitude() < 1e-12
    with pytest.raises(NotIdentifiedError):
        dark.rotation()


def test_a_dict_is_what_the_command_prints(matcher, frames, dark, small_database, centroid_file):
    found = matcher.identify(frames[0]).to_dict()
    [printed] = json.loads(run("identify", small_database, centroid_file, "--json"))
    assert {"frame": "first", **found}.keys() == printed.keys()
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    # The command allows an error of the focal length, and so fits a slightly different attitude.
    for told, other in zip(found["stars"], printed["stars"], strict=True):
        assert {**other, **told}.keys() == told.keys()
        assert (told["star"], told["x_px"], told["observed_mag"]) == (
            other["star"], other["x_px"], other["observed_mag"],
        )  # fmt: skip
    assert dark.to_dict()["refusal"]["reason"] == dark.refusal.reason
    with pytest.raises(ConfigError, match="does not hold the frame"):
        pickle.loads(pickle.dumps(dark)).to_dict()


def test_a_plot_is_the_picture_of_the_command(matcher, frames, dark, small_database, centroid_file):
    drawn, plotted = centroid_file.with_suffix(".png"), centroid_file.with_name("plot.png")
    run("identify", small_database, centroid_file, "--fov-error", 0, "--picture", drawn)
    figure = matcher.identify(frames[0]).plot(plotted, name="first")
    assert plotted.read_bytes() == drawn.read_bytes()
    assert figure.texts[0].get_text().startswith("first: RA ")
    camera = matcher.database.camera
    image = np.zeros((camera.height_px, camera.width_px))
    assert dark.plot(image=image).texts[0].get_text() == "no match"
    with pytest.raises(ConfigError, match=r"one of \.png, \.svg"):
        dark.plot("plot.gif")
    with pytest.raises(ConfigError, match="image: its shape is"):
        dark.plot(image=image[:10])


def test_many_answers_are_one_table(matcher, frames, dark):
    answers = matcher.identify_many([*frames, dark.frame])
    table = answers.table()
    assert len(table) == len(frames) + 1
    assert table["status"].tolist() == answers.status
    assert table["reason"][-1] == dark.refusal.reason
    assert table["n_matched"].tolist() == [one.n_matched for one in answers]
    assert table["boresight_ra_deg"].unit == u.deg
    assert table["boresight_ra_deg"][0].value == answers[0].boresight_ra_deg
    assert table["time_s"].unit == u.s
    assert np.array_equal(table["q_body_from_icrs"], answers.q_body_from_icrs, equal_nan=True)
    assert len(matcher.identify_many([]).table()) == 0


@pytest.mark.slow
def test_a_camera_is_calibrated_from_frames_as_from_their_files(matcher, frames, tmp_path):
    night = tmp_path / "night"
    night.mkdir()
    for number, frame in enumerate(frames):
        content = {"centroids_px": frame.centroids_px.tolist(), "mag": frame.mag.tolist()}
        (night / f"frame{number}.json").write_text(json.dumps(content))
    database, answers = matcher.database, matcher.identify_many(frames)
    measured = [frame for path in sorted(night.iterdir()) for frame in starcat.read_frames(path)]
    pixels = [{"x_px": x, "y_px": y, "mag": f.mag} for f in frames for x, y in [f.centroids_px.T]]
    expected = starcat.calibrate(database, frames)
    files = [night, str(night / "*.json"), sorted(night.iterdir())]
    for given in (*files, measured, answers, iter(answers), pixels):
        found = starcat.calibrate(database, given)
        assert found.n_identified == len(found.frames) == len(frames)
        assert found.camera == expected.camera
    mixed = starcat.calibrate(database, [*frames[:3], *sorted(night.iterdir())[3:]])
    assert mixed.camera == expected.camera
    assert [one.name for one in mixed.frames][2:4] == ["frame 3", "frame3"]
    for wrong in (3, [None], [pickle.loads(pickle.dumps(answers[0]))]):
        with pytest.raises((ConfigError, TypeError), match="frames"):
            starcat.calibrate(database, wrong)


def test_magnitudes_have_one_name():
    for name in starcat.__all__:
        one = getattr(starcat, name)
        methods = vars(one).values() if isinstance(one, type) else (one,)
        for method in filter(inspect.isfunction, methods):
            arguments = set(inspect.signature(method).parameters)
            assert not arguments & {"magnitudes", "magnitude", "mags", "brightness"}, method


def test_the_same_seed_gives_the_same_frames(small_database, frames, tmp_path):
    for count in (1, 3):
        some = starcat.simulate(small_database, count, seed=7)
        for one, other in zip(some, frames, strict=False):
            assert one.matrix.tolist() == other.matrix.tolist()
            assert one.centroids_px.tolist() == other.centroids_px.tolist()
            assert one.mag.tolist() == other.mag.tolist()
    run("simulate", small_database, "-o", tmp_path / "frame.csv", "--seed", 7)
    [written] = starcat.read_frames(tmp_path / "frame.csv")
    assert np.abs(written.centroids_px - frames[0].centroids_px).max() <= 0.5e-4 + 1e-12
    assert np.abs(written.mag - frames[0].mag).max() <= 0.5e-4 + 1e-12


def test_a_prior_is_a_rotation_or_a_place_in_the_sky(matcher, frames):
    first, second = matcher.identify(frames[0]), matcher.identify(frames[1])
    near = matcher.identify(frames[0], prior=first.rotation(), prior_error_deg=0.5)
    assert (near.origin, near.star_ids.tolist()) == ("tracking", first.star_ids.tolist())
    place = first.skycoord.directional_offset_by(30 * u.deg, 0.4 * u.deg)
    for coordinate in (place, place.galactic):
        found = matcher.identify(frames[0], prior=coordinate, prior_error_deg=0.5)
        assert (found.origin, found.star_ids.tolist()) == (
            "lost_in_space", first.star_ids.tolist(),
        )  # fmt: skip
    for wrong, error_deg in ((place, 0.3), (second.skycoord, 20.0), (second.rotation(), 0.5)):
        withheld = matcher.identify(frames[0], prior=wrong, prior_error_deg=error_deg)
        assert (withheld.status, withheld.refusal.reason) == ("no_match", "prior")
    assert starcat.Tracker(matcher).identify(frames[0], prior=place, prior_error_deg=0.5).ok
    several = first.skycoord.__class__([1.0, 2.0] * u.deg, [3.0, 4.0] * u.deg)
    for wrong in (several, Rotation.from_quat(np.eye(4))):
        with pytest.raises(ConfigError, match="prior"):
            matcher.identify(frames[0], prior=wrong, prior_error_deg=0.5)
    with pytest.raises(ConfigError, match="prior_error_deg is missing"):
        matcher.identify(frames[0], prior=place)


def test_a_library_that_is_missing_is_named(matcher, frames, monkeypatch):
    found = matcher.identify(frames[0])
    for library in ("scipy.spatial.transform", "matplotlib", "astropy.table"):
        monkeypatch.setitem(sys.modules, library, None)
    many = matcher.identify_many(frames)
    for ask, name in (
        (found.rotation, "scipy"),
        (found.plot, "matplotlib"),
        (many.table, "astropy"),
    ):
        with pytest.raises(ConfigError, match=name):
            ask()
