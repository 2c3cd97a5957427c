"""Chance: the bound on false matches is what random frames really do, and it is monotone."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from starcat.geometry.attitude import solve_wahba_svd
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import separation
from starcat.matcher.chance import false_match_probability
from starcat.matcher.database import Database, ProductArrays
from starcat.matcher.matcher import Matcher
from starcat.products.pairs import find_pairs

CAMERA = Camera(1024, 1024, fov_x_deg=30.0)


def rays(centroids_px: list[list[float]]) -> np.ndarray:
    return CAMERA.directions_from_pixels(np.array(centroids_px, dtype=float))


FOUR = rays([[100, 150], [900, 80], [500, 980], [60, 800]])


def sky_of(u: np.ndarray) -> Database:
    pairs = find_pairs(u, 0.0, CAMERA.diagonal_rad)
    columns = {
        "i": pairs.i,
        "j": pairs.j,
        "separation_rad": pairs.separation_rad,
        **pairs.index.datasets,
    }
    return Database(
        name="sky-1.0.0",
        camera=CAMERA,
        epoch_jyear=2026.0,
        star_id=np.arange(len(u)),
        directions=u,
        mag=np.zeros(len(u)),
        designation=np.full(len(u), b"star"),
        products={"pairs": ProductArrays(columns, pairs.index.attributes)},
    )


# --- The value


def by_hand(square_px: float, body: np.ndarray, n_centroids: int, stars: int) -> float:
    """Return the expected number of agreements, from whole numbers and differences."""
    n, step = len(body), 1e-6
    ways = math.comb(n_centroids, n) * math.perm(stars, n)
    moved = [
        CAMERA.pixels_from_directions(Rotation.from_rotvec(sign * step * axis).apply(body))
        for axis in np.eye(3)
        for sign in (1.0, -1.0)
    ]
    slopes = np.array([(moved[k] - moved[k + 1]).ravel() / (2.0 * step) for k in (0, 2, 4)])
    attitudes = 8.0 * math.pi**2 * math.sqrt(np.linalg.det(slopes @ slopes.T))
    left = 2 * n - 3
    ball = math.pi ** (left / 2) / math.gamma(left / 2 + 1) * math.sqrt(square_px) ** left
    return ways * attitudes * ball / (1024.0**2) ** n * max(1, n_centroids - 3)


@pytest.mark.parametrize(("n_centroids", "stars"), [(4, 4), (4, 9), (7, 9), (20, 40)])
@pytest.mark.parametrize("square_px", [1e-3, 1.0, 60.0])
def test_the_value_is_the_expected_number(n_centroids, stars, square_px):
    for body in (FOUR, FOUR[:3], np.vstack([FOUR, rays([[600, 400], [350, 333]])])):
        if len(body) > min(n_centroids, stars):
            continue
        found = false_match_probability(square_px, body, n_centroids, stars, CAMERA)
        expected = min(1.0, by_hand(square_px, body, n_centroids, stars))
        # The differences: 1e-10 of rounding over the step, 1e-12 of the third derivative.
        assert found == pytest.approx(expected, rel=1e-7)


def test_three_stars_by_hand():
    # Places (0, 0), (1, 0) and (0, 1) in focal lengths. Turned about x, y and z they move by
    # (0, 1), (-1, 0), (0, 0);  (0, 1), (-2, 0), (0, -1);  (0, 2), (-1, 0), (1, 0), whose squares
    # and products sum to [[6, 0, -1], [0, 6, -1], [-1, -1, 2]]: the determinant is 60.
    body = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    body /= np.linalg.norm(body, axis=1)[:, None]
    # Three stars leave 3 dimensions, a ball of 4/3 pi r^3; 1 way for the centroids, 3 x 2 x 1
    # for the stars, once as there are 3 centroids.
    attitudes = 8.0 * math.pi**2 * CAMERA.focal_length_px**3 * math.sqrt(60.0)
    expected = 6.0 * attitudes * (4.0 / 3.0) * math.pi / (1024.0**2) ** 3
    found = false_match_probability(1.0, body, 3, 3, CAMERA)
    assert found == pytest.approx(expected, rel=1e-12)


def test_a_wider_detector_has_room_for_more_frames():
    # The same stars and attitudes, and the area to the power of their number.
    wide = Camera(2048, 1024, CAMERA.focal_length_px)
    found = false_match_probability(1.0, FOUR, 6, 9, wide)
    assert found == pytest.approx(false_match_probability(1.0, FOUR, 6, 9, CAMERA) / 2**4)


@pytest.mark.parametrize("square_px", [0.0, 1e-300, 1e9, 1e300])
def test_it_is_a_probability(square_px):
    found = false_match_probability(square_px, FOUR, 30, 40, CAMERA)
    assert 0.0 <= found <= 1.0
    assert found < 1e-60 or square_px > 1.0


def test_a_database_with_fewer_stars_in_the_frame_than_matched_counts_those():
    # A star just outside the frame may have its centroid inside.
    few = false_match_probability(1.0, FOUR, 6, 2, CAMERA)
    assert few == false_match_probability(1.0, FOUR, 6, 4, CAMERA)


def test_directions_that_fix_no_attitude_prove_nothing():
    assert false_match_probability(1.0, np.tile([0.0, 0.0, 1.0], (4, 1)), 40, 40, CAMERA) == 1.0


# --- Monotony

frames = st.tuples(st.integers(4, 12), st.integers(0, 20), st.integers(0, 20), st.integers(0, 99))


def directions(count: int, seed: int) -> np.ndarray:
    return CAMERA.directions_from_pixels(np.random.default_rng(seed).random((count, 2)) * 1024.0)


@given(frames, st.floats(0.01, 4.0), st.floats(1.01, 9.0))
def test_a_larger_residual_is_likelier(frame, rms_px, factor):
    n, more, others, seed = frame
    body = directions(n, seed)
    square = n * rms_px**2
    near = false_match_probability(square, body, n + more, n + others, CAMERA)
    far = false_match_probability(square * factor, body, n + more, n + others, CAMERA)
    assert near < far or far == near == 1.0


@given(frames, st.floats(0.01, 2.0))
def test_more_stars_or_centroids_in_the_frame_are_likelier(frame, rms_px):
    n, more, others, seed = frame
    body, square = directions(n, seed), n * rms_px**2
    found = false_match_probability(square, body, n + more, n + others, CAMERA)
    crowded = false_match_probability(square, body, n + more, n + others + 1, CAMERA)
    cluttered = false_match_probability(square, body, n + more + 1, n + others, CAMERA)
    assert found < crowded or crowded == found == 1.0
    assert found < cluttered or cluttered == found == 1.0


@given(frames, st.floats(0.01, 2.0))
def test_more_matched_of_the_same_frame_are_less_likely(frame, rms_px):
    n, more, others, seed = frame
    n_centroids, stars = n + 1 + more, n + 1 + others
    body = directions(n + 1, seed)
    fewer = false_match_probability(n * rms_px**2, body[:n], n_centroids, stars, CAMERA)
    # One more of 33 x 33 pairs falls within 2 px of its place with 2e-2 at the most.
    found = false_match_probability((n + 1) * rms_px**2, body, n_centroids, stars, CAMERA)
    assert found < fewer or fewer == found == 1.0


# --- Honesty


def assignments(
    apart: np.ndarray, stars_apart: np.ndarray, reach_rad: float
) -> Iterator[tuple[list[int], np.ndarray]]:
    """Yield every choice of four or more centroids with all stars that they may be."""
    waiting = [([n], np.arange(len(stars_apart))[:, None]) for n in range(len(apart))]
    while waiting:
        chosen, stars = waiting.pop()
        if len(chosen) >= 4 and len(stars):
            yield chosen, stars
        for further in range(chosen[-1] + 1, len(apart)):
            fits = np.ones((len(stars), len(stars_apart)), dtype=bool)
            for place, centroid in enumerate(chosen):
                miss = stars_apart[stars[:, place]] - apart[centroid, further]
                fits &= np.abs(miss) <= reach_rad
            row, star = np.nonzero(fits)
            waiting.append(([*chosen, further], np.column_stack([stars[row], star])))


def lowest_bound(centroids_px: np.ndarray, u: np.ndarray, apart: np.ndarray, reach_px: float):
    """Return the least bound that any attitude has, whatever stars the centroids are."""
    body = CAMERA.directions_from_pixels(centroids_px)
    seen = separation(body[:, None], body[None])
    least = 1.0
    for chosen, stars in assignments(seen, apart, reach_px / CAMERA.focal_length_px):
        rays = np.broadcast_to(body[chosen], (len(stars), len(chosen), 3))
        matrices = solve_wahba_svd(rays, u[stars])
        turned = np.einsum("kij,knj->kni", matrices, u[stars]).reshape(-1, 3)
        place = CAMERA.pixels_from_directions(turned).reshape(len(stars), -1, 2)
        square = ((place - centroids_px[chosen]) ** 2).sum(axis=(1, 2))
        # Two separations err by more than sqrt(2 Q) for no assignment with less than Q.
        for row in np.flatnonzero(square <= 0.5 * reach_px**2):
            near = u[u @ matrices[row, 2] > np.cos(CAMERA.radius_rad)]
            inside = CAMERA.contains(CAMERA.pixels_from_directions(near @ matrices[row].T))
            bound = false_match_probability(
                float(square[row]), body[chosen], len(body), int(inside.sum()), CAMERA
            )
            least = min(least, bound)
    return least


def lowest_bounds(u: np.ndarray, n_centroids: int, count: int, reach_px: float) -> np.ndarray:
    apart = separation(u[:, None], u[None])
    np.fill_diagonal(apart, np.inf)
    generator = np.random.default_rng(12)
    frames = generator.random((count, n_centroids, 2)) * 1024.0
    return np.array([lowest_bound(frame, u, apart, reach_px) for frame in frames])


def test_as_many_random_frames_agree_as_the_bound_says(random_directions):
    # Eight stars a frame. All frames of four centroids, all assignments: no search that could
    # miss some, and no sum over other numbers of stars: the bound is the expected number.
    found = lowest_bounds(random_directions(374, 11), 4, 300, reach_px=60.0)
    for limit in (0.01, 0.03, 0.1, 0.3):
        count, expected = (found <= limit).sum(), len(found) * limit
        assert count <= expected + 4.0 * math.sqrt(expected)
    # Nor is it loose: of the frames that it expects most exist.
    assert (found <= 0.1).sum() >= 0.1 * len(found) - 4.0 * math.sqrt(0.1 * len(found))


def test_no_more_random_frames_agree_where_any_number_may_match(random_directions):
    found = lowest_bounds(random_directions(230, 13), 6, 100, reach_px=45.0)
    for limit in (0.03, 0.1, 0.3):
        expected = len(found) * limit
        assert (found <= limit).sum() <= expected + 4.0 * math.sqrt(expected)
    assert (found <= 0.3).any()


def test_a_matcher_is_wrong_no_oftener_than_it_is_allowed_to(random_directions):
    lenient = Matcher(
        sky_of(random_directions(374, 14)),
        "pairs",
        tolerance_px=12.0,
        max_false_match_probability=0.1,
    )
    generator = np.random.default_rng(15)
    answers = [lenient.identify(generator.random((6, 2)) * 1024.0) for _ in range(150)]
    wrong = [found for found in answers if found.status == "identified"]
    assert all(found.false_match_probability <= 0.1 for found in wrong)
    # A matcher that is allowed so much does answer some of them.
    assert 1 <= len(wrong) <= 15 + 4.0 * math.sqrt(15)
