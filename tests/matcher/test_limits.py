"""Limits of a search: reach, share of the frame, steps and time; and their messages."""

import numpy as np
import pytest
from frames import agreement_of, needs_c, observe
from hostile_frames import hostile_frame

from starcat.errors import ConfigError
from starcat.geometry.camera import Camera
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods.table import METHODS
from starcat.matcher.options import OPTIONS
from starcat.matcher.settings import Budget, BudgetSpentError
from starcat.pipeline.simulation.simulate import Noise, simulate_frames


def hard_frames(sky, count, false_stars=3, noise_px=0.3):
    noise = Noise(noise_px, 0.1, false_stars)
    return simulate_frames(sky.directions, sky.camera, count, noise, 4, sky.mag)


@pytest.mark.parametrize("half_px", [40.0, 450.0], ids=["cluster", "spread"])
def test_stars_that_do_not_determine_the_corners_or_too_small_a_share_are_no_answer(
    sky_of, random_directions, half_px
):
    # Ten stars are seen, and nothing else of all that the camera should see.
    camera, generator = Camera(1024, 1024, fov_x_deg=12.0), np.random.default_rng(2)
    stars_px = 512.0 + generator.uniform(-half_px, half_px, (10, 2))
    others_px = generator.uniform(0.0, 1024.0, (30, 2))
    seen = camera.directions_from_pixels(np.concatenate([stars_px, others_px]))
    sky = sky_of(np.concatenate([random_directions(1200, 1), seen]))
    noisy_px = stars_px + generator.normal(scale=0.3, size=stars_px.shape)
    px = np.concatenate([noisy_px, generator.uniform(0.0, 1024.0, (30, 2))])
    for min_share in (1.0 / 3.0, 0.0):
        observation = observe(px, camera, 2.0, min_share=min_share)
        found = agreement_of(np.eye(3), observation, sky)
        is_answer = half_px > 100.0 and not min_share
        assert found.withheld == (None if is_answer else "share_of_frame")
        assert 0.0 < found.share < 1.0 / 3.0
        assert found.n_matched >= 10
        assert found.chance < 1e-9
        assert found.false_match_probability == (found.chance if is_answer else 1.0)


def test_the_reason_of_chance_has_the_best_agreement(sky):
    for frame in hard_frames(sky, 3, 0):
        strict = Matcher(sky, engine="numpy", max_false_match_probability=1e-300)
        refusal = strict.identify(frame.centroids_px).refusal
        answer = Matcher(sky, engine="numpy").identify(frame.centroids_px)
        assert (refusal.reason, refusal.n_matched) == ("chance", answer.n_matched)
        # That of a shape: five models share a tenth of the risk, and the camera has the others.
        most = 5.0 * 0.9 / 0.1 * answer.false_match_probability
        assert 1e-300 < refusal.false_match_probability <= most * (1.0 + 1e-9)


@pytest.mark.parametrize("method", ["triangle", "pairs", "pyramid"])
def test_the_same_budget_of_steps_gives_the_same_answer(sky, method):
    px = np.random.default_rng(0).uniform(0.0, 1024.0, (40, 2))
    refusals = []
    for _ in range(2):
        matcher = Matcher(sky, method=method, max_steps=400)
        refusals.append(matcher.identify(px).refusal)
    assert refusals[0] == refusals[1]
    assert refusals[0].reason == "steps"
    budget = Budget(max_steps=700)
    seen = observe(px, sky.camera, 2.0, budget=budget)
    with pytest.raises(BudgetSpentError, match="steps"):
        list(METHODS[method].propose(seen, sky))
    assert budget.steps <= 700
    [frame] = hard_frames(sky, 1)
    assert Matcher(sky, method=method, max_steps=100_000).identify(frame.centroids_px).ok


def test_a_search_can_take_all_steps_of_its_budget():
    budget = Budget(max_steps=700)
    for steps in (300, 400):
        budget.spend(steps)
    with pytest.raises(BudgetSpentError, match="steps"):
        budget.spend(1)
    assert budget.steps == 700


def test_a_limit_of_time_ends_a_search_that_finds_nothing(sky):
    px = np.random.default_rng(0).uniform(0.0, 1024.0, (300, 2))
    result = Matcher(sky, tolerance_px=8.0, time_limit_s=1e-3).identify(px)
    assert result.refusal.reason == "time"
    assert "time limit" in repr(result.refusal)


def test_limits_that_are_none_are_refused(sky):
    for given, text in (
        ({"min_share": 1.5}, "min_share is 1.5; expected 0 to 1"),
        ({"max_steps": 0}, "max_steps is 0; expected a number, at least 1"),
        ({"time_limit_s": float("nan")}, "time_limit_s is nan; expected a number, at least 1e-06"),
    ):
        with pytest.raises(ConfigError, match=text):
            Matcher(sky, **given)


@needs_c
def test_the_library_has_no_other_limit_of_steps(sky):
    with pytest.raises(ConfigError, match="no other selection, share of the frame and limits"):
        Matcher(sky, engine="c", max_steps=10)


@pytest.mark.parametrize(
    ("name", "most", "expected"),
    [
        ("tolerance_px", 200.0, "0.001 to 200"),
        ("noise_px", 50.0, "0.001 to 50"),
        ("noise_mag", 10.0, "0.0001 to 10"),
        ("max_false_match_probability", 1.0, "0 to 1"),
        ("min_share", 1.0, "0 to 1"),
    ],
)
def test_numbers_out_of_range_are_refused(sky, name, most, expected):
    for value in (np.nextafter(most, np.inf), -1.0, np.nan, np.inf, "1", True, np.ones(2)):
        with pytest.raises(ConfigError, match=f"{name} is .*; expected {expected}$"):
            Matcher(sky, **{name: value})
    for value in (most, np.float32(most), OPTIONS[name].low):
        assert getattr(Matcher(sky, **{name: value}).settings, name) == value
    if OPTIONS[name].low == 0.0:
        assert getattr(Matcher(sky, **{name: 0}).settings, name) == 0
    else:
        with pytest.raises(ConfigError, match=f"{name} is 0; expected {expected}$"):
            Matcher(sky, **{name: 0})


def test_what_a_search_for_the_field_does_not_serve_is_refused(sky):
    for value in (-0.1, 0.6, np.nan, "0.1", np.ones(2)):
        with pytest.raises(ConfigError, match=r"fov_error is .*; expected 0 to 0\.5"):
            Matcher(sky).identify(np.zeros((5, 2)), fov_error=value)
    refused = r"method is 'pairs'; it needs the focal length; only 'triangle'"
    with pytest.raises(ConfigError, match=refused):
        Matcher(sky, method="pairs").identify([(1.0, 1.0)], fov_error=0.02)


def test_frames_that_no_answer_belongs_to_get_none(sky):
    matcher = Matcher(sky, max_steps=3_000)
    for number in range(24):
        kind, px, mag, fov_error = hostile_frame(number, sky)
        result = matcher.identify(px, mag=mag, fov_error=fov_error)
        assert not result.ok, (number, kind)
