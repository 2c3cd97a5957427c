"""Sphere: separations keep their digits at every angle, poles are places, spirals are even."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from starcat.geometry.attitude import random_attitudes
from starcat.geometry.proximity import nearest_neighbours
from starcat.geometry.sphere import (
    chord_from_separation,
    directions_from_radec,
    radec_from_directions,
    saff_kuijlaars,
    separation,
    tangent_axes,
)

# A component of a direction is rounded to 1.1e-16; a few of them add up to this.
ROUNDING_RAD = 1e-15

ra_degs = st.floats(0.0, 360.0, exclude_max=True)
dec_degs = st.floats(-90.0, 90.0)
positions = st.tuples(ra_degs, dec_degs)


def direction(position: tuple[float, float]) -> np.ndarray:
    return directions_from_radec(*position)


@given(positions)
def test_identical_directions_are_zero_and_antipodes_pi_apart(position):
    u = direction(position)
    assert separation(u, u) == 0.0
    assert separation(u, -u) == np.pi


@pytest.mark.parametrize("angle_rad", [1e-12, 1e-9, 1e-6, 1e-3, 1.0, 3.0, np.pi - 1e-9])
@pytest.mark.parametrize("position", [(10.0, 20.0), (0.0, 90.0), (359.9, -89.9)])
def test_separation_is_right_at_small_and_large_angles(position, angle_rad):
    u = direction(position)
    east, _ = tangent_axes(*position)
    v = u * np.cos(angle_rad) + east * np.sin(angle_rad)
    assert separation(u, v) == pytest.approx(angle_rad, rel=0.0, abs=ROUNDING_RAD)


@given(positions, positions, positions, st.integers(0, 2**32 - 1))
def test_separation_is_a_metric_that_rotations_do_not_change(a, b, c, seed):
    u, v, w = direction(a), direction(b), direction(c)
    assert separation(u, v) == separation(v, u)
    assert separation(u, w) <= separation(u, v) + separation(v, w) + ROUNDING_RAD
    matrix = random_attitudes(1, np.random.default_rng(seed))[0]
    turned = separation(matrix @ u, matrix @ v)
    assert turned == pytest.approx(separation(u, v), rel=0.0, abs=2 * ROUNDING_RAD)


@given(st.floats(0.0, np.pi))
def test_chord_spans_its_separation(angle_rad):
    v = np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0])
    length = np.linalg.norm(v - [1.0, 0.0, 0.0])
    assert chord_from_separation(angle_rad) == pytest.approx(length, rel=0.0, abs=ROUNDING_RAD)
    # Impossible separations are held at the end.
    assert [chord_from_separation(angle) for angle in (-1.0, 4.0)] == [0.0, 2.0]


@given(positions)
def test_radec_round_trip(position):
    ra_deg, dec_deg = radec_from_directions(direction(position))
    assert 0.0 <= ra_deg < 360.0
    assert separation(direction((ra_deg, dec_deg)), direction(position)) < ROUNDING_RAD
    assert dec_deg == pytest.approx(position[1], rel=0.0, abs=np.degrees(ROUNDING_RAD))


def test_the_poles_are_exact_and_right_ascension_360_is_0():
    for dec_deg in (-90.0, 90.0):
        assert radec_from_directions(directions_from_radec(123.0, dec_deg))[1] == dec_deg
        assert radec_from_directions([0.0, 0.0, np.sign(dec_deg)])[1] == dec_deg
    ra_deg, _ = radec_from_directions([[1.0, -1e-20, 0.0], [1.0, -0.0, 0.0], [1.0, 0.0, 0.0]])
    assert ra_deg.tolist() == [0.0, 0.0, 0.0]


@given(positions)
def test_east_north_and_the_direction_are_a_right_handed_triad(position):
    east, north = tangent_axes(*position)
    triad = np.array([east, north, direction(position)])
    assert np.abs(triad @ triad.T - np.eye(3)).max() < ROUNDING_RAD
    assert np.linalg.det(triad) == pytest.approx(1.0)
    at_the_poles = tangent_axes([0.0, 90.0, 0.0], [90.0, 90.0, -90.0])
    expected = [[[0, 1, 0], [-1, 0, 0], [0, 1, 0]], [[-1, 0, 0], [0, -1, 0], [1, 0, 0]]]
    assert np.abs(np.subtract(at_the_poles, expected)).max() < ROUNDING_RAD


def spiral_by_the_formula(count: int) -> list[tuple[float, float, float]]:
    points = []
    phi = 0.0
    for k in range(1, count + 1):
        h = -1.0 + 2.0 * (k - 1) / (count - 1) if count > 1 else -1.0
        if k in (1, count):
            phi = 0.0
        else:
            phi = (phi + 3.6 / np.sqrt(count * (1.0 - h * h))) % (2.0 * np.pi)
        theta = np.arccos(h)
        points.append((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), h))
    return points


@pytest.mark.parametrize("count", [1, 2, 3, 10, 100, 10000])
def test_spiral_points_are_those_of_the_formula(count):
    points = saff_kuijlaars(count)
    assert points.shape == (count, 3)
    # The phase is a sum of up to 10000 terms, each rounded.
    assert separation(points, spiral_by_the_formula(count)).max() < 1e-11


@pytest.mark.parametrize("count", [100, 1000, 10000])
def test_spiral_points_keep_their_distance(count):
    nearest, _ = nearest_neighbours(saff_kuijlaars(count))
    share = nearest / np.sqrt(4.0 * np.pi / count)
    # Measured: 0.56 next to the poles, 0.8 for the next, 0.9 to 1.04 for the others.
    assert share.min() > 0.5
    assert share.max() < 1.1
    assert np.median(share) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("count", [0, -1])
def test_spiral_of_no_points_is_refused(count):
    with pytest.raises(ValueError, match=f"count is {count}"):
        saff_kuijlaars(count)
