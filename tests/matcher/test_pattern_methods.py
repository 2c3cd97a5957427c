"""Dynamic angles, grid and radial patterns: right stars first, for every roll and order."""

from __future__ import annotations

import numpy as np
import pytest
from frames import frames_of as frames
from frames import observe
from hypothesis import given
from hypothesis import strategies as st
from skies import GRID, RADIUS_RAD, SECTORS, frame_centred_on
from skies import PATTERN_CAMERA as CAMERA
from skies import pattern_sky as database

from starcat.geometry.attitude import matrix_from_radec_roll
from starcat.geometry.patterns import cell_of, cyclic_shifts
from starcat.geometry.sphere import separation
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods import dynamic_angle, patterns
from starcat.matcher.methods.consensus import RANKS, by_reference, references, surroundings
from starcat.matcher.methods.dynamic_angle import angle_tolerance_rad
from starcat.matcher.methods.patterns import alignment_of, most_votes, rank_by_rings, sector_pattern
from starcat.matcher.methods.table import METHODS
from starcat.matcher.observation import Candidates, Observation
from starcat.matcher.star_cells import rows_between
from starcat.pipeline.simulation.simulate import Noise

NAMES = ["dynamic_angle", "grid", "radial"]


@pytest.fixture(scope="module")
def sky(random_directions) -> MatcherDatabase:
    return database(random_directions(2500, 1))


def rank_by_angles(observation, sky, reference):
    found, scores = dynamic_angle.rank_stars(observation, sky, reference)
    return found.stars[:, 0], scores


def rank_by_cells(observation, sky, reference, most=64):
    product = sky.products["grid"]
    around = surroundings(observation, reference, RADIUS_RAD)
    nearest = alignment_of(around, product, 0)
    if nearest is None:
        return np.empty(0), np.empty(0)
    rows, votes = most_votes(around, nearest, observation.tolerance_rad, product, most)
    return product["star"][rows], votes


@pytest.mark.parametrize("most", [1, 5, 20, 64])
def test_of_rows_with_equal_votes_the_smaller_ones_come_first(sky, most):
    """Whatever their number is, so that the processor's way of sorting decides nothing."""
    observation, reference, _ = centred_on(sky, 100, 30.0)
    all_stars, all_votes = rank_by_cells(observation, sky, reference, len(sky.mag))
    stars, votes = rank_by_cells(observation, sky, reference, most)
    assert stars.tolist() == all_stars[:most].tolist()
    assert votes.tolist() == all_votes[:most].tolist()
    assert (np.diff(all_votes) == 0).sum() > 100


RANK = {"dynamic_angle": rank_by_angles, "grid": rank_by_cells, "radial": rank_by_rings}


def centred_on(
    sky: MatcherDatabase, star: int, roll_deg: float, tolerance_px: float = 2.0
) -> tuple[Observation, int, np.ndarray]:
    """Return a noiseless frame around a star, the star's centroid and all centroids' stars."""
    centroids, ahead, _ = frame_centred_on(sky, star, roll_deg)
    observation = observe(centroids, CAMERA, tolerance_px)
    truth = ahead[observation.rows]
    return observation, int(np.flatnonzero(truth == star)[0]), truth


@pytest.mark.parametrize("name", NAMES)
def test_a_star_seen_whole_has_the_best_score_there_is_at_any_roll(sky, name):
    product = sky.products[METHODS[name].products[0]]
    sizes = product.arrays.get({"dynamic_angle": "star_offsets", "grid": "cells_offsets"}.get(name))
    # Only what is there is touched: with any tolerance more cells and rings would be.
    tolerance_px = 2.0 if name == "dynamic_angle" else 1e-3
    for star in range(5, 2500, 125):
        observation, reference, _ = centred_on(sky, star, 77.0, tolerance_px)
        stars, scores = RANK[name](observation, sky, reference)
        # Not always alone: a close double's two stars have the same neighbours in the same cells.
        assert scores[stars == star].tolist() == [scores[0]]
        best = np.diff(sizes)[star] if name == "grid" else 1.0
        assert scores[0] == pytest.approx(best, abs=1e-12)
        assert (np.diff(scores) <= 0.0).all()
        assert len(set(stars.tolist())) == len(stars)
    for roll_deg in (0.0, 33.0, 200.5):
        turned, reference, _ = centred_on(sky, star, roll_deg, tolerance_px)
        other, same = RANK[name](turned, sky, reference)
        assert other.tolist() == stars.tolist()
        assert same.tolist() == pytest.approx(scores.tolist(), abs=1e-12)
    if sizes is not None:  # of equal stars, the stars with fewer neighbours come first
        equal, more = np.diff(scores) == 0.0, np.diff(np.diff(sizes)[stars])
        assert equal.sum() > 10
        assert (more[equal] >= 0).all()
        assert (more[equal] > 0).any()


def test_of_equal_rings_the_sectors_decide():
    # Two stars with neighbours at the same separations, in other position angles.
    apart = np.radians([2.0, 4.0, 6.0])
    stars = []
    for middle, angles_deg in ((0.0, [0.0, 90.0, 200.0]), (1.5, [0.0, 150.0, 160.0])):
        angle = np.radians(angles_deg)
        x, y = np.sin(apart) * np.cos(angle), np.sin(apart) * np.sin(angle)
        around = np.stack([np.cos(apart), x, y], axis=-1)
        turn = np.array([[np.cos(middle), -np.sin(middle)], [np.sin(middle), np.cos(middle)]])
        group = np.concatenate([[[1.0, 0.0, 0.0]], around])
        group[:, :2] = group[:, :2] @ turn.T
        stars.append(group)
    both = database(np.concatenate(stars))
    for star, other in ((0, 4), (4, 0)):
        observation, reference, _ = centred_on(both, star, 40.0)
        ranked, scores = rank_by_rings(observation, both, reference)
        assert ranked[:2].tolist() == [star, other]
        assert scores[0] - scores[1] > 0.25 * patterns.SECTORS


@pytest.mark.parametrize("name", ["dynamic_angle", "grid"])
def test_a_mirrored_star_agrees_in_less(sky, name):
    for star in (5, 80, 1700):
        observation, reference, _ = centred_on(sky, star, 20.0)
        _, scores = RANK[name](observation, sky, reference)
        mirrored = observe(observation.centroids_px * [-1, 1] + [1024, 0], CAMERA, 2.0)
        stars, others = RANK[name](mirrored, sky, int(references(mirrored)[0]))
        seen = others[stars == star]
        assert seen.max(initial=0) < 0.7 * scores[0]


@pytest.mark.parametrize("name", NAMES)
def test_the_star_in_the_middle_may_be_false_or_missing(sky, name):
    matcher = Matcher(sky, method=name)
    for frame in frames(sky, 10, Noise(0.3)):
        found = matcher.identify(np.concatenate([[[512.2, 511.9]], frame.centroids_px]))
        assert found.status == "identified"
        assert found.star_index[1:].tolist() == frame.star_index.tolist()
    for star in range(0, 150, 15):
        observation, reference, truth = centred_on(sky, star, 10.0)
        found = matcher.identify(np.delete(observation.centroids_px, reference, axis=0))
        assert found.star_index.tolist() == np.delete(truth, reference).tolist()
    # Nor may there be one that is near enough for a pattern.
    corners = np.array([[3.0, 3.0], [1020.0, 4.0], [5.0, 1021.0], [1019.0, 1018.0]])
    assert matcher.identify(corners).status == "no_match"
    stars, scores = RANK[name](observe(corners, CAMERA, 2.0), sky, 0)
    assert (len(stars), len(scores)) == (0, 0)


def proposed(name: str, observation: Observation, sky: MatcherDatabase) -> set[tuple[int, int]]:
    """Return centroid and star of all that is proposed for reference stars."""
    batches = METHODS[name].propose(observation, sky)
    pairs = [(b.centroids[:, 0].tolist(), b.stars[:, 0].tolist()) for b in batches]
    return {pair for c, s in pairs for pair in zip(c, s, strict=True)}


def test_a_false_alignment_star_is_passed_over(sky, monkeypatch):
    star = 80
    observation, reference, _ = centred_on(sky, star, 10.0)
    nearest = np.sort(observation.separation_rad[reference])[1]
    false_px = [512.0 + 0.6 * nearest * CAMERA.focal_length_px, 512.0]
    seen = observe(np.concatenate([observation.centroids_px, [false_px]]), CAMERA, 2.0)
    middle = int(references(seen)[0])
    assert 0.6 * nearest > GRID["buffer_rad"]
    assert (middle, star) in proposed("grid", seen, sky)
    monkeypatch.setattr(patterns, "ALIGNMENTS", 1)
    assert (middle, star) not in proposed("grid", seen, sky)


def test_the_alignment_star_is_on_the_axis_and_not_near_it(sky):
    cell_px = 2.0 * np.tan(RADIUS_RAD) / GRID["cells_per_side"] * CAMERA.focal_length_px
    two = observe([[512.0, 512.0], [512.0 + 4.5 * cell_px, 512.0]], CAMERA, 2.0)
    product = sky.products["grid"]
    cell = int(cell_of(4.5 * cell_px / CAMERA.focal_length_px, 0.0, RADIUS_RAD, 40))
    expected = product["cell_rows"][slice(*product["cell_offsets"][cell : cell + 2])]
    _, scores = rank_by_cells(two, sky, int(references(two)[0]), most=2500)
    assert scores.sum() == len(expected) > 10


@pytest.mark.parametrize("corner", [(-1, -1), (-1, 1), (1, -1), (1, 1)])
def test_no_cell_is_missed_within_the_tolerance(sky, corner):
    product, tested = sky.products["grid"], 0
    for star in range(0, 2500, 25):
        observation, reference, _ = centred_on(sky, star, 1.7 * star)
        apart = observation.separation_rad[reference]
        near = np.sort(apart[apart > GRID["buffer_rad"]])
        edge = np.abs(apart - RADIUS_RAD).min() * CAMERA.focal_length_px < 4.0
        if edge or (near[1] - near[0]) * CAMERA.focal_length_px < 4.0:
            continue
        # The star is in the middle: the image is the plane that touches the sphere at it.
        offset = observation.centroids_px - 512.0
        along = offset / np.maximum(np.hypot(*offset.T), 1e-9)[:, None]
        across = along[:, ::-1] * [-1, 1]
        shift = 1.9 * (corner[0] * along + corner[1] * across)
        shift[apart <= near[0]] = 0.0
        moved = observe(observation.centroids_px + shift, CAMERA, 2.0)
        stars, scores = rank_by_cells(moved, sky, int(references(moved)[0]))
        assert scores[stars == star] == np.diff(product["cells_offsets"])[star]
        tested += 1
    assert tested > 50


def test_the_second_star_of_a_dynamic_angle_is_the_farthest_that_agrees(sky):
    observation, reference, truth = centred_on(sky, 80, 0.0)
    first = next(dynamic_angle.candidates(observation, sky))
    around = surroundings(observation, reference, RADIUS_RAD)
    assert first.centroids.tolist() == [[reference, around.centroids[-1]]]
    assert first.stars.tolist() == [[80, truth[around.centroids[-1]]]]


@pytest.fixture(scope="module")
def crowded_sky(random_directions) -> MatcherDatabase:
    return database(random_directions(65_536, 9), np.radians(1.5))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_last_star_of_a_full_16_bit_column_is_found(crowded_sky, name):
    observation, reference, truth = centred_on(crowded_sky, 65_535, 0.0, 0.2)
    stars, _ = RANK[name](observation, crowded_sky, reference)
    assert stars[0] == 65_535
    first = next(METHODS[name].propose(observation, crowded_sky))
    assert first.stars[0].tolist() == truth[first.centroids[0]].tolist()


def merge_walk(observed, star, eps_angle_rad: float, eps_distance_rad: float) -> int:
    """Return N_match of S2 as the paper has it, both lists starting with the matched pair."""
    i = j = matches = 0
    while i < len(observed) and j < len(star):
        angle = observed[i][0] - star[j][0]
        if abs(angle) <= eps_angle_rad and abs(observed[i][1] - star[j][1]) <= eps_distance_rad:
            matches, i, j = matches + 1, i + 1, j + 1
        elif angle < 0.0:
            i += 1
        else:
            j += 1
    return matches


def rolled(angles: np.ndarray, separations: np.ndarray) -> list[list[tuple[float, float]]]:
    """Return cumulative angles and separations, begun with each neighbour in turn."""
    every = []
    for first in range(len(angles)):
        turn = np.mod(np.roll(angles, -first) - angles[first], 2.0 * np.pi)
        every.append(list(zip(turn.tolist(), np.roll(separations, -first).tolist(), strict=True)))
    return every


def test_the_score_is_that_of_the_merge_walk(random_directions, monkeypatch):
    few = database(random_directions(1500, 10))
    eps_angle_rad, eps_distance_rad = np.radians(2.5), np.radians(0.3)
    monkeypatch.setattr(
        dynamic_angle,
        "angle_tolerance_rad",
        lambda _, one, __: np.full(np.shape(one), eps_angle_rad),
    )
    product = few.products["neighbours"]
    tolerance_px = eps_distance_rad * CAMERA.focal_length_px / 1.5
    observation, reference, _ = centred_on(few, 17, 50.0, tolerance_px)
    around = surroundings(observation, reference, RADIUS_RAD)
    order = np.argsort(around.position_angle_rad)
    seen = rolled(around.position_angle_rad[order], around.separation_rad[order])

    def starts(one, other) -> bool:
        step = one[1][0] - (other[1][0] if len(other) > 1 else 2.0 * np.pi)
        return abs(step) <= eps_angle_rad and abs(one[0][1] - other[0][1]) <= eps_distance_rad

    expected: dict[int, float] = {}
    for star in range(1500):
        rows = slice(*product["star_offsets"][star : star + 2])
        own = rolled(product["position_angle_rad"][rows], product["separation_rad"][rows])
        for one in seen:
            for other in own:
                if starts(one, other):
                    n = merge_walk(one, other, eps_angle_rad, eps_distance_rad)
                    expected[star] = max(expected.get(star, 0.0), n / len(around))
    stars, scores = rank_by_angles(observation, few, reference)
    assert len(expected) > 100
    assert len(set(expected.values())) > 2
    assert sorted(stars.tolist()) == sorted(expected)
    more = scores - [expected[star] for star in stars.tolist()]
    # A walk misses matches just before its start, one turn later, and matches in crossed order:
    # it may count fewer.
    assert more.min() > -1e-12
    assert (more > 1e-12).mean() < 0.01


def polar(apart_deg: float, angle_deg: float) -> list[float]:
    """Return a direction from a star on the x axis, by separation and position angle."""
    apart, angle = np.radians([apart_deg, angle_deg])
    return [np.cos(apart), np.sin(apart) * np.sin(angle), np.sin(apart) * np.cos(angle)]


def seen_around(*directions: list[float]) -> tuple[Observation, int]:
    """Return a frame of directions around the star on the x axis, and the star's centroid."""
    body = np.array(directions) @ matrix_from_radec_roll(0.0, 0.0, 15.0).T
    observation = observe(CAMERA.pixels_from_directions(body), CAMERA, 2.0)
    return observation, int(references(observation)[0])


def test_the_angle_to_a_near_neighbour_may_be_off_by_more():
    star, last, near, missing = (polar(*at) for at in ((0, 0), (7, 240), (0.5, 0), (7, 120)))
    few = database(np.array([star, last, near, missing]))
    # The near one is 1.9 px off across, 3.4 deg as seen from the star; then comes a false one.
    turned = polar(0.5, np.degrees(1.9 / (np.radians(0.5) * CAMERA.focal_length_px)))
    observation, reference = seen_around(star, last, turned, polar(7, 60))
    stars, scores = rank_by_angles(observation, few, reference)
    assert stars[0] == 0
    assert scores[0] == pytest.approx(2.0 / 3.0)


def test_false_stars_between_all_neighbours_are_passed_over(monkeypatch):
    around = [polar(3.0 + k, 72.0 * k) for k in range(5)]
    false = [polar(2.0 + k, 72.0 * k + 30.0) for k in range(5)]
    few = database(np.array([polar(0, 0), *around]))
    observation, middle = seen_around(polar(0, 0), *around, *false)
    stars, _ = rank_by_angles(observation, few, middle)
    assert 0 not in stars
    monkeypatch.setattr(dynamic_angle, "bases", lambda observation, database: iter(()))
    assert (middle, 0) in proposed("dynamic_angle", observation, few)
    monkeypatch.setattr(dynamic_angle, "PASSED_OVER", (3,))
    assert (middle, 0) not in proposed("dynamic_angle", observation, few)


def test_the_angle_between_neighbours_is_as_uncertain_as_they_are_near():
    both = angle_tolerance_rad(0.001, np.array([0.1, 0.03, 0.0]), np.array([0.1, 0.04, 0.1]))
    assert both[0] == pytest.approx(0.01 * np.sqrt(2.0))
    assert both[1] == pytest.approx(0.001 * np.hypot(1.0 / 0.03, 1.0 / 0.04))
    assert np.pi <= both[2] < 3.2


def test_a_ring_that_is_only_touched_counts_half(sky, monkeypatch):
    monkeypatch.setattr(patterns, "SECTORS", 0.0)
    product = sky.products["radial"]
    # One centroid 1 px inside the end of ring 20.
    away_px = np.tan(RADIUS_RAD * 21 / 60) * CAMERA.focal_length_px - 1.0
    two = observe([[512.0, 512.0], [512.0, 512.0 + away_px]], CAMERA, 2.0)
    stars, scores = rank_by_rings(two, sky, int(references(two)[0]), most=2500)
    has = np.zeros((60, 2500))
    for ring in range(60):
        has[ring, product["ring_rows"][slice(*product["ring_offsets"][ring : ring + 2])]] = 1.0
    expected = 2.0 * (has[20] + 0.5 * has[21]) / (1.5 + has.sum(axis=0))
    assert sorted(stars.tolist()) == list(range(2500))
    assert scores.tolist() == pytest.approx(expected[stars].tolist())
    assert (np.diff(scores) <= 0.0).all()


def test_surroundings_are_the_neighbours_counter_clockwise(sky):
    product, radial = sky.products["neighbours"], sky.products["radial"]
    for star in (0, 50, 700, 2350, 2499):
        observation, reference, truth = centred_on(sky, star, 123.0 + star)
        around = surroundings(observation, reference, RADIUS_RAD)
        rows = slice(product["star_offsets"][star], product["star_offsets"][star + 1])
        by_angle = np.argsort(np.mod(around.position_angle_rad, 2.0 * np.pi))
        seen = truth[around.centroids][by_angle].tolist()
        first = seen.index(product["neighbour"][rows][0])
        assert seen[first:] + seen[:first] == product["neighbour"][rows].tolist()
        step = np.diff(np.mod(around.position_angle_rad, 2.0 * np.pi)[by_angle])
        expected = np.roll(product["successive_angle_rad"][rows], first)[: len(step)]
        assert step == pytest.approx(expected, abs=1e-9)
        u, v = sky.directions[star], sky.directions[truth[around.centroids]]
        assert around.separation_rad == pytest.approx(separation(u, v), abs=1e-12)
        assert (np.diff(around.separation_rad) >= 0.0).all()
        pattern = sector_pattern(around.position_angle_rad, SECTORS)
        assert cyclic_shifts(pattern, SECTORS).min() == radial["sector_pattern"][star]


def test_reference_stars_come_from_the_centre_outwards_also_with_magnitudes(sky):
    points = np.random.default_rng(11).random((30, 2)) * 1024.0
    for magnitudes in (None, np.arange(30.0)):
        observation = observe(points, CAMERA, 2.0, magnitudes)
        order = references(observation)
        away = np.hypot(*(observation.centroids_px[order] - 512.0).T)
        assert sorted(order.tolist()) == list(range(30))
        assert (np.diff(away) >= 0.0).all()


def test_all_reference_stars_are_asked_for_their_best_before_any_for_more(sky):
    frame = frames(sky, 1)[0]
    observation = observe(frame.centroids_px, CAMERA, 2.0)
    order = references(observation).tolist()

    def of(first):
        def propose(reference):
            stars = first + np.arange(30)
            return Candidates(np.full((30, 2), reference), np.stack([stars, stars + 1], axis=-1))

        return propose

    batches = list(by_reference(observation, of(0), of(100)))
    singles, more = batches[: 2 * len(order)], batches[2 * len(order) :]
    assert [b.centroids[0, 0] for b in singles] == order + order
    assert [b.stars[:, 0].tolist() for b in singles] == [[0]] * len(order) + [[100]] * len(order)
    assert [len(b) for b in more] == [2 * len(order) * n for n in np.diff(RANKS)]
    assert more[0].stars[: RANKS[1] - 1, 0].tolist() == list(range(1, RANKS[1]))


@given(st.lists(st.tuples(st.integers(0, 50), st.integers(0, 5)), max_size=12))
def test_rows_between_are_all_rows_of_all_runs(runs):
    start, count = np.array(runs, dtype=np.int64).reshape(-1, 2).T
    run, row = rows_between(start, start + count)
    expected = [(k, s + n) for k, (s, c) in enumerate(runs) for n in range(c)]
    assert list(zip(run.tolist(), row.tolist(), strict=True)) == expected
