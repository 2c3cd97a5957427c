"""K-vector: it finds the same as a plain comparison, for all values and intervals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from starcat.geometry.kvector import build_kvector

MAX_STEPS_BEYOND = 1.0
"""How far beyond an end of the interval ``range`` may reach, in steps of the line."""


@st.composite
def sorted_values(draw) -> np.ndarray:
    # Small integers times a scale give duplicates and ties; free floats give gaps of all sizes.
    scale = draw(st.sampled_from([5e-324, 1e-300, 1e-9, 1.0, 1e9, 1e300]))
    offset = draw(st.sampled_from([0.0, 0.0, 1.0, 1e16]))
    free = st.floats(-1e6, 1e6, allow_nan=False)
    one = draw(
        st.sampled_from([st.integers(-3, 3).map(float), st.integers(0, 60).map(float), free])
    )
    return np.sort(np.array(draw(st.lists(one, max_size=40)), dtype=float) * scale + offset)


@st.composite
def values_and_ends(draw, count: int = 2) -> tuple[np.ndarray, list[float]]:
    values = draw(sorted_values())
    anything = st.floats(allow_nan=True, allow_infinity=True)
    end = anything
    if len(values):
        on_a_value = st.sampled_from(values.tolist())
        beside = st.builds(np.nextafter, on_a_value, st.sampled_from([-np.inf, np.inf]))
        between = st.floats(values[0], values[-1])
        end = st.one_of(on_a_value, beside.map(float), between, anything)
    return values, [draw(end) for _ in range(count)]


def brute_force(values: np.ndarray, low: float, high: float) -> list[int]:
    return np.flatnonzero((values >= low) & (values <= high)).tolist()


def rows(found: slice) -> list[int]:
    return list(range(found.start, found.stop))


@given(values_and_ends())
def test_exact_is_brute_force(case):
    values, (low, high) = case
    assert rows(build_kvector(values).exact(low, high)) == brute_force(values, low, high)


@given(values_and_ends())
def test_range_holds_all_and_little_more(case):
    values, (low, high) = case
    index = build_kvector(values)
    found = rows(index.range(low, high))
    assert set(brute_force(values, low, high)) <= set(found)
    if found and index.slope:
        # The line itself is rounded: half a unit in the last place of the largest value.
        slack = MAX_STEPS_BEYOND * index.slope + np.spacing(np.abs(values).max())
        assert low - values[found[0]] <= slack
        assert values[found[-1]] - high <= slack


@pytest.mark.parametrize("power", [0.3, 1.0, 3.0])
def test_range_of_many_values_is_a_few_more_than_asked(power):
    generator = np.random.default_rng(3)
    values = np.sort(generator.random(20000) ** power)
    index = build_kvector(values)
    for low in generator.random(200):
        high = low + 0.01
        found = values[index.range(low, high)]
        wide = MAX_STEPS_BEYOND * index.slope * (1.0 + 1e-9)
        assert brute_force(values, low, high) == rows(index.exact(low, high))
        assert len(found) <= len(brute_force(values, low - wide, high + wide))


@given(values_and_ends(count=3))
def test_adjacent_intervals_partition_the_values(case):
    values, ends = case
    assume(not np.isnan(ends).any())
    low, middle, high = sorted(ends)
    assume(middle < high)
    index = build_kvector(values)
    left = rows(index.exact(low, middle))
    right = rows(index.exact(float(np.nextafter(middle, np.inf)), high))
    assert left + right == rows(index.exact(low, high))


@pytest.mark.parametrize(
    ("values", "interval", "expected"),
    [
        ([], (0.0, 1.0), []),
        ([5.0], (5.0, 5.0), [0]),
        ([5.0], (6.0, 7.0), []),
        ([1.0, 2.0], (1.0, 2.0), [0, 1]),
        ([1.0, 2.0], (1.1, 1.9), []),
        ([3.0, 3.0, 3.0], (3.0, 3.0), [0, 1, 2]),
        ([3.0, 3.0, 3.0], (2.0, 2.9), []),
        ([0.0, 0.0, 0.0], (-1.0, 1.0), [0, 1, 2]),
        ([1.0, 2.0, 3.0], (2.0, 1.0), []),
        ([1.0, 2.0, 3.0], (-np.inf, np.inf), [0, 1, 2]),
        ([1.0, 2.0, 3.0], (np.nan, 3.0), []),
        ([1.0, 2.0, 3.0], (1.0, np.nan), []),
        ([1.0, 2.0, 2.0, 3.0], (2.0, 2.0), [1, 2]),
    ],
)
def test_ends_are_closed_and_empty_answers_are_empty(values, interval, expected):
    index = build_kvector(np.array(values, dtype=float))
    assert rows(index.exact(*interval)) == expected


NAN, INF = np.nan, np.inf


@pytest.mark.parametrize(
    "values", [[2, 1], [1, 2, 1.5, 3], [NAN], [1, NAN, 2], [1, INF], [-INF, 1], [[1, 2]]], ids=str
)
def test_what_is_not_a_sorted_array_is_refused(values):
    with pytest.raises(ValueError, match="values"):
        build_kvector(np.array(values, dtype=float))


def test_counts_never_fall_and_end_with_all():
    index = build_kvector(np.sort(np.random.default_rng(4).random(500)))
    assert index.counts.dtype == np.int32
    assert index.counts[0] == 0
    assert index.counts[-1] == 500
    assert (np.diff(index.counts) >= 0).all()


@pytest.mark.parametrize(
    ("interval", "expected"),
    [
        ((-np.inf, np.inf), range(6)),
        ((-np.inf, 1.0), range(1)),
        ((5.0, np.inf), range(5, 6)),
        ((np.inf, np.inf), []),
        ((-np.inf, -np.inf), []),
        ((np.inf, -np.inf), []),
        ((-np.inf, 0.9), []),
        ((5.1, np.inf), []),
        ((-1e300, 1e300), range(6)),
        ((np.nan, np.nan), []),
        ((np.nan, 3.0), []),
        ((0.0, np.nan), []),
        ((3.0, 2.0), []),
    ],
)
def test_range_by_hand(interval, expected):
    index = build_kvector(np.array([1.0, 1.5, 2.0, 2.0, 3.0, 5.0]))
    for low, high in (interval, tuple(np.float64(interval))):
        found = rows(index.range(low, high))
        assert set(expected) <= set(found)
        # A step of the line is 0.8; the values are at most two to a step.
        assert len(found) <= len(expected) + (4 if len(expected) else 0)


@given(values_and_ends(), st.booleans())
def test_narrow_values_are_found_by_wide_ends(case, swap):
    # The triangles' areas are kept as float32; their line and the ends are float64.
    values, ends = case
    assume(np.abs(values).max(initial=0.0) < 1e38)
    narrow = np.sort(values.astype(np.float32))
    wide = build_kvector(narrow.astype(np.float64))
    index = replace(wide, values=narrow)
    low, high = sorted(ends) if swap and not np.isnan(ends).any() else ends
    assume(not max(abs(low), abs(high)) > 3e38)
    expected = brute_force(narrow.astype(np.float64), low, high)
    assert set(expected) <= set(rows(index.range(low, high)))
    assert rows(index.exact(low, high)) == expected
