"""Spread: what the matched stars hold, against the errors of many attitudes."""

from __future__ import annotations

import numpy as np
import pytest
from frames import observe
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from starcat.geometry.attitude import information, solve_wahba_svd
from starcat.geometry.camera import Camera
from starcat.matcher.observation import Observation
from starcat.matcher.pose import (
    Pose,
    corner_deviation,
    explained_fraction,
    is_deformed,
    weighted_share,
)

CAMERA = Camera(1024, 768, fov_x_deg=20.0)

MIDDLE_PX = np.array([512.0, 384.0])
CORNERS_PX = np.array([[0.0, 0.0], [1024.0, 0.0], [0.0, 768.0], [1024.0, 768.0]])


def places(count: int, seed: int, spread_px: float = 1000.0) -> np.ndarray:
    """Return places on the detector, uniform over a square around its middle or all of it."""
    half = np.minimum(0.5 * spread_px, [512.0, 384.0])
    return np.asarray(MIDDLE_PX + np.random.default_rng(seed).uniform(-half, half, (count, 2)))


def rays(centroids_px: np.ndarray) -> np.ndarray:
    return CAMERA.directions_from_pixels(centroids_px)


def covariance_of(centroids_px: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.inv(information(rays(centroids_px))))


def attitudes_from(centroids_px: np.ndarray, sigma_px: float, count: int) -> np.ndarray:
    """Return the attitudes that noisy centroids of stars give where the identity is right."""
    noise = np.random.default_rng(1).normal(scale=sigma_px, size=(count, *centroids_px.shape))
    body = rays((centroids_px + noise).reshape(-1, 2)).reshape(count, -1, 3)
    stars = np.broadcast_to(rays(centroids_px), body.shape)
    return np.asarray(solve_wahba_svd(body, stars))


@pytest.mark.parametrize(("count", "spread_px"), [(4, 900.0), (10, 60.0), (30, 1000.0)])
def test_attitudes_scatter_as_the_information_says(count, spread_px):
    centroids_px, sigma_px = places(count, 2, spread_px), 0.1
    turns = Rotation.from_matrix(attitudes_from(centroids_px, sigma_px, 4000)).as_rotvec()
    expected = (sigma_px / CAMERA.focal_length_px) ** 2 * covariance_of(centroids_px)
    # 4,000 scatter by 2 % each; a pixel off the axis is 3 % smaller an angle.
    scale = np.sqrt(np.diag(expected))
    unit = np.outer(scale, scale)
    assert np.cov(turns.T) / unit == pytest.approx(expected / unit, abs=0.1)


@pytest.mark.parametrize(("count", "spread_px"), [(5, 900.0), (10, 100.0)])
def test_the_worst_corner_scatters_as_predicted(count, spread_px):
    centroids_px, sigma_px = places(count, 3, spread_px), 0.1
    matrices = attitudes_from(centroids_px, sigma_px, 4000)
    turned = np.einsum("kij,nj->kni", matrices, rays(CORNERS_PX))
    # The angle, as the corners are so far off the axis that pixels are 5 % smaller there.
    apart = np.linalg.norm(turned - rays(CORNERS_PX), axis=2)
    worst = np.sqrt((apart**2).mean(axis=0)).max() * CAMERA.focal_length_px / sigma_px
    assert corner_deviation(covariance_of(centroids_px), CAMERA) == pytest.approx(worst, rel=0.06)


@given(st.integers(4, 12), st.integers(0, 99), st.floats(60.0, 900.0))
def test_the_share_is_that_of_the_variances_of_the_places(count, seed, spread_px):
    matched, others = rays(places(count, seed, spread_px)), rays(places(9, seed + 100))
    covariance, step, axes = np.linalg.inv(information(matched)), 1e-6, np.eye(3)
    weights = []
    for ray in np.concatenate([matched, others]):
        slopes = np.array([(Rotation.from_rotvec(step * a).apply(ray) - ray) / step for a in axes])
        weights.append(np.trace(slopes.T @ covariance @ slopes))
    assert sum(weights[:count]) == pytest.approx(3.0, rel=1e-4)
    found = weighted_share(covariance, np.concatenate([matched, others]))
    assert found == pytest.approx(3.0 / sum(weights), rel=1e-4)
    assert weighted_share(covariance, matched) == pytest.approx(1.0, abs=1e-6)


def test_the_share_of_a_ring_by_hand():
    # Ten stars 50 px around leave one at 500 px a weight of ten, plus 2 / 10 for the two
    # directions that all ten hold, and 3 for the ten themselves.
    angle = 0.2 * np.pi * np.arange(10.0)
    ring_px = [512.0, 384.0] + 50.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    every = rays(np.vstack([ring_px, [1012.0, 384.0]]))
    # At 10 degrees off the axis pixels are 3 % smaller across the radius.
    assert weighted_share(covariance_of(ring_px), every) == pytest.approx(3.0 / 13.2, rel=0.03)


def seen(centroids_px: np.ndarray) -> tuple[Pose, Observation]:
    observation = observe(centroids_px, CAMERA, 2.0)
    return Pose(np.eye(3), CAMERA, observation.body), observation


def test_fewer_stars_or_fewer_centroids_in_the_frame_are_no_fault():
    matched_px, others_px = places(8, 6), places(12, 7)
    all_px = np.concatenate([matched_px, others_px])
    matched, all_rays, residual_rad = rays(matched_px), rays(all_px), 0.5 / CAMERA.focal_length_px
    for stars, spots_px in ((all_rays, matched_px), (matched, all_px)):
        found = explained_fraction(matched, stars, residual_rad, *seen(spots_px))
        assert found == pytest.approx(1.0)
    both = explained_fraction(matched, all_rays, residual_rad, *seen(all_px))
    assert both == pytest.approx(weighted_share(covariance_of(matched_px), all_rays))
    assert 0.2 < both < 0.5


def test_a_cluster_alone_explains_the_frame_if_nothing_else_was_seen_and_it_holds_the_corners():
    cluster_px, outside_px = places(10, 8, 60.0), places(10, 9)
    # About 20 px from the middle of the cluster, ten stars: 640 / (20 sqrt(10)) = 10 times.
    assert 5.0 < corner_deviation(covariance_of(cluster_px), CAMERA) < 15.0
    all_px = np.concatenate([cluster_px, outside_px])
    for residual_px, spots_px, is_held in (
        (0.1, cluster_px, True), (1.0, cluster_px, False), (0.5, all_px, False),
    ):  # fmt: skip
        residual_rad = residual_px / CAMERA.focal_length_px
        found = explained_fraction(rays(cluster_px), rays(all_px), residual_rad, *seen(spots_px))
        assert found == pytest.approx(1.0) if is_held else found < 0.05
    same = np.tile([0.0, 0.0, 1.0], (5, 1))  # stars in one place explain nothing
    assert explained_fraction(same, same, 0.0, *seen(places(5, 10))) == 0.0


def deformed(places_px: np.ndarray, scale: float, across: float = 0.0, aslant: float = 0.0):
    """Return places after a change of scale and of shape about the middle."""
    shape = np.array([[scale + across, aslant], [aslant, scale - across]])
    return np.asarray(MIDDLE_PX + (places_px - MIDDLE_PX) @ shape)


@pytest.mark.parametrize(("factor", "is_plain"), [(1.0, False), (1.002, False), (1.01, True)])
def test_a_frame_is_scaled_if_its_corners_move_farther_than_the_tolerance(factor, is_plain):
    # The corner is 640 px from the middle: 1.3 and 6.4 px for a tolerance of 2 px.
    generator, found = np.random.default_rng(11), []
    for seed in range(50):
        predicted_px = places(12, seed)
        noise = generator.normal(scale=0.3, size=predicted_px.shape)
        for scale in (factor, 1.0 / factor):
            centroids_px = deformed(predicted_px, scale) + noise
            found.append(is_deformed(predicted_px, centroids_px, CAMERA, 2.0, is_partial=False))
    assert all(found) if is_plain else not any(found)


def test_noise_is_rarely_a_scale_or_a_shape():
    # Six stars within 60 px: noise alone makes a map that moves the corner by many pixels.
    generator, scales, shapes = np.random.default_rng(14), 0, 0
    for seed in range(2000):
        predicted_px = places(6, seed, 60.0)
        noisy_px = predicted_px + generator.normal(scale=0.2, size=predicted_px.shape)
        is_scaled = is_deformed(predicted_px, noisy_px, CAMERA, 2.0, is_partial=False)
        scales += is_scaled
        shapes += not is_scaled and is_deformed(
            predicted_px, noisy_px, CAMERA, 2.0, is_partial=True
        )
    # Three deviations, estimated from eight degrees of freedom: 2 %.
    assert scales < 0.06 * 2000
    assert shapes <= 8  # 2 of 2,000 expected at 1e-3


@pytest.mark.parametrize("is_partial", [True, False])
@pytest.mark.parametrize(
    ("across", "aslant", "is_plain"),
    [(0.0, 0.0, False), (0.002, 0.0, False), (0.01, 0.0, True), (-0.007, 0.007, True)],
)
def test_a_part_of_a_frame_has_another_shape_if_its_corners_move(
    across, aslant, is_plain, is_partial
):
    generator = np.random.default_rng(13)
    for seed in range(50):
        predicted_px = places(12, seed)
        noise = generator.normal(scale=0.3, size=predicted_px.shape)
        centroids_px = deformed(predicted_px, 1.0, across, aslant) + noise
        found = is_deformed(predicted_px, centroids_px, CAMERA, 2.0, is_partial=is_partial)
        assert found == (is_plain and is_partial)


def test_stars_on_a_line_tell_no_shape():
    predicted_px = np.linspace([100.0, 100.0], [900.0, 700.0], 9)
    centroids_px = predicted_px + np.array([[1.0, -1.0], [-1.0, 1.0], [0.0, 0.0]] * 3)
    assert not is_deformed(predicted_px, centroids_px, CAMERA, 2.0, is_partial=True)
