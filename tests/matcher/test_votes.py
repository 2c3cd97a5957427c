"""Votes: frames that triangles do not solve, in C and in numpy."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from frames import assert_same

from starcat.geometry.attitude import random_attitudes
from starcat.geometry.camera import Camera
from starcat.matcher import c_engine, numpy_engine
from starcat.matcher.chance import MIN_STARS, least_matches, log_false_match_probability
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods import votes
from starcat.matcher.observation import Candidates, as_frame, observe
from starcat.matcher.settings import Settings, TriangleOrder
from starcat.matcher.shape import derivatives
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame, Sky, simulate_frame

CAMERA = Camera(1024, 1024, fov_x_deg=20.0)
STATED = {"noise_px": 3.0, "noise_mag": 0.3}
HALF = Noise(3.0, 0.5, 15, noise_mag=0.3)
"""Half of about 30 stars are missing, and there are as many false spots."""

needs_c = pytest.mark.skipif(
    not c_engine.is_compiled(), reason="starcat was installed without a C compiler"
)


@pytest.fixture(scope="module")
def sky(sky_of, random_directions) -> MatcherDatabase:
    found: MatcherDatabase = sky_of(random_directions(3000, 1))
    return found


@pytest.fixture(scope="module")
def frames(sky) -> list[SimulatedFrame]:
    generator = np.random.default_rng(5)
    points = Sky(sky.directions, sky.mag, np.arange(len(sky.mag), dtype=np.int32))
    return [
        simulate_frame(points, CAMERA, matrix, HALF, generator)
        for matrix in random_attitudes(40, generator)
    ]


def settings(**changes: object) -> Settings:
    return Settings(engine="numpy", **(STATED | changes))  # type: ignore[arg-type]


def test_the_table_lists_each_neighbour_of_each_star_once(sky):
    radius_rad = 0.1
    table = votes.neighbours(sky, radius_rad)
    apart = np.arccos(np.clip(sky.directions @ sky.directions.T, -1.0, 1.0))
    np.fill_diagonal(apart, np.inf)
    for star in (0, 17, 2999):
        entry = slice(*table.offsets[star : star + 2])
        near = np.flatnonzero(apart[star] <= radius_rad)
        assert sorted(table.star[entry].tolist()) == near.tolist()
        units = table.apart[entry] / votes.APART * radius_rad
        np.testing.assert_allclose(units, apart[star, table.star[entry]], atol=1e-5)
        mags = table.magnitude[entry] / votes.PER_MAGNITUDE + votes.BRIGHTEST
        np.testing.assert_allclose(mags, sky.mag[table.star[entry]], atol=0.51 / 16.0)


def test_a_turn_of_the_sky_is_a_turn_of_all_position_angles(sky):
    [matrix] = random_attitudes(1, np.random.default_rng(3))
    u = sky.directions[:50]
    centre = np.broadcast_to(u[0], (49, 3))
    turned = votes.position_angle(centre @ matrix.T, u[1:] @ matrix.T)
    difference = np.exp(1j * (turned - votes.position_angle(centre, u[1:])))
    np.testing.assert_allclose(difference, difference[0], atol=1e-9)


@pytest.mark.slow
def test_votes_solve_frames_that_triangles_do_not(sky, frames):
    """With another order of triangles there are no votes, but all the same triangles."""
    found = Matcher(sky, engine="numpy", **STATED)
    alone = Matcher(sky, engine="numpy", selection=TriangleOrder(most_centroids=31), **STATED)
    right = [0, 0]
    for frame in frames[:12]:
        for row, matcher in enumerate((found, alone)):
            answer = matcher.identify(frame.centroids_px, mag=frame.mag)
            if answer.ok:
                assert np.degrees(np.arccos(answer.matrix[2] @ frame.matrix[2])) < 0.2
                right[row] += 1
    assert right[0] >= right[1]
    assert right[0] >= 10


@needs_c
@pytest.mark.parametrize("stated", [STATED, {"tolerance_px": 9.0}], ids=["stated", "not stated"])
@pytest.mark.parametrize("has_magnitudes", [True, False])
def test_both_engines_say_the_same(sky, frames, stated, has_magnitudes):
    fast = Matcher(sky, engine="c", **stated)
    slow = Matcher(sky, engine="numpy", **stated)
    for frame in frames[:10]:
        mag = frame.mag if has_magnitudes else None
        answers = [one.identify(frame.centroids_px, mag=mag) for one in (fast, slow)]
        if all(answer.ok for answer in answers):
            # A magnitude rounded by an image can be compatible with one centroid more.
            assert_same(*answers, log_error=0.1)
        assert answers[0].status == answers[1].status


@needs_c
def test_c_solves_as_many_and_none_wrongly(sky, frames):
    matcher, right = Matcher(sky, **STATED), 0
    assert matcher._c_engine is not None
    for frame in frames:
        answer = matcher.identify(frame.centroids_px, mag=frame.mag)
        if answer.ok:
            assert np.degrees(np.arccos(answer.matrix[2] @ frame.matrix[2])) < 0.2
            right += 1
    assert right >= 34


def test_votes_are_for_the_default_search_at_a_known_scale(sky, frames):
    frame = as_frame(frames[0].centroids_px, CAMERA, frames[0].mag)
    assert votes.can_vote(observe(frame, settings()), sky)
    assert votes.can_vote(observe(frame, settings(method="pyramid")), sky)
    assert not votes.can_vote(observe(frame, settings(method="pairs")), sky)
    assert not votes.can_vote(observe(frame, settings(selection=TriangleOrder("inradius"))), sky)
    assert not votes.can_vote(observe(frame, settings(), fov_error=0.02), sky)


def test_a_large_database_has_no_table(sky, monkeypatch, frames):
    monkeypatch.setattr(votes, "MAX_NEIGHBOURS", 10)
    frame = as_frame(frames[0].centroids_px, CAMERA, frames[0].mag)
    assert not votes.can_vote(observe(frame, settings()), sky)


def test_a_likely_attitude_ends_the_search(sky, frames, monkeypatch):
    """No reference is tried after the attitude is known, although its stars are too few."""
    tried = []
    own = votes.candidates
    monkeypatch.setattr(numpy_engine, "EFFORT_BEFORE_VOTES", 0)
    monkeypatch.setattr(votes, "candidates", lambda *given: tried.append(given[0]) or own(*given))
    strict = Matcher(sky, engine="numpy", max_false_match_probability=1e-300, **STATED)
    answer = strict.identify(frames[0].centroids_px, mag=frames[0].mag)
    assert not answer.ok
    assert answer.refusal.reason == "chance"
    assert 0 < len(tried) < votes.MAX_REFERENCES


def test_an_effort_ends_the_search_within_a_pattern():
    """A pattern costs 3, a candidate 10; the rest of the last pattern is left out."""
    stars = np.arange(5)[:, None]
    batches = [
        Candidates(stars, stars, np.array([1, 1, 1, 2, 3]), 3),
        Candidates(stars[:0], stars[:0], np.arange(0), 35),
        Candidates(stars[:1], stars[:1], np.array([36]), 36),
    ]
    patterns = numpy_engine._Patterns(iter(batches), 3, 10)

    def tried(most):
        return [one.stars.ravel().tolist() for one in patterns.within(most)]

    assert tried(14) == [[0, 1]]  # 3 and 13 are below 14, 23 is not
    assert tried(26) == []  # 2 * 3 + 20
    assert tried(40) == [[3, 4]]  # 39 for the last one
    assert tried(100) == []  # no more patterns are looked up
    assert tried(148) == []  # 36 * 3 + 40
    assert tried(149) == [[0]]
    assert patterns.tried == 5


def test_one_bright_centroid_may_be_few_stars(sky):
    """The leaders of a reference are among the stars of its magnitude, the right one first."""
    generator = np.random.default_rng(11)
    points = Sky(sky.directions, sky.mag, np.arange(len(sky.mag), dtype=np.int32))
    [matrix] = random_attitudes(1, generator)
    frame = simulate_frame(points, CAMERA, matrix, Noise(0.5, noise_mag=0.1), generator)
    seen = observe(as_frame(frame.centroids_px, CAMERA, frame.mag), settings(noise_px=0.5))
    table = votes.neighbours(sky, CAMERA.radius_rad)
    voters = votes.voters_of(0, seen, table.radius_rad)
    compatible = seen.compatible(sky.mag)
    assert compatible is not None
    stars = compatible[0].nonzero()[0]
    assert len(stars) < len(sky.mag)
    best, _ = votes.leaders(stars, voters, table)[0]
    assert best == frame.star_index[seen.rows[0]]


@needs_c
@pytest.mark.parametrize("threads", [0, 2], ids=["identify", "identify_many in two threads"])
def test_the_library_lists_neighbours_when_a_frame_first_needs_votes(
    sky, frames, threads, monkeypatch
):
    monkeypatch.setattr(c_engine, "CHUNK", 5)

    def identify(matcher, some):
        if threads:
            return list(
                matcher.identify_many(
                    [f.centroids_px for f in some], mag=[f.mag for f in some], threads=threads
                )
            )
        return [matcher.identify(f.centroids_px, mag=f.mag) for f in some]

    listed = Matcher(replace(sky, name="listed"), engine="c", **STATED)
    listed._c_engine.list_neighbours()
    expected = identify(listed, frames)
    matcher = Matcher(replace(sky, name="not listed"), engine="c", **STATED)
    table = matcher._c_engine.image
    clean = simulate_frame(
        Sky(sky.directions, sky.mag, np.arange(len(sky.mag), dtype=np.int32)),
        CAMERA, np.eye(3), Noise(0.3), np.random.default_rng(1),
    )  # fmt: skip
    assert identify(matcher, [clean])[0].ok
    assert not table.neighbours.neighbour
    for found, same in zip(identify(matcher, frames), expected, strict=True):
        assert_same(found, same)
    assert table.neighbours.neighbour
    first = table.neighbours
    matcher._c_engine.list_neighbours()
    assert table.neighbours == first


@pytest.mark.parametrize("count", [8, 20, 33, 60, 200])
@pytest.mark.parametrize("stated", [{}, {"noise_px": 0.3}, {"max_false_match_probability": 1e-3}])
def test_the_references_include_a_star_of_a_frame_that_can_be_accepted(sky, count, stated):
    px = np.random.default_rng(count).uniform(0.0, 1024.0, (count, 2))
    seen = observe(as_frame(px, CAMERA), Settings(engine="numpy", **stated))
    area = CAMERA.width_px * CAMERA.height_px / CAMERA.focal_length_px**2
    stars = round(len(sky.mag) * area / (4.0 * math.pi))
    limit = seen.settings.max_false_match_probability
    least = least_matches(count, stars, CAMERA, seen.noise_px, limit)
    needed = votes.references_needed(seen, sky)

    def miss(references: int) -> float:
        return math.comb(count - least, references) / math.comb(count, references)

    assert miss(needed) <= votes.MISS_PROBABILITY < miss(needed - 1)


def test_a_frame_with_the_least_matches_is_accepted_and_no_smaller_one():
    limit, noise_px, generator = 1e-9, 0.5, np.random.default_rng(8)
    least = least_matches(30, 25, CAMERA, noise_px, limit)
    chances = {}
    for n in (least - 1, least):
        px = generator.uniform(0.0, 1024.0, (400, n, 2))
        body = CAMERA.directions_from_pixels(px.reshape(-1, 2)).reshape(400, n, 3)
        chances[n] = np.median(
            [
                math.exp(
                    log_false_match_probability(
                        (2 * n - 3) * noise_px**2,
                        derivatives(places, seen, CAMERA, 0),
                        30,
                        25,
                        CAMERA,
                    )
                )
                / (30 - MIN_STARS + 1)  # the shares of other numbers of matches
                for places, seen in zip(px, body, strict=True)
            ]
        )
    assert chances[least] < limit < 3.0 * chances[least - 1]


@needs_c
def test_frames_without_sky_end_at_the_same_attitude(sky):
    generator = np.random.default_rng(3)
    in_c, in_numpy = Matcher(sky, engine="c", **STATED), Matcher(sky, engine="numpy", **STATED)
    for count in (14, 34, 45, 60):
        px = generator.uniform(0.0, 1024.0, (count, 2))
        mag = generator.choice(sky.mag, count)
        found, expected = in_c.identify(px, mag=mag), in_numpy.identify(px, mag=mag)
        assert_same(found, expected)
        assert found.refusal is not None
        assert expected.refusal is not None
        assert found.refusal.reason == expected.refusal.reason
        chance = expected.refusal.false_match_probability
        assert found.refusal.false_match_probability == pytest.approx(chance, rel=0.02)
