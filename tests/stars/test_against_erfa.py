"""Proper motion and FK5 against ERFA (the IAU's SOFA), and FK5 against astropy."""

from __future__ import annotations

import erfa
import numpy as np
import pytest
from astropy import units
from astropy.coordinates import FK5, SkyCoord

from starcat.catalog.archives.sao import icrs_from_fk5
from starcat.geometry.sphere import directions_from_radec, radec_from_directions, separation
from starcat.stars.proper_motion import Motion, propagate

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


@pytest.mark.parametrize("kind", ["anywhere", "north pole", "south pole", "fast"])
@pytest.mark.parametrize(("first", "second"), EPOCHS_JYEAR)
def test_propagation_is_that_of_erfa(kind, first, second):
    start = sample(kind)
    moved = propagate(start, second - first)
    ra, dec, pm_ra, pm_dec, _, _ = erfa.pmsafe(
        np.radians(start.ra_deg),
        np.radians(start.dec_deg),
        start.pm_ra_cosdec_mas_yr * MAS / np.cos(np.radians(start.dec_deg)),
        start.pm_dec_mas_yr * MAS,
        PARALLAX_ARCSEC,
        0.0,
        *erfa.epj2jd(first),
        *erfa.epj2jd(second),
    )
    assert apart_rad(moved, ra, dec).max() < POSITION_TOLERANCE_RAD
    pm_ra_cosdec = pm_ra * np.cos(dec) / MAS
    assert np.abs(moved.pm_ra_cosdec_mas_yr - pm_ra_cosdec).max() < MOTION_TOLERANCE_MAS_YR
    assert np.abs(moved.pm_dec_mas_yr - pm_dec / MAS).max() < MOTION_TOLERANCE_MAS_YR


@pytest.mark.parametrize("kind", ["anywhere", "north pole", "south pole", "fast"])
def test_fk5_to_icrs_is_that_of_erfa(kind):
    fk5 = sample(kind)
    ra_deg, dec_deg, pm_ra, pm_dec = icrs_from_fk5(
        fk5.ra_deg, fk5.dec_deg, fk5.pm_ra_cosdec_mas_yr, fk5.pm_dec_mas_yr
    )
    ra, dec, erfa_pm_ra, erfa_pm_dec, _, _ = erfa.fk52h(
        np.radians(fk5.ra_deg),
        np.radians(fk5.dec_deg),
        fk5.pm_ra_cosdec_mas_yr * MAS / np.cos(np.radians(fk5.dec_deg)),
        fk5.pm_dec_mas_yr * MAS,
        PARALLAX_ARCSEC,
        0.0,
    )
    icrs = Motion(ra_deg, dec_deg, pm_ra, pm_dec)
    assert apart_rad(icrs, ra, dec).max() < POSITION_TOLERANCE_RAD
    assert np.abs(pm_ra - erfa_pm_ra * np.cos(dec) / MAS).max() < MOTION_TOLERANCE_MAS_YR
    assert np.abs(pm_dec - erfa_pm_dec / MAS).max() < MOTION_TOLERANCE_MAS_YR


@pytest.mark.parametrize("kind", ["anywhere", "north pole", "south pole"])
def test_fk5_to_icrs_positions_are_those_of_astropy(kind):
    fk5 = sample(kind)
    sky = SkyCoord(fk5.ra_deg * units.deg, fk5.dec_deg * units.deg, frame=FK5(equinox="J2000"))
    ra_deg, dec_deg, _, _ = icrs_from_fk5(
        fk5.ra_deg, fk5.dec_deg, fk5.pm_ra_cosdec_mas_yr, fk5.pm_dec_mas_yr
    )
    icrs = Motion(ra_deg, dec_deg, fk5.pm_ra_cosdec_mas_yr, fk5.pm_dec_mas_yr)
    assert apart_rad(icrs, sky.icrs.ra.radian, sky.icrs.dec.radian).max() < POSITION_TOLERANCE_RAD


def test_fk5_to_icrs_is_a_step_of_some_20_mas():
    fk5 = sample("anywhere")
    ra_deg, dec_deg, pm_ra, pm_dec = icrs_from_fk5(
        fk5.ra_deg, fk5.dec_deg, np.zeros(300), np.zeros(300)
    )
    step = separation(
        directions_from_radec(ra_deg, dec_deg), directions_from_radec(fk5.ra_deg, fk5.dec_deg)
    )
    # The rotation is of 32 mas and the spin of 0.97 mas/yr (ESA SP-1200, vol. 3, eq. 3.4).
    assert 25 * MAS < step.max() < 32 * MAS
    assert 0.8 < np.hypot(pm_ra, pm_dec).max() < 0.98


def test_fk5_to_icrs_keeps_unknown_motions_unknown():
    none = np.array([np.nan])
    ra_deg, dec_deg, pm_ra, pm_dec = icrs_from_fk5(np.array([10.0]), np.array([20.0]), none, none)
    assert np.isfinite([ra_deg[0], dec_deg[0]]).all()
    assert np.isnan([pm_ra[0], pm_dec[0]]).all()
