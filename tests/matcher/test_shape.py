"""Shapes of frames: terms that are fitted with the attitude, and what they do to an answer."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from frames import ARCSEC, agreement_of, both_engines, error_arcsec, few_in_numpy, observe
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation

from starcat.errors import ConfigError
from starcat.geometry.attitude import solve_wahba_svd
from starcat.geometry.camera import Camera
from starcat.geometry.distortion import Distortion
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods.triangle import SIDE_CHANGE, candidates, shaped_candidates
from starcat.matcher.pose import pose_at, pose_of_shape
from starcat.matcher.shape import (
    HALF_RANGES,
    N_TERMS,
    NO_SHAPE,
    Shape,
    basis,
    chance_of_gain,
    chance_of_ratio,
    corner_error_rad,
    derivatives,
    half_ranges,
    largest_influence_rad,
    log_growth,
    of_scale,
    solve_normal,
    undone_px,
)
from starcat.matcher.stars import model_covariance
from starcat.pipeline.simulation.simulate import Noise, simulate_frames

CAMERA = Camera(1024, 768, fov_x_deg=20.0)
LENS = Camera(
    1024, 768, fov_x_deg=30.0, principal_point_px=(500.0, 400.0), distortion=Distortion(k1=-0.2)
)
CORNERS_PX = np.array([[0.0, 0.0], [1024.0, 0.0], [0.0, 768.0], [1024.0, 768.0]])
NAMES = ["scale", "radial", "stretch", "shear", "tilt_x", "tilt_y"]

FEWEST_TERMS = (1, 2, 4, 4, 6, 6)
"""Number of terms of the simplest model that has a term."""


def term_of(number: int, value: float) -> np.ndarray:
    terms = np.zeros(N_TERMS)
    terms[number] = value
    return terms


def shaped_px(px: np.ndarray, terms: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the places that a frame of a shape has, by iteration: the inverse of `undone_px`."""
    found = px
    for _ in range(60):
        found = px + basis(found, camera) @ terms
    assert np.abs(undone_px(found, terms, camera) - px).max() < 1e-9
    return np.asarray(found)


def places(count: int, seed: int, camera: Camera = CAMERA, half: float = 0.5) -> np.ndarray:
    """Return places on the detector, up to a part of its size from the middle."""
    size = np.array([camera.width_px, camera.height_px])
    return np.asarray(size * (0.5 + np.random.default_rng(seed).uniform(-half, half, (count, 2))))


# --- Terms


def test_the_terms_move_places_as_the_table_says():
    px = places(40, 1)
    q = px - [512.0, 384.0]
    moved = basis(px, CAMERA)
    np.testing.assert_allclose(moved[:, :, 0], q)
    np.testing.assert_allclose(moved[:, :, 2], np.column_stack([np.zeros(40), q[:, 1]]))
    np.testing.assert_allclose(moved[:, :, 3], np.column_stack([q[:, 1], np.zeros(40)]))
    np.testing.assert_allclose(moved[:, :, 4], q * q[:, :1] / 640.0)
    np.testing.assert_allclose(moved[:, :, 5], q * q[:, 1:] / 640.0)
    at_corners = basis(CORNERS_PX, CAMERA)[:, :, 1] / (CORNERS_PX - [512.0, 384.0])
    assert np.ptp(at_corners) < 1e-12
    assert 0.4 < at_corners[0, 0] < 0.6  # a corner moves by 1 more than the axis


@pytest.mark.parametrize("camera", [CAMERA, Camera(1024, 1024, fov_x_deg=20.0)])
def test_the_radial_term_has_no_scale_over_the_detector(camera):
    grid = np.stack(np.meshgrid(np.arange(1024) + 0.5, np.arange(camera.height_px) + 0.5), axis=-1)
    moved = basis(grid.reshape(-1, 2), camera)
    radial, scale = moved[:, :, 1].ravel(), moved[:, :, 0].ravel()
    assert abs(radial @ scale) < 1e-4 * (scale @ scale)


def test_a_shape_and_a_focal_length_are_the_same_directions():
    px, terms = places(20, 2), np.array([0.02, 0.01, -0.01, 0.005, 0.01, -0.02])
    seen = CAMERA.directions_from_pixels(undone_px(px, terms, CAMERA))
    shape, camera = of_scale(Shape(terms, 6), CAMERA)
    assert shape.terms[0] == 0.0
    assert camera.focal_length_px == pytest.approx(CAMERA.focal_length_px / 0.98)
    same = camera.directions_from_pixels(undone_px(px, shape.terms, camera))
    np.testing.assert_allclose(same, seen, atol=1e-14)
    assert of_scale(NO_SHAPE, CAMERA) == (NO_SHAPE, CAMERA)


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_derivatives_are_differences(camera):
    px, step = places(30, 3, camera), 1e-6
    body = camera.directions_from_pixels(px)
    rows = derivatives(px, body, camera)
    assert rows.shape == (30, 2, 9)
    pinhole = replace(camera, distortion=Distortion())
    for axis in range(3):
        turn = Rotation.from_rotvec(step * np.eye(3)[axis])
        ahead, behind = turn.apply(body), turn.inv().apply(body)
        slope = pinhole.pixels_from_directions(ahead) - pinhole.pixels_from_directions(behind)
        np.testing.assert_allclose(rows[:, :, axis], slope / (2.0 * step), rtol=1e-6, atol=1e-3)
    for number in range(N_TERMS):
        slope = px - undone_px(px, term_of(number, step), camera)
        np.testing.assert_allclose(rows[:, :, 3 + number], slope / step, rtol=1e-6, atol=1e-3)
    np.testing.assert_array_equal(derivatives(px, body, camera, 2), rows[:, :, :5])


@given(st.integers(0, 99), st.floats(-0.1, 0.1), st.integers(0, 5))
def test_the_growth_of_areas_is_the_determinant_of_differences(seed, value, number):
    px, step = places(7, seed), 1e-3
    terms = term_of(number, value) + 0.3 * value
    slopes = [
        (undone_px(px + move, terms, CAMERA) - undone_px(px - move, terms, CAMERA)) / (2.0 * step)
        for move in step * np.eye(2)
    ]
    determinant = np.linalg.det(np.stack(slopes, axis=-1))
    assert log_growth(px, terms, CAMERA) == pytest.approx(-np.log(determinant).sum(), abs=1e-6)


def test_a_stated_error_of_the_focal_length_is_the_range_of_the_scale():
    assert half_ranges(0.0).tolist() == list(HALF_RANGES)
    stated = half_ranges(0.02)
    assert stated[0] == pytest.approx(0.0202, abs=1e-4)
    assert stated[1:].tolist() == list(HALF_RANGES[1:])


def test_chances_are_those_of_fisher_and_of_chi_square():
    for free in (1, 4, 9, 40):
        for ratio in (0.05, 0.3, 0.9):
            fisher = (1.0 - ratio) / 6.0 / (ratio / free)
            assert chance_of_ratio(ratio, free) == pytest.approx(stats.f.sf(fisher, 6, free))
    for gain in (0.0, 3.0, 20.0, 60.0):
        assert chance_of_gain(gain) == pytest.approx(stats.chi2.sf(gain, 6))


# --- The fit


@given(st.integers(0, 50))
def test_a_fit_to_known_stars_ends_at_the_shape(seed):
    terms = np.random.default_rng(seed).uniform(-0.04, 0.04, N_TERMS)
    stars = CAMERA.directions_from_pixels(places(25, seed))
    seen = observe(shaped_px(places(25, seed), terms, CAMERA), CAMERA, 2.0)
    pose = pose_at(np.eye(3), 1.0, seen)
    for _ in range(8):
        rows = derivatives(seen.centroids_px, pose.body, CAMERA)
        predicted = CAMERA.pixels_from_directions(stars[seen.rows] @ pose.matrix.T)
        half = np.full(N_TERMS, 1e3)  # without priors
        normal = solve_normal(pose.px - predicted, rows, pose.shape.terms, half, 1.0)
        turn = Rotation.from_rotvec(-normal.step[:3]).as_matrix() @ pose.matrix
        pose = pose_of_shape(turn, Shape(pose.shape.terms + normal.step[3:], 6), seen)
    np.testing.assert_allclose(pose.shape.terms, terms, atol=1e-7)
    np.testing.assert_allclose(pose.matrix, np.eye(3), atol=1e-7)


@both_engines
@pytest.mark.parametrize("number", range(N_TERMS), ids=NAMES)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_shape_of_a_frame_is_found_with_its_attitude(sky, engine, number, sign):
    noise_px, value = 0.05, 0.008 * sign
    camera, matcher = sky.camera, Matcher(sky, engine=engine)
    for frame in simulate_frames(sky.directions, camera, 6, Noise(noise_px), 12, sky.mag):
        if len(frame.mag) < 10:
            continue
        px = shaped_px(frame.centroids_px, term_of(number, value), camera)
        found = matcher.identify(px, camera, mag=frame.mag, sigma_px=np.full(len(px), noise_px))
        assert found.ok
        assert found.shape.free >= FEWEST_TERMS[number]
        has_star = found.star_index >= 0
        assert has_star.mean() >= 0.8
        assert (found.star_index == frame.star_index)[has_star].all()
        scale = 1.0 - camera.focal_length_px / found.camera.focal_length_px
        terms = found.shape.terms * (1.0 - scale)
        terms[0] = scale
        # Each term alone has an error of noise over the places, 0.05 / (500 sqrt(n)).
        np.testing.assert_allclose(terms, term_of(number, value), atol=1.5e-3)
        deviations = np.sqrt(found.covariance_arcsec2.diagonal())
        assert (np.abs(error_arcsec(found, frame.matrix)) < 5.0 * deviations).all()
        assert deviations[:2].max() < 0.5 * ARCSEC / camera.focal_length_px


@both_engines
def test_a_frame_of_the_stated_camera_has_no_shape(sky, engine):
    matcher = Matcher(sky, engine=engine, noise_px=0.3)
    frames = simulate_frames(sky.directions, sky.camera, 40, Noise(0.3, 0.1, 2), 5, sky.mag)
    found = [matcher.identify(frame.centroids_px, mag=frame.mag) for frame in frames]
    assert all(one.ok for one in found)
    assert [one.shape for one in found] == 40 * [None]


@both_engines
def test_a_scale_just_beyond_the_stated_range_is_answered_with_a_remark(sky, engine):
    matcher, answered = Matcher(sky, engine=engine), 0
    [frame] = simulate_frames(sky.directions, sky.camera, 1, Noise(0.2), 12, sky.mag)
    for longer in (0.985, 0.99, 1.0, 1.01, 1.015):
        camera = sky.camera.with_focal_length(sky.camera.focal_length_px / longer)
        found = matcher.identify(frame.centroids_px, camera, fov_error=0.012)
        assert found.ok
        assert found.camera.focal_length_px == pytest.approx(sky.camera.focal_length_px, rel=1e-3)
        is_beyond = abs(longer - 1.0) > 0.012
        assert len(found.remarks) == is_beyond
        if is_beyond:
            answered += 1
            side = "longer" if longer > 1.0 else "shorter"
            [remark] = found.remarks
            assert remark.startswith(f"the focal length is 1.5 % {side} than stated, which is")
            assert "error of 1.2 % (fov_error)" in remark
            # The bound is that of a range which is twice as wide and has half of the probability.
            within = matcher.identify(frame.centroids_px, camera, fov_error=0.024)
            assert within.remarks == ()
            assert found.false_match_probability > within.false_match_probability
    assert answered == 2
    camera = sky.camera.with_focal_length(sky.camera.focal_length_px / 1.03)
    assert not matcher.identify(frame.centroids_px, camera, fov_error=0.012).ok


# --- The search of frames of another shape


def not_square(px: np.ndarray, camera: Camera, ratio: float) -> np.ndarray:
    """Return the centroids of a frame whose pixels are narrower than high by a ratio."""
    middle = np.array(camera.middle_px)
    return np.asarray(middle + (px - middle) * [math.sqrt(ratio), 1.0 / math.sqrt(ratio)])


def test_triangles_of_another_shape_are_proposed_with_their_stars(sky):
    camera, found, plain, in_reach = sky.camera, 0, 0, 0
    for frame in simulate_frames(sky.directions, camera, 6, Noise(0.2), 12, sky.mag):
        seen = observe(not_square(frame.centroids_px, camera, 1.07), camera, 2.0, frame.mag)
        star = frame.star_index[seen.rows]
        shaped = [*islice(shaped_candidates(seen, sky), 70)]
        proposed = np.concatenate([one.stars for one in shaped])
        centroids = np.concatenate([one.centroids for one in shaped])
        is_true = (proposed == star[centroids]).all(axis=1)
        found += bool(is_true.any())
        plain += any(
            (one.stars == star[one.centroids]).all(axis=1).any() for one in candidates(seen, sky)
        )
        # Each proposed triangle is as large as the observed one, to the change of a shape.
        corners, stars = seen.body[centroids], sky.directions[proposed]
        for a, b in ((0, 1), (1, 2), (2, 0)):
            apart = np.linalg.norm(corners[:, a] - corners[:, b], axis=1)
            error = np.abs(np.linalg.norm(stars[:, a] - stars[:, b], axis=1) - apart)
            assert (error <= SIDE_CHANGE * apart + seen.side_tolerance_rad + 1e-6).all()
        in_reach += len(proposed)
        # The most compact triangles come first.
        sides = [
            np.linalg.norm(np.diff(seen.body[one.centroids[0]], axis=0), axis=1)
            for one in shaped
            if len(one)
        ]
        assert max(sides[0]) < max(max(one) for one in sides)
    assert found >= 5
    assert found > plain
    assert in_reach > 20


@both_engines
@pytest.mark.parametrize("ratio", [1.07, 1.0 / 1.07])
def test_a_frame_whose_pixels_are_not_square_is_found(sky, engine, ratio):
    """Triangles with sides of the stated camera find 9 of these 20 frames."""
    matcher, answered = Matcher(sky, engine=engine), 0
    for frame in simulate_frames(sky.directions, sky.camera, 20, Noise(0.2), 12, sky.mag):
        px = not_square(frame.centroids_px, sky.camera, ratio)
        is_inside = sky.camera.contains(px)
        found = matcher.identify(px[is_inside], mag=frame.mag[is_inside], fov_error=0.0)
        if not found.ok:
            continue
        answered += 1
        has_star = found.star_index >= 0
        assert (found.star_index == frame.star_index[is_inside])[has_star].all()
        assert np.abs(error_arcsec(found, frame.matrix)[:2]).max() < 60.0
        assert found.shape.free >= 4
    assert answered >= 17


@both_engines
def test_spots_that_are_no_stars_have_no_shape_that_makes_them_stars(sky, engine):
    matcher, generator, tried = Matcher(sky, engine=engine), np.random.default_rng(3), 0
    for _ in range(10):
        px, mag = generator.uniform(0.0, 1024.0, (14, 2)), generator.choice(sky.mag, 14)
        found = matcher.identify(px, mag=mag)
        assert (found.status, found.false_match_probability) == ("no_match", 1.0)
        seen = observe(px, sky.camera, 2.0, mag)
        tried += sum(map(len, islice(shaped_candidates(seen, sky), 20)))
    assert tried > 20


# --- Errors that no shape explains


def test_residuals_beyond_the_noise_are_errors_of_the_attitude_as_they_are(sky):
    [frame] = simulate_frames(sky.directions, sky.camera, 1, Noise(0.3), 12, sky.mag)
    stars = Matcher(sky, noise_px=0.3).identify(frame.centroids_px, mag=frame.mag).stars
    camera, count, noise = sky.camera, len(stars), np.full(len(stars), np.nan)
    free = 2 * count - 3
    assert not model_covariance(stars, camera, 3, math.nan).any()
    off_px = 2.0 * (-1.0) ** np.arange(count)
    for sigma_px, otherwise_px in ((stars.sigma_px, math.nan), (noise, 0.3)):
        off = replace(stars, dx_px=off_px, dy_px=0.0 * off_px, sigma_px=sigma_px)
        found = model_covariance(off, camera, 3, otherwise_px)
        deviation_px = math.sqrt(4.0 * count / free - 0.3**2)
        across = (ARCSEC * deviation_px / camera.focal_length_px) ** 2
        assert np.diag(found)[:2] == pytest.approx(2 * [across])
        assert found[2, 2] > found[0, 0]
        assert np.count_nonzero(found) == 3
    # Chance explains residuals of 2 px if the noise is as large.
    assert not model_covariance(off, camera, 3, 2.0).any()


@few_in_numpy
def test_a_frame_of_which_a_part_has_another_shape_states_a_larger_error(sky, engine, count):
    matcher, camera = Matcher(sky, engine=engine, noise_px=0.3), sky.camera
    answered, off = 0, {"stated": 0, "of noise": 0}
    for frame in simulate_frames(sky.directions, camera, count, Noise(0.3), 9, sky.mag):
        q = frame.centroids_px - camera.middle_px
        px = camera.middle_px + np.where(q[:, :1] > 0.0, q * [1.01, 0.99], q)
        is_inside = camera.contains(px)
        found = matcher.identify(px[is_inside], mag=frame.mag[is_inside])
        if not found.ok:
            continue
        answered += 1
        has_star = found.star_index >= 0
        assert (found.star_index == frame.star_index[is_inside])[has_star].all()
        unknowns = 3 + (0 if found.shape is None else found.shape.free)
        stated = found.covariance_arcsec2
        of_model = model_covariance(found.stars, found.camera, unknowns, 0.3)
        error = np.abs(error_arcsec(found, frame.matrix))[:2]
        for name, covariance in (("stated", stated), ("of noise", stated - of_model)):
            off[name] += bool((error > 5.0 * np.sqrt(covariance.diagonal()[:2])).any())
    assert answered >= 0.85 * count
    assert off["stated"] <= 0.15 * answered
    assert off["stated"] <= 0.5 * off["of noise"]


# --- The corners


@pytest.mark.parametrize(("count", "half"), [(5, 0.45), (12, 0.2)])
def test_the_worst_corner_scatters_as_predicted(count, half):
    px, sigma_px, chosen = places(count, 3, half=half), 0.1, 4000
    noise = np.random.default_rng(1).normal(scale=sigma_px, size=(chosen, count, 2))
    body = CAMERA.directions_from_pixels((px + noise).reshape(-1, 2)).reshape(chosen, count, 3)
    stars = CAMERA.directions_from_pixels(px)
    matrices = solve_wahba_svd(body, np.broadcast_to(stars, body.shape))
    corners = CAMERA.directions_from_pixels(CORNERS_PX)
    turned = np.einsum("kij,nj->kni", matrices, corners)
    worst = np.sqrt((np.linalg.norm(turned - corners, axis=2) ** 2).mean(axis=0)).max()
    normal = solve_normal(
        np.zeros((count, 2)), derivatives(px, stars, CAMERA, 0), np.zeros(6), half_ranges(0.0), 1.0
    )
    assert sigma_px * corner_error_rad(normal.covariance, CAMERA) == pytest.approx(worst, rel=0.25)


def test_terms_that_are_free_make_the_corners_less_certain():
    px = places(8, 5)
    body, errors = CAMERA.directions_from_pixels(px), []
    for free in (0, 1, 2, 4, 6):
        rows = derivatives(px, body, CAMERA, free)
        normal = solve_normal(np.zeros((8, 2)), rows, np.zeros(6), half_ranges(0.0), 0.5)
        errors.append(corner_error_rad(normal.covariance, CAMERA))
    assert (np.diff(errors) >= -1e-12).all()
    assert errors[-1] > 1.5 * errors[0]
    # Stars of a cluster say nothing of the corners; without priors they would be anywhere.
    near = CAMERA.directions_from_pixels(0.1 * (px - 512.0) + 512.0)
    rows = derivatives(0.1 * (px - 512.0) + 512.0, near, CAMERA, 4)
    normal = solve_normal(np.zeros((8, 2)), rows, np.zeros(6), half_ranges(0.0), 0.5)
    assert corner_error_rad(normal.covariance, CAMERA) > 5.0 * errors[3]


@pytest.mark.parametrize("free", [0, 4])
def test_the_influence_of_a_star_is_what_leaving_it_out_changes(free):
    px = places(9, 6)
    body = CAMERA.directions_from_pixels(px)
    residual = np.random.default_rng(7).normal(scale=0.5, size=px.shape)
    residual[3] += [2.0, -1.0]
    rows = derivatives(px, body, CAMERA, free)
    whole = solve_normal(residual, rows, np.zeros(6), half_ranges(0.0), 1.0)
    corner_rad = math.hypot(512.0, 384.0) / CAMERA.focal_length_px
    turns = []
    for left_out in range(9):
        kept = np.arange(9) != left_out
        one = solve_normal(residual[kept], rows[kept], np.zeros(6), half_ranges(0.0), 1.0)
        turn = (whole.step - one.step)[:3] * [1.0, 1.0, corner_rad]
        turns.append(np.linalg.norm(turn))
    left = residual - rows @ whole.step
    found = largest_influence_rad(left, rows, whole.covariance, CAMERA)
    assert found == pytest.approx(max(turns), rel=1e-6)


# --- A calibrated camera


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_the_error_of_a_camera_is_how_far_a_corner_may_move(camera):
    corner_px = 0.5 * math.hypot(camera.width_px, camera.height_px)
    narrow = half_ranges(0.0, camera, 0.004)
    moved = np.linalg.norm(basis(CORNERS_PX, camera) * narrow, axis=1).max(axis=0)
    np.testing.assert_allclose(moved, 0.004 * corner_px)
    assert (half_ranges(0.0, camera, 0.1) <= HALF_RANGES).all()
    assert half_ranges(0.02, camera, 0.004)[0] == half_ranges(0.02)[0]


@both_engines
def test_a_calibrated_camera_gives_up_other_shapes_and_gains_evidence(sky, engine):
    [frame] = simulate_frames(sky.directions, sky.camera, 1, Noise(0.05), 12, sky.mag)
    px = shaped_px(frame.centroids_px, term_of(2, 0.008), sky.camera)
    wide = Matcher(sky, engine=engine, tolerance_px=4.0).identify(px)
    narrow = Matcher(sky, engine=engine, tolerance_px=4.0, camera_error=0.01).identify(px)
    assert wide.ok
    assert narrow.ok
    assert narrow.false_match_probability < 0.1 * wide.false_match_probability
    refused = Matcher(sky, engine=engine, tolerance_px=4.0, camera_error=0.001).identify(px)
    assert not refused.ok
    with pytest.raises(ConfigError, match=r"camera_error is 0\.2; expected 1e-06 to 0\.1"):
        Matcher(sky, camera_error=0.2)


def test_few_stars_of_a_calibrated_camera_determine_the_corners(sky):
    counts, generator = {None: 0, 0.002: 0}, np.random.default_rng(2)
    for frame in simulate_frames(sky.directions, sky.camera, 60, Noise(0.3), 21, sky.mag):
        order = np.argsort(np.linalg.norm(frame.centroids_px - 512.0, axis=1), kind="stable")
        # Five stars in the middle and false spots: less than two thirds of the frame.
        false = generator.uniform(0.0, 1024.0, (6, 2))
        px = np.concatenate([frame.centroids_px[order[:5]], false])
        for error in counts:
            observation = observe(px, sky.camera, 2.0, camera_error=error)
            found = agreement_of(frame.matrix, observation, sky)
            counts[error] += found.false_match_probability < 1e-4
    assert counts[0.002] >= counts[None] + 5
