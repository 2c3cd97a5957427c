"""Matcher: right answers to true frames, no answer to frames that are none."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom

from starcat.attitude import (
    matrix_from_quaternion,
    matrix_from_radec_roll,
    quaternion_from_matrix,
)
from starcat.camera import Camera
from starcat.evaluation.selftest import answers_rightly, self_test
from starcat.evaluation.simulate import Frame, Noise, simulate_frames
from starcat.matcher.database import Database, PairIndex
from starcat.matcher.matcher import Matcher
from starcat.matcher.pairs import candidate_triangles, observed_triangles
from starcat.matcher.verification import chance_of_agreement
from starcat.products.pairs import find_pairs
from starcat.sphere import separation

CAMERA = Camera.from_fov(1024, 1024, 20.0)

FIRST_ID = 1000
"""Star numbers are rows plus this, so that a mix-up of the two shows."""


def database(u: np.ndarray) -> Database:
    pairs = find_pairs(u, 0.0, CAMERA.diagonal_rad)
    return Database(
        name="sky-1.0.0",
        camera=CAMERA,
        epoch_jyear=2026.0,
        star_id=np.arange(len(u)) + FIRST_ID,
        directions=u,
        mag=np.zeros(len(u)),
        designation=np.full(len(u), b"star"),
        pairs=PairIndex(pairs.i, pairs.j, pairs.kvector),
    )


@pytest.fixture(scope="module")
def matcher(random_directions) -> Matcher:
    return Matcher(database(random_directions(1500, 1)))


def frames(matcher: Matcher, count: int, noise: Noise | None = None, seed: int = 3) -> list[Frame]:
    u = matcher.database.directions
    return list(simulate_frames(u, CAMERA, count, noise or Noise(), seed))


def test_every_clean_frame_is_identified_star_by_star(matcher):
    for frame in frames(matcher, 100):
        found = matcher.identify(frame.centroids_px)
        assert found.status == "identified"
        assert found.star_index.tolist() == frame.star_index.tolist()
        assert found.star_ids.tolist() == (frame.star_index + FIRST_ID).tolist()
        assert found.n_matched == len(frame.star_index)
        assert found.false_match_probability <= matcher.max_false_match_probability
        # Centroids to 1e-13 px of 2900 px focal length: 1e-16 rad, some roundings above it.
        assert np.abs(matrix_from_quaternion(found.q_body_from_icrs) - frame.matrix).max() < 1e-13
        assert found.residual_arcsec < 1e-8


def test_noise_missing_and_false_stars_give_no_wrong_answer(matcher):
    noise = Noise(noise_px=0.3, drop_probability=0.1, false_stars=3)
    answers = []
    for frame in frames(matcher, 100, noise):
        found = matcher.identify(frame.centroids_px)
        if found.status == "identified":
            assert answers_rightly(found, frame, matcher)
        answers.append(found.status == "identified")
    assert np.mean(answers) > 0.95


def test_the_self_test_counts_what_it_sees(matcher):
    clean, hard = self_test(matcher, frames=20, noise_px=0.2, seed=8)
    assert (clean.name, clean.frames, clean.identified, clean.wrong) == ("clean", 20, 20, 0)
    assert (hard.name, hard.frames, hard.wrong) == ("hard", 20, 0)
    assert clean.identified_share == 1.0
    # 0.2 px on each axis of 2904 px focal length is 20 arcsec root mean square.
    assert 10.0 < clean.median_residual_arcsec < 25.0


def test_a_wrong_attitude_is_not_taken_for_a_right_one(matcher):
    one, other = frames(matcher, 2)
    assert answers_rightly(matcher.identify(one.centroids_px), one, matcher)
    assert not answers_rightly(matcher.identify(other.centroids_px), one, matcher)


@pytest.mark.parametrize(("shift_px", "is_right"), [(1.0, True), (3.0, False)])
def test_an_answer_is_right_within_the_tolerance(matcher, shift_px, is_right):
    frame = frames(matcher, 1)[0]
    # A tilt moves a star at the edge, 10 deg off the axis, 6 % farther than one in the middle.
    angle = shift_px / CAMERA.focal_length_px
    tilt = np.array([[1.0, 0.0, angle], [0.0, 1.0, 0.0], [-angle, 0.0, 1.0]])
    moved = replace(
        matcher.identify(frame.centroids_px),
        q_body_from_icrs=quaternion_from_matrix(tilt @ frame.matrix),
    )
    assert answers_rightly(moved, frame, matcher) == is_right


def test_the_order_of_the_centroids_does_not_matter(matcher):
    generator = np.random.default_rng(4)
    for frame in frames(matcher, 30, Noise(0.3, 0.1, 3)):
        order = generator.permutation(len(frame.centroids_px))
        one = matcher.identify(frame.centroids_px)
        other = matcher.identify(frame.centroids_px[order])
        assert other.star_ids.tolist() == one.star_ids[order].tolist()
        assert np.array_equal(other.q_body_from_icrs, one.q_body_from_icrs, equal_nan=True)


def test_quaternion_and_angles_are_the_same_attitude(matcher):
    for frame in frames(matcher, 30, Noise(0.3)):
        found = matcher.identify(frame.centroids_px)
        q = found.q_body_from_icrs
        angles = found.boresight_ra_deg, found.boresight_dec_deg, found.roll_deg
        assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-15)
        assert q[3] >= 0.0
        assert np.abs(matrix_from_quaternion(q) - matrix_from_radec_roll(*angles)).max() < 1e-9


def test_the_residual_is_the_angle_between_centroids_and_stars(matcher):
    frame = frames(matcher, 1, Noise(0.3))[0]
    found = matcher.identify(frame.centroids_px)
    matrix = matrix_from_quaternion(found.q_body_from_icrs)
    predicted = matcher.database.directions[found.star_index] @ matrix.T
    miss = np.linalg.norm(CAMERA.directions_from_pixels(frame.centroids_px) - predicted, axis=1)
    expected = np.degrees(np.sqrt(np.mean(miss**2))) * 3600.0
    assert found.residual_arcsec == pytest.approx(expected, rel=1e-9)


def test_unusable_centroids_get_no_star_and_change_nothing(matcher):
    frame = frames(matcher, 1)[0]
    nan, inf = np.nan, np.inf
    unusable = [[nan, 5], [5, nan], [inf, 5], [5, -inf], [-1, 5], [5, 1024], [1e300, 5], [nan, nan]]
    found = matcher.identify(np.concatenate([unusable, frame.centroids_px]))
    assert found.star_ids[:8].tolist() == [-1] * 8
    assert found.star_index[:8].tolist() == [-1] * 8
    assert found.star_index[8:].tolist() == frame.star_index.tolist()
    assert np.array_equal(
        found.q_body_from_icrs, matcher.identify(frame.centroids_px).q_body_from_icrs
    )


@pytest.mark.parametrize("shape", [(4,), (3, 4), (2, 2, 2)])
def test_centroids_of_another_shape_are_refused(matcher, shape):
    with pytest.raises(ValueError, match=r"expected \(N, 2\)"):
        matcher.identify(np.ones(shape))


@pytest.mark.parametrize("count", [0, 1, 3])
@pytest.mark.parametrize("unusable", [0, 5])
def test_too_few_stars_is_an_answer(matcher, count, unusable):
    centroids_px = frames(matcher, 1)[0].centroids_px[:count]
    found = matcher.identify(np.concatenate([centroids_px, np.full((unusable, 2), np.nan)]))
    assert found.status == "too_few_stars"
    assert found.star_ids.tolist() == [-1] * (count + unusable)
    assert np.isnan(found.q_body_from_icrs).all()
    assert np.isnan([found.boresight_ra_deg, found.boresight_dec_deg, found.roll_deg]).all()
    assert (found.n_matched, found.false_match_probability) == (0, 1.0)


@pytest.mark.parametrize("axis", [0, 1], ids=["left-right", "upside-down"])
def test_mirrored_frames_are_never_identified(matcher, axis):
    # 25 of the 200 triangles keep the test short; the frames themselves need no more than these.
    hasty = Matcher(matcher.database, max_triangles=25)
    for frame in frames(matcher, 20):
        mirrored_px = frame.centroids_px.copy()
        mirrored_px[:, axis] = 1024.0 - mirrored_px[:, axis]
        assert hasty.identify(frame.centroids_px).status == "identified"
        assert hasty.identify(mirrored_px).status == "no_match"


def test_random_points_are_never_identified(matcher):
    generator = np.random.default_rng(5)
    hasty = Matcher(matcher.database, max_triangles=25)
    for _ in range(200):
        points = generator.random((generator.integers(8, 21), 2)) * 1024.0
        found = hasty.identify(points)
        assert found.status == "no_match"
        assert found.star_ids.tolist() == [-1] * len(points)


def test_points_at_one_place_are_never_identified(matcher):
    assert matcher.identify(np.full((10, 2), 300.0)).status == "no_match"


def test_two_centroids_do_not_share_a_star(matcher):
    for frame in frames(matcher, 10):
        beside_px = frame.centroids_px[:2] + np.array([0.8, -0.6])
        found = matcher.identify(np.concatenate([beside_px, frame.centroids_px]))
        assert found.status == "identified"
        ids = found.star_ids[found.star_ids >= 0]
        assert len(set(ids.tolist())) == len(ids) == len(frame.star_index)


def test_another_camera_sees_the_same_sky(matcher):
    frame = frames(matcher, 1)[0]
    finer = Camera(2048, 2048, 2.0 * CAMERA.focal_length_px)
    found = matcher.identify(2.0 * frame.centroids_px, finer)
    assert found.star_index.tolist() == frame.star_index.tolist()


def test_candidates_are_all_triangles_that_fit(random_directions):
    u, tolerance_rad = random_directions(2000, 2), 0.02
    near = u[separation(u, [0.0, 0.0, 1.0]) < 0.4]
    body = CAMERA.directions_from_pixels(np.array([[100.0, 80.0], [900.0, 300.0], [300.0, 700.0]]))
    side = separation(near[:, None], near[None, :])
    ab, ac, bc = (separation(body[p], body[q]) for p, q in ((0, 1), (0, 2), (1, 2)))
    volume = np.einsum("ijx,kx->ijk", np.cross(near[:, None], near[None, :]), near)
    fits = (
        (np.abs(side - ab) <= tolerance_rad)[:, :, None]
        & (np.abs(side - ac) <= tolerance_rad)[:, None, :]
        & (np.abs(side - bc) <= tolerance_rad)[None, :, :]
        & (volume * np.linalg.det(body) > 0.0)
    )
    found = candidate_triangles(body, (0, 1, 2), database(near), tolerance_rad)
    assert fits.any()
    assert sorted(found.tolist()) == np.argwhere(fits).tolist()


def test_candidates_hold_the_stars_of_a_triangle_but_not_of_its_mirror_image(matcher):
    for frame in frames(matcher, 20):
        body = CAMERA.directions_from_pixels(frame.centroids_px)
        truth = frame.star_index[:3].tolist()
        seen = candidate_triangles(body, (0, 1, 2), matcher.database, 1e-4)
        mirrored = candidate_triangles(body * [-1, 1, 1], (0, 1, 2), matcher.database, 1e-4)
        assert truth in seen.tolist()
        assert truth not in mirrored.tolist()


@pytest.mark.parametrize("count", [3, 4, 9])
def test_every_triangle_is_observed_once(count):
    body = np.zeros((count, 3))
    assert sorted(observed_triangles(body, 10**6)) == list(combinations(range(count), 3))
    assert len(list(observed_triangles(body, 2))) == min(2, len(list(combinations(body, 3))))


@given(
    st.integers(3, 60), st.integers(0, 60), st.integers(1, 60), st.sampled_from([1e-6, 1e-3, 0.05])
)
def test_chance_of_agreement_is_the_binomial_tail(n_centroids, n_more, stars_in_frame, fraction):
    n_matched = min(3 + n_more, n_centroids)
    p = min(0.5, stars_in_frame * fraction)
    expected = binom.sf(n_matched - 4, n_centroids - 3, p)
    found = chance_of_agreement(n_centroids, n_matched, 3, stars_in_frame, fraction)
    # Sixty products and sums of rounded terms.
    assert found == pytest.approx(expected, rel=1e-12, abs=1e-300)


def test_chance_of_agreement_without_stars_in_the_frame_is_none():
    assert chance_of_agreement(10, 5, 3, 0, 1e-4) == 0.0
