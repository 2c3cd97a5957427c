"""Frames whose focal length is known to some per cent: it is found with the attitude."""

import math

import numpy as np
import pytest
from frames import agreement_of, observe
from skies import database

from starcat.geometry.attitude import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    random_attitudes,
    turn_between,
)
from starcat.geometry.camera import Camera
from starcat.geometry.distortion import Distortion
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods.triangle import scale_free
from starcat.matcher.pose import fit, focal_length_error_px, pose_at
from starcat.matcher.shape import undone_px
from starcat.pipeline.simulation.simulate import Noise, simulate_frames

CAMERA = Camera(1024, 1024, fov_x_deg=12.0)


def told(factor, camera=CAMERA):
    """Return the camera as described by a user who is wrong by a factor."""
    return camera.with_focal_length(factor * camera.focal_length_px)


def errors_px(result, frame, database):
    """Return by how much an answer misplaces the stars of its frame."""
    seen = frame.star_index >= 0
    stars = database.directions[frame.star_index[seen]]
    matrix = matrix_from_quaternion(result.q_body_from_icrs)
    found = result.camera.pixels_from_directions(stars @ matrix.T)
    px = frame.centroids_px[seen]
    if result.shape is not None:
        px = undone_px(px, result.shape.terms, result.camera)
    return np.hypot(*(found - px).T)


@pytest.mark.parametrize(("fov_error", "least"), [(0.02, 58), (0.1, 57)])
@pytest.mark.parametrize("engine", ["auto", "numpy"])
def test_a_focal_length_off_by_some_per_cent_is_found(sky, fov_error, least, engine):
    matcher, generator = Matcher(sky, engine=engine), np.random.default_rng(7)
    noise, pulls, right = Noise(0.5, 0.1, 3), [], 0
    for frame in simulate_frames(sky.directions, sky.camera, 60, noise, 3):
        wrong = told(1.0 + generator.uniform(-fov_error, fov_error), sky.camera)
        result = matcher.identify(frame.centroids_px, wrong, fov_error=fov_error)
        if result.status == "identified":
            assert errors_px(result, frame, sky).max() < 4.0
            right += 1
        if result.focal_length_error_px is not None:
            error_px = result.camera.focal_length_px - sky.camera.focal_length_px
            pulls.append(error_px / result.focal_length_error_px)
    assert right >= least
    assert len(pulls) >= least - 1  # noise can look like a shape, whose scale has no error
    assert np.abs(pulls).max() < 4.0
    assert 0.5 < np.std(pulls) < 1.4


def test_a_focal_length_beyond_what_is_allowed_gives_no_answer(sky):
    matcher = Matcher(sky)
    for n, frame in enumerate(simulate_frames(sky.directions, sky.camera, 12, Noise(0.3), 5)):
        wrong = told(1.06 if n % 2 else 0.94, sky.camera)
        assert matcher.identify(frame.centroids_px, wrong, fov_error=0.02).status == "no_match"


@pytest.mark.parametrize("seed", [pytest.param(n, marks=pytest.mark.slow) for n in range(3)])
def test_a_dense_frame_of_another_scale_is_answered_as_a_whole(seed):
    """Around any point near the middle some 80 of 400 stars fit, with a chance of 1e-15 to 1e-27.

    They are no answer; the frame in its own shape is one.
    """
    camera, generator = Camera(1024, 1024, fov_x_deg=24.0), np.random.default_rng(seed)
    stars = generator.normal(size=(36_000, 3))
    stars /= np.linalg.norm(stars, axis=1)[:, None]
    [truth] = random_attitudes(1, generator)
    body, lens = stars @ truth.T, told(1.018, camera)
    px = lens.pixels_from_directions(body)
    px = generator.permutation(px[(body[:, 2] > 0.0) & lens.contains(px)])[:400]
    seen = observe(px + generator.normal(size=px.shape), camera, 3.0)
    sky = database(stars, camera, {})
    answers = 0
    for _ in range(20):
        turn = np.append(3.0 * generator.normal(size=3) / camera.focal_length_px, 1.0)
        off = matrix_from_quaternion(turn / np.linalg.norm(turn)) @ truth
        found = agreement_of(off, seen, sky)
        if found.false_match_probability == 1.0:
            continue
        answers += 1
        assert (found.star_index >= 0).sum() > 380
        q = quaternion_from_matrix(found.pose.matrix), quaternion_from_matrix(truth)
        assert np.linalg.norm(turn_between(q[1].tolist(), q[0].tolist())) < 0.5 / 2400.0  # 0.5 px
    assert answers >= 10


def test_the_fit_finds_attitude_and_focal_length_exactly():
    generator = np.random.default_rng(1)
    lens = Camera(1024, 768, fov_x_deg=40.0, distortion=Distortion(k1=-0.1, k2=0.02))
    for camera, [matrix] in ((lens, random_attitudes(1, generator)), (CAMERA, [np.eye(3)])):
        px = generator.uniform(20.0, 740.0, (9, 2))
        stars = camera.directions_from_pixels(px) @ matrix
        seen = observe(px, told(0.97, camera), 2.0, fov_error=0.05)
        pose, rows = pose_at(matrix, 1.0, seen), np.arange(9)
        for _ in range(6):
            pose = fit(pose, rows, stars[seen.rows], seen)
        assert pose.camera.focal_length_px == pytest.approx(camera.focal_length_px, rel=1e-9)
        assert np.abs(pose.matrix - matrix).max() < 1e-9


@pytest.mark.parametrize("n", [4, 6, 20])
def test_three_standard_errors_of_the_focal_length_hold_the_truth(n):
    generator, beyond = np.random.default_rng(n), 0
    for _ in range(400):
        px = generator.uniform(0.0, 1024.0, (n, 2))
        stars = CAMERA.directions_from_pixels(px)
        seen = observe(px + generator.normal(scale=0.5, size=(n, 2)), CAMERA, 2.0, fov_error=0.05)
        pose, rows = pose_at(np.eye(3), 1.0, seen), np.arange(len(seen))
        for _ in range(2):
            pose = fit(pose, rows, stars[seen.rows], seen)
        left = pose.body - stars[seen.rows] @ pose.matrix.T
        residual_rad = math.sqrt(np.vdot(left, left) / len(left))
        error_px = focal_length_error_px(pose.body, pose.camera.focal_length_px, residual_rad, None)
        beyond += abs(pose.camera.focal_length_px - CAMERA.focal_length_px) > 3.0 * error_px
    assert beyond <= 8  # 0.27 % of 400 is one


def test_the_shape_of_a_triangle_does_not_depend_on_its_size():
    for size in (1e-3, 0.1):
        shape, error, area, _ = scale_free(3.0 * size, 4.0 * size, 5.0 * size, 0.01 * size)
        assert shape == pytest.approx(6.0 / 2.5**2)
        assert area == pytest.approx(6.0 * size**2)
        a, b, c = (side * size * (1.0 + 0.002) for side in (3.0, 4.0, 5.0))
        assert abs(scale_free(a, b, c - 0.01 * size, 0.0)[0] - shape) <= error
