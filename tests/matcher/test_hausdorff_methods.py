"""Hausdorff methods: scores against plain loops, invariance, and what the matcher makes of them."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace
from math import inf, tan

import numpy as np
import pytest
from frames import frames_of as frames
from frames import observe
from skies import CAMERA, frame_centred_on, set_sky

from starcat.geometry.attitude import matrix_from_quaternion, matrix_from_radec_roll
from starcat.geometry.sphere import separation
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods import hausdorff
from starcat.matcher.methods.consensus import (
    consistent_candidates,
    neighbour_candidates,
    references,
)
from starcat.matcher.methods.hausdorff import (
    lowest,
    means_of_minima,
    rank_by_points,
    rank_by_separations,
)
from starcat.matcher.observation import Observation
from starcat.pipeline.simulation.simulate import Noise
from starcat_lab import bare_methods
from starcat_lab.bare_methods import (
    name_by_points,
    name_by_separations,
    rank_by_full_differences,
    rank_by_ratios,
)

FOCAL_PX = CAMERA.focal_length_px


@pytest.fixture(scope="module")
def sky(random_directions) -> MatcherDatabase:
    return set_sky(random_directions(1500, 1))


@pytest.fixture(scope="module")
def small_sky(random_directions) -> MatcherDatabase:
    """Few enough stars for loops, three of them without any neighbour or with one only."""
    u = random_directions(150, 2)
    pole = np.array([0.0, 0.0, 1.0])
    lonely = u[u @ pole < np.cos(np.radians(40.0))]
    return set_sky(np.concatenate([pole[None, :], lonely]), (30.0, 25.0))


def observed(centroids_px, magnitudes=None, tolerance_px: float = 2.0) -> Observation:
    return observe(centroids_px, CAMERA, tolerance_px, magnitudes)


def members(sky: MatcherDatabase, product: str, values: str, star: int) -> list[float]:
    arrays = sky.products[product].arrays
    first, last = arrays["star_offsets"][star : star + 2]
    return [float(value) for value in arrays[values][first:last]]


# Sets of numbers


def test_means_of_minima_skip_stars_without_members():
    offsets = np.array([0, 0, 2, 2])
    assert means_of_minima([np.array([3.0, 1.0])], offsets).tolist() == [inf, 1.0, inf]
    assert means_of_minima([], offsets).tolist() == [inf] * 3
    assert means_of_minima([np.empty(0)], np.array([0, 0])).tolist() == [inf]


def test_the_lowest_scores_come_first_and_equal_ones_by_row():
    scores = np.array([[3.0, 1.0, 2.0, 1.0], [inf, np.nan, 5.0, inf]])
    stars, best = lowest(scores, 3)
    assert stars.tolist() == [[1, 3, 2], [2, -1, -1]]
    assert best.tolist() == [[1.0, 1.0, 2.0], [5.0, inf, inf]]
    stars, best = lowest(scores, 6)
    assert stars[0].tolist() == [1, 3, 2, 0, -1, -1]
    assert best[1].tolist() == [5.0, inf, inf, inf, inf, inf]
    assert lowest(np.empty((2, 0)), 1)[0].tolist() == [[-1], [-1]]
    many = np.random.default_rng(6).permutation(np.arange(400) // 4).astype(float)[None, :]
    expected = sorted(range(400), key=lambda star: (many[0, star], star))
    for count in (197, 198, 199, 200):  # the last of four equal scores, or not
        assert lowest(many, count)[0][0].tolist() == expected[:count]


def things_made(database: MatcherDatabase) -> list[str]:
    return [database.name]


def test_what_is_cached_is_made_once_and_let_go_with_its_database(random_directions):
    database = set_sky(random_directions(20, 5))
    one = database.cached(things_made)
    assert database.cached(things_made) is one
    other = replace(database, name="other")
    assert other.cached(things_made) == ["other"]
    gone = weakref.ref(database)
    del database
    gc.collect()
    assert gone() is None


# Angular reference sets


def angular_scores(sky: MatcherDatabase, seen: Observation, cap_rad: float | None) -> np.ndarray:
    """The paper's score in plain loops, shape (N, S)."""
    radius = sky.products["hausdorff_angular"].numbers["radius_rad"]
    scores = np.full((len(seen), len(sky.directions)), inf)
    for a in range(len(seen)):
        apart = [float(separation(seen.body[a], seen.body[b])) for b in range(len(seen)) if b != a]
        apart = [one for one in apart if one <= radius]
        for star in range(len(sky.directions)):
            values = members(sky, "hausdorff_angular", "separation_rad", star)
            minima = [min((abs(one - v) for v in values), default=inf) for one in apart]
            if cap_rad is not None:
                minima = [min(one, cap_rad) for one in minima]
            if minima:
                scores[a, star] = sum(minima) / len(minima)
    return scores


@pytest.mark.parametrize("cap_px", [None, 3.0, 60.0])
def test_angular_scores_are_those_of_loops(small_sky, cap_px):
    generator = np.random.default_rng(7)
    cap_rad = None if cap_px is None else cap_px / FOCAL_PX
    for count in (2, 6, 9):
        seen = observed(generator.uniform(0.0, 1024.0, (count, 2)))
        every = len(small_sky.directions)
        if cap_rad is None:
            stars, scores = rank_by_full_differences(seen, small_sky, count=every)
        else:
            stars, scores = rank_by_separations(seen, small_sky, cap_rad=cap_rad, count=every)
        expected = angular_scores(small_sky, seen, cap_rad)
        ordered = np.take_along_axis(expected, np.where(stars < 0, 0, stars), axis=1)
        ordered[stars < 0] = inf
        assert scores == pytest.approx(ordered, abs=1e-12)
        assert scores == pytest.approx(np.sort(expected, axis=1), abs=1e-12)


def test_what_takes_no_part_changes_no_score(small_sky, sky, random_directions, monkeypatch):
    # Separations beyond the radius.
    near = set_sky(random_directions(300, 4), (5.0, 5.0))
    seen = observed([[100.0, 100.0], [150.0, 100.0], [900.0, 900.0]])
    stars, scores = rank_by_separations(seen, near, cap_rad=0.01, count=2)
    alone = int(np.argmax(seen.centroids_px[:, 0]))
    assert stars[alone].tolist() == [-1, -1]
    assert np.isinf(scores[alone]).all()
    pair = observed([[100.0, 100.0], [150.0, 100.0]])
    only = rank_by_separations(pair, near, cap_rad=0.01, count=2)[1]
    assert np.delete(scores, alone, axis=0).tolist() == only.tolist()
    # Centroids after the requested first ones.
    seen = observed(frames(sky, 1)[0].centroids_px)
    how = {"cap_rad": 0.001, "count": 4}
    whole = rank_by_separations(observed(seen.centroids_px[:6]), sky, **how)
    part = rank_by_separations(seen, sky, **how, first=6)
    assert part[0].tolist() == whole[0].tolist()
    assert part[1] == pytest.approx(whole[1], abs=1e-15)
    # How many pairs are scored at once.
    seen = observed(np.random.default_rng(8).uniform(0.0, 1024.0, (9, 2)))
    whole = rank_by_separations(seen, small_sky, cap_rad=0.02, count=5)
    monkeypatch.setattr(hausdorff, "_AT_ONCE", 2 * len(small_sky.directions))
    parts = rank_by_separations(seen, small_sky, cap_rad=0.02, count=5)
    assert parts[0].tolist() == whole[0].tolist()
    assert parts[1] == pytest.approx(whole[1], abs=1e-15)


def test_the_bare_angular_method_names_the_stars_of_noiseless_frames(sky):
    right = total = 0
    for frame in frames(sky, 20):
        seen = observed(frame.centroids_px)
        named = name_by_separations(seen, sky)
        true = frame.star_index[seen.rows]
        right += int((named == true).sum())
        total += len(true)
    assert right >= 0.97 * total


def test_names_outside_the_field_and_names_given_twice_are_outliers(sky, monkeypatch):
    u = sky.directions
    near = np.argsort(-(u @ u[0]))[:3]
    far = np.argsort(u @ u[0])[:2]
    names = np.array([near[0], far[0], near[1], far[1], near[2], near[2], -1])[:, None]
    scores = np.where(names < 0, inf, 0.001)
    monkeypatch.setattr(bare_methods, "rank_by_full_differences", lambda *_, **__: (names, scores))
    seen = observed(np.random.default_rng(1).uniform(0.0, 1024.0, (7, 2)))
    named = name_by_separations(seen, sky)
    assert named.tolist() == [near[0], -1, near[1], -1, -1, -1, -1]
    # Two names on either side of the sky, the last star's among them, and one without: a tie.
    here, there = np.argsort(u @ u[-1])[:2], np.argsort(-(u @ u[-1]))[1:3]
    names = np.array([*here, *there, -1])[:, None]
    scores = np.where(names < 0, inf, 0.001)
    named = name_by_separations(observed(seen.centroids_px[:5]), sky)
    assert named.tolist() == [*here, -1, -1, -1]


def test_the_angular_method_begins_with_consensus_and_goes_on_without(sky, monkeypatch):
    frame = frames(sky, 1)[0]
    seen = observed(frame.centroids_px)
    first = next(hausdorff.angular_candidates(seen, sky))
    assert first.stars.shape[1] > 6
    crowded = np.random.default_rng(17).uniform(0.0, 1024.0, (70, 2))  # is thinned out
    assert len(next(hausdorff.angular_candidates(observed(crowded), sky))) > 0
    monkeypatch.setattr(hausdorff, "consistent_candidates", lambda *_: iter(()))
    first = next(hausdorff.angular_candidates(seen, sky))
    assert first.stars.shape == (1, 3)
    assert (
        Matcher(sky, method="hausdorff_angular").identify(frame.centroids_px).status == "identified"
    )


# Planar reference sets


def l2_scores(sky: MatcherDatabase, seen: Observation, reference: int):
    """Eqs. 13 to 15 in plain loops, for each star."""
    radius = sky.products["hausdorff_l2"].numbers["radius_rad"]
    apart = np.delete(separation(seen.body[reference], seen.body), reference).tolist()
    around = [tan(one) for one in apart if one <= radius]
    scores = np.full(len(sky.directions), inf)
    for star in range(len(scores) if around else 0):
        ratios = members(sky, "hausdorff_l2", "ratio", star)
        least = [min((abs(r - one / min(around)) for r in ratios), default=inf) for one in around]
        scores[star] = sum(one**2 for one in least) / len(around)
    return scores


def assert_ranking(found: tuple[np.ndarray, np.ndarray], expected: np.ndarray) -> None:
    """Check that a whole ranking has the expected scores, in order."""
    stars, scores = found
    there = stars >= 0
    assert there.sum() == np.isfinite(expected).sum()
    assert scores[there] == pytest.approx(expected[stars[there]], rel=1e-9, abs=1e-12)
    assert np.all(np.diff(scores[there]) >= 0.0)


def test_l2_scores_are_those_of_loops(small_sky):
    generator = np.random.default_rng(9)
    for count in (2, 5, 8):
        seen = observed(generator.uniform(0.0, 1024.0, (count, 2)))
        for reference in range(count):
            found = rank_by_ratios(seen, small_sky, reference, count=200)
            assert_ranking(found, l2_scores(small_sky, seen, reference))


def test_the_reference_star_is_the_nearest_to_the_centre(small_sky):
    seen = observed([[100.0, 900.0], [700.0, 700.0], [530.0, 500.0]], [1.0, 2.0, 3.0])
    central = int(np.flatnonzero(seen.centroids_px[:, 0] == 530.0)[0])
    for rank_stars in (rank_by_ratios, rank_by_points):
        default = rank_stars(seen, small_sky, count=9)
        asked = rank_stars(seen, small_sky, central, count=9)
        assert default[0].tolist() == asked[0].tolist()
        assert default[1].tolist() == asked[1].tolist()


def test_the_smallest_distance_is_one_that_is_not_zero(small_sky):
    seen = observed(np.random.default_rng(18).uniform(200.0, 824.0, (6, 2)))
    body = seen.body.copy()
    body[5] = body[0]
    twin = replace(seen, body=body)
    alone = observed(seen.centroids_px[:5])
    found = rank_by_ratios(twin, small_sky, 0, count=200)
    expected = rank_by_ratios(alone, small_sky, 0, count=200)
    assert found[0].tolist() == expected[0].tolist()
    assert found[1].tolist() == expected[1].tolist()
    same = (hausdorff.likely_stars(one, small_sky, 0, 3, 9).tolist() for one in (twin, alone))
    assert len({tuple(stars) for stars in same}) == 1


def test_l2_names_the_star_at_the_centre_of_noiseless_frames(sky):
    right = 0
    for star in range(40):
        for roll_deg, scale in ((0.0, 1.0), (77.0, 1.0), (180.0, 1.4)):
            px, *_ = frame_centred_on(sky, star, roll_deg, scale)
            right += int(rank_by_ratios(observed(px), sky, count=1)[0][0]) == star
    assert right >= 0.95 * 120
    # Another radius serves frames of another scale.
    shrunk = float(np.arctan(0.7 * np.tan(sky.products["hausdorff_l2"].numbers["radius_rad"])))
    right = {None: 0, shrunk: 0}
    for star in range(40):
        seen = observed(frame_centred_on(sky, star, 180.0, 0.7)[0])
        for radius_rad in right:
            found = rank_by_ratios(seen, sky, count=1, radius_rad=radius_rad)
            right[radius_rad] += int(found[0][0]) == star
    assert right[shrunk] >= 38
    assert right[None] < 20


def test_a_difference_of_ratios_counts_in_units_of_its_error(small_sky):
    """`likely_stars` in plain loops."""
    generator = np.random.default_rng(10)
    product = small_sky.products["hausdorff_l2"]
    for count, tolerance_px in ((4, 20.0), (4, 20.0), (200, 20.0), (200, 2.0)):
        seen = observed(generator.uniform(200.0, 824.0, (6, 2)), None, tolerance_px)
        apart = np.sort(seen.separation_rad[0])[1:]
        distance = np.tan(apart[apart <= product.numbers["radius_rad"]])
        for divisors in (1, 2, 3):
            expected = set()
            for j in range(min(divisors, len(distance) - 1)):
                for k in range(divisors):
                    scores = [
                        loop_agreement(members(small_sky, "hausdorff_l2", "ratio", star), k)(
                            distance, j, seen.side_tolerance_rad
                        )
                        for star in range(len(small_sky.directions))
                    ]
                    order = sorted(range(len(scores)), key=lambda s: (-round(scores[s], 12), s))
                    expected |= {star for star in order[:count] if scores[star] > 0.0}
            found = hausdorff.likely_stars(seen, small_sky, 0, divisors, count)
            assert set(found.tolist()) == expected


def loop_agreement(values: list[float], k: int):
    """Agreement of a star whose distances are divided by the k-th smallest."""

    def agreement(distance: np.ndarray, j: int, error: float) -> float:
        if len(values) <= k:
            return 0.0
        total = 0.0
        for i, one in enumerate(distance):
            if i == j:
                continue
            ratio = one / distance[j]
            reach = error / distance[j] * np.sqrt(1.0 + ratio * ratio)
            nearest = min(abs(ratio - value / values[k]) for value in values)
            total += 1.0 - min(1.0, nearest / reach) ** 2
        return total

    return agreement


# The baseline


def test_l1_scores_are_those_of_loops(small_sky):
    generator, u = np.random.default_rng(11), small_sky.directions
    radius = small_sky.products["hausdorff_l2"].numbers["radius_rad"]
    # The camera looks along the x axis with north up, so its own sky is at hand.
    upright = u @ matrix_from_radec_roll(0.0, 0.0, 0.0).T
    around = [
        [
            tangent_point(upright[int(n)], upright[star], np.array([0.0, -1.0, 0.0]))
            for n in members(small_sky, "hausdorff_l2", "neighbour", star)
        ]
        for star in range(len(u))
    ]
    for count in (2, 5, 8):
        seen = observed(generator.uniform(0.0, 1024.0, (count, 2)))
        for reference in range(count):
            middle = seen.body[reference]
            points = [
                tangent_point(one, middle, np.array([0.0, -1.0, 0.0]))
                for one in np.delete(seen.body, reference, axis=0)
                if separation(one, middle) <= radius
            ]
            expected = []
            for stars in around:
                apart = [[abs(x - p) + abs(y - q) for p, q in stars] for x, y in points]
                minima = [min(one, default=inf) for one in apart]
                expected.append(sum(minima) / len(minima) if minima else inf)
            # A star at the pole has its own north, which the loops do not know.
            found = rank_by_points(seen, small_sky, reference, count=200)
            kept = found[0] != 0
            expected[0] = inf
            assert_ranking((found[0][kept], found[1][kept]), np.array(expected))


def tangent_point(v: np.ndarray, u: np.ndarray, up: np.ndarray) -> tuple[float, float]:
    north = up - (up @ u) * u
    north = north / np.linalg.norm(north)
    plane = v / (v @ u) - u
    return float(plane @ np.cross(north, u)), float(plane @ north)


def test_l1_needs_an_upright_camera_of_the_nominal_scale(sky):
    def right(**how) -> float:
        frames = (frame_centred_on(sky, star, **how)[0] for star in range(40))
        seen = [observed(px) for px in frames]
        return np.mean([name_by_points(one, sky) == k for k, one in enumerate(seen)])

    assert right(roll_deg=0.0) == 1.0
    assert right(roll_deg=0.5) == 1.0
    assert right(roll_deg=3.0) < 0.1
    assert right(roll_deg=0.0, scale=1.05) < 0.1


# Consensus


def names_of(
    sky: MatcherDatabase, frame, generator, ranks: int = 4
) -> tuple[Observation, np.ndarray]:
    """A frame, and for each centroid some stars, the right one at a random rank."""
    seen = observed(frame.centroids_px)
    ranked = generator.integers(0, len(sky.directions), (len(seen), ranks))
    place = generator.integers(0, ranks, len(seen))
    ranked[np.arange(len(seen)), place] = frame.star_index[seen.rows]
    return seen, ranked


def loop_fits(sky: MatcherDatabase, seen: Observation, one, other) -> bool:
    (a, s), (b, t) = one, other
    if a == b or s == t:
        return False
    apart = separation(sky.directions[s], sky.directions[t])
    wanted = separation(seen.body[a], seen.body[b])
    return bool(abs(apart - wanted) <= seen.side_tolerance_rad)


def test_all_agreeing_pairs_are_proposed_once_the_best_supported_first(sky):
    generator = np.random.default_rng(13)
    for frame in frames(sky, 5, Noise(0.5), seed=13):
        seen, ranked = names_of(sky, frame, generator)
        ranked[generator.random(ranked.shape) < 0.2] = -1
        ranked[0, 0] = ranked[1, 0] = ranked[1].max()  # one star for two centroids
        names = [(a, int(s)) for a in range(len(seen)) for s in ranked[a] if s >= 0]
        partners = {
            one: {other for other in names if loop_fits(sky, seen, one, other)} for one in names
        }
        count = {one: len({a for a, _ in others}) for one, others in partners.items()}
        first, *batches = consistent_candidates(ranked, seen, sky)
        proposed = [
            tuple(zip(centroids.tolist(), stars.tolist(), strict=True))
            for batch in batches
            for centroids, stars in zip(batch.centroids, batch.stars, strict=True)
        ]
        expected = {frozenset((one, other)) for one in names for other in partners[one]}
        assert {frozenset(pair) for pair in proposed} == expected
        assert len(proposed) == len(expected)
        joint = [count[one] + count[other] for one, other in proposed]
        assert joint == sorted(joint, reverse=True)
        apart = [seen.separation_rad[one[0], other[0]] for one, other in proposed]
        level = [row for row, value in enumerate(joint) if value == joint[0]]
        assert [apart[row] for row in level] == sorted((apart[r] for r in level), reverse=True)
        group = list(zip(first.centroids[0].tolist(), first.stars[0].tolist(), strict=True))
        assert set(proposed[0]) == set(group[:2])
        assert all(loop_fits(sky, seen, a, b) for a in group for b in group if a != b)


def test_there_may_be_nothing_to_agree_on(sky):
    seen = observed([[100.0, 100.0], [500.0, 300.0], [900.0, 700.0]])
    none = np.full((3, 4), -1)
    one = none.copy()
    one[1, 2] = 7
    for ranked in (none, one, np.full((3, 2), 7), np.empty((0, 4), dtype=int)):
        assert not list(consistent_candidates(ranked, seen, sky))
    product = sky.products["hausdorff_l2"]
    for stars in (np.empty(0, dtype=np.intp), np.array([3])):
        assert len(neighbour_candidates(0, stars, product, seen, sky)) == 0


def test_the_number_of_names_and_of_proposals_has_a_limit(sky):
    frame = max(frames(sky, 5), key=lambda frame: frame.n_stars)
    seen, ranked = names_of(sky, frame, np.random.default_rng(15))
    batches = list(consistent_candidates(ranked, seen, sky, most=30))
    assert [len(batch) for batch in batches] == [1, 4, 16, 10]
    repeated = np.tile(ranked, (1, 100))
    assert repeated.size > 2048
    assert len(next(consistent_candidates(repeated, seen, sky)).stars[0]) >= len(seen) - 1
    # Of too many names the lower ranks are left out.
    seen, ranked = names_of(sky, frame, np.random.default_rng(19), ranks=1)
    false = np.random.default_rng(19).integers(0, len(sky.directions), (len(seen), 150))
    for names, is_whole in (([ranked, false], True), ([false, ranked], False)):
        first = next(consistent_candidates(np.concatenate(names, axis=1), seen, sky))
        assert first.stars.shape[1] == len(seen) if is_whole else first.stars.shape[1] < 6


@pytest.mark.parametrize(("double", "tolerance_px"), [(False, 2.0), (True, 2.0), (False, 12.0)])
def test_neighbours_that_agree_are_those_of_loops(sky, double, tolerance_px):
    if double:
        # Companions 2 px away, nearer than the tolerance.
        u = sky.directions[:400] + 2.0 / FOCAL_PX * np.roll(sky.directions[:400], 1, axis=0)
        companions = u / np.linalg.norm(u, axis=1)[:, None]
        sky = set_sky(np.concatenate([sky.directions[:400], companions]))
    product = sky.products["hausdorff_l2"]
    generator = np.random.default_rng(16)
    for frame in frames(sky, 2, Noise(0.5, 0.1, 2), seed=16):
        seen = observed(frame.centroids_px, None, tolerance_px)
        true = frame.star_index[seen.rows]
        reference = next(int(row) for row in references(seen) if true[row] >= 0)
        others = generator.choice(len(sky.directions), 30, replace=False)
        stars = np.unique(np.append(others, true[reference]))
        found = neighbour_candidates(reference, stars, product, seen, sky)
        expected = {}
        for star in stars:
            first, last = product["star_offsets"][star : star + 2]
            names = [
                (k, int(n))
                for n in product["neighbour"][first:last]
                for k in range(len(seen))
                if loop_fits(sky, seen, (reference, int(star)), (k, int(n)))
            ]
            count = {
                one: len({other[0] for other in names if loop_fits(sky, seen, one, other)})
                for one in names
            }
            joint = {
                frozenset((one, other)): count[one] + count[other]
                for one in names
                for other in names
                if loop_fits(sky, seen, one, other)
            }
            if joint:
                expected[int(star)] = joint
        assert sorted(found.stars[:, 0].tolist()) == sorted(expected)
        chosen = []
        for centroids, named in zip(found.centroids.tolist(), found.stars.tolist(), strict=True):
            pair = frozenset(zip(centroids[1:], named[1:], strict=True))
            chosen.append(expected[named[0]][pair])
            assert chosen[-1] == max(expected[named[0]].values())
        assert chosen == sorted(chosen, reverse=True)
        if not double:
            assert (found.stars[0] == true[found.centroids[0]]).all()
        assert (found.centroids[:, 0] == reference).all()


# The matcher


@pytest.mark.parametrize("name", ["hausdorff_angular", "hausdorff_l2"])
def test_centroids_at_nearly_the_same_place_do_no_harm(sky, name):
    matcher, some = Matcher(sky, method=name), frames(sky, 10, Noise(0.3))
    px, star = max(((one.centroids_px, one.star_index) for one in some), key=lambda f: len(f[0]))
    twin = px + np.spacing(px)
    found = matcher.identify(np.concatenate([px, twin[:3]]))
    assert found.status == "identified"
    assert (found.star_index[3 : len(px)] == star[3:]).mean() > 0.9
    matrix = matrix_from_quaternion(found.q_body_from_icrs)
    assert np.linalg.det(matrix) == pytest.approx(1.0)
