"""Proper motion and FK5 against ERFA (the IAU's SOFA)."""

from __future__ import annotations

import erfa
import numpy as np
import pytest

from starcat.catalog.archives.sao import icrs_from_fk5
from starcat.catalog.stars.proper_motion import Motion, propagate
from starcat.geometry.sphere import directions_from_radec, radec_from_directions, separation

ARCSEC = np.pi / (180.0 * 3600.0)
MAS = 1e-3 * ARCSEC

# A thousandth of the error of the best star of the best catalog; measured 4e-10 arcsec.
POSITION_TOLERANCE_RAD = 1e-6 * ARCSEC
# The same in a year; measured 4e-10 mas/yr, near a pole, because ERFA divides by cos(dec).
MOTION_TOLERANCE_MAS_YR = 1e-6

# Straight-line motion has no light time and no relativity. A near and so a slow star has hardly
# any, and ERFA does not put a parallax of its own in place of one that makes a star too fast.
PARALLAX_ARCSEC = 1000.0

EPOCHS_JYEAR = [(first, second) for first in (1991.25, 2000.0, 2016.0) for second in (1900.0, 2100)]


def sample(kind: str, count: int = 300) -> Motion:
    generator = np.random.default_rng(11)
    u = generator.normal(size=(count, 3))
    ra_deg, dec_deg = radec_from_directions(u / np.linalg.norm(u, axis=1)[:, None])
    largest_mas_yr = 300.0
    if kind == "north pole":
        dec_deg = generator.uniform(89.0, 90.0, count)
    if kind == "south pole":
        dec_deg = generator.uniform(-90.0, -89.0, count)
    if kind == "fast":
        largest_mas_yr = 10000.0
    angle = generator.uniform(0.0, 2.0 * np.pi, count)
    speed = largest_mas_yr * generator.uniform(0.9 if kind == "fast" else 0.0, 1.0, count)
    return Motion(ra_deg, dec_deg, speed * np.cos(angle), speed * np.sin(angle))


def apart_rad(moved: Motion, ra: np.ndarray, dec: np.ndarray) -> np.ndarray:
    u = directions_from_radec(moved.ra_deg, moved.dec_deg)
    return separation(u, directions_from_radec(np.degrees(ra), np.degrees(dec)))


def for_erfa(stars: Motion) -> tuple[np.ndarray | float, ...]:
    """Positions and motions as ERFA takes them, of stars without a radial velocity."""
    ra, dec = np.radians(stars.ra_deg), np.radians(stars.dec_deg)
    pm_ra, pm_dec = stars.pm_ra_cosdec_mas_yr * MAS / np.cos(dec), stars.pm_dec_mas_yr * MAS
    return ra, dec, pm_ra, pm_dec, PARALLAX_ARCSEC, 0.0


def check_same(found: Motion, ra, dec, pm_ra, pm_dec) -> None:
    assert apart_rad(found, ra, dec).max() < POSITION_TOLERANCE_RAD
    pm_ra_cosdec = pm_ra * np.cos(dec) / MAS
    assert np.abs(found.pm_ra_cosdec_mas_yr - pm_ra_cosdec).max() < MOTION_TOLERANCE_MAS_YR
    assert np.abs(found.pm_dec_mas_yr - pm_dec / MAS).max() < MOTION_TOLERANCE_MAS_YR


@pytest.mark.parametrize("kind", ["anywhere", "north pole", "south pole", "fast"])
@pytest.mark.parametrize(("first", "second"), EPOCHS_JYEAR)
def test_propagation_is_that_of_erfa(kind, first, second):
    start = sample(kind)
    times = (*erfa.epj2jd(first), *erfa.epj2jd(second))
    moved = propagate(start, second - first)
    check_same(moved, *erfa.pmsafe(*for_erfa(start), *times)[:4])


@pytest.mark.parametrize("kind", ["anywhere", "north pole", "south pole", "fast"])
def test_fk5_to_icrs_is_that_of_erfa(kind):
    fk5 = sample(kind)
    check_same(Motion(*icrs_from_fk5(*vars(fk5).values())), *erfa.fk52h(*for_erfa(fk5))[:4])


def test_fk5_to_icrs_keeps_unknown_motions_unknown():
    none = np.array([np.nan])
    ra_deg, dec_deg, pm_ra, pm_dec = icrs_from_fk5(np.array([10.0]), np.array([20.0]), none, none)
    assert np.isfinite([ra_deg[0], dec_deg[0]]).all()
    assert np.isnan([pm_ra[0], pm_dec[0]]).all()
