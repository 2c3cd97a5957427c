"""Small fields: four known stars among missing and false ones are found from any pair of them."""

from __future__ import annotations

import numpy as np
import pytest
from frames import frames_of as frames
from frames import observe
from skies import PATTERN_CAMERA as CAMERA
from skies import pattern_sky as database
from slew import is_near

from starcat.geometry.sphere import separation
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods import dynamic_angle
from starcat.matcher.methods.dynamic_angle import bases
from starcat.matcher.settings import Budget, BudgetSpentError
from starcat.pipeline.simulation.simulate import SimulatedFrame


@pytest.fixture(scope="module")
def sky(random_directions):
    return database(random_directions(2500, 1))


def sparse(frame: SimulatedFrame, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return centroids and stars of a frame that keeps four stars and has five false ones."""
    kept = generator.choice(len(frame.star_index), 4, replace=False)
    false = generator.uniform(0.0, 1024.0, (5, 2))
    centroids = np.concatenate([frame.centroids_px[kept], false])
    truth = np.concatenate([frame.star_index[kept], np.full(5, -1)])
    order = generator.permutation(9)
    return centroids[order], truth[order]


def solved(sky, count: int, seed: int = 5) -> int:
    matcher = Matcher(sky, method="dynamic_angle", tolerance_px=1.0, engine="numpy")
    generator, right = np.random.default_rng(seed), 0
    for frame in frames(sky, count, seed=seed):
        centroids, truth = sparse(frame, generator)
        found = matcher.identify(centroids)
        if found.ok:
            assert is_near(found.q_body_from_icrs, frame.matrix)
            assert np.array_equal(found.star_index[truth >= 0], truth[truth >= 0])
            right += 1
    return right


def test_four_stars_of_fifteen_are_found_among_false_ones(sky, monkeypatch):
    # Four stars that lie close together do not determine the corners of the frame.
    assert solved(sky, 20) >= 19
    monkeypatch.setattr(dynamic_angle, "bases", lambda observation, database: iter(()))
    assert solved(sky, 10) < 7


def test_three_centroids_are_as_far_apart_as_their_stars(sky):
    generator, proposed = np.random.default_rng(2), 0
    for frame in frames(sky, 10):
        centroids, _ = sparse(frame, generator)
        observation = observe(centroids, CAMERA, 4.0)
        for batch in bases(observation, sky):
            u, seen = sky.directions[batch.stars], observation.separation_rad
            for one, other in ((0, 1), (0, 2), (1, 2)):
                apart = seen[batch.centroids[:, one], batch.centroids[:, other]]
                error = separation(u[:, one], u[:, other]) - apart
                assert np.abs(error).max() <= observation.side_tolerance_rad
            proposed += len(batch)
    assert proposed > 20


def test_a_base_of_two_stars_needs_two_more(sky):
    frame = frames(sky, 1)[0]
    observation = observe(frame.centroids_px[:3], CAMERA, 1.0)
    assert list(bases(observation, sky)) == []
    apart = observe(np.array([[5.0, 5.0], [1000.0, 5.0], [5.0, 1000.0], [999.0, 999.0]]), CAMERA, 1)
    assert list(bases(apart, sky)) == []  # no pair is within the radius of the neighbours
    poles = database(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))
    assert list(bases(observe(frame.centroids_px, CAMERA, 1), poles)) == []


def test_the_search_has_an_end_and_a_budget(sky, monkeypatch):
    frame = frames(sky, 1)[0]
    whole = sum(len(batch) for batch in bases(observe(frame.centroids_px, CAMERA, 2.0), sky))
    monkeypatch.setattr(dynamic_angle, "MAX_PLACES", 20_000)
    assert 0 < sum(len(b) for b in bases(observe(frame.centroids_px, CAMERA, 2.0), sky)) < whole
    limited = observe(frame.centroids_px, CAMERA, 2.0, budget=Budget(max_steps=100))
    with pytest.raises(BudgetSpentError):
        list(bases(limited, sky))
