"""Proper motion: straight lines, poles without trouble, and stars that do not move."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from starcat.catalog.stars.proper_motion import (
    MAS,
    Motion,
    central_error,
    propagate,
    propagate_directions,
)
from starcat.geometry.sphere import directions_from_radec, separation

# Directions are rounded to 1e-16, so a position is good to 1e-10 arcsec after a few steps.
ROUNDING_RAD = 1e-15


def motion(*rows: tuple[float, float, float, float]) -> Motion:
    return Motion(*np.array(rows, dtype=float).T)


def directions(moved: Motion) -> np.ndarray:
    return directions_from_radec(moved.ra_deg, moved.dec_deg)


stars = st.tuples(
    st.floats(0.0, 360.0, exclude_max=True),
    st.one_of(st.floats(-90.0, 90.0), st.sampled_from([-90.0, 90.0, 89.9999, -89.9999])),
    st.floats(-10000.0, 10000.0),
    st.floats(-10000.0, 10000.0),
)
spans = st.floats(-150.0, 150.0)


@given(stars, spans)
def test_directions_are_those_of_the_positions(star, years):
    moved, u = propagate_directions(motion(star), years)
    assert separation(u, directions(moved)).max() < ROUNDING_RAD
    assert np.abs(np.linalg.norm(u, axis=1) - 1.0).max() < ROUNDING_RAD
    assert 0.0 <= moved.ra_deg[0] < 360.0
    assert -90.0 <= moved.dec_deg[0] <= 90.0


@pytest.mark.parametrize("dec_deg", [90.0, -90.0, 89.99999])
def test_a_star_crosses_the_pole(dec_deg):
    towards = -3600.0 if dec_deg < 0.0 else 3600.0
    moved = propagate(motion((20.0, dec_deg, 0.0, towards)), 100.0)
    assert moved.ra_deg[0] == pytest.approx(200.0, abs=1e-6)
    past_deg = abs(dec_deg) + 0.1 - 90.0
    assert abs(moved.dec_deg[0]) == pytest.approx(90.0 - past_deg, abs=1e-6)
    assert moved.pm_dec_mas_yr[0] == pytest.approx(-towards, rel=1e-5)


NO_MOTION = [
    (10.1, 20.2, np.nan, np.nan),
    (359.99999999999994, -89.99999, 0.0, 0.0),
    (0.1, 90.0, np.nan, 5.0),
    (12.3, -45.6, 7.0, np.nan),
    (77.7, 0.3, -0.0, 0.0),
]


def test_a_star_without_proper_motion_stays_to_the_last_bit():
    start = motion(*NO_MOTION)
    moved = propagate(start, 57.3)
    assert moved.ra_deg.tobytes() == start.ra_deg.tobytes()
    assert moved.dec_deg.tobytes() == start.dec_deg.tobytes()
    for name in ("pm_ra_cosdec_mas_yr", "pm_dec_mas_yr"):
        assert np.array_equal(getattr(moved, name), getattr(start, name), equal_nan=True)


def test_each_star_has_its_own_span_and_motion():
    star, unknown = (50.0, 60.0, 100.0, -200.0), (1.0, 2.0, np.nan, np.nan)
    years = [0.0, 10.0, -25.0, 26.0]
    moved = propagate(motion(star, star, star, unknown), np.array(years))
    for row, span in enumerate(years[:3]):
        assert moved.ra_deg[row] == propagate(motion(star), span).ra_deg[0]
    none, u = propagate_directions(Motion(*(np.empty(0) for _ in range(4))), 10.0)
    assert (none.ra_deg.shape, u.shape) == ((0,), (0, 3))


def test_a_star_that_ends_exactly_at_the_pole():
    # cos(90 deg) is 6e-17 in float64; this proper motion takes away just that in a year.
    # A division that leaves such stars out must say what it leaves in their place.
    left = np.cos(np.radians(90.0)) / MAS
    start = Motion(np.zeros(1), np.full(1, 90.0), np.zeros(1), np.full(1, left))
    end, u = propagate_directions(start, 1.0)
    assert u.tolist() == [[0.0, 0.0, 1.0]]
    assert end.dec_deg.tolist() == [90.0]
    assert end.pm_ra_cosdec_mas_yr.tolist() == [0.0]
    np.testing.assert_allclose(end.pm_dec_mas_yr, left, rtol=1e-12)


@given(st.floats(0.1, 100.0), st.floats(0.1, 10.0), st.floats(-0.99, 0.99), st.floats(-60.0, 60.0))
def test_errors_of_a_centre_are_those_of_the_covariance(error, pm_error, correlation, years):
    covariance = correlation * error * pm_error
    expected = error**2 + 2.0 * years * covariance + (years * pm_error) ** 2
    smallest, centre = central_error(*np.array([[error], [pm_error], [correlation]]), 1991.25)
    since = 1991.25 + years - centre
    assert smallest**2 + (since * pm_error) ** 2 == pytest.approx([expected], rel=1e-6)


def test_an_error_without_its_correlation_stays_at_its_epoch():
    error, centre = central_error(np.array([2.0]), np.array([1.0]), np.array([np.nan]), 1991.25)
    assert (error[0], centre[0]) == (2.0, 1991.25)
