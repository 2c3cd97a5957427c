"""Matcher: right answers to true frames, no answer to other frames."""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from dataclasses import replace

import h5py
import numpy as np
import pytest
from frames import frames_of as frames
from frames import observe
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from starcat.errors import ConfigError, ProductError, SchemaVersionError
from starcat.geometry.attitude import (
    matrix_from_quaternion,
    matrix_from_radec_roll,
    quaternion_from_matrix,
)
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import separation
from starcat.matcher import c_engine
from starcat.matcher.c_engine import FEATURES, is_compiled
from starcat.matcher.database import Database, open_database, products_in
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods import pairs, triangle
from starcat.matcher.methods.table import METHODS, best_method
from starcat.matcher.observation import Candidates, Observation
from starcat.matcher.pose import pose_at
from starcat.matcher.settings import REACH, TriangleOrder
from starcat.matcher.verification import BestOf, agree, agreeing_centroids, verify_candidates
from starcat.simulation.selftest import answers_rightly, self_test
from starcat.simulation.simulate import Noise, SimulatedFrame, Sky, simulate_frame

CAMERA = Camera(1024, 1024, fov_x_deg=20.0)

IN_MEMORY = ("triangle", "pairs", "pyramid")
"""The methods whose products the fixture `sky_of` makes."""


def verified(candidates, seen, database):
    """Return the best agreement of a batch of candidates."""
    best = BestOf(1e-9)
    verify_candidates(candidates, seen, database, best)
    return best.found


def agreement_of(matrix, seen, database):
    """Return the agreement of an attitude with the focal length that is given."""
    return agree(pose_at(matrix, 1.0, seen), seen, database)


@pytest.fixture(scope="module")
def sky(sky_of, random_directions) -> Database:
    return sky_of(random_directions(1200, 1))


@pytest.fixture(scope="module", params=[*IN_MEMORY, *(f"{name} in C" for name in FEATURES)])
def matcher(sky, request) -> Matcher:
    method, _, in_c = request.param.partition(" ")
    if in_c and not is_compiled():
        pytest.skip("starcat was installed without a C compiler")
    return Matcher(sky, method, engine="c" if in_c else "numpy")


@pytest.fixture(scope="module")
def triangles(sky) -> Matcher:
    return Matcher(sky, engine="numpy")


def observed(frame: SimulatedFrame, magnitudes: bool = False) -> Observation:
    return observe(frame.centroids_px, CAMERA, 2.0, frame.mag if magnitudes else None)


# --- Observation


def test_without_magnitudes_the_nearest_to_the_centre_come_first():
    points = np.random.default_rng(30).random((40, 2)) * 1024.0
    seen = observe(points, CAMERA, 2.0)
    assert (np.diff(np.hypot(*(seen.centroids_px - 512.0).T)) >= 0.0).all()
    assert np.array_equal(points[seen.rows], seen.centroids_px)
    assert np.array_equal(CAMERA.directions_from_pixels(seen.centroids_px), seen.body)
    assert seen.mag is None
    assert seen.dropped == ()


def test_with_magnitudes_the_brightest_come_first_and_unknown_ones_last():
    points = np.random.default_rng(31).random((6, 2)) * 1024.0
    seen = observe(points, CAMERA, 2.0, [4.0, np.nan, -1.5, 6.0, np.nan, 4.0])
    assert seen.rows[0] == 2
    assert sorted(seen.rows[1:3]) == [0, 5]
    assert seen.rows[3] == 3
    assert sorted(seen.rows[4:]) == [1, 4]
    assert np.array_equal(seen.mag, [-1.5, 4.0, 4.0, 6.0, np.nan, np.nan], equal_nan=True)


@pytest.mark.parametrize("magnitudes", [[np.nan] * 3, [np.inf, np.nan, -np.inf]])
def test_magnitudes_of_which_none_is_known_are_none(magnitudes):
    points = [[10.0, 20.0], [500.0, 500.0], [900.0, 40.0]]
    assert observe(points, CAMERA, 2.0, magnitudes).mag is None


@given(st.permutations(range(12)), st.booleans())
def test_the_order_of_an_observation_is_its_own(order, known):
    generator = np.random.default_rng(32)
    # Ties on purpose: four centroids as far from the centre as each other, two magnitudes.
    points = np.concatenate(
        [
            generator.random((8, 2)) * 1024.0,
            512.0 + 99.0 * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]),
        ]
    )
    mag = generator.integers(1, 3, 12).astype(float) if known else None
    one = observe(points, CAMERA, 2.0, mag)
    other = observe(points[order], CAMERA, 2.0, None if mag is None else mag[order])
    assert np.array_equal(other.centroids_px, one.centroids_px)
    assert np.array_equal(np.array(order)[other.rows], one.rows)


def test_every_unusable_centroid_is_reported_with_its_reason():
    nan, inf = np.nan, np.inf
    given_px = [
        [5, 5], [nan, 5], [5, inf], [-1e-9, 5], [1024, 5], [5, 1024], [1e300, 5], [0, 0], [5, 5],
    ]  # fmt: skip
    seen = observe(given_px, CAMERA, 2.0)
    assert sorted(seen.dropped) == [
        (1, "not_finite"), (2, "not_finite"), (3, "out_of_frame"), (4, "out_of_frame"),
        (5, "out_of_frame"), (6, "out_of_frame"), (8, "duplicate"),
    ]  # fmt: skip
    assert sorted(seen.rows) == [0, 7]
    assert len(seen) == 2


def test_of_repeats_the_brightest_is_kept():
    points = [[300.0, 300.0], [700.0, 700.0], [300.0, 300.0], [300.0, 300.0]]
    seen = observe(points, CAMERA, 2.0, [5.0, 4.0, 2.0, 3.0])
    assert seen.rows.tolist() == [2, 1]
    assert sorted(seen.dropped) == [(0, "duplicate"), (3, "duplicate")]
    # Minus zero is zero.
    assert len(observe([[0.0, 5.0], [-0.0, 5.0]], CAMERA, 2.0)) == 1


@pytest.mark.parametrize("given_px", [[], np.empty((0, 2)), np.empty((2, 0)), [[np.nan, 1.0]]])
def test_an_observation_of_nothing(given_px):
    seen = observe(given_px, CAMERA, 2.0)
    assert (len(seen), seen.body.shape, seen.separation_rad.shape) == (0, (0, 3), (0, 0))


def test_separations_and_tolerance_are_angles():
    seen = observe(np.random.default_rng(33).random((9, 2)) * 1024.0, CAMERA, 2.0)
    expected = separation(seen.body[:, None], seen.body[None])
    # For separation 0 the chord of rounded components is not exactly 0.
    assert np.abs(seen.separation_rad - expected).max() < 1e-15
    assert seen.tolerance_rad == pytest.approx(2.0 / CAMERA.focal_length_px)


@pytest.mark.parametrize("shape", [(4,), (3, 4), (2, 2, 2), (1, 1)])
def test_centroids_of_another_shape_are_refused(shape):
    with pytest.raises(ConfigError, match=r"centroids_px has shape .*expected \(N, 2\)"):
        observe(np.ones(shape), CAMERA, 2.0)


@pytest.mark.parametrize(
    "values",
    [[[1.0, 2.0], [3.0]], [["a", "b"]], [[{}, 1.0]], [[1.0, 2j]], [[10**400, 1]], object()],
)
def test_what_numpy_cannot_convert_is_refused(triangles, values):
    with pytest.raises(ConfigError, match=r"centroids_px is not an array of .* shape \(N, 2\)"):
        triangles.identify(values)
    with pytest.raises(ConfigError, match="centroids_px is not an array of real numbers"):
        triangles.identify_many([np.ones((5, 2)), values])
    with pytest.raises(ConfigError, match=r"mag is not an array of real .* shape \(4,\)"):
        triangles.identify(np.ones((4, 2)), mag=values)


@pytest.mark.parametrize("shape", [(3,), (5,), (4, 1), ()])
def test_magnitudes_of_another_number_are_refused(shape):
    with pytest.raises(ConfigError, match=r"mag has shape .*expected \(4,\)"):
        observe(np.ones((4, 2)), CAMERA, 2.0, np.ones(shape))


# --- Verification


def truth_as_candidate(frame: SimulatedFrame, seen: Observation, size: int = 3) -> Candidates:
    rows = np.arange(size)[None, :]
    return Candidates(rows, frame.star_index[seen.rows][rows])


def test_agreement_from_an_attitude_nearby_is_that_of_all_stars(sky):
    for frame in frames(sky, 10):
        seen, angle = observed(frame), 1.0 / CAMERA.focal_length_px
        tilt = matrix_from_quaternion(np.array([0.5 * angle, 0.0, 0.5 * angle, 1.0]))
        found = agreement_of(tilt @ frame.matrix, seen, sky)
        assert found.star_index.tolist() == frame.star_index[seen.rows].tolist()
        assert np.abs(found.pose.matrix - frame.matrix).max() < 1e-13
        assert found.n_matched == len(seen)
        assert found.residual_rad < 1e-14
        assert found.false_match_probability < 1e-50


def test_the_residual_is_that_of_the_attitude_that_is_returned(sky):
    for frame in frames(sky, 20, Noise(0.5)):
        seen = observed(frame)
        found = agreement_of(frame.matrix, seen, sky)
        named = found.star_index >= 0
        miss = seen.body[named] - sky.directions[found.star_index[named]] @ found.pose.matrix.T
        expected = np.sqrt((miss**2).sum() / named.sum())
        assert found.residual_rad == pytest.approx(expected, rel=1e-9)
        # And the attitude is the best one for the stars that are named.
        best, _ = Rotation.align_vectors(seen.body[named], sky.directions[found.star_index[named]])
        assert np.abs(best.as_matrix() - found.pose.matrix).max() < 1e-9


def cluster_sky(sky_of, random_directions) -> Database:
    """Return a sky with ten stars within 100 px of its north pole."""
    offset = np.random.default_rng(5).normal(scale=25.0 / CAMERA.focal_length_px, size=(10, 2))
    cluster = np.column_stack([offset, np.ones(10)])
    cluster /= np.linalg.norm(cluster, axis=1)[:, None]
    return sky_of(np.concatenate([random_directions(1200, 5), cluster]))


def test_the_stars_outside_of_a_cluster_outweigh_a_wrong_one(sky_of, random_directions):
    # Turned about the cluster by 8 px at 400 px another star takes the first centroid outside:
    # together with the cluster it holds the attitude there, for all that the others miss.
    cluster = cluster_sky(sky_of, random_directions).directions[1200:]
    angle, turn = 0.7 * np.arange(8.0), 8.0 / 400.0
    outside_px = 512.0 + 400.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    outside = CAMERA.directions_from_pixels(outside_px)
    wrong = matrix_from_quaternion(np.array([0.0, 0.0, 0.5 * turn, 1.0]))
    database = sky_of(np.concatenate([cluster, outside, outside[:1] @ wrong]), boresights=10)
    stars = np.arange(18)
    seen = observe(CAMERA.pixels_from_directions(database.directions[stars]), CAMERA, 2.0)
    found = agreement_of(wrong, seen, database)
    assert np.abs(found.pose.matrix - np.eye(3)).max() < 1e-12
    assert found.star_index.tolist() == stars[seen.rows].tolist()
    assert found.false_match_probability < 1e-30


def test_a_false_spot_beside_a_far_star_does_not_take_it(sky_of, random_directions):
    # An attitude that puts the far star on the false spot, 5 px beside it, fits the cluster too, as
    # the noise there allows: 5 px at 400 px are 0.6 px at 50 px.
    cluster = cluster_sky(sky_of, random_directions).directions[1200:]
    (far,) = CAMERA.directions_from_pixels(np.array([[912.0, 512.0]]))
    database, matrix = sky_of(np.vstack([cluster, far]), boresights=10), np.eye(3)
    spots = CAMERA.pixels_from_directions(database.directions)
    spots += np.random.default_rng(2).normal(scale=0.7, size=spots.shape)
    spots[-1] = [912.0, 512.0]
    seen = observe(np.vstack([spots, [[912.0, 517.0]]]), CAMERA, 1.5)
    turned = matrix_from_quaternion(np.array([0.0, 0.0, -0.5 * 5.0 / 400.0, 1.0]))
    for start in (matrix, turned):
        found = agreement_of(start, seen, database)
        star = np.full(len(spots) + 1, -1)
        star[seen.rows] = found.star_index
        assert star.tolist() == [*range(len(spots)), -1]


def test_the_agreement_of_a_cluster_alone_is_refused(sky_of, random_directions):
    # The stars outside are seen elsewhere: no attitude near this one explains them.
    database = cluster_sky(sky_of, random_directions)
    matrix = matrix_from_radec_roll(0.0, 90.0, 30.0)
    place = CAMERA.pixels_from_directions(database.directions @ matrix.T)
    stars = np.flatnonzero(CAMERA.contains(place))
    outside = stars[stars < 1200]
    generator = np.random.default_rng(37)
    place += generator.normal(scale=0.3, size=place.shape)
    place[outside] = generator.random((len(outside), 2)) * 1024.0
    found = agreement_of(matrix, observe(place[stars], CAMERA, 2.0), database)
    assert found.n_matched >= 10
    assert found.false_match_probability == 1.0


def test_an_attitude_elsewhere_agrees_with_too_few(sky):
    one, other = frames(sky, 2)
    found = agreement_of(other.matrix, observed(one), sky)
    assert found.false_match_probability > 1e-3
    assert found.n_matched < 4 or found.residual_rad > 0.0
    assert np.isnan(found.residual_rad) == (found.n_matched < 4)


def test_an_attitude_where_no_star_is(sky):
    empty = replace(sky, directions=sky.directions[:0])
    found = agreement_of(np.eye(3), observed(frames(sky, 1)[0]), empty)
    assert (found.n_matched, found.false_match_probability) == (0, 1.0)


@pytest.mark.parametrize(("offset_px", "is_matched"), [(0.0, True), (2.9, True), (3.1, False)])
def test_stars_agree_within_the_reach(sky, offset_px, is_matched):
    assert REACH * 2.0 == 3.0
    frame = frames(sky, 1)[0]
    centroids_px = frame.centroids_px.copy()
    centroids_px[0, 0] += offset_px
    found = agreement_of(frame.matrix, observe(centroids_px, CAMERA, 2.0), sky)
    assert found.n_matched == len(centroids_px) - (not is_matched)


def test_two_centroids_do_not_share_a_star_nor_two_stars_a_centroid(sky):
    for frame in frames(sky, 10):
        beside_px = frame.centroids_px[:2] + np.array([0.8, -0.6])
        seen = observe(np.concatenate([beside_px, frame.centroids_px]), CAMERA, 2.0)
        found = agreement_of(frame.matrix, seen, sky)
        ids = found.star_index[found.star_index >= 0]
        assert len(set(ids.tolist())) == len(ids) == len(frame.star_index)
        # The nearer of two takes the star.
        assert (found.star_index[np.isin(seen.rows, [0, 1])] == -1).all()


def test_the_count_of_agreeing_centroids_is_that_of_a_plain_search(sky):
    here, other = frames(sky, 2, Noise(1.0, 0.1, 3))
    seen = observed(here)
    matrices = np.stack([here.matrix, other.matrix])
    # The reach is an angle here, and stars just off the detector count as well.
    apart = [separation(seen.body[:, None] @ matrix, sky.directions) for matrix in matrices]
    expected = [int((rows.min(axis=1) <= 3.0 / CAMERA.focal_length_px).sum()) for rows in apart]
    assert agreeing_centroids(matrices, seen, sky).tolist() == expected
    assert expected[0] > 8 > expected[1]


def test_verification_finds_the_true_one_among_false_ones(sky):
    generator = np.random.default_rng(34)
    for frame in frames(sky, 10, Noise(0.3)):
        seen = observed(frame)
        true = truth_as_candidate(frame, seen)
        stars = generator.integers(len(sky.directions), size=(300, 3))
        stars[generator.integers(300)] = true.stars[0]
        found = verified(Candidates(np.broadcast_to(true.centroids, (300, 3)), stars), seen, sky)
        assert found is not None
        assert found.false_match_probability < 1e-9
        assert found.star_index.tolist() == frame.star_index[seen.rows].tolist()


def test_verification_of_false_ones_is_never_certain(sky):
    generator = np.random.default_rng(35)
    for frame in frames(sky, 5):
        seen = observed(frame)
        stars = generator.integers(len(sky.directions), size=(300, 3))
        centroids = np.broadcast_to(np.arange(3), (300, 3))
        found = verified(Candidates(centroids, stars), seen, sky)
        assert found is None or found.false_match_probability > 1e-6


def test_verification_of_nothing(sky):
    none = np.empty((0, 3), dtype=np.intp)
    assert verified(Candidates(none, none), observed(frames(sky, 1)[0]), sky) is None


# --- Methods


def proposals(matcher: Matcher, seen: Observation) -> Iterator:
    for batch in METHODS[matcher.method].propose(seen, matcher.database):
        yield from zip(batch.centroids.tolist(), batch.stars.tolist(), strict=True)


@pytest.mark.parametrize("noise", [Noise(), Noise(0.5), Noise(0.3, 0.1, 3)])
def test_the_truth_is_among_the_candidates(matcher, noise):
    for frame in frames(matcher.database, 10, noise):
        seen = observed(frame)
        truth = frame.star_index[seen.rows]
        assert any(
            (truth[centroids] == stars).all() for centroids, stars in proposals(matcher, seen)
        )


def test_nothing_is_proposed_for_a_mirror_image_of_three_stars(sky):
    for frame in frames(sky, 20):
        seen = observed(frame)
        truth = frame.star_index[seen.rows][:3].tolist()
        mirrored = replace(seen, body=seen.body * [-1.0, 1.0, 1.0])
        assert truth in pairs.triangles_of_stars(np.arange(3), seen, sky).tolist()
        assert truth not in pairs.triangles_of_stars(np.arange(3), mirrored, sky).tolist()


def test_star_pairs_make_all_triangles_that_fit(sky_of, random_directions):
    u = random_directions(2000, 2)
    near = u[separation(u, [0.0, 0.0, 1.0]) < 0.4]
    seen = observe([[100.0, 80.0], [900.0, 300.0], [300.0, 700.0]], CAMERA, 40.0)
    tolerance_rad = 60.0 / CAMERA.focal_length_px
    side = separation(near[:, None], near[None, :])
    ab, ac, bc = (separation(seen.body[p], seen.body[q]) for p, q in ((0, 1), (0, 2), (1, 2)))
    volume = np.einsum("ijx,kx->ijk", np.cross(near[:, None], near[None, :]), near)
    fits = (
        (np.abs(side - ab) <= tolerance_rad)[:, :, None]
        & (np.abs(side - ac) <= tolerance_rad)[:, None, :]
        & (np.abs(side - bc) <= tolerance_rad)[None, :, :]
        & (volume * np.linalg.det(seen.body) > 0.0)
    )
    found = pairs.triangles_of_stars(np.arange(3), seen, sky_of(near, boresights=10))
    assert fits.sum() > 20
    assert sorted(found.tolist()) == np.argwhere(fits).tolist()


@pytest.mark.parametrize("low", [0.0, 0.05, 0.348])
def test_directed_pairs_go_both_ways(sky, low):
    first, second = pairs.directed_pairs(sky, low, 0.006)
    u = sky.directions
    apart = separation(u[:, None], u[None])
    np.fill_diagonal(apart, np.inf)
    expected = np.argwhere((np.abs(apart - low) <= 0.006) & (apart <= CAMERA.diagonal_rad))
    assert sorted(map(list, zip(first.tolist(), second.tolist(), strict=True))) == expected.tolist()
    assert len(expected) > 0


def test_a_pyramid_has_the_fourth_star_of_its_apex(sky):
    for frame in frames(sky, 5, Noise(0.3, 0.1, 3)):
        seen = observed(frame)
        for batch in filter(len, pairs.pyramid_candidates(seen, sky)):
            assert batch.centroids.shape == batch.stars.shape == (len(batch), 4)
            assert (batch.centroids == batch.centroids[0]).all()
            assert len(set(batch.centroids[0].tolist())) == 4
            # A star is only one corner of a triangle.
            assert all(len(set(row)) == 4 for row in batch.stars.tolist())
            break


SIDES = st.tuples(*[st.floats(0.01, 0.3)] * 3).filter(lambda s: 2 * max(s) < 0.97 * sum(s))


@given(SIDES)
def test_area_and_circumradius_of_a_triangle(sides):
    a, b, c = sides
    half = 0.5 * (a + b + c)
    expected = np.sqrt(half * (half - a) * (half - b) * (half - c))
    area, _, radius, _ = triangle.features(a, b, c, 1e-5)
    assert area == pytest.approx(expected, rel=1e-9)
    assert radius == pytest.approx(a * b * c / (4.0 * expected), rel=1e-9)


@given(SIDES)
def test_errors_of_area_and_circumradius_are_their_slopes(sides):
    tolerance = 1e-7
    area, area_error, radius, radius_error = triangle.features(*sides, tolerance)
    moved = np.array(
        [
            triangle.features(*(np.array(sides) + tolerance * step), tolerance)[::2]
            for step in np.eye(3)
        ]
    )
    # Independent errors of the sides add as squares; the second order is 1e-4 of the first.
    expected = np.hypot.reduce(moved - [area, radius], axis=0)
    assert area_error == pytest.approx(expected[0], rel=1e-2, abs=1e-12)
    assert radius_error == pytest.approx(expected[1], rel=1e-2, abs=1e-12)


@pytest.mark.parametrize("sides", [(0.1, 0.1, 0.2), (0.1, 0.1, 0.3)])
def test_a_flat_triangle_is_no_crash(sides):
    assert np.isfinite(triangle.features(*sides, 1e-4)[0])


# --- Identification


@pytest.mark.parametrize("count", [0, 1, 3])
@pytest.mark.parametrize("unusable", [0, 5])
def test_too_few_stars_is_an_answer(triangles, count, unusable):
    centroids_px = frames(triangles.database, 1)[0].centroids_px[:count]
    found = triangles.identify(np.concatenate([centroids_px, np.full((unusable, 2), np.nan)]))
    assert found.status == "too_few_stars"
    assert found.star_ids.tolist() == found.star_index.tolist() == [-1] * (count + unusable)
    assert (found.star_ids.dtype, found.star_index.dtype) == (np.int64, np.int32)
    assert np.isnan(found.q_body_from_icrs).all()
    assert np.isnan([found.boresight_ra_deg, found.boresight_dec_deg, found.roll_deg]).all()
    assert np.isnan(found.residual_arcsec)
    assert (found.n_matched, found.false_match_probability) == (0, 1.0)
    assert len(found.dropped) == unusable


def test_four_stars_are_enough_but_not_with_one_of_them_false(triangles):
    many = frames(triangles.database, 40)
    exact = [triangles.identify(frame.centroids_px[:4]).status for frame in many]
    # Not every frame's triangles are among the brightest of a field.
    assert exact.count("identified") >= 10
    for frame in many:
        spoilt_px = frame.centroids_px[:4].copy()
        spoilt_px[3] = (spoilt_px[3] + 400.0) % 1024.0
        assert triangles.identify(spoilt_px).status == "no_match"


def test_a_stricter_limit_withholds_the_answer(matcher):
    frame = frames(matcher.database, 1, Noise(0.5, 0.2))[0]
    found = matcher.identify(frame.centroids_px)
    probability = found.false_match_probability
    assert 0.0 < probability < 1e-9
    exactly = replace(matcher, max_false_match_probability=probability)
    assert exactly.identify(frame.centroids_px).status == "identified"
    stricter = replace(matcher, max_false_match_probability=0.5 * probability)
    refused = stricter.identify(frame.centroids_px)
    assert refused.status == "no_match"
    assert refused.false_match_probability == 1.0


def test_the_tolerance_is_how_far_centroids_may_err(triangles):
    coarse = frames(triangles.database, 40, Noise(2.0))
    narrow, wide = (replace(triangles, tolerance_px=width) for width in (1.0, 6.0))
    counts = [
        sum(some.identify(frame.centroids_px).status == "identified" for frame in coarse)
        for some in (narrow, wide)
    ]
    assert counts[1] > 35 > counts[0] + 10


def test_another_camera_sees_the_same_sky(matcher):
    frame = frames(matcher.database, 1)[0]
    finer = Camera(2048, 2048, 2.0 * CAMERA.focal_length_px)
    found = matcher.identify(2.0 * frame.centroids_px, finer)
    assert found.star_index.tolist() == frame.star_index.tolist()


def test_the_truth_is_found_at_the_poles_and_in_any_roll(triangles):
    u = triangles.database.directions
    for dec_deg in (90.0, -90.0, 0.0):
        for roll_deg in (0.0, 90.0, 180.0, 271.0):
            matrix = matrix_from_radec_roll(0.0, dec_deg, roll_deg)
            place = CAMERA.pixels_from_directions(u @ matrix.T)
            found = triangles.identify(place[CAMERA.contains(place)])
            assert found.status == "identified"
            assert np.abs(matrix_from_quaternion(found.q_body_from_icrs) - matrix).max() < 1e-12


@pytest.mark.parametrize("method", IN_MEMORY)
def test_a_cluster_of_stars_is_not_taken_for_the_whole_frame(sky_of, random_directions, method):
    # Ten stars within 100 px hardly say how the camera is turned about them: an attitude that
    # only they agree with is no chance, and yet wrong.
    generator, database = np.random.default_rng(5), cluster_sky(sky_of, random_directions)
    stars = Sky(database.directions, database.mag, np.arange(1210, dtype=np.int32))
    for _ in range(300):
        ra_deg, roll_deg = generator.uniform(0.0, 360.0, 2)
        matrix = matrix_from_radec_roll(ra_deg, generator.uniform(83.0, 90.0), roll_deg)
        frame = simulate_frame(stars, CAMERA, matrix, Noise(0.5), generator)
        found = Matcher(database, method).identify(frame.centroids_px)
        if found.status == "identified":
            turn = matrix_from_quaternion(found.q_body_from_icrs) - matrix
            assert np.linalg.norm(turn, axis=1).max() * CAMERA.focal_length_px < 6.0


# --- Self-test


def test_the_self_test_counts_what_it_sees(triangles):
    clean, hard, *bare = self_test(triangles, frames=20, noise_px=0.2, seed=8, without_magnitudes=7)
    assert [(rate.frames, rate.identified, rate.noise_mag) for rate in bare] == [(7, 7, None)] * 2
    assert (clean.name, clean.frames, clean.identified, clean.wrong) == ("clean", 20, 20, 0)
    assert (hard.name, hard.frames, hard.wrong) == ("hard", 20, 0)
    assert clean.identified_share == 1.0
    # 0.2 px on each axis of 2904 px focal length is 20 arcsec root mean square.
    assert 10.0 < clean.median_residual_arcsec < 25.0


def test_a_wrong_attitude_is_not_taken_for_a_right_one(triangles):
    one, other = frames(triangles.database, 2)
    assert answers_rightly(triangles.identify(one.centroids_px), one, triangles)
    assert not answers_rightly(triangles.identify(other.centroids_px), one, triangles)


@pytest.mark.parametrize(("shift_px", "is_right"), [(1.0, True), (3.0, False)])
def test_an_answer_is_right_within_the_tolerance(triangles, shift_px, is_right):
    frame = frames(triangles.database, 1)[0]
    # A tilt moves a star at the edge, 10 deg off the axis, 6 % farther than one in the middle.
    angle = shift_px / CAMERA.focal_length_px
    tilt = np.array([[1.0, 0.0, angle], [0.0, 1.0, 0.0], [-angle, 0.0, 1.0]])
    moved = replace(triangles.identify(frame.centroids_px), matrix=tilt @ frame.matrix)
    assert answers_rightly(moved, frame, triangles) == is_right


def test_many_frames_are_answered_without_c(sky, monkeypatch):
    monkeypatch.setattr(c_engine, "_onboard", None)
    matcher = Matcher(sky)
    some = frames(sky, 3)
    found = matcher.identify_many([frame.centroids_px for frame in some])
    assert [answer.status for answer in found] == ["identified"] * 3
    prior = quaternion_from_matrix(some[0].matrix)
    tracked = matcher.identify(some[0].centroids_px, prior=prior, prior_error_deg=0.5)
    assert tracked.star_ids.tolist() == found[0].star_ids.tolist()


def test_many_frames_need_as_many_magnitudes(sky):
    (frame,) = frames(sky, 1)
    with pytest.raises(ConfigError, match="mag of 1 frames; expected 2"):
        Matcher(sky).identify_many([frame.centroids_px] * 2, mag=[frame.mag])


def test_engines_that_cannot_serve_say_why(sky, monkeypatch):
    with pytest.raises(ConfigError, match="choose one of auto, c, numpy"):
        Matcher(sky, engine="rust")
    monkeypatch.setattr(c_engine, "_onboard", None)
    assert not c_engine.is_compiled()
    assert c_engine.library_version() is None
    with pytest.raises(ConfigError, match="without a C compiler"):
        Matcher(sky, engine="c")


# --- The database


def mapping_under(array: np.ndarray) -> object:
    base: object = array
    while isinstance(base, np.ndarray):
        base = base.base
    return base.obj if isinstance(base, memoryview) else base


def test_arrays_are_read_only_views_of_the_file(small_artifact):
    database = open_database(small_artifact, products_in(small_artifact))
    arrays = {
        (name, key): array
        for name, product in database.products.items()
        for key, array in product.arrays.items()
    }
    with h5py.File(small_artifact / "database.h5", "r") as file:
        there = {(name, key) for name in file for key in file[name]}
        assert set(arrays) == there
        for (name, key), array in arrays.items():
            assert isinstance(mapping_under(array), mmap.mmap), (name, key)
            assert not array.flags.writeable
            stored = file[name][key]
            assert (array.dtype, array.shape) == (stored.dtype, stored.shape)
            assert np.array_equal(array, stored[()], equal_nan=array.dtype.kind == "f")
        attributes = {
            (name, key): value
            for name in file
            for key, value in file[name].attrs.items()
            if key != "schema" and not isinstance(value, (str, bytes))
        }
    for (name, key), value in attributes.items():
        if np.ndim(value) == 0:
            assert database.products[name].numbers[key] == value
    for array in (database.star_id, database.mag, database.designation):
        assert isinstance(mapping_under(array), mmap.mmap)
        assert not array.flags.writeable


def test_the_database_says_what_it_is(small_artifact):
    database = open_database(small_artifact / "database.h5")
    assert (database.name, database.epoch_jyear) == ("small-1.0.0", 2026.0)
    assert database.camera == Camera(512, 512, fov_x_deg=40.0)
    assert database.products == {}
    assert np.abs(np.linalg.norm(database.directions, axis=1) - 1.0).max() < 1e-15
    assert len(database.directions) == len(database.star_id) == len(database.mag) > 300


@pytest.mark.parametrize("method", METHODS)
def test_a_missing_product_is_named_with_the_line_that_adds_it(artifact_copy, method):
    name = METHODS[method].products[0]
    with h5py.File(artifact_copy / "database.h5", "r+") as file:
        del file[name]
    with pytest.raises(ProductError, match=f"products.{name}.enabled = true") as caught:
        Matcher.open(artifact_copy, method)
    assert str(artifact_copy) in str(caught.value)
    assert "build" in str(caught.value)


@pytest.mark.parametrize(
    ("group", "attribute", "value", "words"),
    [
        ("/", "layout_version", "2.0.0", "database is of version 2.0.0; this matcher reads 1"),
        ("triangles", "schema", "triangles-2.1.0", "triangles is of version 2.1.0"),
        ("stars", "schema", "stars-0.9.0", "stars is of version 0.9.0"),
    ],
)
def test_another_major_version_is_refused(artifact_copy, group, attribute, value, words):
    with h5py.File(artifact_copy / "database.h5", "r+") as file:
        file[group].attrs[attribute] = value
    with pytest.raises(SchemaVersionError, match=words):
        Matcher.open(artifact_copy)


def test_another_minor_version_will_do(artifact_copy):
    with h5py.File(artifact_copy / "database.h5", "r+") as file:
        file["triangles"].attrs["schema"] = "triangles-1.7.3"
        file.attrs["layout_version"] = "1.9.0"
    assert Matcher.open(artifact_copy, verify=False).method == "triangle"


@pytest.mark.parametrize("group", ["/", "triangles"])
@pytest.mark.parametrize("attribute", ["camera", "schema", "layout_version"])
def test_a_database_without_an_attribute_is_refused(artifact_copy, group, attribute):
    with h5py.File(artifact_copy / "database.h5", "r+") as file:
        if attribute not in file[group].attrs:
            return
        del file[group].attrs[attribute]
    with pytest.raises(ProductError, match="build it again"):
        Matcher.open(artifact_copy)


@pytest.mark.parametrize("content", [b"", b"no database", b"\x89HDF\r\n\x1a\n" + bytes(500)])
def test_a_folder_that_is_not_a_database_is_refused(tmp_path, content):
    (tmp_path / "database.h5").write_bytes(content)
    with pytest.raises(ProductError, match="not a readable starcat database"):
        Matcher.open(tmp_path)


def test_a_database_that_is_cut_short_is_refused(artifact_copy):
    path = artifact_copy / "database.h5"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(ProductError, match="not a readable starcat database"):
        Matcher.open(artifact_copy)


def test_no_artifact(tmp_path):
    with pytest.raises(ProductError, match="give the folder <name>"):
        Matcher.open(tmp_path / "nowhere")


def test_an_unknown_method_is_refused_with_those_there_are(small_artifact):
    with pytest.raises(ConfigError, match=r"'triangles' is unknown.*triangle, pairs"):
        Matcher.open(small_artifact, "triangles")


def test_the_first_method_is_the_default_and_the_best(small_artifact, artifact_copy):
    assert next(iter(METHODS)) == "triangle" == Matcher.open(str(small_artifact)).method
    assert Matcher.open(small_artifact, None).method == "triangle"
    with h5py.File(artifact_copy / "database.h5", "r+") as file:
        del file["triangles"]
    assert Matcher.open(artifact_copy, None, verify=False).method == "pairs"
    with pytest.raises(ProductError, match=r"products\.triangles\.enabled"):
        best_method(["stars"])


def test_only_what_the_method_needs_is_opened(small_artifact):
    for name, method in METHODS.items():
        database = Matcher.open(small_artifact, name).database
        assert set(database.products) == set(method.products)


def test_the_limits_of_open_reach_the_matcher(small_artifact):
    selection = TriangleOrder("inradius")
    found = Matcher.open(
        small_artifact, "pairs", tolerance_px=1.5, max_false_match_probability=1e-6,
        selection=selection,
    )  # fmt: skip
    assert (found.tolerance_px, found.max_false_match_probability) == (1.5, 1e-6)
    assert found.selection is selection


def test_a_stated_noise_is_three_of_the_tolerance(small_artifact):
    found = Matcher.open(small_artifact, noise_px=0.5, noise_mag=0.25)
    assert (found.tolerance_px, found.noise_px, found.noise_mag) == (1.5, 0.5, 0.25)
    assert Matcher.open(small_artifact, noise_mag=0.25).tolerance_px == 2.0
    again = replace(found, max_steps=7)
    assert (again.tolerance_px, again.noise_px, again.noise_mag) == (1.5, 0.5, 0.25)


def test_noise_and_tolerance_are_not_both_given(small_artifact):
    with pytest.raises(
        ConfigError, match=r"both tolerance_px, 2\.0, and noise_px, 0\.5, are given"
    ):
        Matcher.open(small_artifact, tolerance_px=2.0, noise_px=0.5)


@pytest.mark.parametrize("name", ["noise_px", "noise_mag"])
@pytest.mark.parametrize("value", [0.0, -0.5, np.nan, np.inf, "0.5", True])
def test_a_noise_that_is_invalid_is_refused(triangles, name, value):
    with pytest.raises(ConfigError, match=f"{name} is .*; expected a number above 0, at most"):
        replace(triangles, **{name: value, "tolerance_px": None})


def test_centroids_take_no_star_of_another_magnitude(sky):
    frame = frames(sky, 1, Noise(0.3))[0]
    mag = sky.mag[frame.star_index].astype(np.float64)
    mag[0], mag[1] = mag[0] + 0.36, np.nan
    seen = observe(frame.centroids_px, CAMERA, 2.0, mag, noise_mag=0.1)
    found = np.empty(len(seen), dtype=np.int64)
    found[seen.rows] = agreement_of(frame.matrix, seen, sky).star_index
    assert found[0] == -1
    assert (found[1:] == frame.star_index[1:]).all()
    # Without a stated error the zero point may be any one.
    seen = observe(frame.centroids_px, CAMERA, 2.0, mag + 9.0)
    found[seen.rows] = agreement_of(frame.matrix, seen, sky).star_index
    assert (found == frame.star_index).all()


def test_a_star_of_another_magnitude_hides_no_star_behind_it(sky):
    # The star that is nearest to a centroid is too faint; the next one within reach is taken.
    frame = frames(sky, 1, Noise())[0]
    star, moved = int(frame.star_index[0]), frame.centroids_px.copy()
    moved[0, 0] += 1.0
    [near] = CAMERA.directions_from_pixels(moved[:1]) @ frame.matrix
    crowded = replace(
        sky,
        directions=np.vstack([sky.directions, near]),
        mag=np.append(sky.mag, sky.mag[star] + 2.0),
    )
    for noise_mag, expected in ((0.3, star), (None, len(sky.mag))):
        seen = observe(moved, CAMERA, 2.0, sky.mag[frame.star_index], noise_mag=noise_mag)
        [row] = np.flatnonzero(seen.rows == 0)
        assert agreement_of(frame.matrix, seen, crowded).star_index[row] == expected
