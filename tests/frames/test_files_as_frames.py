"""`starcat.identify_file` has the answers of ``starcat identify``, and obeys every option."""

from __future__ import annotations

import json

import numpy as np
import pytest
from astropy.coordinates import SkyCoord

import starcat
from starcat.errors import ConfigError
from starcat.frames.images.render import write_simulated


@pytest.fixture(scope="module")
def matcher(small_database):
    return starcat.Matcher.open(small_database)


@pytest.fixture(scope="module")
def frame(small_database):
    return starcat.simulate(small_database, seed=7)[0]


@pytest.fixture(scope="module")
def paths(matcher, frame, tmp_path_factory):
    folder = tmp_path_factory.mktemp("frames")
    content = {"centroids_px": frame.centroids_px.tolist(), "mag": frame.mag.tolist()}
    (folder / "frame.json").write_text(json.dumps(content))
    write_simulated(folder / "frame.png", frame, matcher.database.camera, 7)
    return folder / "frame.json", folder / "frame.png"


FAR = [0.0, 0.0, 0.0, 1.0]
OUTCOMES = {
    "nothing": ({}, "identified"),
    "prior far away": ({"prior": FAR, "prior_error_deg": 1.0}, "no_match"),
    "the same as an option": ({"prior_q": FAR, "prior_error_deg": 1.0}, "no_match"),
    "an error of no prior": ({"prior_error_deg": 1.0}, "prior_q is missing"),
    "boresight far away": (
        {"prior": SkyCoord(0.0, 0.0, unit="deg"), "prior_error_deg": 1.0},
        "no_match",
    ),
    "prior without error": ({"prior": FAR}, "prior_error_deg is missing"),
    "prior_error_deg of 30": ({"prior": FAR, "prior_error_deg": 30.0}, "expected 1e-09 to 20"),
    "another field": ({"fov_deg": 5.0}, "no_match"),
    "no field": ({"fov_deg": -12}, "fov_x_deg"),
    "a range without levels": ({"fov_deg": (10, 14)}, "levels"),
    "a range and an error": ({"fov_deg": (10, 14), "fov_error": 0.1}, "either fov_deg"),
    "fov_error of 7": ({"fov_error": 7}, "expected 0 to 0.5"),
    "fov_error": ({"fov_error": 0.03}, "identified"),
    "no camera": ({"camera": 3}, "a starcat.Camera"),
    "one step": ({"max_steps": 1}, "no_match"),
    "a limit that none passes": ({"max_false_match_probability": 1e-300}, "no_match"),
    "a tolerance of another kind": ({"tolerance_px": 1000.0}, "expected 0.001 to 200"),
}


@pytest.mark.parametrize("name", OUTCOMES)
def test_a_file_obeys_every_option(matcher, paths, name):
    options, expected = OUTCOMES[name]
    for path in paths:
        assert expected in outcome(matcher, path, options)


def outcome(matcher, path, options) -> str:
    try:
        return starcat.identify_file(matcher, path, **options).status
    except (starcat.StarcatError, TypeError) as error:
        return str(error)


def test_a_database_and_a_matcher_have_the_same_answer(small_database, matcher, frame, paths):
    found = starcat.identify_file(matcher, paths[0])
    assert starcat.identify_file(small_database, paths[0]) == found
    options = starcat.IdentifyOptions(fov_error=0.0)
    exact = starcat.identify_file(matcher, paths[0], options)
    assert np.array_equal(exact.matrix, matcher.identify(frame).matrix)
    with pytest.raises(TypeError, match="fov_eror"):
        starcat.identify_file(matcher, paths[0], fov_eror=0.1)


def test_a_right_prior_is_used_for_files(matcher, frame, paths):
    prior = {"prior": matcher.identify(frame).rotation(), "prior_error_deg": 0.5}
    assert [starcat.identify_file(matcher, path, **prior).ok for path in paths] == [True, True]
    assert starcat.identify_file(matcher, paths[0], **prior).origin == "tracking"


def test_a_matcher_takes_arrays_and_no_files(matcher, paths):
    for path in (*paths, str(paths[0])):
        with pytest.raises(ConfigError, match="is a file; identify it with"):
            matcher.identify(path)


def test_the_limits_of_the_matcher_hold_for_files(small_database, paths):
    hurried = starcat.Matcher.open(small_database, max_steps=1)
    for path in paths:
        assert starcat.identify_file(hurried, path).refusal.reason == "steps"
