"""Answers as objects of astropy, scipy and matplotlib: tables, world coordinates, pictures.

Each library is imported when it is needed; a program that only matches needs none of them.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import lru_cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from starcat.arguments import unit_of_argument
from starcat.arrays import Array, Matrix
from starcat.errors import ConfigError
from starcat.geometry.attitude import radec_roll_from_matrix
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import tangent_axes
from starcat.version import missing_packages

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.table import QTable
    from astropy.wcs import WCS
    from matplotlib.figure import Figure
    from scipy.spatial.transform import Rotation


SIP_ORDERS = range(2, 10)
"""Orders of the polynomials of SIP: 9 is the highest that the convention has."""

SIP_ERROR_PX = 0.005
"""The lowest order whose error is below this at all tested places is used."""

FIRST_CENTRE_PX = 0.5
"""Place of the centre of the first pixel; FITS calls it 1."""

_log = logging.getLogger(__name__)


def sky_object_table(columns: Mapping[str, Any], facts: Mapping[str, Any]) -> QTable:
    """Return columns as a table of astropy, with the units that their names end with."""
    table = _astropy("table").QTable(meta=dict(facts))
    for name, values in columns.items():
        column, unit = np.array(values), unit_of_argument(name)
        table[name] = _astropy("units").Quantity(column, unit) if unit else column
    return table


def skycoord(ra_deg: float, dec_deg: float) -> SkyCoord:
    """Return a direction as an object of astropy."""
    return _astropy("coordinates").SkyCoord(ra_deg, dec_deg, unit="deg", frame="icrs")


def rotation(matrix: Matrix) -> Rotation:
    """Return the rotation of scipy that applies a matrix to vectors."""
    attitude: Rotation = _library("scipy.spatial.transform").Rotation.from_matrix(matrix)
    return attitude


def wcs(camera: Camera, matrix: Array, bottom_up: bool = False) -> WCS:
    """Return the world coordinates of a picture.

    The reference pixel is the principal point, where the projection touches the sky. Pixel
    (0, 0) of the camera is the outer corner of the first pixel, whose centre is (1, 1) in FITS:
    0.5 is added. With rows that count from the bottom, y becomes the height minus y.
    """
    package = _astropy("wcs")
    ra_deg, dec_deg, _ = radec_roll_from_matrix(matrix)
    axes = np.array(tangent_axes(ra_deg, dec_deg))
    x_px, y_px = camera.principal_point_px
    centre = [x_px, camera.height_px - y_px if bottom_up else y_px]
    sip = None if camera.distortion.is_none else _sip(camera, bottom_up)
    coordinates = package.WCS(naxis=2)
    ending = "" if sip is None else "-SIP"
    coordinates.wcs.ctype = [f"RA---TAN{ending}", f"DEC--TAN{ending}"]
    coordinates.wcs.cunit = ["deg", "deg"]
    coordinates.wcs.crval = [ra_deg, dec_deg]
    coordinates.wcs.crpix = np.array(centre) + FIRST_CENTRE_PX
    step = np.array([1.0, -1.0 if bottom_up else 1.0]) / camera.focal_length_px
    coordinates.wcs.cd = np.degrees(axes @ matrix[:2].T * step)
    coordinates.wcs.lonpole = 180.0
    coordinates.wcs.radesys = "ICRS"
    if sip is not None:
        coordinates.sip = package.Sip(*sip, coordinates.wcs.crpix)
    coordinates.pixel_shape = (camera.width_px, camera.height_px)
    coordinates.wcs.set()
    return coordinates


@lru_cache(maxsize=16)
def _sip(camera: Camera, bottom_up: bool) -> tuple[Array, Array, Array, Array]:
    """Return the polynomials that remove the distortion, and the polynomials that add it."""
    # The ends of an interval need more places than its middle.
    along = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 41))
    x, y = np.meshgrid(along * camera.width_px, along * camera.height_px)
    px = np.column_stack([x.ravel(), y.ravel()])
    body = camera.directions_from_pixels(px)
    seen = px - camera.principal_point_px
    plain = camera.focal_length_px * body[:, :2] / body[:, 2:]
    if bottom_up:
        seen[:, 1] *= -1.0
        plain[:, 1] *= -1.0
    return (*_polynomials(seen, plain - seen), *_polynomials(plain, seen - plain))


def _polynomials(places: Array, shifts: Array) -> tuple[Array, Array]:
    """Return the polynomials of SIP, of the lowest order that will do, for shifts in x and y."""
    scale = float(np.abs(places).max())
    u, v = (places / scale).T
    for order in SIP_ORDERS:
        powers = [(p, q) for p in range(order + 1) for q in range(order + 1 - p) if p + q > 1]
        terms = np.stack([u**p * v**q for p, q in powers], axis=-1)
        coefficients, *_ = np.linalg.lstsq(terms, shifts)
        error_px = float(np.abs(terms @ coefficients - shifts).max())
        if error_px <= SIP_ERROR_PX:
            break
    else:
        _log.warning(
            "the distortion of this camera is beyond polynomials of order %d: the WCS is off by "
            "up to %.2g px",
            order,
            error_px,
        )
    polynomials = np.zeros((2, order + 1, order + 1))
    for (p, q), (in_x, in_y) in zip(powers, coefficients, strict=True):
        polynomials[:, p, q] = np.array([in_x, in_y]) / scale ** (p + q)
    return polynomials[0], polynomials[1]


def plot(result: Any, output: Any, image: Any, name: str) -> Figure:
    """Return the picture of a result, drawn by `starcat.frames.images` if that is installed."""
    try:
        # An installation of the matcher alone has neither pictures nor astropy.
        pictures = import_module("starcat.frames.images.picture")
        drawn: Figure = pictures.draw_result(result, output, image, name)
    except ModuleNotFoundError as error:
        raise ConfigError(missing_packages("MatchResult.plot", error)) from error
    return drawn


def _astropy(module: str) -> Any:
    return _library(f"astropy.{module}")


def _library(module: str) -> Any:
    package = module.partition(".")[0]
    try:
        return import_module(module)
    except ImportError as error:
        raise ConfigError(
            f"{package} is not installed ({error}), which this is an object of",
            hint=f"pip install {package}",
        ) from error
