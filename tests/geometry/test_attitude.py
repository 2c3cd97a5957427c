"""Attitudes: quaternion, matrix and angles say the same, and mean what the manual says."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from starcat.geometry import attitude
from starcat.geometry.attitude import (
    matrix_from_quaternion,
    matrix_from_radec_roll,
    quaternion_from_matrix,
    random_attitudes,
    solve_wahba_svd,
)
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import directions_from_radec, separation

# Components are rounded to 1.1e-16, and a handful of products add up.
ROUNDING = 4e-15

ARCSEC = np.pi / (180.0 * 3600.0)


@st.composite
def quaternions(draw) -> np.ndarray:
    # Zeros and tiny components are where a careless formula divides by nothing.
    part = st.one_of(st.sampled_from([0.0, 1.0, -1.0, 1e-9, -1e-9]), st.floats(-1.0, 1.0))
    q = np.array([draw(part) for _ in range(4)])
    if np.linalg.norm(q) < 1e-8:
        q[draw(st.integers(0, 3))] = 1.0
    return q / np.linalg.norm(q)


angles = st.tuples(
    st.floats(0.0, 360.0, exclude_max=True),
    st.one_of(
        st.floats(-90.0, 90.0),
        st.sampled_from([-90.0, 90.0, -89.9999999, 89.9999999, 89.999999999999]),
    ),
    st.floats(0.0, 360.0, exclude_max=True),
)


@given(quaternions())
@example(np.array([1.0, 0.0, 0.0, 0.0]))
@example(np.array([0.0, -0.6, 0.8, -0.0]))
@example(np.array([0.0, 0.0, -1.0, 1e-17]))
def test_matrices_and_quaternions_are_those_of_scipy(q):
    matrix = matrix_from_quaternion(q)
    assert np.abs(matrix_from_quaternion(7.0 * q) - matrix).max() < ROUNDING
    # scipy turns a vector; this turns the axes under it, which is the inverse.
    assert np.abs(matrix - Rotation.from_quat(q).inv().as_matrix()).max() < ROUNDING
    expected = Rotation.from_matrix(matrix).inv().as_quat(canonical=True)
    found = quaternion_from_matrix(matrix)
    assert min(np.abs(found - expected).max(), np.abs(found + expected).max()) < ROUNDING
    # The sign of w is plus, even of zero.
    for w in (found[3], quaternion_from_matrix(matrix_from_quaternion(-q))[3]):
        assert math.copysign(1.0, w) == 1.0


@pytest.mark.parametrize("zero", [0.0, -0.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turns_about_the_axes(axis, zero):
    matrix = np.full((3, 3), zero)
    np.fill_diagonal(matrix, -1.0)
    matrix[axis, axis] = 1.0
    q = quaternion_from_matrix(matrix)
    assert np.abs(q).tolist() == [float(n == axis) for n in range(4)]
    assert math.copysign(1.0, q[3]) == 1.0


@given(angles)
@example((-1e-14, 0.0, -1e-14))
@example((1e-14, 0.0, 1e-14))
@example((359.9999999999999, 0.0, 359.9999999999999))
def test_angles_make_a_rotation_about_the_boresight_and_come_back(given_angles):
    matrix = matrix_from_radec_roll(*given_angles)
    assert np.abs(matrix @ matrix.T - np.eye(3)).max() < ROUNDING
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    assert separation(matrix[2], directions_from_radec(*given_angles[:2])) < ROUNDING
    back = attitude.radec_roll_from_matrix(matrix)
    # Near a pole right ascension and roll are only defined together, so the matrices compare.
    assert np.abs(matrix_from_radec_roll(*back) - matrix).max() < ROUNDING
    assert 0.0 <= back[0] < 360.0
    assert -90.0 <= back[1] <= 90.0
    assert 0.0 <= back[2] < 360.0


@pytest.mark.parametrize("pole", [1.0, -1.0], ids=["north", "south"])
@pytest.mark.parametrize("turn_deg", [0.0, 16.0, 90.0, 180.0, 300.0])
@pytest.mark.parametrize("zeros", [(0.0, 0.0), (0.0, -0.0)])
def test_at_the_pole_itself_the_right_ascension_is_0(pole, turn_deg, zeros):
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    matrix = np.array([[c, s, 0.0], [-s * pole, c * pole, 0.0], [*zeros, pole]])
    ra_deg, dec_deg, roll_deg = attitude.radec_roll_from_matrix(matrix)
    assert (ra_deg, dec_deg) == (0.0, 90.0 * pole)
    assert np.abs(matrix_from_radec_roll(ra_deg, dec_deg, roll_deg) - matrix).max() < ROUNDING
    # A quaternion with these zeros makes a boresight of [-0, 0, 1].
    matrix = matrix_from_quaternion(np.array([0.0, -0.0, -0.6, 0.8]))
    angles = attitude.radec_roll_from_matrix(matrix)
    assert angles[0] == 0.0
    assert np.abs(matrix_from_radec_roll(*angles) - matrix).max() < ROUNDING


@pytest.mark.parametrize("ra_deg", [0.0, 123.0, 300.0])
@pytest.mark.parametrize("dec_deg", [-90.0, 90.0])
def test_next_to_the_pole_each_angle_comes_back(ra_deg, dec_deg):
    # The cosine of 90 deg in radians is 6e-17, not 0: enough to carry the right ascension.
    back = attitude.radec_roll_from_matrix(matrix_from_radec_roll(ra_deg, dec_deg, 17.0))
    assert back == pytest.approx((ra_deg, dec_deg, 17.0), abs=1e-12)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("noise", [0.0, 30 * ARCSEC, 0.3])
@pytest.mark.parametrize("radius_rad", [None, 0.1, 0.005])
def test_wahba_agrees_with_scipy(noise, weighted, radius_rad, random_directions):
    generator = np.random.default_rng(8)
    half_turns = [np.diag(2.0 * axis - 1.0) for axis in np.eye(3)]
    for seed, matrix in enumerate([*random_attitudes(20, generator), *half_turns]):
        icrs = random_directions(6, seed) if radius_rad is None else field(6, seed, radius_rad)
        body = icrs @ matrix.T + generator.normal(scale=noise, size=icrs.shape)
        weights = generator.uniform(0.1, 5.0, 6) if weighted else None
        expected = Rotation.align_vectors(body, icrs, weights=weights)[0].as_matrix()
        found = solve_wahba_svd(body, icrs, weights)
        assert np.abs(found - expected).max() < 1e-9
        if noise == 0.0 and radius_rad is None:
            assert np.abs(found - matrix).max() < 1e-12


def test_a_weight_of_zero_leaves_a_star_out(random_directions):
    icrs = random_directions(5, 3)
    matrix = matrix_from_radec_roll(10.0, 20.0, 30.0)
    body = icrs @ matrix.T
    body[4] = -body[4]
    found = solve_wahba_svd(body, icrs, np.array([1.0, 1.0, 1.0, 1.0, 0.0]))
    assert np.abs(found - matrix).max() < 1e-12


@pytest.mark.parametrize("kind", ["noise only", "coplanar", "two", "mirrored"])
def test_wahba_always_gives_a_proper_rotation_of_many_problems_at_once_too(kind, random_directions):
    generator, problems = np.random.default_rng(9), []
    for seed in range(30):
        icrs = random_directions(2 if kind == "two" else 5, seed)
        body = random_directions(len(icrs), seed + 100)
        if kind == "coplanar":
            icrs[:, 2] = 0.0
            turned = random_attitudes(1, generator)[0]
            body = icrs @ turned.T + generator.normal(scale=1e-5, size=icrs.shape)
        if kind == "mirrored":
            body = icrs * [-1.0, 1.0, 1.0]
        problems.append((body, icrs))
    together = solve_wahba_svd(*map(np.stack, zip(*problems, strict=True)))
    assert together.shape == (30, 3, 3)
    for problem, one in zip(problems, together, strict=True):
        found = solve_wahba_svd(*problem)
        assert np.linalg.det(found) == pytest.approx(1.0)
        assert np.abs(found @ found.T - np.eye(3)).max() < ROUNDING
        assert np.abs(one - found).max() < 1e-12


def field(count: int, seed: int, radius_rad: float = 0.1) -> np.ndarray:
    """Return directions within a field of view somewhere on the sky."""
    generator = np.random.default_rng(seed)
    offset = generator.uniform(-1.0, 1.0, (count, 2)) * radius_rad
    near = np.column_stack([offset, np.ones(count)]) @ random_attitudes(1, generator)[0]
    return near / np.linalg.norm(near, axis=1)[:, None]


def test_no_attitudes():
    assert solve_wahba_svd(np.empty((0, 3, 3)), np.empty((0, 3, 3))).shape == (0, 3, 3)
    assert random_attitudes(0, np.random.default_rng(0)).shape == (0, 3, 3)


def test_random_attitudes_are_rotations_spread_evenly():
    matrices = random_attitudes(4000, np.random.default_rng(10))
    assert np.allclose(np.linalg.det(matrices), 1.0)
    # Each element of a uniform rotation has mean 0 and variance 1/3; five sigma of 4000.
    assert np.abs(matrices.mean(axis=0)).max() < 5.0 * np.sqrt(1.0 / 3.0 / 4000)
    assert np.abs((matrices**2).mean(axis=0) - 1.0 / 3.0).max() < 5.0 * np.sqrt(4.0 / 45.0 / 4000)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-12, 1e-3, 2.0, 3.1])
def test_a_turn_is_what_leads_from_one_attitude_to_another(angle_rad):
    generator = np.random.default_rng(6)
    for matrix in random_attitudes(20, generator):
        q = quaternion_from_matrix(matrix).tolist()
        x, y, z = generator.normal(size=3)
        scale = angle_rad / math.hypot(x, y, z)
        turn = x * scale, y * scale, z * scale
        there = attitude.after_turn(q, turn)
        # The negative quaternion is the same attitude.
        for same in (there, [-part for part in there]):
            found = attitude.turn_between(q, same)
            np.testing.assert_allclose(found, turn, rtol=1e-9, atol=1e-15)
        # A turn about the boresight leaves the boresight where it is.
        rolled = matrix_from_quaternion(np.array(attitude.after_turn(q, (0.0, 0.0, 0.3))))
        np.testing.assert_allclose(rolled[2], matrix[2], atol=1e-15)


ROOT = Path(__file__).parents[2]
EXAMPLE = {"q_body_from_icrs": 4, "v_icrs": 3, "v_camera": 3, "pixel": 2}
"""Lines of the worked example, and how many numbers stand in each."""


def worked_example(path: str) -> dict[str, list[str]]:
    """Return the numbers of the worked example of a document, as they are printed."""
    text = (ROOT / path).read_text(encoding="utf-8")
    lines = {}
    for name, count in EXAMPLE.items():
        [found] = re.findall(rf"^[ *]*{name}((?: +-?\d+\.\d+){{{count}}})$", text, re.MULTILINE)
        lines[name] = found.split()
    return lines


def test_the_worked_example_is_the_same_everywhere():
    """And its numbers agree with this library, its C library, and scipy."""
    example = worked_example("onboard/include/starcat.h")
    for path in ("docs/tutorial.md", "docs/python-identify.md"):
        assert worked_example(path) == example, path
        text = (ROOT / path).read_text(encoding="utf-8")
        assert "A = (w^2 - v.v) I + 2 v v^T - 2 w [v x]" in text
        assert "Rotation.from_quat(q).inv().apply(v_icrs)" in text
    test_in_c = (ROOT / "onboard" / "tests" / "test_geometry.c").read_text(encoding="utf-8")
    for numbers in example.values():  # what the C library makes of them is tested there
        assert re.search(r",\s+".join(map(re.escape, numbers)), test_in_c), numbers

    q, v_icrs, v_camera, pixel = (np.array(row, dtype=float) for row in example.values())
    printed = {"rtol": 0.0, "atol": 2e-9}
    expected = quaternion_from_matrix(matrix_from_radec_roll(100.0, -15.0, 30.0))
    np.testing.assert_allclose(q, expected, **printed)
    [sirius] = directions_from_radec(np.array([101.287155]), np.array([-16.716116]))
    np.testing.assert_allclose(v_icrs, sirius, **printed)
    x, y, z, w = q
    np.testing.assert_allclose(matrix_from_quaternion(q) @ v_icrs, v_camera, **printed)
    np.testing.assert_allclose(Rotation.from_quat(q).inv().apply(v_icrs), v_camera, **printed)
    conjugate = Rotation.from_quat([-x, -y, -z, w])
    np.testing.assert_allclose(conjugate.apply(v_icrs), v_camera, **printed)
    np.testing.assert_allclose(Rotation.from_quat(q).apply(v_camera), v_icrs, **printed)
    v = q[:3]
    cross = np.cross(v, np.eye(3)).T  # cross @ u is v x u
    formula = (w * w - v @ v) * np.eye(3) + 2.0 * np.outer(v, v) - 2.0 * w * cross
    np.testing.assert_allclose(formula, matrix_from_quaternion(q), **printed)
    seen = Camera(1280, 960, 3200.0).pixels_from_directions(v_camera[None])
    np.testing.assert_allclose(seen, [pixel], rtol=0.0, atol=2e-5)
