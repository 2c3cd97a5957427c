"""Tracking: frames near a prior attitude, and sequences of frames."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from frames import both_engines
from slew import is_near, slew, wrong_by

from starcat.errors import ConfigError
from starcat.geometry.attitude import after_turn, matrix_from_quaternion
from starcat.geometry.camera import Camera
from starcat.matcher import prior as prior_search
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.matcher import Matcher
from starcat.matcher.tracking import MAX_STEPS, Tracker
from starcat.pipeline.simulation.simulate import (
    Noise,
    SimulatedFrame,
    Sky,
    simulate_frame,
    simulate_frames,
)

HARD = Noise(0.5, drop_probability=0.1, false_stars=3)


@pytest.fixture(scope="module")
def sky(sky_of, random_directions) -> MatcherDatabase:
    return sky_of(random_directions(2000, 1))


def frames(
    sky: MatcherDatabase, count: int, noise: Noise = HARD, seed: int = 31
) -> list[SimulatedFrame]:
    return list(simulate_frames(sky.directions, sky.camera, count, noise, seed, sky.mag))


def wrong(frame: SimulatedFrame, angle_deg: float, seed: int) -> np.ndarray:
    return wrong_by(frame.matrix, math.radians(angle_deg), np.random.default_rng(seed))


@both_engines
@pytest.mark.parametrize("error_deg", [1e-3, 0.1, 0.5, 2.0, 10.0, 20.0])
def test_a_frame_near_a_prior_gets_the_stars_that_it_gets_lost_in_space(sky, engine, error_deg):
    matcher, same = Matcher(sky, engine=engine), 0
    for number, frame in enumerate(frames(sky, 20)):
        lost = matcher.identify(frame.centroids_px)
        prior = wrong(frame, 0.999 * error_deg, number)
        found = matcher.identify(frame.centroids_px, prior=prior, prior_error_deg=error_deg)
        assert (lost.origin, found.origin) == ("lost_in_space", "tracking")
        if lost.ok:
            assert found.star_ids.tolist() == lost.star_ids.tolist()
            same += 1
    assert same >= 18


@both_engines
def test_magnitudes_and_stated_noises_hold_near_a_prior_too(sky, engine):
    matcher = Matcher(sky, engine=engine, noise_px=0.5, noise_mag=0.3)
    noise, same = Noise(0.5, 0.1, 3, noise_mag=0.3), 0
    for error_deg in (0.1, 3.0):
        for number, frame in enumerate(frames(sky, 20, noise)):
            lost = matcher.identify(frame.centroids_px, mag=frame.mag)
            prior = wrong(frame, error_deg, number)
            near = {"prior": prior, "prior_error_deg": error_deg}
            found = matcher.identify(frame.centroids_px, mag=frame.mag, **near)
            assert found.ok == lost.ok
            # A centroid at the end of the reach may move the attitude so that it is within.
            both = (found.star_ids >= 0) & (lost.star_ids >= 0)
            assert (found.star_ids == lost.star_ids)[both].all()
            same += found.star_ids.tolist() == lost.star_ids.tolist()
    assert same >= 38


@pytest.mark.parametrize("most_stars", [prior_search.MAX_STARS, 0], ids=["few stars", "many stars"])
def test_what_is_near_the_prior_takes_few_steps(sky, monkeypatch, most_stars):
    monkeypatch.setattr(prior_search, "MAX_STARS", most_stars)
    budget = 2_500 if most_stars else 1_000_000
    matcher = Matcher(sky, engine="numpy", max_steps=budget)
    found = [
        matcher.identify(frame.centroids_px, prior=wrong(frame, 4.0, n), prior_error_deg=5.0)
        for n, frame in enumerate(frames(sky, 10))
    ]
    assert [answer.status for answer in found] == ["identified"] * 10


def test_a_prior_needs_no_product(sky):
    bare = replace(sky, products={})
    (frame,) = frames(sky, 1)
    for error_deg in (0.1, 5.0):
        found = Matcher(bare, engine="numpy").identify(
            frame.centroids_px, prior=wrong(frame, error_deg, 1), prior_error_deg=error_deg
        )
        assert is_near(found.q_body_from_icrs, frame.matrix)


@both_engines
@pytest.mark.parametrize("error_deg", [0.1, 2.0])
def test_an_attitude_far_from_the_prior_is_no_answer(sky, engine, error_deg):
    matcher = Matcher(sky, engine=engine)
    for number, frame in enumerate(frames(sky, 20)):
        for away_deg in (30.0, error_deg + 1.0):
            found = matcher.identify(
                frame.centroids_px, prior=wrong(frame, away_deg, number), prior_error_deg=error_deg
            )
            assert (found.status, found.n_matched, found.origin) == ("no_match", 0, "tracking")
            assert np.isnan(found.q_body_from_icrs).all()
            assert (found.star_ids == -1).all()
            assert (found.star_index == -1).all()
            assert found.refusal is not None
            assert found.refusal.reason in ("prior", "chance", "share_of_frame")
        # Only false spots are no answer near any prior.
        px, prior = np.random.default_rng(number).random((15, 2)) * 1024.0, wrong(frame, 0.0, 1)
        assert not matcher.identify(px, prior=prior, prior_error_deg=error_deg).ok


def test_an_unknown_scale_and_a_prior_are_found_together(sky):
    matcher = Matcher(sky, engine="numpy")
    for number, frame in enumerate(frames(sky, 5)):
        camera = sky.camera.with_focal_length(1.015 * sky.camera.focal_length_px)
        asked = {"fov_error": 0.02, "prior_error_deg": 2.0}
        near = wrong(frame, 1.9, number)
        found = matcher.identify(frame.centroids_px, camera, prior=near, **asked)
        assert is_near(found.q_body_from_icrs, frame.matrix)
        assert found.origin == "tracking"
        away = wrong(frame, 9.0, number)
        found = matcher.identify(frame.centroids_px, camera, prior=away, **asked)
        assert found.status == "no_match"


UPRIGHT = [0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("prior", "error_deg", "words"),
    [
        ([0.0, 0.0, 0.0, 0.0], 1.0, "not all 0"),
        ([0.0, 0.0, 1.0], 1.0, "expected a quaternion"),
        ([UPRIGHT], 1.0, "expected a quaternion"),
        (UPRIGHT, 21.0, "expected 1e-09 to 20"),
        (UPRIGHT, np.nan, "expected 1e-09 to 20"),
        (UPRIGHT, "1", "expected 1e-09 to 20"),
        ([0.0, 0.0, [0.0], 1.0], 1.0, "prior: not an array of real numbers"),
        ([0.0, 0.0, 0.0, np.inf], 1.0, "expected a quaternion"),
        (UPRIGHT, None, "prior_error_deg is missing"),
        (None, 1.0, "prior is missing"),
    ],
)
def test_a_prior_that_is_invalid_is_refused(sky, prior, error_deg, words):
    with pytest.raises(ConfigError, match=words):
        Matcher(sky).identify(np.zeros((5, 2)), prior=prior, prior_error_deg=error_deg)


def test_the_length_of_the_prior_does_not_matter(sky):
    (frame,) = frames(sky, 1)
    matcher, prior = Matcher(sky, engine="numpy"), wrong(frame, 0.1, 2)
    one, other = (
        matcher.identify(frame.centroids_px, prior=scale * prior, prior_error_deg=0.2)
        for scale in (1.0, -3.0)
    )
    np.testing.assert_allclose(one.q_body_from_icrs, other.q_body_from_icrs, atol=1e-12)
    for scale in (1e200, 1e-300):  # the squares are beyond all numbers
        found = matcher.identify(frame.centroids_px, prior=scale * prior, prior_error_deg=0.2)
        np.testing.assert_allclose(one.q_body_from_icrs, found.q_body_from_icrs, atol=1e-12)


@both_engines
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("count", "jumps"),
    [(300, (150,)), pytest.param(10_000, (2_500, 5_000, 7_501), marks=pytest.mark.slow)],
)
def test_a_slew_is_tracked_and_a_jump_costs_no_frame(sky, engine, count, jumps):
    tracker, origins, missed = Tracker(Matcher(sky, engine=engine)), [], 0
    for frame in slew(sky, count, HARD, 7, jumps):
        found = tracker.identify(frame.centroids_px)
        assert not found.ok or is_near(found.q_body_from_icrs, frame.matrix)
        missed += not found.ok
        origins.append(found.origin)
    assert missed <= 0.001 * count
    for jump in (0, *jumps):
        assert origins[jump : jump + 2] == ["lost_in_space", "tracking"]
    assert Counter(origins)["tracking"] >= min(0.995 * count, count - 5)


@both_engines
def test_frames_without_stars_are_bridged(sky, engine):
    tracker = Tracker(Matcher(sky, engine=engine))
    origins = {}
    for number, frame in enumerate(slew(sky, 60, HARD, 7)):
        # Two dark frames, then so many that the last answer is of no use.
        dark = number in (20, 21) or 40 <= number <= 40 + MAX_STEPS
        found = tracker.identify(np.zeros((0, 2)) if dark else frame.centroids_px)
        assert found.status == ("too_few_stars" if dark else "identified")
        assert dark or is_near(found.q_body_from_icrs, frame.matrix)
        origins[number] = found.origin
    assert origins[22] == origins[39] == "tracking"
    assert origins[41 + int(MAX_STEPS)] == "lost_in_space"


@both_engines
def test_times_that_are_not_equally_apart(sky, engine):
    every = list(slew(sky, 90, HARD, 9))
    times = [n for n in range(90) if n < 10 or n % 3 != 1]
    tracker = Tracker(Matcher(sky, engine=engine))
    found = [tracker.identify(every[n].centroids_px, time_s=0.1 * n) for n in times]
    for n, answer in zip(times, found, strict=True):
        assert is_near(answer.q_body_from_icrs, every[n].matrix)
    assert [answer.origin for answer in found[1:]] == ["tracking"] * (len(times) - 1)


def turning(sky, angles_deg, noise=HARD):
    """Yield frames of a camera that has turned by these angles about its x axis."""
    stars = Sky(sky.directions, sky.mag, np.arange(len(sky.mag), dtype=np.int32))
    generator = np.random.default_rng(12)
    for angle_deg in angles_deg:
        q = after_turn((0.0, 0.0, 0.0, 1.0), (math.radians(angle_deg), 0.0, 0.0))
        matrix = matrix_from_quaternion(np.array(q))
        yield simulate_frame(stars, sky.camera, matrix, noise, generator)


@pytest.mark.parametrize("step_s", [0.05, 5.0, 60.0])
def test_the_unit_of_time_does_not_matter(sky, step_s):
    tracker = Tracker(Matcher(sky))
    found = [
        tracker.identify(frame.centroids_px, time_s=step_s * number)
        for number, frame in enumerate(turning(sky, 0.05 * np.arange(6)))
    ]
    assert [answer.origin for answer in found] == ["lost_in_space", *["tracking"] * 5]


@pytest.mark.parametrize("acceleration_deg", [0.05, 0.2])
@pytest.mark.parametrize(
    "times", [[*range(6), *range(10, 15)], [0, 1, 2, 3, 4, 5, 9, 9.5, 10, 10.5]], ids=str
)
def test_a_turn_that_speeds_up_is_tracked_after_missing_frames(sky, acceleration_deg, times):
    times = np.array(times, dtype=float)
    tracker = Tracker(Matcher(sky))
    angles_deg = 0.3 * times + 0.5 * acceleration_deg * times**2
    for time_s, frame in zip(times, turning(sky, angles_deg), strict=True):
        found = tracker.identify(frame.centroids_px, time_s=time_s)
        assert found.origin == ("tracking" if time_s else "lost_in_space"), time_s


def test_the_first_of_two_attempts_can_be_recorded(sky):
    trackers = [Tracker(Matcher(sky)) for _ in range(2)]
    for number, frame in enumerate(turning(sky, range(6))):
        for tracker in trackers:
            found = tracker.attempt(frame.centroids_px)
            if tracker is trackers[1] and number == 4:
                assert tracker.attempt(frame.centroids_px[::-1] * 0.9).status == "no_match"
            tracker.record(found)
    assert trackers[0]._motion == trackers[1]._motion
    assert trackers[0]._motion.change_rad < 0.01


def test_numbers_of_numpy_are_numbers_and_trackers_can_be_compared(sky):
    matcher = Matcher(sky)
    tracker, other = Tracker(matcher, np.int64(3)), Tracker(matcher, 3.0)
    for number, frame in enumerate(turning(sky, range(2))):
        tracker.identify(frame.centroids_px, time_s=np.int64(number))
    assert tracker == other
    with pytest.raises(ConfigError, match="max_turn_deg is True"):
        Tracker(matcher, max_turn_deg=True)


def test_turns_and_times_that_cannot_be_are_refused(sky):
    for max_turn_deg in (0.0, -1.0, 21.0, math.nan, "5", None):
        with pytest.raises(ValueError, match=r"max_turn_deg is .*; expected above 0, at most 20"):
            Tracker(Matcher(sky), max_turn_deg=max_turn_deg)
    tracker = Tracker(Matcher(sky, engine="numpy"))
    tracker.identify(np.zeros((0, 2)), time_s=2.0)
    for time_s in (2.0, 1.0, math.nan, math.inf, "3"):
        with pytest.raises(ValueError, match=r"expected a number above 2\.0"):
            tracker.identify(np.zeros((0, 2)), time_s=time_s)
    tracker.reset()
    tracker.identify(np.zeros((0, 2)), time_s=1.0)


def test_a_narrow_field_is_tracked(sky_of, random_directions):
    """The noise of its centroids turns it about its axis by many pixels of a shift."""
    camera = Camera(1024, 1024, fov_x_deg=2.0)
    around = random_directions(400_000, 4)
    u = around[around[:, 0] > math.cos(math.radians(12.0))]
    narrow = sky_of(u, camera, 3000)
    tracker = Tracker(Matcher(narrow, engine="numpy"), max_turn_deg=1.0)
    generator = np.random.default_rng(5)
    q = (0.5, 0.5, 0.5, 0.5)
    boresight = matrix_from_quaternion(np.array(q))[2]
    assert boresight[0] > 0.99
    all_stars = Sky(u, narrow.mag, np.arange(len(u), dtype=np.int32))
    origins = []
    for _ in range(40):
        q = after_turn(q, (0.002, 0.001, 0.01))
        matrix = matrix_from_quaternion(np.array(q))
        frame = simulate_frame(all_stars, camera, matrix, HARD, generator)
        found = tracker.identify(frame.centroids_px)
        assert is_near(found.q_body_from_icrs, frame.matrix)
        origins.append(found.origin)
    assert origins[1:] == ["tracking"] * 39


def test_frames_are_followed_as_they_come(sky):
    frames_px = (frame.centroids_px for frame in slew(sky, 5, HARD, 7))
    answers = Tracker(Matcher(sky)).follow(frames_px)
    assert next(answers).origin == "lost_in_space"
    assert len(list(frames_px)) == 4
    assert not list(answers)
    some = [frame.centroids_px for frame in slew(sky, 10, HARD, 7, (5,))]
    one, other = (
        [answer.q_body_from_icrs.tobytes() for answer in Tracker(Matcher(sky)).follow(some)]
        for _ in range(2)
    )
    assert one == other
