"""Candidates: the best attitude of a refused frame, and the risk as a choice."""

from __future__ import annotations

import json
import pickle
from functools import cache

import numpy as np
import pytest
from frames import ENGINES, both_engines, frames_of, needs_c

from starcat.matcher.matcher import Matcher
from starcat.pipeline.simulation.simulate import Noise

WEAK = Noise(1.0, drop_probability=0.55, false_stars=5, noise_mag=0.3)
"""Frames of which about half have a probability between 1e-9 and 1."""

STATED = {"noise_px": 1.0, "noise_mag": 0.3}


@pytest.fixture(scope="module")
def weak(sky):
    return frames_of(sky, 40, WEAK)


@pytest.fixture(scope="module")
def answers(sky, weak):
    """The answers of a matcher with the usual limit, by engine."""

    @cache
    def of(engine):
        matcher = Matcher(sky, engine=engine, **STATED)
        return [matcher.identify(frame.centroids_px, mag=frame.mag) for frame in weak]

    return of


@both_engines
def test_a_higher_limit_accepts_the_candidate_and_changes_nothing_else(sky, weak, answers, engine):
    loose = Matcher(sky, engine=engine, max_false_match_probability=1e-2, **STATED)
    counts = {"answered": 0, "candidates": 0, "none": 0}
    for frame, found in zip(weak, answers(engine), strict=True):
        other = loose.identify(frame.centroids_px, mag=frame.mag)
        if found.ok:
            assert found.refusal is None
            assert other == found
            counts["answered"] += 1
            continue
        candidate = found.refusal.candidate
        is_uncertain = found.refusal.reason == "chance"
        if candidate is None or candidate.false_match_probability > 1e-2 or not is_uncertain:
            assert not other.ok
            counts["none"] += 1
            continue
        assert found.n_matched == 0
        assert np.isnan(found.q_body_from_icrs).all()
        assert 1e-9 < candidate.false_match_probability == found.refusal.false_match_probability
        assert candidate.n_matched == found.refusal.n_matched >= 4
        assert candidate == other
        assert candidate.star_ids.tolist() == other.star_ids.tolist()
        close = {"rtol": 1e-6, "atol": 1e-6}
        np.testing.assert_allclose(candidate.covariance_arcsec2, other.covariance_arcsec2, **close)
        counts["candidates"] += 1
    assert min(counts.values()) >= 3, counts


@needs_c
def test_both_engines_have_the_same_candidates(answers):
    compared = 0
    for pair in zip(*map(answers, ENGINES), strict=True):
        one, other = (answer.refusal for answer in pair)
        assert (one is None) == (other is None)
        if one is None:
            continue
        assert one.reason == other.reason
        assert (one.candidate is None) == (other.candidate is None)
        if one.candidate is not None and one.candidate.false_match_probability < 0.1:
            assert one.candidate.star_index.tolist() == other.candidate.star_index.tolist()
            np.testing.assert_allclose(one.candidate.matrix, other.candidate.matrix, atol=1e-7)
            compared += 1
    assert compared >= 3


@both_engines
def test_a_candidate_is_of_the_whole_frame(sky, weak, answers, engine):
    matcher = Matcher(sky, engine=engine, **STATED)
    frame, before = next(
        (frame, answer.refusal.candidate)
        for frame, answer in zip(weak, answers(engine), strict=True)
        if has_candidate(answer)
    )
    # A centroid outside of the frame, and one that is no number.
    px = np.vstack([[[-5.0, 3.0]], frame.centroids_px, [[np.nan, 1.0]]])
    mag = np.concatenate([[5.0], frame.mag, [5.0]])
    found = matcher.identify(px, mag=mag)
    candidate = found.refusal.candidate
    assert candidate.star_index.tolist() == [-1, *before.star_index.tolist(), -1]
    assert dict(candidate.dropped) == dict(found.dropped) == {
        0: "out_of_frame", len(px) - 1: "not_finite",
    }  # fmt: skip
    assert (found.star_index == -1).all()
    again = pickle.loads(pickle.dumps(found)).refusal.candidate
    assert again.star_ids.tolist() == candidate.star_ids.tolist()
    # In a batch.
    [batched] = matcher.identify_many([px], mag=[mag])
    assert batched.refusal.candidate.star_index.tolist() == candidate.star_index.tolist()


@both_engines
def test_the_json_of_a_refusal_has_its_candidate(answers, engine):
    found = next(filter(has_candidate, answers(engine)))
    content = json.loads(json.dumps(found.to_dict()))
    told, candidate = content["refusal"]["candidate"], found.refusal.candidate
    assert content["status"] == "no_match"
    assert "status" not in told
    assert told["q_body_from_icrs"] == candidate.q_body_from_icrs.tolist()
    assert told["false_match_probability"] == candidate.false_match_probability
    assert sum(star["star"] is not None for star in told["stars"]) == candidate.n_matched
    assert all(star["star"] is None for star in content["stars"])


@both_engines
def test_a_frame_without_sky_has_no_likely_candidate(sky, engine):
    matcher = Matcher(sky, engine=engine, noise_px=1.0)
    generator = np.random.default_rng(4)
    for _ in range(10):
        why = matcher.identify(generator.uniform(0.0, 512.0, (15, 2))).refusal
        assert why.candidate is None or why.candidate.false_match_probability > 1e-4
    assert matcher.identify(np.zeros((2, 2))).refusal.candidate is None


def has_candidate(answer):
    return answer.refusal is not None and answer.refusal.candidate is not None
