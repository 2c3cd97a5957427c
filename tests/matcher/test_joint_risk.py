"""Frames that confirm each other, and the bound near a prior attitude."""

from __future__ import annotations

import math

import numpy as np
import pytest
from frames import few_in_numpy, frames_of
from slew import steady_turn, wrong_by

from starcat.geometry.attitude import random_attitudes
from starcat.matcher.chains import chain_of, extended
from starcat.matcher.chance import (
    LOG_ALL_ATTITUDES,
    evidence_of_frame,
    joint_false_match_probability,
    log_attitudes_within,
    log_false_match_probability,
)
from starcat.matcher.matcher import Matcher
from starcat.matcher.tracking import Tracker
from starcat.pipeline.simulation.simulate import Noise

WEAK = Noise(1.0, drop_probability=0.6, false_stars=6, noise_mag=0.3)
STATED = {"noise_px": 1.0, "noise_mag": 0.3}


def is_right(found, matrix):
    return float(found.matrix[2] @ matrix[2]) > math.cos(math.radians(0.5))


@few_in_numpy
def test_near_a_prior_fewer_stars_are_enough_and_a_wrong_prior_gives_no_answer(sky, engine, count):
    matcher = Matcher(sky, engine=engine, noise_px=4.0, noise_mag=0.3)
    noise, generator = Noise(4.0, 0.4, false_stars=6, noise_mag=0.3), np.random.default_rng(2)
    lost = near = 0
    for frame in frames_of(sky, count, noise, seed=8):
        given = {"mag": frame.mag, "prior_error_deg": 0.5}
        lost += matcher.identify(frame.centroids_px, mag=frame.mag).ok
        prior = wrong_by(frame.matrix, math.radians(0.3), generator)
        found = matcher.identify(frame.centroids_px, prior=prior, **given)
        if found.ok:
            near += 1
            assert is_right(found, frame.matrix)
        for degrees in (3.0, 90.0):
            prior = wrong_by(frame.matrix, math.radians(degrees), generator)
            assert not matcher.identify(frame.centroids_px, prior=prior, **given).ok
    assert near >= lost + count // 8


def test_the_volume_of_attitudes_within_an_angle():
    # A rotation by less than the angle, of random rotations; the ball is a little larger.
    half = 0.5 * np.arccos(np.clip((_traces(20_000) - 1.0) / 2.0, -1.0, 1.0))
    for angle in (0.5, 1.0):
        share = float((2.0 * half <= angle).mean())
        bound = math.exp(log_attitudes_within(angle) - LOG_ALL_ATTITUDES)
        assert share <= bound * 1.1
        assert share >= bound * 0.7
    assert log_attitudes_within(10.0) == LOG_ALL_ATTITUDES


def _traces(count):
    return np.einsum("kii->k", random_attitudes(count, np.random.default_rng(1)))


def test_the_joint_bound_of_one_frame_is_its_bound(sky):
    rows = np.random.default_rng(3).normal(scale=800.0, size=(6, 2, 3))
    area = math.log(sky.camera.width_px * sky.camera.height_px)
    one = evidence_of_frame(3.0, rows, 12, 15, area, LOG_ALL_ATTITUDES)
    alone = math.exp(log_false_match_probability(3.0, rows, 12, 15, sky.camera))
    # Two and more spots can agree with an attitude that is known, not four and more.
    assert joint_false_match_probability([one]) == pytest.approx(alone * 11.0 / 9.0, rel=1e-9)
    near = evidence_of_frame(3.0, rows, 12, 15, area, log_attitudes_within(0.02))
    assert joint_false_match_probability([one, near]) < 1e-3 * alone


def test_weak_frames_of_a_sequence_confirm_each_other(sky):
    matcher, generator = Matcher(sky, **STATED), np.random.default_rng(5)
    alone = together = confirmed = 0
    for _ in range(120):
        tracker, single = Tracker(matcher, max_turn_deg=1.0), False
        found = None
        for frame in steady_turn(sky, WEAK, generator):
            single |= matcher.identify(frame.centroids_px, mag=frame.mag).ok
            found = tracker.identify(frame.centroids_px, mag=frame.mag)
            if found.ok:
                assert is_right(found, frame.matrix)
                assert found.false_match_probability <= 1e-9
                confirmed += found.origin == "tracking"
                break
        alone += single
        together += found.ok
    assert together >= alone
    assert confirmed >= 2


def test_the_same_spots_again_are_no_second_proof(sky):
    matcher, repeated = Matcher(sky, **STATED), 0
    for frame in frames_of(sky, 40, WEAK, seed=8):
        found = matcher.identify(frame.centroids_px, mag=frame.mag)
        if found.ok or found.refusal.candidate is None:
            continue
        tracker = Tracker(matcher, max_turn_deg=1.0)
        for _ in range(4):
            assert not tracker.identify(frame.centroids_px, mag=frame.mag).ok
        candidate = found.refusal.candidate
        begun = chain_of(candidate, 0, matcher.settings, sky)
        assert begun is not None
        near = log_attitudes_within(0.02)
        assert extended(begun, candidate, 1, matcher.settings, sky, near) is None
        repeated += candidate.false_match_probability < 1e-4
    assert repeated >= 3


def test_sequences_without_sky_and_with_wrong_priors_have_no_answer(sky):
    matcher, generator = Matcher(sky, **STATED), np.random.default_rng(6)
    for _ in range(6):
        tracker = Tracker(matcher)
        for _ in range(3):
            px = generator.uniform(0.0, sky.camera.width_px, (14, 2))
            assert not tracker.identify(px, mag=generator.choice(sky.mag, 14)).ok
    wrong = 0
    for _ in range(10):
        tracker = Tracker(matcher, max_turn_deg=1.0)
        for frame in steady_turn(sky, WEAK, generator):
            prior = wrong_by(frame.matrix, 1.0, generator)
            found = tracker.identify(
                frame.centroids_px, mag=frame.mag, prior=prior, prior_error_deg=1.0
            )
            wrong += found.ok and not is_right(found, frame.matrix)
    assert wrong == 0
