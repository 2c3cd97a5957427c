"""Ways: the numbers of assignments are those of an enumeration, and never above the bound."""

from __future__ import annotations

import math
from itertools import combinations, permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from starcat.matcher.chance import log_assignments, log_compatible_assignments
from starcat.matcher.observation import compatible_pairs

GRAPHS = arrays(bool, array_shapes(min_dims=2, max_dims=2, max_side=6))


def matchings(compatible: np.ndarray, n: int) -> int:
    """Count the ways to assign n rows to n columns that they are joined to, one by one."""
    count, stars = compatible.shape
    return sum(
        all(compatible[row, column] for row, column in zip(rows, columns, strict=True))
        for rows in combinations(range(count), n)
        for columns in permutations(range(stars), n)
    )


def bounds_by_hand(compatible: np.ndarray, n: int) -> list[float]:
    """Return the five bounds as sums of products over all choices."""
    bounds = [float(math.comb(len(compatible), n) * math.perm(compatible.shape[1], n))]
    for graph in (compatible, compatible.T):
        others = graph.shape[1]
        degrees = graph.sum(axis=1).tolist()
        roots = [math.factorial(c) ** (1.0 / c) if c else 0.0 for c in degrees]
        bounds.append(sum(math.prod(chosen) for chosen in combinations(degrees, n)))
        filled = math.factorial(others) ** ((others - n) / others) / math.factorial(others - n)
        bounds.append(filled * sum(math.prod(chosen) for chosen in combinations(roots, n)))
    return bounds


@given(GRAPHS)
def test_the_bound_is_the_least_of_five_and_above_the_number_of_matchings(compatible):
    most = min(compatible.shape)
    found = np.exp(log_compatible_assignments(most, compatible))
    for n in range(most + 1):
        number, bounds = matchings(compatible, n), bounds_by_hand(compatible, n)
        assert all(number <= bound * (1.0 + 1e-12) for bound in bounds)
        assert found[n] == pytest.approx(min(bounds), rel=1e-12, abs=1e-300)
        if number == math.comb(len(compatible), n) * math.perm(compatible.shape[1], n):
            assert found[n] == pytest.approx(number, rel=1e-12)


@given(GRAPHS)
def test_centroids_and_stars_may_change_places(compatible):
    most = min(compatible.shape)
    one, other = (np.exp(log_compatible_assignments(most, g)) for g in (compatible, compatible.T))
    np.testing.assert_allclose(one, other, rtol=1e-12)


@pytest.mark.parametrize("sizes", [(2, 2), (3, 2), (1, 1, 1), (4, 3, 2)])
def test_groups_that_keep_to_themselves_are_counted_exactly(sizes):
    count = sum(sizes)
    group = np.repeat(np.arange(len(sizes)), sizes)
    found = log_compatible_assignments(count, group[:, None] == group)[count]
    assert math.exp(found) == pytest.approx(math.prod(map(math.factorial, sizes)), rel=1e-12)


def test_one_centroid_without_a_star_leaves_no_way_for_all():
    compatible = np.ones((4, 6), dtype=bool)
    compatible[2] = False
    found = log_compatible_assignments(4, compatible)
    assert found[4] == -np.inf
    assert math.exp(found[3]) == pytest.approx(math.perm(6, 3))


@pytest.mark.parametrize(("count", "stars"), [(900, 1100), (64, 2000)])
def test_large_numbers_do_not_overflow(count, stars):
    found = log_compatible_assignments(count, np.ones((count, stars), dtype=bool))
    assert found[-1] == pytest.approx(log_assignments(count, count, stars), rel=1e-12)
    assert np.isfinite(found).all()


@given(st.integers(0, 9), st.integers(0, 9), st.integers(0, 9))
def test_the_number_without_magnitudes(n, more, others):
    found = math.exp(log_assignments(n, n + more, n + others))
    assert found == pytest.approx(math.comb(n + more, n) * math.perm(n + others, n), rel=1e-11)


def test_magnitudes_are_compatible_within_a_closed_interval():
    # All numbers are exact: 3.5 x 0.5 = 1.75.
    mag, stars = np.array([4.0, np.nan]), np.array([2.25, 2.0, 5.75, 6.0, np.nan])
    found = compatible_pairs(mag, stars, 0.5)
    assert found.tolist() == [[True, False, True, False, True], [True] * 5]
