"""Chance: the bound on false matches is what random frames really do, and it is monotone."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np
import pytest
from frames import agreement_of, observe
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from scipy.spatial.transform import Rotation
from skies import pair_sky

from starcat.geometry.attitude import matrix_from_quaternion, random_attitudes, solve_wahba_svd
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import separation
from starcat.matcher.chance import (
    INCOMPATIBLE,
    log_assignments,
    log_false_match_probability,
    log_weighted_assignments,
)
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.matcher import Matcher
from starcat.matcher.observation import whole_deviations
from starcat.matcher.shape import derivatives
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame, Sky, simulate_frame

CAMERA = Camera(1024, 1024, fov_x_deg=30.0)


def rays(centroids_px: list[list[float]]) -> np.ndarray:
    return CAMERA.directions_from_pixels(np.array(centroids_px, dtype=float))


FOUR = rays([[100, 150], [900, 80], [500, 980], [60, 800]])


def log_chance_of(
    square_px: float,
    body: np.ndarray,
    n_centroids: int,
    stars: int,
    camera: Camera = CAMERA,
    free: int = 0,
    **stated,
) -> float:
    """Return the logarithm of the bound of centroids that agree, from their directions."""
    rows = derivatives(camera.pixels_from_directions(body), body, camera, free)
    return log_false_match_probability(square_px, rows, n_centroids, stars, camera, **stated)


def chance_of(*agreement, **stated) -> float:
    """Return this bound."""
    return math.exp(log_chance_of(*agreement, **stated))


# --- The value


def by_hand(
    square_px: float, body: np.ndarray, n_centroids: int, stars: int, log_scales: float = 0.0
) -> float:
    """Return the expected number of agreements, from whole numbers and differences.

    With a range of focal lengths (of its logarithm) the scale is a fourth unknown.
    """
    n, step = len(body), 1e-6
    ways = math.comb(n_centroids, n) * math.perm(stars, n)
    moved = [
        CAMERA.pixels_from_directions(Rotation.from_rotvec(sign * step * axis).apply(body))
        for axis in np.eye(3)
        for sign in (1.0, -1.0)
    ]
    focal_px = CAMERA.focal_length_px * np.exp([step, -step])
    moved += [CAMERA.with_focal_length(f).pixels_from_directions(body) for f in focal_px]
    slopes = np.array([(moved[k] - moved[k + 1]).ravel() / (2.0 * step) for k in (0, 2, 4, 6)])
    volume = 0.0
    for unknowns, widest in ((3, 1.0), (4, log_scales)):
        of_unknowns = slopes[:unknowns]
        attitudes = 8.0 * math.pi**2 * math.sqrt(np.linalg.det(of_unknowns @ of_unknowns.T))
        left = 2 * n - unknowns
        ball = math.pi ** (left / 2) / math.gamma(left / 2 + 1) * math.sqrt(square_px) ** left
        volume += attitudes * widest * ball
    return ways * volume / (1024.0**2) ** n * max(1, n_centroids - 3)


def directions(count: int, seed: int) -> np.ndarray:
    return CAMERA.directions_from_pixels(np.random.default_rng(seed).random((count, 2)) * 1024.0)


@given(
    st.integers(3, 9), st.integers(0, 20), st.integers(0, 20), st.integers(0, 99),
    st.sampled_from([1e-3, 1.0, 60.0]),
)  # fmt: skip
@example(4, 0, 0, 5, 1.0)
@example(4, 16, 36, 5, 1.0)
def test_the_value_is_the_expected_number(n, more, others, seed, square_px):
    body = directions(n, seed)
    for camera in (CAMERA, Camera(2048, 1024, CAMERA.focal_length_px)):
        found = chance_of(square_px, body, n + more, n + others, camera)
        expected = by_hand(square_px, body, n + more, n + others)
        # A wider detector has room for more frames: the area to the power of their number.
        expected /= (camera.width_px / 1024.0) ** n
        # The differences: 1e-10 of rounding over the step, 1e-12 of the third derivative.
        assert found == pytest.approx(min(1.0, expected), rel=1e-6)
    half = np.array([0.02])
    found = chance_of(square_px, body, n + more, n + others, free=1, half_ranges=half)
    expected = by_hand(square_px, body, n + more, n + others, 0.04)
    assert found == pytest.approx(min(1.0, expected), rel=1e-6)


def test_numbers_of_stars_at_the_ends():
    # The centroid of a star just outside the frame can be inside: fewer stars than matched ones.
    few = chance_of(1.0, FOUR, 6, 2, CAMERA)
    assert few == chance_of(1.0, FOUR, 6, 4, CAMERA)
    # Directions that fix no attitude prove nothing.
    assert chance_of(1.0, np.tile([0.0, 0.0, 1.0], (4, 1)), 40, 40, CAMERA) == 1.0
    # With a stated noise, of four centroids there is only one number, nothing to divide; and
    # three are no agreement.
    for noise_px in (0.1, 2.0):
        found = chance_of(1.0, FOUR, 4, 9, CAMERA, noise_px=noise_px)
        assert found == pytest.approx(chance_of(1.0, FOUR, 4, 9, CAMERA), rel=1e-12)
    assert chance_of(1e-9, FOUR[:3], 5, 9, CAMERA, noise_px=0.5) == 1.0


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
    found = chance_of(1.0, body, 3, 3, CAMERA)
    assert found == pytest.approx(expected, rel=1e-12)


# --- What is stated


def shares(noise_px: float, n_centroids: int, stars: int, **stated) -> dict[int, float]:
    """Return for each number of stars the expected number divided by the bound."""
    found = {}
    for n in range(4, min(n_centroids, stars) + 1):
        frame = 1e-9, directions(n, n), n_centroids, stars, CAMERA
        evenly = log_chance_of(*frame, **stated) - math.log(n_centroids - 3)
        found[n] = math.exp(evenly - log_chance_of(*frame, noise_px=noise_px, **stated))
    return found


@pytest.mark.parametrize(("n_centroids", "stars"), [(4, 4), (9, 12), (9, 5), (12, 9), (30, 40)])
@pytest.mark.parametrize("noise_px", [1e-3, 0.3, 1.0, 30.0])
def test_the_shares_of_all_numbers_add_up_to_one(noise_px, n_centroids, stars):
    deviations = np.random.default_rng(stars).integers(0, 5, (n_centroids, stars), dtype=np.int8)
    deviations[range(min(n_centroids, stars)), range(min(n_centroids, stars))] = 0
    for stated in ({}, {"deviations": deviations}):
        found = shares(noise_px, n_centroids, stars, **stated)
        assert sum(found.values()) == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize("noise_px", [0.01, 0.3, 0.7, 2.0, 30.0])
def test_a_share_falls_with_the_fifth_root_of_the_factor_from_the_limit(noise_px):
    # Frames of 9 centroids and 12 stars, four to nine of which agree as well as noise lets them.
    # Their places are spread as the whole frame is, 1024^2 / 12 on each axis: the determinant of
    # their squared derivatives by two angles across the axis is f^4 n^2, about it n (x^2 + y^2).
    found, expected = shares(noise_px, 9, 12), {}
    for n in found:
        left, focal_px = 2 * n - 3, CAMERA.focal_length_px
        root = focal_px**2 * n * math.sqrt(n * 2.0 * 1024.0**2 / 12.0)
        ball = (math.pi * left * noise_px**2) ** (left / 2) / math.gamma(left / 2 + 1)
        ways = math.comb(9, n) * math.perm(12, n)
        number = ways * 8.0 * math.pi**2 * root * ball / (1024.0**2) ** n
        expected[n] = max(number / 1e-9, 1e-9 / number) ** -0.2
    for n, share in found.items():
        assert share == pytest.approx(expected[n] / sum(expected.values()), rel=1e-9)


@given(st.integers(4, 9), st.integers(0, 6), st.integers(0, 6), st.integers(0, 99))
def test_magnitudes_divide_the_bound_by_the_ways_they_leave(n, more, others, seed):
    is_apart = np.random.default_rng(seed).random((n + more, n + others)) < 0.3
    is_apart[range(n), range(n)] = False
    deviations = (INCOMPATIBLE * is_apart).astype(np.int8)
    frame = 0.1 * n, directions(n, seed), n + more, n + others, CAMERA
    without = chance_of(*frame)
    found = chance_of(*frame, deviations=deviations)
    ways = log_weighted_assignments(n, deviations)[n] - log_assignments(n, n + more, n + others)
    if without < 1.0:
        assert found == pytest.approx(without * math.exp(ways), rel=1e-9)
    assert found <= without * (1.0 + 1e-12)


@given(
    arrays(np.int8, st.sampled_from([(4, 5), (5, 4), (5, 5)]), elements=st.integers(0, 4)),
    st.floats(0.1, 40.0),
)
def test_a_deviation_is_a_residual(deviations, square):
    # With both noises stated, the number that is expected is at least the sum over all assignments
    # of the volumes that their magnitudes leave for the places: by hand, for four stars.
    noise_px = 0.5
    frame = directions(4, 3), *deviations.shape, CAMERA
    stated = {"noise_px": noise_px, "deviations": deviations}
    found = log_chance_of(square * noise_px**2, *frame, **stated)
    left = [
        max(0.0, square - sum(int(deviations[pair]) ** 2 for pair in pairs)) ** 2.5
        for pairs in (
            tuple(zip(rows, columns, strict=True))
            for rows in combinations(range(deviations.shape[0]), 4)
            for columns in permutations(range(deviations.shape[1]), 4)
        )
        if all(deviations[pair] < INCOMPATIBLE for pair in pairs)
    ]
    of_one = by_hand(noise_px**2, frame[0], 4, 4) / math.factorial(4)  # if the square is 1
    assert found == 0.0 or math.exp(found) >= of_one * math.fsum(left) * (1.0 - 1e-6)


@pytest.mark.parametrize("square_px", [0.0, 1e-300, 1e9, 1e300])
def test_it_is_a_probability(square_px):
    found = chance_of(square_px, FOUR, 30, 40, CAMERA)
    assert 0.0 <= found <= 1.0
    assert found < 1e-60 or square_px > 1.0


# --- Honesty


def assignments(
    apart: np.ndarray, stars_apart: np.ndarray, reach_rad: float, joined: np.ndarray
) -> Iterator[tuple[list[int], np.ndarray]]:
    """Yield every choice of four or more centroids with all stars that they can be."""
    waiting = [([n], np.flatnonzero(joined[n])[:, None]) for n in range(len(apart))]
    while waiting:
        chosen, stars = waiting.pop()
        if len(chosen) >= 4 and len(stars):
            yield chosen, stars
        for further in range(chosen[-1] + 1, len(apart)):
            fits = np.tile(joined[further], (len(stars), 1))
            for place, centroid in enumerate(chosen):
                miss = stars_apart[stars[:, place]] - apart[centroid, further]
                fits &= np.abs(miss) <= reach_rad
            row, star = np.nonzero(fits)
            waiting.append(([*chosen, further], np.column_stack([stars[row], star])))


@dataclass(frozen=True)
class Stated:
    """Known properties of the centroids, and the magnitudes of the stars."""

    noise_px: float | None = None
    noise_mag: float | None = None
    star_mag: np.ndarray | None = None

    def deviations(self, mag: np.ndarray) -> np.ndarray | None:
        if self.noise_mag is None:
            return None
        found = whole_deviations(mag, self.star_mag, self.noise_mag)
        return found if self.noise_px is not None else np.where(found < INCOMPATIBLE, 0, found)


def lowest_bound(centroids_px, u, apart, reach_px: float, stated: Stated, mag) -> float:
    """Return the least bound of all attitudes and all assignments of stars to the centroids."""
    body = CAMERA.directions_from_pixels(centroids_px)
    seen = separation(body[:, None], body[None])
    apart_mag = stated.deviations(mag)
    joined = np.ones((len(body), len(u)), dtype=bool)
    if apart_mag is not None:
        joined = apart_mag < INCOMPATIBLE
    least = 1.0
    for chosen, stars in assignments(seen, apart, reach_px / CAMERA.focal_length_px, joined):
        rays = np.broadcast_to(body[chosen], (len(stars), len(chosen), 3))
        matrices = solve_wahba_svd(rays, u[stars])
        turned = np.einsum("kij,knj->kni", matrices, u[stars]).reshape(-1, 3)
        place = CAMERA.pixels_from_directions(turned).reshape(len(stars), -1, 2)
        square = ((place - centroids_px[chosen]) ** 2).sum(axis=(1, 2))
        # Two separations err by more than sqrt(2 Q) for no assignment with less than Q.
        for row in np.flatnonzero(square <= 0.5 * reach_px**2):
            near = np.flatnonzero(u @ matrices[row, 2] > np.cos(CAMERA.radius_rad))
            inside = CAMERA.contains(CAMERA.pixels_from_directions(u[near] @ matrices[row].T))
            around = near[inside]
            known, residual = None, float(square[row])
            if apart_mag is not None:
                known = apart_mag[:, np.union1d(around, stars[row])]
                of_stars = apart_mag[chosen, stars[row]].astype(float)
                residual += (stated.noise_px or 0.0) ** 2 * float(of_stars @ of_stars)
            frame = residual, body[chosen], len(body), len(around), CAMERA
            stating = {"noise_px": stated.noise_px, "deviations": known}
            least = min(least, chance_of(*frame, **stating))
    return least


def lowest_bounds(
    u: np.ndarray, n_centroids: int, count: int, reach_px: float, stated: Stated
) -> np.ndarray:
    apart = separation(u[:, None], u[None])
    np.fill_diagonal(apart, np.inf)
    generator = np.random.default_rng(12)
    frames = generator.random((count, n_centroids, 2)) * 1024.0
    # False spots can have the magnitudes of the stars.
    star_mag = np.zeros(1) if stated.star_mag is None else stated.star_mag
    mags = generator.choice(star_mag, (count, n_centroids))
    given = zip(frames, mags, strict=True)
    return np.array([lowest_bound(one, u, apart, reach_px, stated, mag) for one, mag in given])


def magnitudes(count: int) -> np.ndarray:
    """Return magnitudes up to 6 as stars have them: three times as many in each further one."""
    return 6.0 + np.log10(1.0 - np.random.default_rng(count).random(count)) / 0.5


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("n_centroids", "count", "reach_px", "noise_px", "noise_mag"),
    [
        # Eight stars a frame. All frames of four centroids, all assignments: no search that could
        # miss some, and no sum over other numbers of stars: the bound is the expected number.
        pytest.param(4, 300, 60.0, None, None, marks=SLOW),
        # With the smaller error an agreement of the same bound has larger residuals.
        (4, 150, 180.0, None, 0.05),
        pytest.param(4, 150, 60.0, None, 0.6, marks=SLOW),
        # Any number may match.
        (6, 60, 45.0, None, None),
        # The first noise gives the largest share to four stars, which is what chance agrees with;
        # with the second one this depends on how many stars there are around an attitude.
        pytest.param(6, 100, 45.0, 0.01, None, marks=SLOW),
        pytest.param(6, 200, 45.0, 0.2, None, marks=SLOW),
        # Magnitudes count as residuals: a star may be as far off as its magnitude lets it.
        (6, 100, 45.0, 10.0, 0.3),
        (6, 60, 60.0, 10.0, 1.0),
    ],
)
def test_no_more_random_frames_agree_than_the_bound_says(
    random_directions, n_centroids, count, reach_px, noise_px, noise_mag
):
    stars, seed = (374, 11) if n_centroids == 4 else (230, 13)
    stated = Stated(noise_px, noise_mag, None if noise_mag is None else magnitudes(stars))
    found = lowest_bounds(random_directions(stars, seed), n_centroids, count, reach_px, stated)
    for limit in (0.003, 0.01, 0.03, 0.1, 0.3):
        expected = len(found) * limit
        assert (found <= limit).sum() <= expected + 4.0 * math.sqrt(expected)
    assert (found <= 0.3).any() or noise_px == 0.2
    if noise_px is noise_mag is None and n_centroids == 4:
        # The bound is not loose either: it expects 10 % of the frames, and nearly as many exist.
        assert (found <= 0.1).sum() >= 0.1 * len(found) - 4.0 * math.sqrt(0.1 * len(found))


@pytest.mark.slow
def test_a_matcher_is_wrong_no_oftener_than_it_is_allowed_to(random_directions):
    sky = pair_sky(random_directions(374, 14), CAMERA)
    lenient = Matcher(sky, method="pairs", tolerance_px=12.0, max_false_match_probability=0.1)
    generator = np.random.default_rng(15)
    answers = [lenient.identify(generator.random((6, 2)) * 1024.0) for _ in range(150)]
    wrong = [found for found in answers if found.status == "identified"]
    assert all(found.false_match_probability <= 0.1 for found in wrong)
    # A matcher that is allowed so much does answer some of them.
    assert 1 <= len(wrong) <= 15 + 4.0 * math.sqrt(15)


# --- Frames that are withheld if no noise is stated

NARROW = Camera(1024, 1024, fov_x_deg=12.0)
NOISE_MAG = 0.3


@pytest.fixture(scope="module")
def narrow_sky(random_directions) -> MatcherDatabase:
    return pair_sky(random_directions(4500, 16), NARROW, magnitudes(4500))


def six_of_nine(
    sky: MatcherDatabase, noise_px: float, astray_px: float, seed: int
) -> Iterator[SimulatedFrame]:
    """Yield frames of six true spots and three false ones, one of the six out of its place."""
    generator = np.random.default_rng(seed)
    stars = Sky(sky.directions, sky.mag, np.arange(len(sky.mag)))
    noise = Noise(noise_px, noise_mag=NOISE_MAG)
    while True:
        [matrix] = random_attitudes(1, generator)
        whole = simulate_frame(stars, sky.camera, matrix, noise, generator)
        kept = generator.permutation(len(whole.mag))[:6]
        true_px, angle = whole.centroids_px[kept], generator.uniform(0.0, 2.0 * math.pi)
        true_px[:1] += astray_px * np.array([math.cos(angle), math.sin(angle)])
        centroids_px = np.concatenate([true_px, generator.random((3, 2)) * 1024.0])
        mag = np.concatenate([whole.mag[kept], generator.choice(sky.mag, 3)])
        if len(kept) == 6 and sky.camera.contains(centroids_px).all():
            star = np.concatenate([whole.star_index[kept], np.full(3, -1)])
            yield SimulatedFrame(matrix, centroids_px, star, mag, star < 0)


def withheld(
    sky: MatcherDatabase, count: int, noise_px: float, astray_px: float, most: float
) -> list[SimulatedFrame]:
    """Return such frames of which five spots match, with a bound from 1e-9 to another one."""
    found: list[SimulatedFrame] = []
    for frame in six_of_nine(sky, noise_px, astray_px, 17):
        right = agreement_of(frame.matrix, observe(frame.centroids_px, sky.camera, 2.0), sky)
        if right.n_matched == 5 and 1e-9 < right.false_match_probability <= most:
            found.append(frame)
            if len(found) == count:
                break
    return found


def accepted(matcher: Matcher, frames: list[SimulatedFrame]) -> int:
    """Return how many frames are identified, all of them rightly."""
    count = 0
    for frame in frames:
        found = matcher.identify(frame.centroids_px, mag=frame.mag)
        if found.status == "identified":
            count += 1
            turned = matrix_from_quaternion(found.q_body_from_icrs) @ frame.matrix.T
            assert Rotation.from_matrix(turned).magnitude() < math.radians(0.4)
            named = (found.star_index >= 0) & (frame.star_index >= 0)
            assert (found.star_index[named] == frame.star_index[named]).all()
    return count


@pytest.mark.slow
def test_frames_that_are_withheld_are_identified_where_both_noises_are_stated(narrow_sky):
    # One of six is always 12 px off its place: five of nine have to suffice.
    frames = withheld(narrow_sky, 15, 0.5, 12.0, 1e-8)
    assert accepted(Matcher(narrow_sky, method="pairs"), frames[:2]) == 0
    by_noise = accepted(Matcher(narrow_sky, method="pairs", noise_px=0.5), frames)
    by_mag = accepted(Matcher(narrow_sky, method="pairs", noise_mag=NOISE_MAG), frames)
    both = Matcher(narrow_sky, method="pairs", noise_px=0.5, noise_mag=NOISE_MAG)
    assert by_noise >= 5
    assert by_mag >= 5
    assert accepted(both, frames) >= 9
    # In the widest ranges of shapes the five stars of two frames do not determine the corners.
    calibrated = both.with_settings(camera_error=0.002)
    assert accepted(calibrated, frames) >= 11
    # The other four are just above the limit.
    assert accepted(calibrated.with_settings(max_false_match_probability=3e-9), frames) == 15


@pytest.mark.slow
def test_a_star_beyond_the_usual_reach_is_within_that_of_its_noise(narrow_sky):
    # Of six true spots with 1 px of noise one is farther than 3 px from its star.
    frames = withheld(narrow_sky, 3, 1.0, 0.0, 1e-6)
    stated = Matcher(narrow_sky, method="pairs", noise_px=1.0, noise_mag=NOISE_MAG)
    assert accepted(stated, frames) >= 2
    assert stated.identify(frames[0].centroids_px, mag=frames[0].mag).n_matched == 6


# --- Assignments: their numbers are those of an enumeration, and never above the bound

DEVIATIONS = arrays(
    np.int8, array_shapes(min_dims=2, max_dims=2, max_side=6), elements=st.integers(0, INCOMPATIBLE)
)


def weight(deviation: int) -> float:
    return 0.0 if deviation == INCOMPATIBLE else math.exp(-(deviation**2) / 3.0)


def weighted_ways(deviations: np.ndarray, n: int) -> float:
    """Sum the weights of the ways to assign n rows to n columns, one by one."""
    count, stars = deviations.shape
    return math.fsum(
        math.prod(
            weight(deviations[row, column]) for row, column in zip(rows, columns, strict=True)
        )
        for rows in combinations(range(count), n)
        for columns in permutations(range(stars), n)
    )


def bound_by_hand(deviations: np.ndarray, n: int) -> float:
    """Return the bound as a sum of products over all choices of the side that has fewer."""
    fewer = deviations if len(deviations) <= deviations.shape[1] else deviations.T
    others = fewer.shape[1]
    roots = [0.0, *(math.factorial(r) ** (1.0 / r) for r in range(1, others + 1))]
    sums = []
    for row in fewer.tolist():
        # Of the columns from the heaviest on, each adds its weight times what the root grows by.
        heaviest = sorted(map(weight, row), reverse=True)
        sums.append(sum(w * (roots[k + 1] - roots[k]) for k, w in enumerate(heaviest)))
    filled = math.factorial(others) ** ((others - n) / others) / math.factorial(others - n)
    plain = [math.fsum(map(weight, row)) for row in fewer.tolist()]
    return min(
        factor * math.fsum(math.prod(chosen) for chosen in combinations(numbers, n))
        for factor, numbers in ((filled, sums), (1.0, plain))
    )


@given(DEVIATIONS)
@example(np.array([[0] * 6, [0] * 6, [INCOMPATIBLE] * 6, [0] * 6], dtype=np.int8))
def test_the_bound_is_above_the_sum_of_the_weights_of_all_ways(deviations):
    most = min(deviations.shape)
    found = np.exp(log_weighted_assignments(most, deviations))
    for n in range(most + 1):
        ways = weighted_ways(deviations, n)
        assert ways <= found[n] * (1.0 + 1e-12)
        assert found[n] == pytest.approx(bound_by_hand(deviations, n), rel=1e-11, abs=1e-300)
    if (deviations == deviations[0, 0]).all():
        assert found[most] == pytest.approx(ways, rel=1e-12)


@pytest.mark.parametrize("sizes", [(2, 2), (3, 2), (1, 1, 1), (4, 3, 2)])
def test_groups_that_keep_to_themselves_are_counted_exactly(sizes):
    group = np.repeat(np.arange(len(sizes)), sizes)
    apart = np.where(group[:, None] == group, 0, INCOMPATIBLE)
    found = log_weighted_assignments(len(group), apart.astype(np.int8))[-1]
    assert math.exp(found) == pytest.approx(math.prod(map(math.factorial, sizes)), rel=1e-12)


@pytest.mark.parametrize(("count", "stars"), [(900, 1100), (64, 2000), (2000, 64)])
def test_large_numbers_do_not_overflow(count, stars):
    most = min(count, stars)
    found = log_weighted_assignments(most, np.zeros((count, stars), dtype=np.int8))
    assert found[-1] == pytest.approx(log_assignments(most, count, stars), rel=1e-12)
    assert np.isfinite(found).all()


@given(st.integers(0, 9), st.integers(0, 9), st.integers(0, 9))
def test_the_number_without_magnitudes(n, more, others):
    found = math.exp(log_assignments(n, n + more, n + others))
    assert found == pytest.approx(math.comb(n + more, n) * math.perm(n + others, n), rel=1e-11)


def test_magnitudes_are_compatible_within_a_closed_interval():
    # All numbers are exact: 3.5 x 0.5 = 1.75.
    mag, stars = np.array([4.0, np.nan]), np.array([2.25, 2.0, 5.75, 6.0, np.nan])
    found = whole_deviations(mag, stars, 0.5)
    assert found.tolist() == [[3, 4, 3, 4, 0], [0] * 5]
    whole = whole_deviations(np.zeros(1), np.array([0.5, 0.75, 1.0, 1.25, 1.5, 1.625]), 0.5)
    assert whole.tolist() == [[1, 1, 2, 2, 3, 3]]
