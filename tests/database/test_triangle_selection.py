"""Triangles in order: S3's flow chart step by step, thresholds at both ends, three orders."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest
from frames import observe, with_selection
from hypothesis import given
from hypothesis import strategies as st

from starcat.geometry.camera import Camera
from starcat.matcher.methods.triangle import is_well_shaped, select_triangles
from starcat.matcher.observation import Observation
from starcat_lab.papers.s3 import optimised_triangle

CAMERA = Camera(1024, 1024, fov_x_deg=12.0)


def frame(count: int, seed: int, magnitudes: bool = False) -> Observation:
    generator = np.random.default_rng(seed)
    points = generator.random((count, 2)) * 1024.0
    return observe(points, CAMERA, 2.0, generator.random(count) if magnitudes else None)


def ordered(seen: Observation, **order: object) -> np.ndarray:
    return select_triangles(with_selection(seen, **order))


def angles_of(a: float, b: float, c: float) -> list[float]:
    """Return the angles of a plane triangle, opposite each side, one law of cosines each."""
    sides = ((b, c, a), (a, c, b), (a, b, c))
    return [
        math.acos(max(-1.0, min(1.0, (p * p + q * q - r * r) / (2 * p * q)))) for p, q, r in sides
    ]


# --- Shape

points = st.tuples(*[st.floats(0.0, 1000.0)] * 6)


@given(points, st.floats(0.0, 60.0), st.floats(1.0, 59.0))
def test_shape_is_every_side_and_every_angle(place, min_side, min_angle_deg):
    p, q, r = np.array(place).reshape(3, 2)
    a, b, c = math.dist(q, r), math.dist(p, r), math.dist(p, q)
    found = bool(is_well_shaped(*np.array([[a], [b], [c]]), min_side, np.radians(min_angle_deg))[0])
    if min(a, b, c) <= min_side:
        assert not found
        return
    narrowest = math.degrees(min(angles_of(a, b, c)))
    # Both ways round to 1e-13 or so of the square of the sides: near the limit either will do.
    if abs(narrowest - min_angle_deg) > 1e-4:
        assert found == (narrowest > min_angle_deg)


@pytest.mark.parametrize("order", [[0, 1, 2], [1, 2, 0], [2, 1, 0]])
def test_thresholds_have_to_be_exceeded(order):
    sides = np.array([[3.0], [4.0], [5.0]])[order]
    narrowest = math.acos(0.8)
    assert is_well_shaped(*sides, np.nextafter(3.0, 0.0), 0.1)[0]
    assert not is_well_shaped(*sides, 3.0, 0.1)[0]
    assert is_well_shaped(*sides, 2.0, narrowest - 1e-12)[0]
    assert not is_well_shaped(*sides, 2.0, narrowest + 1e-12)[0]


@pytest.mark.parametrize("sides", [(0.0, 0.0, 0.0), (0.0, 1.0, 1.0), (1.0, 2.0, 3.0)])
def test_no_triangle_of_two_places_or_a_line(sides):
    assert not is_well_shaped(*np.array(sides)[:, None], 0.0, np.radians(1.0))[0]


# --- S3


def separations(places: np.ndarray) -> np.ndarray:
    return np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))


def flow_chart(places: list[tuple[float, float]], d_min: float, theta_min_deg: float):
    """Follow S3's flow chart with a list of stars, the brightest first."""
    for n in range(len(places)):
        queue = list(range(n, len(places)))
        triangle = [queue.pop(0) for _ in range(min(3, len(queue)))]
        while len(triangle) == 3:
            one, two, three = triangle
            drop = None
            # A double star loses its fainter member; the brightest stars are looked at first.
            for bright, faint in ((one, two), (one, three), (two, three)):
                if drop is None and math.dist(places[bright], places[faint]) <= d_min:
                    drop = faint
            if drop is None:
                sides = [math.dist(places[p], places[q]) for p, q in combinations(triangle, 2)]
                if min(angles_of(*sides)) > math.radians(theta_min_deg):
                    return tuple(triangle)
                drop = three
            triangle.remove(drop)
            if queue:
                triangle.append(queue.pop(0))
    return None


@pytest.mark.parametrize(("d_min", "theta_min_deg"), [(10.0, 15.0), (200.0, 15.0), (30.0, 40.0)])
def test_the_flow_chart(d_min, theta_min_deg):
    generator = np.random.default_rng(21)
    answers = set()
    for _ in range(300):
        places = generator.random((generator.integers(3, 9), 2)) * 1024.0
        if generator.random() < 0.5:
            places[1] = places[0] + generator.normal(scale=5.0, size=2)
        if generator.random() < 0.5:
            places[2] = 0.5 * (places[0] + places[1]) + generator.normal(scale=2.0, size=2)
        expected = flow_chart([tuple(place) for place in places], d_min, theta_min_deg)
        found = optimised_triangle(separations(places), d_min, math.radians(theta_min_deg))
        assert found == expected
        answers.add(found)
    # All branches of the chart: more than the three brightest, and more than one start.
    assert len(answers) > 8


GOOD = [(0.0, 0.0), (300.0, 0.0), (0.0, 300.0)]


@pytest.mark.parametrize(
    ("places", "expected"),
    [
        (GOOD, (0, 1, 2)),
        # The second is the first's companion, and the next in line takes its place.
        ([GOOD[0], (5.0, 0.0), *GOOD[1:]], (0, 2, 3)),
        # The third is the second's companion.
        ([GOOD[0], GOOD[1], (300.0, 5.0), GOOD[2]], (0, 1, 3)),
        # In a line: the faintest goes.
        ([GOOD[0], GOOD[1], (600.0, 0.0), GOOD[2]], (0, 1, 3)),
        # All stars are in a line: at the end no star is left to try.
        ([(0.0, 0.0), (100.0, 0.0), (200.0, 0.0), (300.0, 0.0)], None),
        # The brightest pairs with all others; without it there is a triangle.
        ([(9.0, 9.0), (3.0, 9.0), (200.0, 9.0), (100.0, 300.0)], (0, 2, 3)),
        ([(0.0, 0.0), (500.0, 0.0), (1000.0, 0.0), (500.0, 300.0)], (0, 1, 3)),
        # The first two and each of the others make a line; the others alone make a triangle.
        ([(0.0, 0.0), (1e6, 1e6), (100.0, 0.0), (100.0, 300.0), (400.0, 0.0)], (2, 3, 4)),
        (GOOD[:2], None),
        ([], None),
    ],
)
def test_flow_chart_by_hand(places, expected):
    apart = separations(np.array(places).reshape(-1, 2))
    assert optimised_triangle(apart, 10.0, math.radians(15.0)) == expected


# --- Triangles of a frame


def pixels_apart(observation: Observation, triangle: tuple[int, int, int]) -> list[float]:
    apart = observation.separation_rad * CAMERA.focal_length_px
    i, j, k = triangle
    return [apart[j, k], apart[i, k], apart[i, j]]


@pytest.mark.parametrize("magnitudes", [False, True])
@pytest.mark.parametrize("order", ["auto", "brightness", "inradius", "compact"])
def test_every_well_shaped_triangle_once(order, magnitudes):
    observation = frame(12, 22, magnitudes)
    strict = {"min_side_px": 150.0, "min_angle_deg": 25.0, "few_centroids": 0}
    found = ordered(observation, order=order, **strict).tolist()
    expected = [
        list(triangle)
        for triangle in combinations(range(12), 3)
        if min(pixels_apart(observation, triangle)) > 150.0
        and min(angles_of(*pixels_apart(observation, triangle))) > math.radians(25.0)
    ]
    assert 20 < len(expected) < 200
    assert sorted(found) == expected


def test_few_centroids_try_the_poor_triangles_last():
    observation = frame(10, 22)
    strict = {"order": "brightness", "min_side_px": 150.0, "min_angle_deg": 25.0}
    good = ordered(observation, **strict, few_centroids=9).tolist()
    both = ordered(observation, **strict, few_centroids=10).tolist()
    assert both[: len(good)] == good
    poor = [
        list(triangle)
        for triangle in sorted(combinations(range(10), 3), key=lambda triple: triple[::-1])
        if list(triangle) not in good
        and min(angles_of(*pixels_apart(observation, triangle))) > math.radians(4.0)
        and min(pixels_apart(observation, triangle)) > observation.tolerance_px
    ]
    assert both[len(good) :] == poor
    assert 20 < len(poor) < 120 - len(good)


def inradius(a: float, b: float, c: float) -> float:
    return b * c * math.sin(angles_of(a, b, c)[0]) / (a + b + c)


KEYS = {
    "faintest": lambda triangle, sides: triangle[::-1],
    "longest side": lambda triangle, sides: max(sides),
    "inradius": lambda triangle, sides: round(-inradius(*sides), 9),
}


@pytest.mark.parametrize(
    ("order", "magnitudes", "key"),
    [
        ("brightness", False, "faintest"),
        ("auto", True, "faintest"),
        ("compact", True, "longest side"),
        ("auto", False, "longest side"),
        ("inradius", False, "inradius"),
        ("inradius", True, "inradius"),
    ],
)
def test_triangles_are_in_order(order, magnitudes, key):
    observation = frame(9, 23, magnitudes)
    found = ordered(observation, order=order, few_centroids=0).tolist()
    keys = [KEYS[key](triangle, pixels_apart(observation, triangle)) for triangle in found]
    assert keys == sorted(keys)
    assert len(found) > 20


def test_equal_keys_keep_the_order_of_the_centroids():
    square = [[300.0, 300.0], [300.0, 700.0], [700.0, 300.0], [700.0, 700.0]]
    observation = observe(square, CAMERA, 2.0)
    found = ordered(observation, order="brightness", few_centroids=0).tolist()
    assert found == [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]


@pytest.mark.parametrize("most", [4, 7, 40])
def test_only_the_first_centroids_take_part(most):
    found = ordered(frame(40, 26), order="compact", min_angle_deg=1.0, most_centroids=most)
    assert found.max() == most - 1
    assert (np.diff(found, axis=1) > 0).all()


@pytest.mark.parametrize("count", [0, 1, 2, 3, 4])
def test_few_centroids_make_all_triangles_or_none(count):
    seen = frame(count, 1)
    assert select_triangles(seen)[:0].shape == (0, 3)
    assert len(ordered(seen, order="spread", min_angle_deg=0.0)) == math.comb(count, 3)
    assert is_well_shaped(*np.empty((3, 0)), 1.0, 0.1).shape == (0,)


# --- Crowded frames


def test_every_centroid_of_a_crowded_frame_has_its_turn():
    seen = frame(120, 4)
    found = select_triangles(seen)
    # Every triangle has one turn, the turn of its owner: after 120 turns nearly all were in one.
    assert len(set(found[:120].ravel().tolist())) > 100
    before = ordered(seen, order="compact")
    assert set(before.ravel().tolist()) == set(range(32))
    assert len({tuple(row) for row in found.tolist()}) == len(found)
    assert (np.diff(found, axis=1) > 0).all()


def test_triangles_of_a_crowded_frame_are_of_near_centroids():
    seen = frame(80, 5)
    for row in select_triangles(seen).tolist():
        apart = seen.separation_rad[np.ix_(row, row)]
        nearer = [(seen.separation_rad[star] < apart[n].max()).sum() for n, star in enumerate(row)]
        assert min(nearer) <= 21


@pytest.mark.parametrize(("count", "magnitudes"), [(32, False), (60, True)])
def test_other_frames_are_as_they_were(count, magnitudes):
    seen = frame(count, 6, magnitudes)
    order = "brightness" if magnitudes else "compact"
    assert select_triangles(seen).tolist() == ordered(seen, order=order).tolist()
