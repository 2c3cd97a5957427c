"""Matcher: right answers to true frames, no answer to other frames."""

from __future__ import annotations

import mmap
from dataclasses import replace

import h5py
import numpy as np
import pytest
from frames import agreement_of, observe
from frames import frames_of as frames
from hypothesis import given
from hypothesis import strategies as st

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
from starcat.matcher.database import MatcherDatabase, open_database, products_in
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods import pairs, triangle
from starcat.matcher.methods.table import METHODS, best_method
from starcat.matcher.observation import Candidates, Observation
from starcat.matcher.settings import REACH, TriangleOrder
from starcat.matcher.verification import BestOf, agreeing_centroids, verify_candidates
from starcat.pipeline.simulation.selftest import answers_rightly, self_test
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame, Sky, simulate_frame

CAMERA = Camera(1024, 1024, fov_x_deg=20.0)

IN_MEMORY = ("triangle", "pairs", "pyramid")
"""The methods whose products the fixture `sky_of` makes."""


@pytest.fixture(scope="module", params=[*IN_MEMORY, *(f"{name} in C" for name in FEATURES)])
def matcher(sky, request) -> Matcher:
    method, _, in_c = request.param.partition(" ")
    if in_c and not is_compiled():
        pytest.skip("starcat was installed without a C compiler")
    return Matcher(sky, method=method, engine="c" if in_c else "numpy")


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
    # Separations and tolerance are angles.
    expected = separation(seen.body[:, None], seen.body[None])
    # For separation 0 the chord of rounded components is not exactly 0.
    assert np.abs(seen.separation_rad - expected).max() < 1e-15
    assert seen.tolerance_rad == pytest.approx(2.0 / CAMERA.focal_length_px)


def test_with_magnitudes_the_brightest_come_first_and_unknown_ones_last():
    points = np.random.default_rng(31).random((6, 2)) * 1024.0
    seen = observe(points, CAMERA, 2.0, [4.0, np.nan, -1.5, 6.0, np.nan, 4.0])
    assert seen.rows[0] == 2
    assert sorted(seen.rows[1:3]) == [0, 5]
    assert seen.rows[3] == 3
    assert sorted(seen.rows[4:]) == [1, 4]
    assert np.array_equal(seen.mag, [-1.5, 4.0, 4.0, 6.0, np.nan, np.nan], equal_nan=True)
    for unknown in ([np.nan] * 6, [np.inf, np.nan, -np.inf] * 2):
        assert observe(points, CAMERA, 2.0, unknown).mag is None


@given(st.permutations(range(12)), st.booleans())
def test_the_order_of_an_observation_is_its_own(order, known):
    generator = np.random.default_rng(32)
    # Ties on purpose: four centroids as far from the centre as each other, two magnitudes.
    tied = 512.0 + 99.0 * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    points = np.concatenate([generator.random((8, 2)) * 1024.0, tied])
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
    # Of repeats the brightest is kept.
    points = [[300.0, 300.0], [700.0, 700.0], [300.0, 300.0], [300.0, 300.0]]
    seen = observe(points, CAMERA, 2.0, [5.0, 4.0, 2.0, 3.0])
    assert seen.rows.tolist() == [2, 1]
    assert sorted(seen.dropped) == [(0, "duplicate"), (3, "duplicate")]
    # Minus zero is zero.
    assert len(observe([[0.0, 5.0], [-0.0, 5.0]], CAMERA, 2.0)) == 1
    for nothing in ([], np.empty((0, 2)), np.empty((2, 0)), [[nan, 1.0]]):
        seen = observe(nothing, CAMERA, 2.0)
        assert (len(seen), seen.body.shape, seen.separation_rad.shape) == (0, (0, 3), (0, 0))


def test_arrays_of_another_shape_are_refused():
    for shape in ((4,), (3, 4), (2, 2, 2), (1, 1)):
        with pytest.raises(ConfigError, match=r"centroids_px has shape .*expected \(N, 2\)"):
            observe(np.ones(shape), CAMERA, 2.0)
    for shape in ((3,), (5,), (4, 1), ()):
        with pytest.raises(ConfigError, match=r"mag has shape .*expected \(4,\)"):
            observe(np.ones((4, 2)), CAMERA, 2.0, np.ones(shape))


@pytest.mark.parametrize(
    "values",
    [[[1.0, 2.0], [3.0]], [["a", "b"]], [["1", "2"]], [[{}, 1.0]], [[1.0, 2j]], [[10**400, 1]],
     np.ones((4, 2), bool), [[True, None]], object()],
)  # fmt: skip
def test_what_numpy_cannot_convert_is_refused(triangles, values):
    with pytest.raises(ConfigError, match="mag: it has 1 frames; expected 2"):
        triangles.identify_many([np.ones((5, 2))] * 2, mag=[np.ones(5)])
    with pytest.raises(ConfigError, match=r"centroids_px: not an array of .* shape \(N, 2\)"):
        triangles.identify(values)
    with pytest.raises(ConfigError, match="centroids_px: not an array of real numbers"):
        triangles.identify_many([np.ones((5, 2)), values])
    with pytest.raises(ConfigError, match=r"mag: not an array of real .* shape \(4,\)"):
        triangles.identify(np.ones((4, 2)), mag=values)


# --- Verification


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


def cluster_sky(sky_of, random_directions) -> MatcherDatabase:
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


def test_an_attitude_elsewhere_agrees_with_too_few(sky):
    one, other = frames(sky, 2)
    found = agreement_of(other.matrix, observed(one), sky)
    assert found.false_match_probability > 1e-3
    assert found.n_matched < 4 or found.residual_rad > 0.0
    assert np.isnan(found.residual_rad) == (found.n_matched < 4)
    empty = replace(sky, directions=sky.directions[:0])
    found = agreement_of(np.eye(3), observed(one), empty)
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

    def verified(stars):
        best = BestOf(1e-9)
        centroids = np.broadcast_to(np.arange(3), (len(stars), 3))
        verify_candidates(Candidates(centroids, stars), seen, sky, best)
        return best.agreement

    for frame in frames(sky, 10, Noise(0.3)):
        seen = observed(frame)
        true = frame.star_index[seen.rows]
        stars = generator.integers(len(sky.directions), size=(300, 3))
        false = verified(stars)  # never certain
        assert false is None or false.false_match_probability > 1e-6
        stars[generator.integers(300)] = true[:3]
        found = verified(stars)
        assert found is not None
        assert found.false_match_probability < 1e-9
        assert found.star_index.tolist() == true.tolist()
    assert verified(np.empty((0, 3), dtype=np.intp)) is None


# --- Methods


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
def test_area_and_circumradius_of_a_triangle_and_their_errors(sides):
    a, b, c = sides
    half, tolerance = 0.5 * (a + b + c), 1e-7
    expected = np.sqrt(half * (half - a) * (half - b) * (half - c))
    area, area_error, radius, radius_error = triangle.features(a, b, c, *3 * [tolerance])
    assert area == pytest.approx(expected, rel=1e-9)
    assert radius == pytest.approx(a * b * c / (4.0 * expected), rel=1e-9)
    moved = [
        triangle.features(*(np.array(sides) + tolerance * step), *3 * [tolerance])[::2]
        for step in np.eye(3)
    ]
    # Independent errors of the sides add as squares; the second order is 1e-4 of the first.
    slopes = np.hypot.reduce(np.array(moved) - [area, radius], axis=0)
    assert area_error == pytest.approx(slopes[0], rel=1e-2, abs=1e-12)
    assert radius_error == pytest.approx(slopes[1], rel=1e-2, abs=1e-12)
    for flat in ((a, a, a + a), (a, a, 3.0 * a)):  # no crash
        assert np.isfinite(triangle.features(*flat, *3 * [1e-4])[0])


# --- Identification


@pytest.mark.parametrize(("count", "unusable"), [(0, 0), (0, 5), (3, 0), (3, 5)])
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
    finer = Camera(2048, 2048, 2.0 * CAMERA.focal_length_px)  # it sees the same sky
    same = matcher.identify(2.0 * frame.centroids_px, finer)
    assert same.star_index.tolist() == found.star_index.tolist()
    probability = found.false_match_probability
    assert 0.0 < probability < 1e-9
    exactly = matcher.with_settings(max_false_match_probability=probability)
    assert exactly.identify(frame.centroids_px).status == "identified"
    stricter = matcher.with_settings(max_false_match_probability=0.5 * probability)
    refused = stricter.identify(frame.centroids_px)
    assert refused.status == "no_match"
    assert refused.false_match_probability == 1.0


def test_the_tolerance_is_how_far_centroids_may_err(triangles):
    coarse = frames(triangles.database, 15, Noise(2.0))
    narrow, wide = (replace(triangles, tolerance_px=width) for width in (1.0, 6.0))
    few, most = (
        sum(some.identify(frame.centroids_px).ok for frame in coarse) for some in (narrow, wide)
    )
    assert most > 12 > few + 3


@pytest.mark.parametrize("method", IN_MEMORY)
def test_a_cluster_of_stars_is_not_taken_for_the_whole_frame(sky_of, random_directions, method):
    # Ten stars within 100 px hardly determine the roll: an attitude with which only they agree is
    # wrong, although they do not agree by chance.
    generator, database = np.random.default_rng(5), cluster_sky(sky_of, random_directions)
    stars = Sky(database.directions, database.mag, np.arange(1210, dtype=np.int32))
    for _ in range(150):
        ra_deg, roll_deg = generator.uniform(0.0, 360.0, 2)
        matrix = matrix_from_radec_roll(ra_deg, generator.uniform(83.0, 90.0), roll_deg)
        frame = simulate_frame(stars, CAMERA, matrix, Noise(0.5), generator)
        found = Matcher(database, method=method).identify(frame.centroids_px)
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


def test_an_answer_is_right_within_the_tolerance(triangles):
    frame, other = frames(triangles.database, 2)
    found = triangles.identify(frame.centroids_px)
    assert answers_rightly(found, frame, triangles)
    assert not answers_rightly(triangles.identify(other.centroids_px), frame, triangles)
    for shift_px, is_right in ((1.0, True), (3.0, False)):
        # A tilt moves a star at the edge, 10 deg off the axis, 6 % farther than one in the middle.
        angle = shift_px / CAMERA.focal_length_px
        tilt = np.array([[1.0, 0.0, angle], [0.0, 1.0, 0.0], [-angle, 0.0, 1.0]])
        moved = replace(found, matrix=tilt @ frame.matrix)
        assert answers_rightly(moved, frame, triangles) == is_right


def test_without_c_numpy_answers_and_c_is_refused(sky, monkeypatch):
    with pytest.raises(ConfigError, match="choose one of auto, c, numpy"):
        Matcher(sky, engine="rust")
    monkeypatch.setattr(c_engine, "_onboard", None)
    assert not c_engine.is_compiled()
    assert c_engine.library_version() is None
    with pytest.raises(ConfigError, match="without a C compiler"):
        Matcher(sky, engine="c")
    matcher, some = Matcher(sky), frames(sky, 3)
    found = matcher.identify_many([frame.centroids_px for frame in some])
    assert [answer.status for answer in found] == ["identified"] * 3
    prior = quaternion_from_matrix(some[0].matrix)
    tracked = matcher.identify(some[0].centroids_px, prior=prior, prior_error_deg=0.5)
    assert tracked.star_ids.tolist() == found[0].star_ids.tolist()


# --- The database


def mapping_under(array: np.ndarray) -> object:
    base: object = array
    while isinstance(base, np.ndarray):
        base = base.base
    return base.obj if isinstance(base, memoryview) else base


def test_a_database_says_what_it_is_and_its_arrays_are_views_of_the_file(small_database):
    database = open_database(small_database, products_in(small_database))
    assert (database.name, database.epoch_jyear) == ("small-1.0.0", 2026.0)
    assert database.camera == Camera(512, 512, fov_x_deg=40.0)
    assert np.abs(np.linalg.norm(database.directions, axis=1) - 1.0).max() < 1e-15
    assert len(database.directions) == len(database.star_id) == len(database.mag) > 300
    with h5py.File(small_database / "database.h5", "r") as file:
        assert set(database.products) == set(file)
        for name, product in database.products.items():
            assert set(product.arrays) == set(file[name])
            for key, array in product.arrays.items():
                assert isinstance(mapping_under(array), mmap.mmap), (name, key)
                assert not array.flags.writeable
                stored = file[name][key]
                assert (array.dtype, array.shape) == (stored.dtype, stored.shape)
                assert np.array_equal(array, stored[()], equal_nan=array.dtype.kind == "f")
            for key, value in file[name].attrs.items():
                if key != "schema" and not isinstance(value, (str, bytes)) and np.ndim(value) == 0:
                    assert product.numbers[key] == value
    for array in (database.star_id, database.mag, database.designation):
        assert isinstance(mapping_under(array), mmap.mmap)
        assert not array.flags.writeable
    assert open_database(small_database / "database.h5").products == {}


def test_another_major_version_is_refused_and_another_minor_one_will_do(database_copy):
    path = database_copy / "database.h5"
    for group, attribute, sound, other, words in (
        ("/", "layout_version", "1.9.0", "2.0.0", "database is of version 2.0.0; this matcher"),
        ("triangles", "schema", "triangles-1.7.3", "triangles-2.1.0", "triangles is of version"),
        ("stars", "schema", "stars-1.0.0", "stars-0.9.0", "stars is of version 0.9.0"),
    ):
        with h5py.File(path, "r+") as file:
            file[group].attrs[attribute] = other
        with pytest.raises(SchemaVersionError, match=words):
            Matcher.open(database_copy)
        with h5py.File(path, "r+") as file:
            file[group].attrs[attribute] = sound
        assert Matcher.open(database_copy, verify=False).settings.method == "triangle"


def test_a_database_without_an_attribute_is_refused(database_copy):
    for group, attribute in (("triangles", "schema"), ("/", "layout_version"), ("/", "camera")):
        with h5py.File(database_copy / "database.h5", "r+") as file:
            value = file[group].attrs.pop(attribute)
        with pytest.raises(ProductError, match="build it again"):
            Matcher.open(database_copy)
        with h5py.File(database_copy / "database.h5", "r+") as file:
            file[group].attrs[attribute] = value


def test_the_first_method_is_the_default_and_the_best(small_database, database_copy):
    for name, method in METHODS.items():  # only what it needs is opened
        assert set(Matcher.open(small_database, name).database.products) == set(method.products)
    assert next(iter(METHODS)) == "triangle" == Matcher.open(str(small_database)).settings.method
    assert Matcher.open(small_database, None).settings.method == "triangle"
    with h5py.File(database_copy / "database.h5", "r+") as file:
        del file["triangles"]
    assert Matcher.open(database_copy, None, verify=False).settings.method == "pairs"
    with pytest.raises(ProductError, match=r"products\.triangles\.enabled"):
        best_method(["stars"])


def test_the_limits_of_open_reach_the_matcher(small_database):
    selection = TriangleOrder("inradius")
    limits = {"tolerance_px": 1.5, "max_false_match_probability": 1e-6, "selection": selection}
    found = Matcher.open(small_database, "pairs", **limits)
    assert {name: getattr(found.settings, name) for name in limits} == limits
    assert found.settings.selection is selection
    # A stated noise is a third of the tolerance.
    found = Matcher.open(small_database, noise_px=0.5, noise_mag=0.25)
    for stated in (found.settings, found.with_settings(max_steps=7).settings):
        assert (stated.tolerance_px, stated.noise_px, stated.noise_mag) == (1.5, 0.5, 0.25)
    assert Matcher.open(small_database, noise_mag=0.25).settings.tolerance_px == 2.0
    with pytest.raises(ConfigError, match=r"noise_px is .*; give one of tolerance_px and noise_px"):
        Matcher.open(small_database, tolerance_px=2.0, noise_px=0.5)


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
    mag = np.append(sky.mag, sky.mag[star] + 2.0)
    crowded = replace(sky, directions=np.vstack([sky.directions, near]), mag=mag)
    for noise_mag, expected in ((0.3, star), (None, len(sky.mag))):
        seen = observe(moved, CAMERA, 2.0, sky.mag[frame.star_index], noise_mag=noise_mag)
        [row] = np.flatnonzero(seen.rows == 0)
        assert agreement_of(frame.matrix, seen, crowded).star_index[row] == expected
