"""`Matcher.identify` obeys the same arguments for a file as for a frame."""

from __future__ import annotations

import json

import numpy as np
import pytest
from astropy.coordinates import SkyCoord

import starcat
from starcat.errors import ConfigError
from starcat.images.render import write_simulated


@pytest.fixture(scope="module")
def matcher(small_artifact):
    return starcat.Matcher.open(small_artifact)


@pytest.fixture(scope="module")
def frame(small_artifact):
    return starcat.simulate(small_artifact, seed=7)[0]


@pytest.fixture(scope="module")
def paths(matcher, frame, tmp_path_factory):
    folder = tmp_path_factory.mktemp("frames")
    content = {"centroids_px": frame.centroids_px.tolist(), "mag": frame.mag.tolist()}
    (folder / "frame.json").write_text(json.dumps(content))
    write_simulated(folder / "frame.png", frame, matcher.database.camera, 7)
    return folder / "frame.json", folder / "frame.png"


FAR = [0.0, 0.0, 0.0, 1.0]
ARGUMENTS = {
    "nothing": {},
    "prior far away": {"prior": FAR, "prior_error_deg": 1.0},
    "boresight far away": {"prior": SkyCoord(0.0, 0.0, unit="deg"), "prior_error_deg": 1.0},
    "prior without error": {"prior": FAR},
    "prior_error_deg of 30": {"prior": FAR, "prior_error_deg": 30.0},
    "another field": {"fov_deg": 5.0},
    "no field": {"fov_deg": -12},
    "the wider field first": {"fov_deg": (14, 10)},
    "a range without levels": {"fov_deg": (10, 14)},
    "a range and an error": {"fov_deg": (10, 14), "fov_error": 0.1},
    "a range and a prior": {"fov_deg": (10, 14), "prior": FAR, "prior_error_deg": 1.0},
    "fov_error of 7": {"fov_error": 7},
    "fov_error": {"fov_error": 0.03},
    "no camera": {"camera": 3},
    "explain": {"fov_deg": 20.0, "explain": True},
}


def outcome(matcher, given, arguments) -> str:
    try:
        found = matcher.identify(given, **arguments)
    except (starcat.StarcatError, TypeError) as error:
        return f"{type(error).__name__}: {error}"
    return found.status


@pytest.mark.parametrize("name", ARGUMENTS)
def test_a_file_has_the_answer_and_the_error_of_its_frame(matcher, frame, paths, name):
    expected = outcome(matcher, frame, ARGUMENTS[name])
    assert [outcome(matcher, path, ARGUMENTS[name]) for path in paths] == [expected] * 2


def test_a_file_of_centroids_has_the_same_answer_to_the_last_bit(matcher, frame, paths):
    for arguments in ({}, {"mag": frame.mag + 1.0}, {"sigma_px": np.full(len(frame.mag), 0.3)}):
        found = matcher.identify(paths[0], **arguments)
        assert found == matcher.identify(frame, **arguments)
        assert np.array_equal(found.matrix, matcher.identify(frame, **arguments).matrix)


def test_a_right_prior_is_used_for_files(matcher, frame, paths):
    prior = {"prior": matcher.identify(frame).rotation(), "prior_error_deg": 0.5}
    assert [matcher.identify(path, **prior).ok for path in paths] == [True, True]
    assert matcher.identify(paths[0], **prior).origin == "tracking"


@pytest.mark.parametrize("name", ["mag", "sigma_px"])
def test_what_a_picture_measures_itself_is_refused(matcher, frame, paths, name):
    with pytest.raises(
        ConfigError, match=f"^{name}: it is for centroids, and .*frame.png is a pict"
    ):
        matcher.identify(paths[1], **{name: frame.mag})
    with pytest.raises(ConfigError, match=rf"^{name} has shape \(2,\)"):
        matcher.identify(paths[0], **{name: [1.0, 2.0]})


def test_the_limits_of_the_matcher_hold_for_pictures(small_artifact, paths):
    hurried = starcat.Matcher.open(small_artifact, max_steps=1)
    assert hurried.identify(paths[1]).refusal.reason == "steps"
    assert hurried.identify(paths[0]).refusal.reason == "steps"
