"""K-vector: it finds the same as a plain comparison, for all values and intervals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, example, given
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
def values_and_ends(draw) -> tuple[np.ndarray, list[float]]:
    values = draw(sorted_values())
    anything = st.floats(allow_nan=True, allow_infinity=True)
    end = anything
    if len(values):
        on_a_value = st.sampled_from(values.tolist())
        beside = st.builds(np.nextafter, on_a_value, st.sampled_from([-np.inf, np.inf]))
        between = st.floats(values[0], values[-1])
        end = st.one_of(on_a_value, beside.map(float), between, anything)
    return values, [draw(end) for _ in range(2)]


def brute_force(values: np.ndarray, low: float, high: float) -> list[int]:
    return np.flatnonzero((values >= low) & (values <= high)).tolist()


def rows(found: slice) -> list[int]:
    return list(range(found.start, found.stop))


SIX = np.array([1.0, 1.5, 2.0, 2.0, 3.0, 5.0])


@given(values_and_ends())
@example((np.empty(0), [0.0, 1.0]))
@example((np.array([5.0]), [5.0, 5.0]))
@example((np.array([5.0]), [6.0, 7.0]))
@example((np.full(3, 3.0), [3.0, 3.0]))
@example((np.full(3, 3.0), [2.0, 2.9]))
@example((np.zeros(3), [-1.0, 1.0]))
@example((SIX, [1.1, 1.4]))
@example((SIX, [2.0, 2.0]))
@example((SIX, [3.0, 2.0]))
@example((SIX, [5.1, np.inf]))
@example((SIX, [-np.inf, np.inf]))
@example((SIX, [-1e300, 1e300]))
@example((SIX, [np.nan, 3.0]))
@example((SIX, [0.0, np.nan]))
def test_exact_is_brute_force_and_range_has_little_more(case):
    values, ends = case
    index, expected = build_kvector(values), brute_force(values, *ends)
    for low, high in (ends, np.array(ends)):
        with np.errstate(over="ignore"):  # of the quotient of a number of numpy
            assert rows(index.exact(low, high)) == expected
            found = rows(index.range(low, high))
        assert set(expected) <= set(found)
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


NAN, INF = np.nan, np.inf


@pytest.mark.parametrize(
    "values", [[2, 1], [1, 2, 1.5, 3], [NAN], [1, NAN, 2], [1, INF], [-INF, 1], [[1, 2]]], ids=str
)
def test_what_is_not_a_sorted_array_is_refused(values):
    with pytest.raises(ValueError, match="values"):
        build_kvector(np.array(values, dtype=float))


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
