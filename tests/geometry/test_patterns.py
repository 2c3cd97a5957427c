"""Bins, cells, rings, sectors and shifts, against loops over single numbers."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from starcat.geometry.patterns import bin_of, cell_of, cyclic_shifts, ring_of, sector_of


@given(
    st.lists(st.tuples(st.floats(0.0, 7.0), st.floats(0.0, 0.3)), max_size=20),
    st.floats(1e-3, 8.0),
    st.floats(1e-4, 0.3),
    st.integers(1, 400),
    st.integers(1, 400),
)
def test_bins(pairs, angle_bin, separation_bin, angles, separations):
    pairs = [*pairs, (0.0, 0.0), (angle_bin, separation_bin), (7.0, 0.3)]
    angle_rad, separation_rad = np.array(pairs).T
    found = bin_of(angle_rad, separation_rad, angle_bin, separation_bin, angles, separations)
    assert found.tolist() == [
        min(math.floor(a / angle_bin), angles - 1) * separations
        + min(math.floor(s / separation_bin), separations - 1)
        for a, s in pairs
    ]


@given(
    st.lists(st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)), max_size=20),
    st.floats(0.01, 1.2),
    st.integers(1, 200),
)
def test_cells(points, radius_rad, side):
    reach = math.tan(radius_rad)
    points = [*points, (-reach, reach), (0.0, 0.0), (reach, -reach)]

    def step(value: float) -> int:
        return min(max(math.floor((value + reach) / (2.0 * reach) * side), 0), side - 1)

    x, y = np.array(points).T
    expected = [step(b) * side + step(a) for a, b in points]
    assert cell_of(x, y, radius_rad, side).tolist() == expected


@given(st.lists(st.floats(0.0, 1.5), max_size=20), st.floats(0.01, 1.2), st.integers(1, 200))
def test_rings(parts, radius_rad, rings):
    apart = [radius_rad * part for part in (*parts, 0.0, 0.5, 1.0)]
    expected = [min(math.floor(each / radius_rad * rings), rings - 1) for each in apart]
    assert ring_of(apart, radius_rad, rings).tolist() == expected


@given(st.lists(st.floats(-7.0, 7.0), max_size=20), st.integers(1, 31))
def test_sectors(turns, sectors):
    found = sector_of(np.array([*turns, 0.0, -1e-30]), sectors)
    assert ((found >= 0) & (found < sectors)).all()
    assert found[-2] == 0
    assert found[-1] == sectors - 1
    for turn, sector in zip(turns, found.tolist(), strict=False):
        middle = (sector + 0.5) * 2.0 * math.pi / sectors
        off = (turn - middle + math.pi) % (2.0 * math.pi) - math.pi
        assert abs(off) <= math.pi / sectors + 1e-12


@given(st.integers(1, 31), st.data())
def test_shifts_are_turns_of_the_bits(sectors, data):
    patterns = data.draw(st.lists(st.integers(0, 2**sectors - 1), min_size=1, max_size=5))
    found = cyclic_shifts(np.array(patterns), sectors)
    for pattern, shifts in zip(patterns, found.T.tolist(), strict=True):
        text = f"{pattern:0{sectors}b}"
        turned = {int(text[n:] + text[:n], 2) for n in range(sectors)}
        assert len(shifts) == sectors
        assert set(shifts) == turned
        assert cyclic_shifts(pattern, sectors).tolist() == shifts
