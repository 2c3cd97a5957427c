"""The image path: rendered spots have the requested light, and are found at their places."""

from __future__ import annotations

import gzip
import logging
import re
import struct
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.image
import matplotlib.text
import numpy as np
import pytest
from astropy.io import fits
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pictures import png_of
from PIL import Image
from scipy.spatial import cKDTree

import starcat
from starcat.errors import ConfigError, OutputError
from starcat.frames.images.background import (
    SMALLEST_PX,
    SkyLevels,
    repair_hot_pixels,
    subtract_background,
)
from starcat.frames.images.centroiding import Spots, brightest_first, detect, find_spots
from starcat.frames.images.image_file import read_image, write_image
from starcat.frames.images.overlay import FrameAxes, draw_compass, mark_radii, place_labels, stretch
from starcat.frames.images.picture import compass_from_matrix, draw_identified
from starcat.frames.images.render import Optics, render_image, star_electrons
from starcat.geometry.attitude import matrix_from_radec_roll
from starcat.version import install_command

Array = NDArray[np.float64]

NO_STARS = np.empty((0, 2)), np.empty(0)
OPTICS = Optics()


def star_grid(side: int, pitch: float, seed: int) -> Array:
    """Return places far enough from each other, at random phases of the pixels."""
    generator = np.random.default_rng(seed)
    row = (np.arange(side) + 0.5) * pitch
    places = np.stack(np.meshgrid(row, row), axis=-1).reshape(-1, 2)
    return np.asarray(places + generator.uniform(-0.5, 0.5, places.shape))


def found_at(spots: Spots, places: Array, radius: float = 1.5) -> NDArray[np.intp]:
    """Return the index of the spot at each place, or the number of spots if there is no spot."""
    return np.asarray(cKDTree(spots.centroids_px).query(places, distance_upper_bound=radius)[1])


# Rendering


@pytest.mark.parametrize("sigma", [0.4, 1.0, 2.7])
@pytest.mark.parametrize("place", [(50.5, 40.5), (50.0, 40.0), (49.731, 40.118)])
def test_a_star_has_the_light_of_its_magnitude(sigma, place):
    optics = Optics(psf_sigma_px=sigma, zero_point_e=1e6)
    image = star_electrons(np.array([place]), np.array([5.0]), (100, 80), optics)
    assert image.shape == (80, 100)
    assert image.sum() == pytest.approx(1e4, rel=1e-8)  # 4e-9 of it lies beyond 6 sigma
    if sigma < 1.0:
        return  # so narrow a spot does not have its middle of mass at its middle
    moment_x, moment_y = image.sum(axis=0) @ np.arange(100), image.sum(axis=1) @ np.arange(80)
    assert moment_x / image.sum() + 0.5 == pytest.approx(place[0], abs=1e-6)
    assert moment_y / image.sum() + 0.5 == pytest.approx(place[1], abs=1e-6)


def test_a_pixel_holds_the_integral_of_the_spot_not_its_middle():
    # Of a Gaussian of sigma 0.5, 0.6826895 lies within one sigma of the middle, along each axis.
    optics = Optics(psf_sigma_px=0.5, zero_point_e=1.0)
    image = star_electrons(np.array([[5.5, 5.5]]), np.zeros(1), (11, 11), optics)
    assert image[5, 5] == pytest.approx(0.6826894921**2, rel=1e-9)


def test_pixels_are_counted_from_the_outer_corner_of_the_first():
    image = star_electrons(np.array([[10.5, 20.5]]), np.zeros(1), (64, 48), OPTICS)
    assert np.unravel_index(image.argmax(), image.shape) == (20, 10)
    around = image[14:27, 4:17]
    np.testing.assert_allclose(around, around[::-1], rtol=1e-12)
    np.testing.assert_allclose(around, around[:, ::-1], rtol=1e-12)
    np.testing.assert_allclose(around, around.T, rtol=1e-12)


def test_a_star_outside_shines_into_the_frame():
    on_the_edge = star_electrons(np.array([[0.0, 24.0]]), np.zeros(1), (64, 48), OPTICS)
    assert on_the_edge.sum() == pytest.approx(0.5 * OPTICS.zero_point_e)
    assert on_the_edge[24, 0] == on_the_edge.max()
    corner = star_electrons(np.array([[64.0, 48.0]]), np.zeros(1), (64, 48), OPTICS)
    assert corner.sum() == pytest.approx(0.25 * OPTICS.zero_point_e)
    far = np.array([[-7.0, 5.0], [5.0, 56.0], [1e12, 5.0], [np.nan, 5.0], [np.inf, 5.0]])
    assert not star_electrons(far, np.zeros(5), (64, 48), OPTICS).any()
    # A spot larger than the frame is cut on all sides.
    image = star_electrons(np.array([[8.0, 5.0]]), np.zeros(1), (16, 10), Optics(psf_sigma_px=30.0))
    np.testing.assert_allclose(image, image[::-1, ::-1], rtol=1e-12)
    assert image.min() > 0.0


def test_photons_are_poisson_and_reading_is_gaussian():
    optics = Optics(background_e=400.0, read_noise_e=10.0, gain_e_per_adu=2.0, bias_adu=50.0)
    image = render_image(*NO_STARS, (500, 400), optics, 1)
    assert image.dtype == np.uint16
    assert image.shape == (400, 500)
    # (400 + 10^2) / 2^2, and 1/12 for the rounding; 200,000 pixels: 0.3 % of a variance.
    assert image.mean() == pytest.approx(250.0, abs=0.13)
    assert image.var() == pytest.approx(125.0 + 1.0 / 12.0, rel=0.015)
    # The light of a star is Poisson too.
    star, electrons = (np.array([[8.3, 8.6]]), np.array([4.0])), 600_000.0 * 10**-1.6
    quiet = Optics(background_e=0.0, read_noise_e=0.0, bias_adu=0.0)
    frames = [render_image(*star, (16, 16), quiet, seed) for seed in (*range(800), 7)]
    sums = [frame.sum() for frame in frames[:-1]]
    assert np.mean(sums) == pytest.approx(electrons, abs=4.0 * (electrons / 800) ** 0.5)
    assert np.var(sums) == pytest.approx(electrons, rel=0.2)  # 4 of its standard deviations
    assert (frames[-1] == frames[7]).all()  # the same seed gives the same image


def test_wells_fill_and_sixteen_bits_end():
    bright = np.array([[8.5, 8.5]]), np.array([-4.0])
    well = Optics(read_noise_e=0.0, bias_adu=100.0, full_well_e=30_000.0)
    assert render_image(*bright, (17, 17), well, 1).max() == 30_100
    deep = replace(well, full_well_e=1e6)
    assert render_image(*bright, (17, 17), deep, 1).max() == 65_535
    noisy = Optics(bias_adu=0.0, background_e=0.0, read_noise_e=20.0)
    assert render_image(*NO_STARS, (50, 50), noisy, 1).min() == 0
    assert render_image(bright[0], np.array([-45.0]), (17, 17), well, 1).max() == 30_100


def test_hot_pixels_are_as_many_as_asked_for():
    hot = Optics(hot_pixels=25)
    image = render_image(*NO_STARS, (200, 100), hot, 3).astype(int)
    assert (image > 100 + 20 + 800).sum() == 25  # at least 2 % of the well above the rest
    assert render_image(*NO_STARS, (4, 4), hot, 3).min() > 900


@pytest.mark.parametrize("sigma", [0.7, 1.0])
def test_centroids_do_not_follow_the_pixel_grid(sigma):
    # Without noise only the method's own error remains, at any place within a pixel.
    places = star_grid(15, 30.0, 3)
    mean = star_electrons(places, np.full(225, 3.0), (450, 450), Optics(psf_sigma_px=sigma))
    spots = find_spots(mean, psf_sigma_px=sigma)
    error = spots.centroids_px[found_at(spots, places)] - places
    assert np.abs(error).max() < 0.02


@pytest.mark.parametrize("sigma", [0.7, 1.0, 1.5])
def test_stars_that_the_border_cuts_are_where_they_are(sigma):
    # One after the other along each side; two thirds to all of their light is in the image.
    depth = np.linspace(0.5, 4.0, 20)
    along, last = 12.3 + 24.1 * np.arange(20), 500.0
    places = np.concatenate(
        [np.stack(xy, 1) for xy in ((depth, along), (last - depth, along), (along, depth))]
    )
    mean = star_electrons(places, np.full(60, 3.0), (500, 500), Optics(psf_sigma_px=sigma))
    spots = find_spots(mean, psf_sigma_px=sigma)
    index = found_at(spots, places)
    error = spots.centroids_px[index] - places
    assert np.abs(error).max() < 0.05, "up to 0.7 px if nothing is corrected"
    assert np.ptp(spots.mag[index]) < 0.12
    # The error that noise makes grows with the part that is outside.
    noisy = render_image(places, np.full(60, 7.0), (500, 500), Optics(psf_sigma_px=sigma), 8)
    spots = find_spots(noisy, psf_sigma_px=sigma)
    index = found_at(spots, places)
    ratio = (spots.centroids_px[index] - places) / spots.sigma_px[index, None]
    assert np.sqrt((ratio**2).mean()) < 1.3
    assert spots.sigma_px[index[0]] > 1.5 * spots.sigma_px[index[19]]


def cramer_rao_px(electrons: float, optics: Optics) -> float:
    """Return the least error of an unbiased centroid, one axis, by Fisher's information."""
    mag, step = np.array([-2.5 * np.log10(electrons / optics.zero_point_e)]), 1e-3
    at = [np.array([[10.2 + shift, 10.4]]) for shift in (-step, 0.0, step)]
    low, mean, high = (star_electrons(place, mag, (21, 21), optics) for place in at)
    variance = mean + optics.background_e + optics.read_noise_e**2 + 1.0 / 12.0
    return float((((high - low) / (2.0 * step)) ** 2 / variance).sum() ** -0.5)


@pytest.mark.parametrize(
    ("sigma", "electrons"),
    [(1.0, 500.0), (1.0, 2_000.0), (1.0, 8_000.0), (0.7, 15_000.0), (1.5, 15_000.0)],
)
def test_errors_are_near_the_least_that_photons_allow(sigma, electrons):
    places, optics = star_grid(20, 24.0, 4), Optics(psf_sigma_px=sigma)
    mag = np.full(400, -2.5 * np.log10(electrons / OPTICS.zero_point_e))
    spots = find_spots(render_image(places, mag, (480, 480), optics, 6))
    index = found_at(spots, places)
    assert (index < len(spots)).sum() >= 398
    assert len(spots) <= 402
    error = spots.centroids_px[index[index < len(spots)]] - places[index < len(spots)]
    limit = cramer_rao_px(electrons, optics)
    # 800 values: 2.5 % of a standard deviation. The least error itself has no margin.
    assert 0.9 * limit < np.sqrt((error**2).mean()) < 1.2 * limit + 0.004
    assert np.abs(error.mean(axis=0)).max() < 0.15 * limit + 0.002
    if electrons > 5_000.0:
        assert spots.psf_sigma_px == pytest.approx(sigma, rel=0.1)


def test_spots_are_in_order_of_brightness():
    places, mag = star_grid(10, 30.0, 5), np.random.default_rng(5).uniform(2.0, 7.0, 100)
    spots = find_spots(render_image(places, mag, (300, 300), OPTICS, 7))
    assert (np.diff(spots.flux) <= 0.0).all()
    np.testing.assert_allclose(spots.mag, -2.5 * np.log10(spots.flux))
    index = found_at(spots, places)
    assert sorted(index) == list(range(100))
    zero_point = spots.mag[index] - mag
    assert np.median(zero_point) == pytest.approx(-2.5 * np.log10(600_000.0), abs=0.03)
    # Equal spots are in order of place.
    places = np.array([[3.0, 1.0], [1.0, 3.0], [9.0, 9.0], [1.0, 1.0], [3.0, 3.0]])
    order = brightest_first(np.array([5.0, 5.0, 7.0, 5.0, 5.0]), places)
    assert places[order].tolist() == [[9, 9], [1, 1], [1, 3], [3, 1], [3, 3]]


@pytest.mark.parametrize("kind", [np.uint16, np.int32, np.float32, np.float64, ">f4", ">i2"])
def test_any_kind_of_number_gives_the_same_spots(kind):
    image = render_image(star_grid(3, 30.0, 6), np.full(9, 5.0), (90, 90), OPTICS, 8)
    expected, spots = find_spots(image), find_spots(image.astype(kind))
    np.testing.assert_array_equal(spots.centroids_px, expected.centroids_px)
    np.testing.assert_array_equal(spots.flux, expected.flux)
    # A view is read as it is seen.
    top_down = find_spots(image.astype(kind)[::-1]).centroids_px
    index = found_at(spots, [0.0, 90.0] + top_down * [1.0, -1.0], 0.05)
    assert sorted(index) == list(range(len(spots)))


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((50, 60)),
        np.full((50, 60), 7.3),
        np.full((50, 60), 1e30),
        np.full((50, 60), 255, dtype=np.uint8),
        np.full((SMALLEST_PX, SMALLEST_PX), -2.0, dtype=np.float32),
    ],
)
def test_an_image_without_light_has_no_spots(image):
    spots = find_spots(image)
    assert len(spots) == 0
    assert spots.centroids_px.shape == (0, 2)
    assert spots.flux.shape == spots.mag.shape == (0,)


def test_noise_has_hardly_any_spots():
    image = render_image(*NO_STARS, (1024, 512), OPTICS, 9)
    assert len(find_spots(image)) <= 2
    assert len(find_spots(image[:, :512], threshold_sigma=3)) > 20


def test_a_threshold_is_a_signal_over_noise():
    # 225 stars of a signal over noise of 8: all of them pass at 4, none passes at 14.
    per_pixel = OPTICS.background_e + OPTICS.read_noise_e**2 + 1.0 / 12.0
    electrons = 0.5 * (64.0 + np.sqrt(64.0**2 + 4.0 * 64.0 * 4.0 * np.pi * per_pixel))
    mag = np.full(225, -2.5 * np.log10(electrons / OPTICS.zero_point_e))
    places = star_grid(15, 30.0, 7)
    image = render_image(places, mag, (450, 450), OPTICS, 10)

    def found(threshold: float) -> int:
        spots = find_spots(image, threshold_sigma=threshold, psf_sigma_px=1.0)
        return int((found_at(spots, places) < len(spots)).sum())

    assert found(4.0) >= 223
    assert 60 < found(8.0) < 165
    assert len(find_spots(image, threshold_sigma=14.0, psf_sigma_px=1.0)) == 0


def test_the_background_may_slope_and_pixels_may_have_no_value():
    places = star_grid(8, 40.0, 8)
    image = render_image(places, np.full(64, 5.0), (320, 320), OPTICS, 11).astype(float)
    y, x = np.mgrid[:320, :320]
    spots = find_spots(image + 1.0 * x + 0.002 * y**2)
    error = spots.centroids_px[found_at(spots, places)] - places
    assert len(spots) == 64
    assert np.sqrt((error**2).mean()) < 0.04
    image[:, 280:], image[5, 5] = np.nan, np.inf
    spots = find_spots(image)
    assert len(spots) == 56
    assert (found_at(spots, places[places[:, 0] < 280.0], 0.2) < 56).all()


@pytest.mark.parametrize(("side", "pitch", "saturated"), [(6, 40.0, 6), (12, 30.0, 60)])
def test_saturated_stars_are_well_placed(side, pitch, saturated):
    places, size = star_grid(side, pitch, 9), int(side * pitch)
    mag = np.where(np.arange(side**2) < saturated, -1.0, 3.5)
    spots = find_spots(render_image(places, mag, (size, size), OPTICS, 13))
    error = spots.centroids_px[found_at(spots, places)] - places
    assert np.abs(error[mag < 0]).max() < 0.12
    assert spots.psf_sigma_px == pytest.approx(1.0, rel=0.1)  # not that of the flat tops


@pytest.mark.parametrize("sigma", [None, 1.0])
def test_hot_pixels_are_not_stars(sigma):
    places, mag = star_grid(12, 40.0, 10), np.random.default_rng(10).uniform(1.5, 6.5, 144)
    image = render_image(places, mag, (480, 480), Optics(hot_pixels=60), 15)
    spots = find_spots(image, psf_sigma_px=sigma)
    assert (found_at(spots, places) < len(spots)).all()
    assert len(spots) <= 144 + 2
    assert spots.psf_sigma_px == pytest.approx(1.0, rel=0.1)  # not the width of hot pixels
    # Nor are faint hot pixels.
    image = render_image(*NO_STARS, (300, 300), OPTICS, 15)
    warm = np.random.default_rng(15).choice(image.size, 100, replace=False)
    image.flat[warm] += 120  # 13 times the noise; a star of that peak is seen well
    assert len(find_spots(image, psf_sigma_px=sigma)) <= 5


def test_what_replaces_a_hot_pixel_is_the_mean_beside_it():
    image = np.full((40, 40), 100.0)
    image[::2, ::2] = 103.0
    image[20, 10] = image[0, 0] = image[39, 39] = 9_000.0
    repaired = repair_hot_pixels(subtract_background(image), 1.0).above
    assert np.abs(repaired).max() < 5.0
    image = np.full((40, 40), 100.0)
    image[19:22, 9:12] = 140.0
    image[20, 10] = 9_000.0
    sky = subtract_background(image)
    beside = float(np.delete(sky.above[19:22, 9:12].ravel(), 4).mean())
    assert repair_hot_pixels(sky, 1.0).above[20, 10] == pytest.approx(beside, rel=1e-6)
    assert beside > 30.0


def test_a_spot_without_light_is_not_a_spot():
    # A ring of dead pixels around a faint star makes the sum of its aperture negative.
    image = render_image(np.array([[30.5, 30.5]]), np.array([7.0]), (60, 60), OPTICS, 16)
    assert len(find_spots(image, psf_sigma_px=1.0)) == 1
    y, x = np.mgrid[:60, :60]
    radius = np.hypot(x - 30, y - 30)
    dead = np.where((radius > 1.9) & (radius < 2.3), -80.0, image)
    assert len(find_spots(dead, psf_sigma_px=1.0)) == 0


def test_single_steps_of_a_clipped_background_are_no_stars():
    image = np.zeros((200, 200), dtype=np.uint8)
    for x, y in np.random.default_rng(17).integers(5, 195, (60, 2)):
        image[[y, y, y + 1], [x, x + 1, x]] = 1
    image[50:53, 60:63] = [[5, 20, 5], [20, 80, 20], [5, 20, 5]]
    spots = find_spots(image, psf_sigma_px=1.0)
    assert np.floor(spots.centroids_px).tolist() == [[61, 51]]


@pytest.mark.parametrize("sigma", [0.5, 0.7, 1.0, 2.0])
def test_stars_are_not_hot_pixels(sigma):
    places = star_grid(10, 30.0, 11)
    mag = np.random.default_rng(11).uniform(2.0, 6.0, 100)
    image = render_image(places, mag, (300, 300), Optics(psf_sigma_px=sigma), 16)
    sky = subtract_background(image)
    y, x = np.nonzero(repair_hot_pixels(sky, sigma).above != sky.above)
    assert len(x) < 10  # peaks of the noise
    near = cKDTree(np.stack([x, y], axis=1) + 0.5).query(places, distance_upper_bound=4.0)[1]
    assert (near == len(x)).all()


def test_a_bright_star_does_not_hide_the_faint_ones_around_it():
    optics = Optics(psf_sigma_px=1.5, full_well_e=1e9, gain_e_per_adu=10.0)
    places = np.array([[60.0, 50.0], [72.0, 50.0]])
    mag = np.array([2.0, 8.05])  # 355 electrons: a signal over noise of 7
    images = [render_image(places, mag, (120, 100), optics, seed) for seed in range(20)]
    found = [find_spots(image, psf_sigma_px=1.5) for image in images]
    assert sum(int(found_at(spots, places[1:])[0] < len(spots)) for spots in found) >= 18


def test_windows_do_not_drift_to_the_star_beside():
    places, mag = np.array([[50.2, 50.3], [53.2, 50.3]]), np.array([4.0, 5.0])
    image = render_image(places, mag, (100, 100), Optics(psf_sigma_px=0.5), 1)
    spots = find_spots(image, psf_sigma_px=0.5)
    assert len(spots) == 2
    np.testing.assert_allclose(spots.centroids_px, places, atol=0.4)
    places, mag = np.array([[50.3, 50.6], [57.0, 50.6]]), np.array([2.0, 6.0])  # a faint one
    spots = find_spots(render_image(places, mag, (100, 100), OPTICS, 18), psf_sigma_px=1.0)
    assert (found_at(spots, places, 0.5) == [0, 1]).all()


def test_images_and_options_that_cannot_be_are_refused():
    for image, word in (
        (np.zeros((3, 40, 40)), "two"),
        (np.zeros(40), "two"),
        (np.zeros((40, SMALLEST_PX - 1)), "16 px or more"),
        (np.full((40, 40), "a"), "grey values"),
        (np.full((40, 40), np.nan), "no finite value"),
    ):
        with pytest.raises(ConfigError, match=word):
            find_spots(image)
    for option in ("threshold_sigma", "psf_sigma_px", "most_spots"):
        for value in (0.0, -1.0, np.nan, np.inf):
            with pytest.raises(ConfigError, match=option) as caught:
                find_spots(np.zeros((40, 40)), **{option: value})
            assert caught.value.parameter == option


def test_where_too_much_stands_out_it_says_what_to_do():
    light = 5.0 + np.random.default_rng(1).exponential(size=(1000, 1000)).astype(np.float32)
    nothing = np.zeros(light.shape, dtype=np.bool_)
    levels = SkyLevels(light, light, np.full_like(light, 1e-3), nothing)
    with pytest.raises(ConfigError, match="too much in it") as caught:
        detect(levels, 1.0, 5.0)
    assert "buffer" not in str(caught.value)
    for option in ("psf_sigma_px", "threshold="):
        assert option in str(caught.value)


# Image files

GREY16 = np.random.default_rng(0).integers(0, 65_536, (20, 31), dtype=np.uint16)
GREY8 = (GREY16 >> 8).astype(np.uint8)
COLOUR8 = np.random.default_rng(1).integers(0, 256, (20, 31, 3), dtype=np.uint8)
COLOUR16 = np.random.default_rng(2).integers(0, 65_536, (20, 31, 3), dtype=np.uint16)
LUMINANCE = [0.299, 0.587, 0.114]


@pytest.mark.parametrize("name", ["a.fits", "a.fit", "a.png", "A.TIF", "a.tiff"])
@pytest.mark.parametrize("image", [GREY8, GREY16], ids=["8", "16"])
def test_grey_values_come_back(name, image, tmp_path):
    write_image(tmp_path / name, image)
    back = read_image(tmp_path / name)
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, image)
    np.testing.assert_array_equal(read_image(tmp_path / name, flip=True), image[::-1])
    first = (tmp_path / name).read_bytes()
    write_image(tmp_path / name, image)
    assert (tmp_path / name).read_bytes() == first
    (tmp_path / "packed.gz").write_bytes(gzip.compress(first))
    np.testing.assert_array_equal(read_image(tmp_path / "packed.gz"), image)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [("f4", "f4"), ("f8", "f8"), ("i2", "f4"), ("i4", "f8"), ("i8", "f8"), ("u4", "f8")],
)
def test_fits_keeps_all_digits(kind, expected, tmp_path):
    image = (GREY16 // 4).astype(kind) * 2
    write_image(tmp_path / "a.fits", image)
    back = read_image(tmp_path / "a.fits")
    assert back.dtype == expected
    assert back.flags.c_contiguous
    np.testing.assert_array_equal(back, image)


def test_of_several_fits_images_the_first_plane_is_read(tmp_path, caplog):
    tiles = fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(GREY16)])
    tiles.writeto(tmp_path / "tiles.fits")
    np.testing.assert_array_equal(read_image(tmp_path / "tiles.fits"), GREY16)
    parts = [fits.PrimaryHDU(np.zeros((4, 4, 5))), *map(fits.ImageHDU, (GREY16[None], GREY8))]
    fits.HDUList(parts).writeto(tmp_path / "a.fits")
    with caplog.at_level(logging.INFO, "starcat.frames.images.image_file"):
        np.testing.assert_array_equal(read_image(tmp_path / "a.fits"), GREY16)
    assert "HDU 1 of 3 (HDU 0 4x4x5; HDU 1 1x20x31; HDU 2 20x31)" in caplog.text
    # Three planes are colours, and one may be chosen.
    planes = np.moveaxis(COLOUR16, 2, 0)
    fits.PrimaryHDU(planes).writeto(tmp_path / "b.fits")
    colours = COLOUR16 @ LUMINANCE
    np.testing.assert_allclose(read_image(tmp_path / "b.fits"), colours, rtol=1e-7)
    for number in range(3):
        found = read_image(tmp_path / "b.fits", plane=number)
        np.testing.assert_array_equal(found, planes[number])
    with pytest.raises(ConfigError, match="there is no plane"):
        read_image(tmp_path / "b.fits", plane=-1)


def test_the_first_row_of_fits_is_the_top_unless_the_file_says_otherwise(tmp_path):
    part = fits.PrimaryHDU(GREY16)
    part.writeto(tmp_path / "silent.fits")
    part.header["ROWORDER"] = "BOTTOM-UP"
    part.writeto(tmp_path / "up.fits")
    np.testing.assert_array_equal(read_image(tmp_path / "silent.fits"), GREY16)
    np.testing.assert_array_equal(read_image(tmp_path / "up.fits"), GREY16[::-1])
    np.testing.assert_array_equal(read_image(tmp_path / "up.fits", flip=False), GREY16)
    np.testing.assert_array_equal(read_image(tmp_path / "up.fits", flip=True), GREY16[::-1])
    write_image(tmp_path / "own.fits", GREY16)
    assert fits.getheader(tmp_path / "own.fits")["ROWORDER"] == "TOP-DOWN"


def png(values: NDArray[Any], colour_type: int) -> bytes:
    """Return a PNG of 16 bits, of kinds that Pillow does not write."""
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    return png_of(values.shape[1], values.shape[0], rows, 16, colour_type)


def tiff(values: NDArray[Any], order: str, photometric: int, samples: int = 1) -> bytes:
    """Return a TIFF of 16 bits by hand."""
    height, width = values.shape[:2]
    data = values.astype(order + "u2").tobytes()
    bits_at = 8 + len(data)
    data += struct.pack(order + "HHH", 16, 16, 16)
    tags = [(256, 3, width), (257, 3, height), (258, 3, 16), (259, 3, 1), (262, 3, photometric)]
    tags += [(273, 4, 8), (277, 3, samples), (278, 3, height), (279, 4, bits_at - 8)]
    out = (b"II" if order == "<" else b"MM") + struct.pack(order + "HI", 42, 8 + len(data)) + data
    out += struct.pack(order + "H", len(tags))
    for tag, kind, value in tags:
        count = samples if tag == 258 else 1
        out += struct.pack(order + "HHI", tag, kind, count)
        if count > 2:
            out += struct.pack(order + "I", bits_at)
        else:
            out += struct.pack(order + ("HH" if kind == 3 else "I"), *(value, 0)[: 5 - kind])
    return out + struct.pack(order + "I", 0)


def test_files_of_other_programs_are_read_right(tmp_path):
    cases = {
        "grey.png": png(GREY16, 0),
        "little.tif": tiff(GREY16, "<", 1),
        "big.tif": tiff(GREY16, ">", 1),
        "white_is_zero.tif": tiff(65_535 - GREY16, "<", 0),
        "transparent.png": png(np.dstack([GREY16, GREY16[::-1]]), 4),
    }
    for name, data in cases.items():
        (tmp_path / name).write_bytes(data)
        np.testing.assert_array_equal(read_image(tmp_path / name), GREY16, err_msg=name)
    for name, data in {
        "colour.png": png(COLOUR16, 2),
        "with_alpha.png": png(np.dstack([COLOUR16, GREY16]), 6),
        "little.tif": tiff(COLOUR16, "<", 2, 3),
        "big.tif": tiff(COLOUR16, ">", 2, 3),
    }.items():  # colour of 16 bits keeps them
        (tmp_path / name).write_bytes(data)
        found = read_image(tmp_path / name)
        np.testing.assert_allclose(found, COLOUR16 @ LUMINANCE, rtol=1e-7, err_msg=name)
    for number, mode in enumerate(["RGB", "RGB", "RGBA"]):
        path = tmp_path / f"colour_{number}.{'tif' if number else 'png'}"
        Image.fromarray(COLOUR8).convert(mode).save(path)
        np.testing.assert_allclose(read_image(path), np.rint(COLOUR8 @ LUMINANCE), rtol=1e-12)
    for kind in ("f4", "i4"):  # a TIFF may hold more than 16 bits
        image = GREY16.astype(kind) * 3
        Image.fromarray(image).save(tmp_path / "wide.tif")
        np.testing.assert_array_equal(read_image(tmp_path / "wide.tif"), image)


def test_jpeg_is_written_and_read(tmp_path):
    y, x = np.mgrid[:40, :56]
    smooth = (2 * x + 3 * y).astype(np.uint8)
    write_image(tmp_path / "a.jpg", smooth)
    assert (tmp_path / "a.jpg").read_bytes()[:3] == b"\xff\xd8\xff"
    assert np.abs(read_image(tmp_path / "a.jpg") - smooth).max() <= 4
    write_image(tmp_path / "b.jpeg", smooth, quality=30)
    assert (tmp_path / "b.jpeg").stat().st_size < (tmp_path / "a.jpg").stat().st_size


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "RGBA"])
def test_bmp_is_read(mode, tmp_path):
    grey = GREY8 // 128 * 255 if mode == "1" else GREY8
    Image.fromarray(grey).convert(mode).save(tmp_path / "a.bmp")
    np.testing.assert_array_equal(read_image(tmp_path / "a.bmp"), grey)
    (tmp_path / "a.png").write_bytes((tmp_path / "a.bmp").read_bytes())
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), grey)


UNREAD = [
    ("a.jpg", b"\0\0\0\x20ftypavif", "an AVIF image"),
    ("a.jpg", b"\xff\x0a\xfa\x1f", "a JPEG XL image"),
    ("a.jpg", b"\0\0\0\x0cjP  \r\n\x87\n", "a JPEG 2000 image"),
    ("a.tif", b"II*\0\x10\0\0\0CR\x02\0", r"a raw image of Canon \(CR2\)"),
    ("a.fits", b"XISF0100\xff\0", "an XISF image"),
    ("a.ser", b"LUCAM-RECORDER\xff", "an SER video"),
    ("a.mov", b"\0\0\0\x14ftypqt  \xff", "an MP4 or QuickTime video"),
]


@pytest.mark.parametrize(("name", "data", "words"), UNREAD)
def test_a_format_that_is_not_read_is_named(name, data, words, tmp_path):
    (tmp_path / name).write_bytes(data + bytes(40))
    with pytest.raises(ConfigError, match=f"is {words}, which is not supported; convert it to"):
        starcat.read_frames(tmp_path / name)


def dng(mosaic: np.ndarray, black: int) -> bytes:
    """A raw picture of 16 bits in Adobe's format, as small as LibRaw reads it."""
    height, width = mosaic.shape
    pixels = mosaic.astype("<u2").tobytes()
    matrix = np.stack([np.eye(3).ravel() * 1000, np.full(9, 1000)], axis=1)
    ratios = matrix.astype("<i4").tobytes()
    shorts = lambda *values: (3, len(values), struct.pack(f"<{len(values)}H", *values))  # noqa: E731
    text = b"starcat test\0"
    tags = {
        254: (4, 1, struct.pack("<I", 0)), 256: (4, 1, struct.pack("<I", width)),
        257: (4, 1, struct.pack("<I", height)), 258: shorts(16), 259: shorts(1), 262: shorts(32803),
        271: (2, len(text), text), 272: (2, len(text), text), 273: (4, 1, b""), 277: shorts(1),
        278: (4, 1, struct.pack("<I", height)), 279: (4, 1, struct.pack("<I", len(pixels))),
        33421: shorts(2, 2), 33422: (1, 4, bytes([0, 1, 1, 2])), 50706: (1, 4, bytes([1, 4, 0, 0])),
        50708: (2, len(text), text), 50714: shorts(black), 50717: shorts(65535),
        50721: (10, 9, ratios),
    }  # fmt: skip
    beyond = 8 + 2 + 12 * len(tags) + 4
    extra = b"".join(value for _, _, value in tags.values() if len(value) > 4)
    tags[273] = (4, 1, struct.pack("<I", beyond + len(extra)))
    entries, at = b"", beyond
    for tag, (kind, count, value) in tags.items():
        entries += struct.pack("<HHI", tag, kind, count)
        entries += struct.pack("<I", at) if len(value) > 4 else value.ljust(4, b"\0")
        at += len(value) if len(value) > 4 else 0
    head = b"II*\0" + struct.pack("<IH", 8, len(tags))
    return head + entries + bytes(4) + extra + pixels


def test_a_raw_picture_is_read_above_its_black_level(tmp_path):
    pytest.importorskip("rawpy", reason="rawpy, of the extra raw, is not installed")
    image = np.full((96, 128), 1000.0)
    y, x = np.mgrid[:96, :128] + 0.5
    for x_px, y_px in ((40.25, 30.5), (90.75, 60.0)):
        image += 20_000 * np.exp(-((x - x_px) ** 2 + (y - y_px) ** 2) / 4.0)
    (tmp_path / "a.dng").write_bytes(dng(image, 900))
    grey = read_image(tmp_path / "a.dng")
    assert grey.shape == (96, 128)
    assert np.median(grey) == pytest.approx(100.0, abs=1.0)
    [frame] = starcat.read_frames(tmp_path / "a.dng")
    found = frame.centroids_px[np.argsort(frame.centroids_px[:, 0])]
    np.testing.assert_allclose(found, [(40.25, 30.5), (90.75, 60.0)], atol=0.05)


HEIC = Path(__file__).with_name("two_stars.heic").read_bytes()
"""64 x 48 px of 8 bits, stars at 12.3, 20.6 and 40.2, 8.4; written by pillow-heif 1.8.1."""


@pytest.mark.parametrize(
    ("module", "name", "data", "words"),
    [
        ("sep", "a.png", png(GREY16, 0), re.escape(install_command("images"))),
        ("imagecodecs", "a.png", png(COLOUR16, 2), re.escape(install_command("images"))),
        ("pi_heif", "a.heic", HEIC, r"HEIC needs the package pi-heif .*\[images\]"),
        ("rawpy", "a.NEF", b"MM\0*\0\0\0\x08\xff", r"need the package rawpy .*\[raw\]"),
    ],
)
def test_without_an_extra_it_says_how_to_get_it(monkeypatch, tmp_path, module, name, data, words):
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ConfigError, match=words):
        starcat.read_frames(tmp_path / name)


def test_heic_of_a_telephone_is_read(tmp_path):
    pytest.importorskip("pi_heif", reason="pi-heif, of the extra images, is not installed")
    (tmp_path / "a.heic").write_bytes(HEIC)
    image = read_image(tmp_path / "a.heic")
    assert image.shape == (48, 64)
    assert image[20, 12] > 200.0
    assert image[8, 40] > 100.0
    assert np.median(image) < 30.0


@pytest.mark.parametrize(
    ("name", "data", "word"),
    [
        ("a.png", png(np.dstack([GREY16] * 3), 2)[:900], "cannot be read as PNG"),
        ("a.tif", tiff(np.dstack([GREY16] * 3), "<", 2, 3)[:900], "TIFF|variety"),
        ("a.png", png(GREY16, 0)[:900], "cannot be read as PNG"),
        ("a.png", b"\x89PNG\r\n\x1a\nxyz", "damaged, or a variety"),
        ("a.tif", tiff(GREY16, "<", 1)[:900], "TIFF|variety"),
        ("a.tif", b"II*\0xyz", "TIFF|variety"),
        ("a.gz", b"\x1f\x8bxyz", "damaged gzip file"),
        ("a.gz", gzip.compress(b"hello", mtime=0), "neither FITS nor PNG, TIFF, JPEG, HEIC or BMP"),
        ("a.jpg", b"\xff\xd8\xff\xe0", "damaged, or a variety"),
        ("a.fits", b"", "neither FITS nor PNG, TIFF, JPEG, HEIC or BMP"),
    ],
)
def test_damaged_and_unknown_files_are_refused(name, data, word, tmp_path):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ConfigError, match=word) as caught:
        read_image(tmp_path / name)
    assert str(caught.value).startswith(str(tmp_path / name))
    assert "object at 0x" not in str(caught.value)


def test_files_that_are_cut_or_not_one_plane_are_refused(tmp_path):
    path = tmp_path / "a.fits"
    write_image(path, GREY16)
    data = path.read_bytes()
    for length in (80, 2880, 3000, 2880 + GREY16.nbytes - 1):
        path.write_bytes(data[:length])
        with pytest.raises(ConfigError, match="cannot be read as FITS"):
            read_image(path)
    # Without its last filling a file is whole enough.
    path.write_bytes(data[: 2880 + GREY16.nbytes])
    np.testing.assert_array_equal(read_image(path), GREY16)
    column = fits.Column("a", "E", array=np.zeros(1))
    table = fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU.from_columns([column])])
    table.writeto(tmp_path / "table.fits")
    page = Image.fromarray(GREY8)
    page.save(tmp_path / "pages.tif", save_all=True, append_images=[page])
    for name, word in (
        ("table.fits", "HDU 0 no image; HDU 1 no image"),
        ("pages.tif", "holds 2 images; expected one"),
    ):
        with pytest.raises(ConfigError, match=word):
            read_image(tmp_path / name)


def test_writing_refuses_what_does_not_fit(tmp_path):
    for name, image, error, words in (
        ("a.gif", GREY8, ConfigError, "unknown kind"),
        ("a.fits", COLOUR8, ValueError, "two dimensions"),
        ("a.png", GREY16.astype(float), ValueError, "takes uint8 and uint16"),
        ("a.jpg", GREY16, ValueError, "JPEG takes uint8"),
        ("absent/a.png", GREY8, OutputError, "No such file"),
    ):
        with pytest.raises(error, match=words):
            write_image(tmp_path / name, image)


# Pictures

SPOTS = star_grid(4, 40.0, 12)
NAMES = [f"$^$ {100 + i}" if i % 5 else None for i in range(16)]
SKY_IMAGE = render_image(SPOTS, np.linspace(1.0, 7.0, 16), (160, 160), OPTICS, 19)


def draw(path: Path, **options: Any) -> bytes:
    compass = compass_from_matrix(matrix_from_radec_roll(10.0, 20.0, 30.0))
    arguments: dict[str, Any] = {
        "image": SKY_IMAGE,
        "camera_size": (160, 160),
        "centroids_px": SPOTS,
        "names": NAMES,
        "title": "One & a $^$ frame",
        "mag": np.linspace(1.0, 7.0, 16),
        "below": "12 of $_$",
        "compass": compass,
    }
    draw_identified(path, **(arguments | options))
    return path.read_bytes()


@pytest.fixture(scope="module")
def picture(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("picture") / "a.png"
    draw(path)
    return path


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_a_picture_is_the_same_whatever_the_user_has_set(suffix, picture, tmp_path):
    first = picture.read_bytes() if suffix == ".png" else draw(tmp_path / "a.svg")
    with matplotlib.rc_context({"font.size": 20.0, "xtick.direction": "in", "svg.hashsalt": "x"}):
        assert draw(tmp_path / f"b{suffix}") == first
        assert matplotlib.rcParams["font.size"] == 20.0
    assert b"Date" not in first
    assert matplotlib.__version__.encode() not in first


def test_a_picture_names_stars_and_counts_the_rest(tmp_path, written_words):
    written = written_words
    draw(tmp_path / "a.png")
    for name in NAMES:
        assert name is None or name in written
    for word in ("identified: 12", "not identified: 4", "N", "E", "One & a $^$ frame"):
        assert word in written
    assert "no room" not in " ".join(written)
    written.clear()
    crowd = np.full((90, 2), 80.0) + np.random.default_rng(1).normal(0, 9, (90, 2))
    many = {"centroids_px": crowd, "names": ["HIP 1"] * 90, "mag": None}
    draw(tmp_path / "b.png", compass=None, image=None, **many)
    assert "N" not in written
    assert 5 < written.count("HIP 1") < 60
    assert f"{90 - written.count('HIP 1')} more names have no room" in written


def test_a_picture_shows_rings_where_the_stars_are(picture):
    pixels = matplotlib.image.imread(picture)
    assert 900 <= pixels.shape[1] <= 1200
    left, top, scale = 60, 80, 900 / 160
    ring, diamond = ((np.array(c) / 255) for c in ((0x5A, 0xD1, 0xE6), (0xFF, 0xB4, 0x54)))
    for place, name in zip(SPOTS, NAMES, strict=True):
        x, y = int(left + place[0] * scale), int(top + place[1] * scale)
        patch = pixels[y - 22 : y + 22, x - 22 : x + 22, :3]
        near = {
            kind: (np.abs(patch - colour).max(axis=2) < 0.1).sum()
            for kind, colour in (("ring", ring), ("diamond", diamond))
        }
        assert (near["ring"] > 10) == (name is not None)
        assert (near["diamond"] > 10) == (name is None)


@pytest.mark.parametrize("size", [(1024, 300), (300, 1024), (3000, 2000)])
def test_pictures_have_a_good_size_and_need_no_image(size, tmp_path):
    spots = np.array([[10.0, 10.0], [size[0] - 1.0, size[1] - 1.0]])
    draw(tmp_path / "a.png", image=None, camera_size=size, centroids_px=spots,
         names=["a", None], mag=np.array([2.0, np.nan]))  # fmt: skip
    height, width = matplotlib.image.imread(tmp_path / "a.png").shape[:2]
    assert 900 <= max(width, height) <= 1200
    assert min(width, height) >= 400


def test_a_frame_without_spots_is_a_picture_too_of_a_kind_that_can_be_drawn(tmp_path):
    nothing = {"centroids_px": np.empty((0, 2)), "names": [], "mag": None, "compass": None}
    assert draw(tmp_path / "a.png", image=None, **nothing)
    with pytest.raises(ConfigError, match="a picture is"):
        draw(tmp_path / "a.pdf")
    with pytest.raises(OutputError, match="No such file"):
        draw(tmp_path / "absent" / "a.png", **nothing)


def test_brighter_stars_have_larger_marks():
    assert mark_radii(3, np.array([2.0, 4.0, 3.0])).tolist() == [10.0, 5.0, 7.5]
    assert mark_radii(3, np.array([2.0, np.nan, 3.0])).tolist() == [10.0, 5.0, 5.0]
    assert mark_radii(2, np.array([3.0, 3.0])).tolist() == [5.0, 5.0]
    for nothing in (None, np.full(2, np.nan)):
        assert mark_radii(2, nothing).tolist() == [6.0, 6.0]


@pytest.mark.parametrize("roll_deg", [0.0, 33.0, 200.0])
def test_the_compass_points_where_north_and_east_are(roll_deg):
    matrix = matrix_from_radec_roll(75.0, 40.0, roll_deg)
    places = np.radians([(75.0, 40.0), (75.0, 40.001), (75.001, 40.0)])
    ra, dec = places.T
    icrs = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    seen = (icrs @ matrix.T)[:, :2]
    for direction, to in zip(compass_from_matrix(matrix), seen[1:] - seen[0], strict=True):
        np.testing.assert_allclose(direction, to / np.hypot(*to), atol=1e-4)


@pytest.mark.parametrize("free", [(0, 1), (0, 0), (1, 1), (1, 0)])
def test_the_compass_stands_in_the_emptiest_corner(free):
    corners = {(0, 1), (0, 0), (1, 1), (1, 0)} - {free}
    spots = 100.0 * np.array(sorted(corners)) + np.where(np.array(sorted(corners)) > 0, -9, 9)
    axes = Figure().add_axes((0.0, 0.0, 1.0, 1.0))
    plate = FrameAxes(axes, 2.0, (100, 100), spots, ["a", "b", "c"], np.full(3, 6.0))
    box = draw_compass(plate, (np.array([0.0, -1.0]), np.array([-1.0, 0.0])))
    assert tuple((box[0, :2] > 50.0).astype(int)) == free
    assert draw_compass(plate, None).shape == (0, 4)


def test_labels_cover_nothing():
    generator = np.random.default_rng(2)
    centres = generator.uniform(0.0, 600.0, (80, 2))
    radii, sizes = generator.uniform(4.0, 9.0, 80), np.tile([50.0, 10.0], (80, 1))
    taken = np.array([[0.0, 500.0, 80.0, 600.0]])
    placed = place_labels(centres, radii, sizes, list(range(80)), (600.0, 600.0), taken)
    assert 50 < len(placed) < 80
    boxes = np.array([[x, y, x + 50.0, y + 10.0] for x, y in placed.values()])
    marks = np.concatenate([centres - radii[:, None], centres + radii[:, None]], axis=1)
    assert boxes.min() >= 0.0
    assert boxes.max() <= 600.0
    for number, (mark, box) in enumerate(zip(placed, boxes, strict=True)):
        others = np.concatenate([np.delete(boxes, number, 0), np.delete(marks, mark, 0), taken])
        over = (others[:, :2] < box[2:]).all(axis=1) & (others[:, 2:] > box[:2]).all(axis=1)
        assert not over.any()
        # Next to its own star and no other.
        gap = np.maximum(0.0, np.maximum(box[:2] - centres[mark], centres[mark] - box[2:]))
        assert np.hypot(*gap) < 2.0 * radii[mark]


def test_images_are_shown_from_black_to_white():
    shown = stretch(SKY_IMAGE)
    assert shown.shape == SKY_IMAGE.shape
    assert (shown.min(), shown.max()) == (0.0, 1.0)
    assert np.median(shown) < 0.1
    brightest = np.unravel_index(SKY_IMAGE.argmax(), SKY_IMAGE.shape)
    assert shown[brightest] == 1.0
    assert not stretch(np.full((9, 9), np.nan)).any()
    assert stretch(np.full((9, 9), 3.0)).max() < 0.2
    holed = SKY_IMAGE.astype(float)
    holed[:5] = np.nan
    assert not stretch(holed)[:5].any()
    # Large images keep their stars.
    image = np.random.default_rng(3).normal(100.0, 1.0, (1801, 2703))
    image[1000, 2000] = 900.0
    shown = stretch(image)
    assert shown.shape == (601, 901)
    assert shown[1000 // 3, 2000 // 3] == shown.max()
