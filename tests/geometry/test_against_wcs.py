"""Cameras and attitudes against astropy's WCS, which shares no code with them.

A tangent-plane WCS is written down from a boresight and a roll as the manual describes them:
with no roll the image's up is north and its left is east; a positive roll turns north from up
towards left. FITS counts pixels so that the centre of the first one is at 1.0; here it is 0.5.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from starcat.geometry.attitude import matrix_from_radec_roll
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import directions_from_radec, radec_from_directions
from starcat.matcher.matcher import Matcher

Array = NDArray[np.float64]

FITS_FROM_CAMERA_PX = 0.5

POINTINGS = [
    (83.8, -5.4, 0.0), (0.0, 0.0, 90.0), (359.9999, 10.0, 181.0), (266.4, -29.0, 270.0),
    (12.3, 90.0, 33.0), (200.0, -90.0, 300.0), (45.0, 89.9, 123.4),
]  # fmt: skip
"""Right ascension, declination and roll, degrees; the poles and RA 0 among them."""

pointings = st.tuples(st.floats(0.0, 360.0), st.floats(-90.0, 90.0), st.floats(0.0, 360.0))


def wcs_of(camera: Camera, ra_deg: float, dec_deg: float, roll_deg: float) -> WCS:
    """The WCS of a camera that points there."""
    roll, scale = np.radians(roll_deg), np.degrees(1.0 / camera.focal_length_px)
    # Directions of north and east in the image, x right and y down.
    north = np.array([-np.sin(roll), -np.cos(roll)])
    east = np.array([-np.cos(roll), np.sin(roll)])
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = [ra_deg, dec_deg]
    wcs.wcs.crpix = np.array(camera.principal_point_px) + FITS_FROM_CAMERA_PX
    wcs.wcs.cd = scale * np.array([east, north])
    # astropy has another default at the north pole.
    wcs.wcs.lonpole = 180.0
    return wcs


def pixels_of(wcs: WCS, ra_deg: Array, dec_deg: Array) -> Array:
    """The centroids of stars, by WCS."""
    return np.stack(wcs.wcs_world2pix(ra_deg, dec_deg, 1), axis=1) - FITS_FROM_CAMERA_PX


def stars_around(ra_deg: float, dec_deg: float, radius_deg: float, count: int) -> Array:
    """Directions within a cap, drawn without any attitude."""
    centre = directions_from_radec(np.array([ra_deg]), np.array([dec_deg]))[0]
    drawn = np.random.default_rng(count).normal(size=(count, 3))
    across = drawn - np.outer(drawn @ centre, centre)
    across /= np.linalg.norm(across, axis=1)[:, None]
    angle = np.radians(np.linspace(0.0, radius_deg, count))[:, None]
    return np.asarray(np.cos(angle) * centre + np.sin(angle) * across)


CAMERAS = [
    Camera(1024, 1024, 4871.0),
    Camera(2592, 1944, 2500.0, principal_point_px=(1301.7, 950.2)),
]


@pytest.mark.parametrize("camera", CAMERAS, ids=["narrow", "wide"])
@given(pointing=pointings)
@example(pointing=POINTINGS[1])
@example(pointing=POINTINGS[4])
@example(pointing=POINTINGS[5])
def test_stars_fall_on_the_pixels_of_the_wcs(
    camera: Camera, pointing: tuple[float, float, float]
) -> None:
    stars = stars_around(*pointing[:2], np.degrees(camera.radius_rad), 60)
    found = camera.pixels_from_directions(stars @ matrix_from_radec_roll(*pointing).T)
    expected = pixels_of(wcs_of(camera, *pointing), *radec_from_directions(stars))
    assert np.abs(found - expected).max() < 1e-6


@pytest.mark.parametrize("pointing", POINTINGS)
def test_an_identified_frame_has_the_pointing_and_the_roll_of_the_wcs(
    small_database: Path, pointing: tuple[float, float, float]
) -> None:
    matcher = Matcher.open(small_database)
    database = matcher.database
    camera, wcs = database.camera, wcs_of(database.camera, *pointing)
    ra_deg, dec_deg = radec_from_directions(database.directions)
    # The tangent plane has no place for the other half of the sky.
    centre = directions_from_radec(np.array(pointing[:1]), np.array(pointing[1:2]))[0]
    ahead = np.flatnonzero(database.directions @ centre > 0.5)
    places = pixels_of(wcs, ra_deg[ahead], dec_deg[ahead])
    seen = camera.contains(places)
    found = matcher.identify(places[seen])
    assert found.status == "identified"
    np.testing.assert_array_equal(found.star_index, ahead[seen])
    matrix = matrix_from_radec_roll(found.boresight_ra_deg, found.boresight_dec_deg, found.roll_deg)
    # At a pole right ascension and roll are one angle, so points are compared: the axis and
    # one that is 100 px above it in the image.
    points = np.add(camera.principal_point_px, [[0.0, 0.0], [0.0, -100.0]]) + FITS_FROM_CAMERA_PX
    body = directions_from_radec(*wcs.wcs_pix2world(points, 1).T) @ matrix.T
    # The C matcher has directions that are rounded to 5e-10.
    assert np.abs(np.cross(body[0], [0.0, 0.0, 1.0])).max() < 1e-9
    assert abs(body[1, 0]) < 1e-9
    assert body[1, 1] < 0.0 < body[1, 2]
    assert found.skycoord.separation(SkyCoord(*pointing[:2], unit="deg")).arcsec < 1e-4
    if abs(pointing[1]) < 89.0:
        angles = found.boresight_ra_deg, found.boresight_dec_deg, found.roll_deg
        assert np.abs((np.subtract(angles, pointing) + 180.0) % 360.0 - 180.0).max() < 1e-8
