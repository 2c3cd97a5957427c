"""Where the error of an attitude comes from: each contributor alone, for the stars of a frame.

Closed forms are those of small errors: of the centroid in a Gaussian window, and of Wahba's
problem with equal weights.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from starcat.arrays import Array, Directions, Matrix, Pixels, Rows
from starcat.geometry.attitude import information, quaternion_from_matrix, solve_wahba_svd
from starcat.images.background import load_sep
from starcat.images.centroiding import centres_of_mass
from starcat.matcher.stars import ARCSEC
from starcat.products.blends import widths_px
from starcat.sky.observer import aberrated
from starcat_lab.ecss.bench import Bench, error_arcsec, random_day

_STEP_PX = 0.5
LOW_ORBIT_KM_S = 7.6

CONTRIBUTORS = {
    "sampling": "pixel spatial error: sampling of the spot, full well",
    "prnu": "pixel spatial error: PRNU",
    "dsnu": "pixel spatial error: DSNU",
    "blends": "neighbouring stars in the window or box",
    "distortion": "FOV spatial error: focal length, principal point and distortion",
    "catalog": "FOV spatial error: catalog",
    "aberration": "aberration residual",
    "no_orbit": "aberration, corrected for the Earth's motion only",
    "no_aberration": "aberration, not corrected",
}
"""What is simulated by itself, in the order of the report."""


def centroid_noise_px(bench: Bench, mag: Array) -> Array:
    """Return the noise of a star's centroid on one axis, in closed form.

    The windowed centroid is where the sum of ``w x I`` over the pixels is 0, for a window w and
    offsets x from it. With a spot of N electrons and variance s^2, a window of variance w^2 and
    a background of variance b in a pixel, the variance of that sum is
    ``N A' v' + b pi w^4 / 2`` with ``A' = w^2/(2 s^2 + w^2)`` and ``v' = s^2 A'``, and its
    slope is ``N A^2`` with ``A = w^2/(s^2 + w^2)``. Not valid for saturated stars, nor near the
    threshold, where only lucky stars are found.
    """
    sensor = bench.sensor
    electrons = sensor.zero_point_e * 10.0 ** (-0.4 * np.asarray(mag))
    widths = widths_px(sensor.psf_sigma_px)
    s2, w2 = widths.spot**2, widths.window**2
    rounding = sensor.gain_e_adu**2 / 12.0
    background = sensor.background_e + sensor.read_noise_e**2 + rounding
    slope, part = (w2 / (s2 + w2)) ** 2, w2 / (2.0 * s2 + w2)
    shot, rest = electrons * s2 * part**2, background * math.pi * w2**2 / 2.0
    return np.asarray(np.sqrt(shot + rest) / (electrons * slope))


def attitude_variance(bench: Bench, places: Pixels, noise_px: Array) -> Array:
    """Return the variances of an attitude about x, y and z that centroids give, arcsec^2.

    As `starcat.matcher.stars.attitude_covariance`, but with a noise of each centroid.
    """
    camera = bench.camera
    body = camera.directions_from_pixels(places)
    total = np.zeros((3, 3))
    for axis in (0, 1):
        step = np.zeros(2)
        step[axis] = _STEP_PX
        ends = [camera.directions_from_pixels(places + sign * step) for sign in (1.0, -1.0)]
        moved = np.cross(body, (ends[0] - ends[1]) / (2.0 * _STEP_PX)) * noise_px[:, None]
        total += moved.T @ moved
    inverse = np.linalg.inv(information(body))
    return np.asarray(ARCSEC**2 * np.diag(inverse @ total @ inverse))


@dataclass(frozen=True)
class Contributions:
    """The error of one frame by its contributors."""

    errors: dict[str, Array]  # about x, y and z, arcsec
    noise_variance: Array  # of the temporal noise about x, y and z in closed form, arcsec^2


def contributions(
    bench: Bench, truth: Matrix, stars: Rows, generator: np.random.Generator
) -> Contributions:
    """Return what each contributor does to the attitude of the guide stars of a frame.

    ``truth`` is the attitude of the camera. The alignment is in none of them.
    """
    rows = bench.row_of_guide[stars]
    icrs, mag = bench.sky.directions[rows], bench.sky.mag[rows]
    known = bench.camera.pixels_from_directions(icrs @ truth.T)
    places = bench.lens.pixels_from_directions(bench.true_sky.directions[rows] @ truth.T)

    def error(body: Directions, stars: Directions = icrs) -> Array:
        return error_arcsec(truth, quaternion_from_matrix(solve_wahba_svd(body, stars)))

    def moved(by_px: Pixels) -> Array:
        return error(bench.camera.directions_from_pixels(known + by_px))

    own = bench.light(places, mag)
    near, around = bench.in_field(truth)
    everything = bench.light(around, bench.true_sky.mag[near])
    alone = _centroids(bench, own, places)
    lens_only = bench.lens.pixels_from_directions(icrs @ truth.T)
    found = {
        "sampling": moved(alone - places),
        "prnu": moved(_centroids(bench, own * bench.prnu, places) - alone),
        "dsnu": moved(_centroids(bench, own + bench.dsnu_e, places) - alone),
        "blends": moved(_centroids(bench, everything, places) - alone),
        "distortion": moved(lens_only - known),
        "catalog": error(bench.true_sky.directions[rows] @ truth.T),
        **_aberrations(bench, truth, icrs, generator),
    }
    return Contributions(found, attitude_variance(bench, known, centroid_noise_px(bench, mag)))


def _centroids(bench: Bench, light: Array, places: Pixels) -> Pixels:
    """Return the centroids of light without noise, as the spec of the database says it is measured.

    A window settles from the true places on; a box is around the brightest pixel next to them.
    """
    held = np.minimum(light, bench.sensor.full_well_e)
    if bench.box_px is not None:
        return centres_of_mass(held, places, bench.box_px)
    start = np.ascontiguousarray((places - 0.5).T)
    window = widths_px(bench.sensor.psf_sigma_px).window
    x, y, _ = load_sep().winpos(held, *start, window, subpix=0)
    return np.stack([x, y], axis=1) + 0.5


def _aberrations(
    bench: Bench, truth: Matrix, icrs: Directions, generator: np.random.Generator
) -> dict[str, Array]:
    """Return what is left of aberration on a random day in a random low orbit."""
    across = generator.normal(size=3)
    orbit = LOW_ORBIT_KM_S * across / np.linalg.norm(across)
    earth = random_day(generator)
    true_km_s = earth.velocity_km_s + orbit
    off = bench.sensor.velocity_error_km_s * generator.normal(size=3)
    body = aberrated(icrs, true_km_s) @ truth.T

    def left(stars: Directions) -> Array:
        return error_arcsec(truth, quaternion_from_matrix(solve_wahba_svd(body, stars)))

    return {
        "aberration": left(aberrated(icrs, true_km_s + off)),
        "no_orbit": left(aberrated(icrs, earth.velocity_km_s)),
        "no_aberration": left(icrs),
    }
