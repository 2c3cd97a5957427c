"""Pictures as cameras take them: coarse, clipped, compressed, with town light, Moon and defects."""

from __future__ import annotations

import hard_pictures
import numpy as np
import pytest
from frames import needs_c
from hard_pictures import KINDS, MORE_KINDS, Scene, in_file_steps, scene_light, verdicts
from scipy.spatial import cKDTree

from starcat.errors import ConfigError
from starcat.frames.images.background import subtract_background
from starcat.frames.images.centroiding import find_spots
from starcat.frames.images.image_file import (
    grey_of_mosaic,
    without_dark,
    without_dead_zones,
    write_image,
)
from starcat.frames.images.measure import LocalInputs, measure_file
from starcat.frames.images.render import Optics, render_image, star_electrons
from starcat.frames.images.solve_files import FOV_ERROR, answer_file
from starcat.frames.images.spots import best_widths
from starcat.geometry.attitude import random_attitudes
from starcat.matcher.matcher import Matcher
from starcat.matcher.options import IdentifyOptions
from starcat.pipeline.build import build
from starcat.pipeline.specs.reading import preset

SIZE = (400, 300)


@pytest.fixture(scope="module")
def matcher(tmp_path_factory: pytest.TempPathFactory) -> Matcher:
    built = build(preset("gaia-12deg"), tmp_path_factory.mktemp("sky"))
    return Matcher.open(built.folder)


def stars(count: int, seed: int, faintest: float = 6.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(10, [SIZE[0] - 10, SIZE[1] - 10], (count, 2)), rng.uniform(
        3, faintest, count
    )


def grid(first: int, pitch: int, shift: float) -> np.ndarray:
    """Places all over a picture, off the pixels' middles by up to a shift."""
    axes = (np.arange(first, side - 10, pitch) for side in SIZE)
    places = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    return places + np.random.default_rng(1).uniform(-shift, shift, places.shape)


def picture(seed: int = 1, scene: Scene | None = None, **optics: float) -> np.ndarray:
    scene, eye = scene or Scene(), Optics(**optics)
    light = scene_light(scene, SIZE, eye.full_well_e, seed)
    return in_file_steps(render_image(*stars(40, seed), SIZE, eye, seed, light), scene)


@pytest.mark.timeout(1800)
@pytest.mark.slow
@pytest.mark.parametrize(("kinds", "least"), [(KINDS, 19), (MORE_KINDS, 16)], ids=["all", "clouds"])
def test_hard_pictures_are_identified(matcher, tmp_path, kinds, least):
    said = list(verdicts(matcher, tmp_path, 20, list(kinds)))
    for kind in kinds:
        of_kind = [word for taken, word in said if taken.kind == kind]
        assert "wrong" not in of_kind
        assert of_kind.count("right") >= least, (kind, of_kind)


@pytest.mark.parametrize("kind", ["8 bits", "JPEG 60", "clipped", "hot pixels"])
def test_stars_of_a_hard_picture_are_found(kind, tmp_path):
    rng = np.random.default_rng(3)
    taken = hard_pictures.KINDS[kind](rng)
    places, mag = stars(30, 4, 5.0)
    optics = Optics(psf_sigma_px=taken.optics.psf_sigma_px, hot_pixels=taken.optics.hot_pixels // 8)
    image = in_file_steps(render_image(places, mag, SIZE, optics, 5), taken.scene)
    path = tmp_path / ("a.png" if taken.quality is None else "a.jpg")
    write_image(path, image, **({} if taken.quality is None else {"quality": taken.quality}))
    [frame] = measure_file(path).frames
    distance, _ = cKDTree(frame.centroids_px).query(places)
    assert (distance < 0.7).sum() >= 26
    if taken.quality is None:  # some of the noise that compression leaves stands out
        assert len(frame.centroids_px) <= 45
    assert (distance[np.argsort(mag)[:10]] < 0.7).all()


@pytest.mark.parametrize("sigma", [0.6, 1.0, 2.0, 4.0])
def test_the_width_of_each_spot_is_that_of_its_gaussian(sigma):
    places = grid(40, 60, 0.5)
    optics = Optics(psf_sigma_px=sigma, full_well_e=1e9)
    image = render_image(places, np.full(len(places), 4.0), SIZE, optics, 2)
    widths, snr = best_widths(subtract_background(image), places - 0.5)
    assert np.median(widths) == pytest.approx(sigma, rel=0.02)
    assert widths == pytest.approx(sigma, rel=0.15)
    assert (snr > 50.0).all()


@pytest.mark.parametrize(
    "scene",
    [
        Scene(bits=8, black_adu=100.0, adu_per_step=12.0),
        Scene(bits=8, black_adu=135.0, adu_per_step=6.0),
        Scene(bits=8, black_adu=90.0, adu_per_step=6.0, nebula_e=100.0, nebula_px=12.0),
        Scene(moon_px=(350.0, 40.0), glow_e=3000.0),
        Scene(town_light_e=2000.0),
    ],
    ids=["coarse", "clipped", "nebula", "Moon", "town"],
)
def test_the_width_is_measured_in_any_picture(scene):
    image = picture(7, scene, psf_sigma_px=1.3)
    spots = find_spots(image)
    assert spots.psf_sigma_px == pytest.approx(1.3, rel=0.25)
    places, mag = stars(40, 7)
    distance, _ = cKDTree(spots.centroids_px).query(places[mag < 4.5])
    assert (distance < 0.5).mean() > 0.8
    some = find_spots(image, most_spots=10)  # the brightest ones
    np.testing.assert_array_equal(some.flux, spots.flux[:10])


def test_a_clipped_background_has_few_false_spots():
    scene = Scene(bits=8, black_adu=133.0, adu_per_step=4.0)
    light = render_image(np.empty((0, 2)), np.empty(0), (1024, 1024), Optics(), 3)
    assert len(find_spots(in_file_steps(light, scene))) <= 40


def elongated(sky: tuple[np.ndarray, np.ndarray], by_px: np.ndarray) -> np.ndarray:
    """An image of stars whose light is spread along lines."""
    places, mag = sky
    parts = np.linspace(-0.5, 0.5, 25)[:, None, None] * by_px + places
    faint = np.repeat(mag[None] + 2.5 * np.log10(25), 25, axis=0).ravel()
    return render_image(parts.reshape(-1, 2), faint, SIZE, Optics(), 4)


@pytest.mark.parametrize("length_px", [15.0, 60.0])
def test_streaks_are_measured_at_their_middles(length_px):
    places = grid(50, 100, 3.0)
    sky = places, np.random.default_rng(5).uniform(2.0, 4.0, len(places))
    spots = find_spots(elongated(sky, length_px * np.array([0.8, 0.6])), gain_e_per_adu=1.0)
    assert spots.streak is not None
    assert spots.streak.length_px == pytest.approx(length_px, rel=0.06)
    distance, index = cKDTree(spots.centroids_px).query(places)
    near = distance < 1.5
    assert near.sum() >= 11
    pull = (spots.centroids_px[index] - places)[near] / spots.sigma_px[index][near, None]
    assert 0.5 < np.median(pull**2) / 0.455 < 2.0


def test_lines_that_are_no_trails_are_measured_as_stars():
    places, mag = stars(25, 3, 4.0)
    # The width of spots is stated.
    spots = find_spots(elongated((places, mag), np.array([12.0, 9.0])), psf_sigma_px=1.5)
    assert spots.streak is None
    assert len(spots) > 10
    # Long spots of a lens point outwards.
    outwards = places - 0.5 * np.array(SIZE)
    outwards *= 12.0 / np.linalg.norm(outwards, axis=1)[:, None]
    assert len(find_spots(elongated((places, mag), outwards))) > 10


@pytest.mark.parametrize("sigma", [0.8, 1.2, 2.5])
@pytest.mark.parametrize(
    ("faintest", "background_e"), [(6.0, 20.0), (7.5, 20.0), (6.0, 1000.0)],
    ids=["bright", "faint", "bright sky"],
)  # fmt: skip
def test_the_errors_of_centroids_are_what_is_said_of_them(sigma, faintest, background_e):
    rng = np.random.default_rng(int(10 * sigma))
    axis = np.arange(25, 590, 36)
    places = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2) + rng.uniform(-1, 1, (256, 2))
    mag = rng.uniform(faintest - 2.5, faintest, len(places))
    optics = Optics(psf_sigma_px=sigma, full_well_e=1e9, background_e=background_e)
    spots = find_spots(render_image(places, mag, (620, 620), optics, 3), gain_e_per_adu=1.0)
    distance, index = cKDTree(places).query(spots.centroids_px)
    near = distance < 3.0
    pull = (spots.centroids_px - places[index])[near] / spots.sigma_px[near, None]
    # The standard deviation of the mean of 300 squares and more is 0.08.
    assert near.sum() > 150
    assert 0.8 < (pull**2).mean() < 1.25


def test_faint_stars_among_many_hot_pixels_are_found_without_those():
    places, mag = stars(40, 11, 4.0)
    optics = Optics(psf_sigma_px=1.3, hot_pixels=3600, zero_point_e=50_000.0)
    image = render_image(places, mag, SIZE, optics, 12)

    def found(**how: object) -> tuple[int, int]:
        spots = find_spots(image, **how)
        distance, _ = cKDTree(places).query(spots.centroids_px) if len(spots) else (np.empty(0), 0)
        return int((distance < 1.0).sum()), len(spots)

    assert found()[0] < 10
    right, count = found(without_hot_pixels=True)
    assert right >= 35
    assert count < 60


@needs_c
def test_a_picture_without_an_answer_is_measured_deeper(small_database, tmp_path):
    matcher = Matcher.open(small_database)
    camera, matrix = matcher.database.camera, random_attitudes(1, np.random.default_rng(4))[0]
    body = matcher.database.directions @ matrix.T
    seen = np.flatnonzero(body[:, 2] > 0.9)
    places, mag = camera.pixels_from_directions(body[seen]), matcher.database.mag[seen]
    optics = Optics(psf_sigma_px=1.3, hot_pixels=8000, zero_point_e=80_000.0)
    path = tmp_path / "faint.png"
    size = camera.width_px, camera.height_px
    write_image(path, render_image(places, mag, size, optics, 5))
    measured = measure_file(path)
    [frame] = measured.frames
    first = matcher.identify(frame.centroids_px, camera, mag=frame.mag, fov_error=FOV_ERROR)
    assert not first.ok
    [answer] = answer_file(path, matcher)
    assert answer.result.ok
    turned = answer.result.matrix @ matrix.T
    assert np.degrees(np.linalg.norm(turned - np.eye(3)) / np.sqrt(2.0)) < 0.1


def test_a_dark_frame_takes_hot_pixels_out(tmp_path):
    rng = np.random.default_rng(8)
    current = np.where(rng.uniform(size=SIZE[::-1]) < 0.01, rng.uniform(500, 3e4, SIZE[::-1]), 0.0)
    lid = render_image(np.empty((0, 2)), np.empty(0), SIZE, Optics(background_e=0.0), 1, current)
    image = render_image(*stars(40, 5), SIZE, Optics(full_well_e=6e4), 2, current)
    write_image(tmp_path / "image.fits", image)
    write_image(tmp_path / "dark.fits", lid)
    given = tmp_path / "image.fits", IdentifyOptions(psf_sigma_px=1.0)
    [bare] = measure_file(*given).frames
    [frame] = measure_file(*given, LocalInputs(dark=tmp_path / "dark.fits")).frames
    assert len(frame.centroids_px) < len(bare.centroids_px)
    distance, _ = cKDTree(frame.centroids_px).query(stars(40, 5)[0])
    assert (distance < 0.5).sum() >= 36


def test_no_spot_is_found_in_a_dead_zone(tmp_path):
    mask = np.zeros(SIZE[::-1], dtype=np.uint8)
    mask[:, 200:] = 255
    write_image(tmp_path / "image.png", picture(5))
    write_image(tmp_path / "mask.png", mask)
    local = LocalInputs(mask=tmp_path / "mask.png")
    [frame] = measure_file(tmp_path / "image.png", local=local).frames
    places, _ = stars(40, 5)
    assert (frame.centroids_px[:, 0] < 201.0).all()
    distance, _ = cKDTree(frame.centroids_px).query(places[places[:, 0] < 195.0])
    assert (distance < 0.5).mean() > 0.9


def test_what_repairs_has_the_size_of_the_image_and_leaves_something():
    for repair in (without_dark, without_dead_zones):
        with pytest.raises(ConfigError, match="40 x 30 px, the image 50 x 30; expected the same"):
            repair(np.zeros((30, 50)), np.zeros((30, 40)))
    with pytest.raises(ConfigError, match="leaves no pixel"):
        without_dead_zones(np.zeros((30, 50)), np.ones((30, 50)))


@pytest.mark.parametrize("order", ["RGGB", "BGGR", "GRBG", "GBRG"])
@pytest.mark.parametrize("star", [(1.0, 0.6, 0.3), (0.2, 0.5, 1.0)], ids=["red", "blue"])
def test_centroids_behind_a_mosaic_do_not_depend_on_colour(order, star):
    places = grid(30, 30, 1.0)
    light = star_electrons(places, np.full(len(places), 2.0), SIZE, Optics(psf_sigma_px=1.2))
    mosaic = np.empty(SIZE[::-1])
    for number, colour in enumerate(order):
        cell = slice(number // 2, None, 2), slice(number % 2, None, 2)
        at = "RGB".index(colour)
        mosaic[cell] = star[at] * light[cell] + (300.0, 900.0, 500.0)[at]
    spots = find_spots(grey_of_mosaic(mosaic), psf_sigma_px=1.4)
    distance, index = cKDTree(spots.centroids_px).query(places)
    assert distance.max() < 0.12
    assert np.abs((spots.centroids_px[index] - places).mean(axis=0)).max() < 0.01
