"""Frames that confirm each other, and the bound near a prior attitude."""

from __future__ import annotations

import math

import numpy as np
from frames import few_in_numpy, frames_of
from slew import steady_turn, wrong_by

from starcat.geometry.attitude import after_turn, matrix_from_quaternion, random_attitudes
from starcat.geometry.camera import Camera
from starcat.matcher.chance import LOG_ALL_ATTITUDES, log_attitudes_within
from starcat.matcher.composite import composite_of, joined
from starcat.matcher.matcher import Matcher
from starcat.matcher.observation import as_frame, observe
from starcat.matcher.settings import Settings
from starcat.matcher.tracking import Tracker
from starcat.pipeline.simulation.simulate import Noise

WEAK = Noise(4.0, drop_probability=0.5, false_stars=6, noise_mag=0.3)
STATED = {"noise_px": 4.0, "noise_mag": 0.3}


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


def _observed(sky, body, noise_px=1.0):
    px = sky.camera.pixels_from_directions(body)
    return observe(as_frame(px, sky.camera), Settings(noise_px=noise_px))


def _directions(sky, count, generator):
    size_px = np.array([sky.camera.width_px, sky.camera.height_px])
    px = (0.2 + 0.6 * generator.uniform(size=(count, 2))) * size_px
    return sky.camera.directions_from_pixels(px)


def test_frames_are_joined_by_the_turn_of_the_camera(sky):
    generator = np.random.default_rng(3)
    for _ in range(20):
        shared, old, new = (_directions(sky, count, generator) for count in (5, 4, 4))
        x, y, z = generator.normal(size=3)
        scale = 0.015 / math.hypot(x, y, z)
        turn = matrix_from_quaternion(
            np.array(after_turn((0.0, 0.0, 0.0, 1.0), (x * scale, y * scale, z * scale)))
        )
        first = composite_of(_observed(sky, np.concatenate([shared, old])))
        second = _observed(sky, np.concatenate([shared @ turn.T, new]))
        both = joined(first, second, 0.02)
        assert len(both) == 13
        assert sorted(both.seen) == [0] * 4 + [1] * 4 + [2] * 5
        apart = np.linalg.norm(both.body[both.seen == 2][:, None] - shared @ turn.T, axis=2)
        assert apart.min(axis=1).max() < 1e-9
        # A spot of one frame is dropped when a second frame does not have it.
        third = joined(both, _observed(sky, shared @ turn.T), 0.02)
        assert sorted(third.seen) == [0] * 4 + [3] * 5
        assert joined(first, second, 0.002) is None


def test_spots_that_are_seen_again_have_the_mean_of_their_places(sky):
    generator, noise = np.random.default_rng(4), 2e-5
    truth = _directions(sky, 12, generator)
    frames = [truth + noise * generator.normal(size=truth.shape) for _ in range(9)]
    composite = composite_of(_observed(sky, frames[0]))
    for body in frames[1:]:
        composite = joined(composite, _observed(sky, body), 0.01)
    assert composite.seen.tolist() == [9] * 12
    matched = np.linalg.norm(composite.body[:, None] - frames[-1], axis=2).argmin(axis=1)
    # The camera frame is that of the last frame, as its own spots tell it.
    u, _, vt = np.linalg.svd(composite.body.T @ truth[matched])
    apart = composite.body - truth[matched] @ (u @ vt).T
    assert 0.2 * noise < np.sqrt(np.mean(apart**2)) < 0.5 * noise


def test_spots_that_leave_the_field_are_dropped(sky):
    generator, farthest = np.random.default_rng(5), math.cos(sky.camera.radius_rad)
    turn = matrix_from_quaternion(np.array(after_turn((0.0, 0.0, 0.0, 1.0), (0.01, 0.0, 0.0))))
    truth, composite = _directions(sky, 12, generator), None
    for _ in range(40):
        frame = _observed(sky, truth)
        composite = composite_of(frame) if composite is None else joined(composite, frame, 0.02)
        assert (composite.body[:, 2] >= farthest).all()
        truth = np.concatenate([truth @ turn.T, _directions(sky, 1, generator)])


def test_a_turn_through_many_stars_is_followed(sky):
    # The turn is sought with 24 stars of each frame.
    generator = np.random.default_rng(11)
    stars = generator.normal(size=(9000, 3))
    stars /= np.linalg.norm(stars, axis=1)[:, None]
    turn_rad, composite = 0.15 * sky.camera.radius_rad, None
    turn = matrix_from_quaternion(np.array(after_turn((0.0, 0.0, 0.0, 1.0), (turn_rad, 0.0, 0.0))))
    for _ in range(20):
        px = sky.camera.pixels_from_directions(stars)
        is_seen = sky.camera.contains(px) & (stars[:, 2] > 0.0)
        frame = observe(as_frame(px[is_seen], sky.camera), Settings(noise_px=1.0))
        assert len(frame) > 40
        if composite is None:
            composite = composite_of(frame)
        else:
            composite = joined(composite, frame, 2.0 * turn_rad)
            assert composite is not None
            assert (composite.seen[: len(frame)] >= 1).all()
            assert (composite.seen >= 2).sum() >= 0.7 * len(frame)
        stars = stars @ turn.T


def test_two_spots_are_not_enough_whatever_the_composite_has_beside_them(sky):
    def spots(*px):
        return observe(as_frame(np.array(px), sky.camera), Settings(noise_px=1.0))

    three = composite_of(spots((200.0, 200.0), (201.0, 200.0), (800.0, 800.0)))
    others = (500.0, 100.0), (100.0, 600.0)
    assert joined(three, spots((210.0, 205.0), (810.0, 805.0), *others), 0.02) is None
    assert joined(three, spots((200.0, 200.0), (205.0, 200.0), (800.0, 800.0)), 0.02) is None


def test_a_composite_has_no_more_spots_than_are_searched(sky):
    generator, tracker = np.random.default_rng(8), Tracker(Matcher(sky))
    for _ in range(3):
        px = generator.uniform(0.0, 1024.0, (4000, 2))
        assert tracker.identify(px).status == "no_match"
        assert len(tracker._composite) <= 512
    few = composite_of(_observed(sky, _directions(sky, 300, generator)))
    again = np.concatenate([few.body[:40], _directions(sky, 400, generator)])
    both = joined(few, _observed(sky, again), 0.01)
    assert len(both) == 512
    assert (both.seen[:440] >= 1).all()


def test_a_narrow_field_of_small_noise_is_joined():
    camera = Camera(4096, 4096, fov_x_deg=0.1)
    generator, settings = np.random.default_rng(9), Settings(noise_px=0.005)
    for _ in range(20):
        px = generator.uniform(200.0, 3900.0, (12, 2))
        frames = [px + generator.normal(0.0, 0.005, px.shape) for _ in range(2)]
        first, second = (observe(as_frame(each, camera), settings) for each in frames)
        assert joined(composite_of(first), second, 1e-4) is not None


def test_a_confirmed_answer_has_the_remarks_on_its_frame(sky):
    matcher, generator = Matcher(sky, **STATED), np.random.default_rng(5)
    remarks = []
    for _ in range(40):
        tracker = Tracker(matcher, max_turn_deg=1.0)
        for frame in steady_turn(sky, WEAK, generator):
            x, y = frame.centroids_px.T
            table = {"x_px": x, "y_px": y, "mag": frame.mag, "colour": x}
            found = tracker.identify(table)
            if found.ok:
                remarks += [found.remarks] if found.origin == "tracking" else []
                break
    assert remarks
    assert all("not used: colour" in each[0] for each in remarks)


def test_frames_that_share_no_spots_are_not_joined(sky):
    generator, made = np.random.default_rng(7), 0
    for _ in range(40):
        first = composite_of(_observed(sky, _directions(sky, 9, generator)))
        made += joined(first, _observed(sky, _directions(sky, 9, generator)), 0.02) is not None
    assert made <= 4
    lone = _observed(sky, _directions(sky, 1, generator))
    assert joined(composite_of(lone), lone, 0.02) is None


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
    assert together > alone
    assert confirmed >= 12


def test_the_same_spots_again_are_no_second_proof(sky):
    matcher, repeated = Matcher(sky, **STATED), 0
    for frame in frames_of(sky, 40, WEAK, seed=8):
        found = matcher.identify(frame.centroids_px, mag=frame.mag)
        if found.ok or found.refusal.candidate is None:
            continue
        tracker = Tracker(matcher, max_turn_deg=1.0)
        for _ in range(4):
            assert not tracker.identify(frame.centroids_px, mag=frame.mag).ok
        repeated += found.refusal.candidate.false_match_probability < 1e-4
    assert repeated >= 3


def test_a_frame_without_sky_is_not_answered_by_the_frames_before_it(sky):
    matcher, generator, tried = Matcher(sky, **STATED), np.random.default_rng(9), 0
    for frame in frames_of(sky, 60, WEAK, seed=8):
        tracker = Tracker(matcher, max_turn_deg=1.0)
        if tracker.identify(frame.centroids_px, mag=frame.mag).ok:
            continue
        tried += 1
        for _ in range(10):
            # Three of its spots are where the frame before has them, so that both are joined.
            px = generator.uniform(0.0, sky.camera.width_px, frame.centroids_px.shape)
            px[:3] = frame.centroids_px[:3]
            assert not tracker.attempt(px, mag=frame.mag).ok
    assert tried >= 10


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
