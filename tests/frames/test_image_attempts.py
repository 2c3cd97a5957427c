"""Images whose first spots are not identified: other spots of the same image are tried."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from skies import product_arrays

from starcat.database.products.levels import find_levels, level_fields
from starcat.frames.images.attempts import MAX_SEARCHES, counted, further_attempts
from starcat.frames.images.blocks import BLOCK_PX, without_block_edges
from starcat.frames.images.image_file import write_image
from starcat.frames.images.measure import LocalInputs, measure_file
from starcat.frames.images.render import Optics, star_electrons
from starcat.frames.images.solve_files import answer_file
from starcat.geometry.attitude import random_attitudes
from starcat.geometry.camera import Camera
from starcat.matcher.matcher import Matcher
from starcat.matcher.options import IdentifyOptions

SIZE = (512, 512)
SKY_E, NOISE_E = 20.0, 1.0
OPTICS = Optics(psf_sigma_px=1.3, zero_point_e=5e4, full_well_e=1e9)


@pytest.fixture(scope="module")
def matcher(small_database):
    return Matcher.open(small_database)


def stars_of(matcher, seed, count=14):
    """Return centroids, magnitudes and attitude of the brightest stars of a frame."""
    database = matcher.database
    camera, matrix = database.camera, random_attitudes(1, np.random.default_rng(seed))[0]
    body = database.directions @ matrix.T
    rows = np.flatnonzero(body[:, 2] > np.cos(camera.radius_rad))
    px = camera.pixels_from_directions(body[rows])
    rows, px = rows[camera.contains(px)], px[camera.contains(px)]
    first = np.argsort(database.mag[rows], kind="stable")[:count]
    return px[first], database.mag[rows[first]], matrix


def with_false_spots(px, mag, size, count, range_mag, seed):
    """Return stars and false spots of some magnitudes."""
    rng = np.random.default_rng([seed, 1])
    false = rng.uniform(10.0, np.subtract(size, 10.0), (count, 2))
    return np.vstack([px, false]), np.append(mag, rng.uniform(*range_mag, count))


def noisy(px, mag, size, seed):
    light = star_electrons(px, mag, size, OPTICS)
    return light + np.random.default_rng(seed).normal(SKY_E, NOISE_E, light.shape)


def pictured(path, matcher, seed, stars, false_mag=None):
    """Write a picture of some stars, among 300 false spots of some magnitudes or alone."""
    px, mag, matrix = stars_of(matcher, seed, stars)
    if false_mag is not None:
        px, mag = with_false_spots(px, mag, SIZE, 300, false_mag, seed)
    write_image(path, noisy(px, mag, SIZE, seed).astype(np.float32))
    return matrix


def is_right(answer, matrix):
    turned = answer.result.matrix @ matrix.T
    return np.degrees(np.linalg.norm(turned - np.eye(3)) / np.sqrt(2.0)) < 0.3


def first_search(matcher, path):
    [frame] = measure_file(path).frames
    camera = matcher.database.camera
    return matcher.identify(frame.centroids_px, camera, mag=frame.mag, fov_error=0.05)


@pytest.mark.parametrize(
    ("seed", "stars", "false_mag", "number", "limit"),
    [(2, 6, (8.25, 8.5), 4, 1e-9), (30, 6, (7.6, 8.1), 5, 1e-9), (49, 7, (5.5, 6.5), 6, 1e-13)],
    ids=["8 sigma", "15 sigma", "40 brightest"],
)
def test_few_stars_among_many_spots_are_found_in_a_further_attempt(
    matcher, tmp_path, seed, stars, false_mag, number, limit
):
    path = tmp_path / "a.fits"
    matrix = pictured(path, matcher, seed, stars, false_mag)
    matcher = Matcher(matcher.database, max_false_match_probability=limit)
    assert not first_search(matcher, path).ok
    [answer] = answer_file(path, matcher)
    assert answer.attempt.number == number
    assert is_right(answer, matrix)
    assert answer.result.n_matched >= 5
    assert len(answer.frame.centroids_px) == len(answer.result.star_index) <= 100


def test_higher_thresholds_than_stated_are_tried_and_others_not():
    def numbers(is_limited=False, **given):
        tried = further_attempts(IdentifyOptions(**given), is_limited=is_limited)
        return [(attempt.number, attempt.threshold) for attempt in tried]

    assert numbers() == [(2, 3.5), (3, 5.0), (4, 8.0), (5, 15.0), (6, None)]
    assert numbers(threshold=9.0) == [(2, 9.0 * 0.7), (3, 9.0), (5, 15.0), (6, None)]
    assert numbers(is_limited=True, most_spots=40) == [(3, 5.0), (4, 8.0), (5, 15.0)]
    assert len(numbers()) + 2 == MAX_SEARCHES


def test_the_chance_of_a_further_attempt_counts_all_searches(matcher, tmp_path):
    path = tmp_path / "a.fits"
    pictured(path, matcher, 2, 6, (8.25, 8.5))
    answers = answer_file(path, matcher)
    [answer] = answers
    frame, camera = answer.frame, matcher.database.camera
    alone = matcher.identify(frame.centroids_px, camera, mag=frame.mag, fov_error=0.05)
    chance = answer.result.false_match_probability
    assert chance == pytest.approx(MAX_SEARCHES * alone.false_match_probability)

    said = answer.content()
    assert (said["attempt"], said["searches_in_chance"]) == (4, MAX_SEARCHES)
    assert said["spots_of_attempt"] == "a threshold of 8 times the noise"
    json.dumps(said)
    [note] = answers.notes(answer)
    assert "in attempt 4, with a threshold of 8 times the noise; the chance" in note
    assert f"counts all {MAX_SEARCHES} searches" in note

    # Between the bound of its search alone and that of all searches an answer is withheld.
    strict = Matcher(matcher.database, max_false_match_probability=2.0 * chance / MAX_SEARCHES)
    [other] = answer_file(path, strict)
    assert other.attempt.number == 5
    assert other.result.false_match_probability < strict.settings.max_false_match_probability


def test_an_answer_is_withheld_above_the_limit_of_all_searches(matcher):
    px, mag, _ = stars_of(matcher, 2)
    found = matcher.identify(px, mag=mag)
    almost = replace(found, false_match_probability=1e-10)
    assert counted(almost, 1e-9).false_match_probability == pytest.approx(MAX_SEARCHES * 1e-10)
    assert counted(replace(found, false_match_probability=2e-10), 1e-9) is None
    assert counted(replace(found, false_match_probability=0.5), 1.0).false_match_probability == 1.0
    assert counted(matcher.identify(px[:2]), 1.0) is None


def test_the_first_attempt_states_its_own_chance(matcher, tmp_path):
    path = tmp_path / "a.fits"
    pictured(path, matcher, 3, 14)
    first = first_search(matcher, path)
    answers = answer_file(path, matcher)
    [answer] = answers
    assert answer.attempt is None
    assert answer.result.false_match_probability == first.false_match_probability
    assert not {"attempt", "spots_of_attempt", "searches_in_chance"} & set(answer.content())
    assert answers.notes(answer) == []


def test_the_same_spots_are_not_searched_twice(matcher, tmp_path, monkeypatch):
    spots = np.random.default_rng(3).uniform(20.0, 490.0, (30, 2))
    path = tmp_path / "a.fits"
    write_image(path, noisy(spots, np.linspace(2.0, 3.0, 30), SIZE, 3).astype(np.float32))
    searched, search = [], Matcher.identify

    def record(self, px, *arguments, **named):
        searched.append(np.asarray(px))
        return search(self, px, *arguments, **named)

    monkeypatch.setattr(Matcher, "identify", record)
    [answer] = answer_file(path, matcher)
    assert not answer.result.ok
    # Two of the first attempt, and one deeper where that finds other spots; then mirrored, and in
    # five parts of other fields. Numpy, whose steps are limited, leaves some out.
    assert 6 <= len(searched) <= 9


@pytest.mark.parametrize("limit", [{"max_steps": 1}, {"time_limit_s": 0.001}])
def test_a_limit_that_is_stated_ends_all_attempts(matcher, tmp_path, limit):
    path = tmp_path / "a.fits"
    pictured(path, matcher, 0, 6, (5.5, 6.5))
    limited = Matcher(matcher.database, **limit)
    [answer] = answer_file(path, limited, IdentifyOptions(**limit))
    assert answer.result.refusal.reason in ("steps", "time")


def test_stars_on_the_stairs_of_a_jpeg_are_found(matcher, tmp_path):
    px, mag, matrix = stars_of(matcher, 1, 20)
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    glow = 60.0 * np.exp(-((x - 150.0) ** 2 + (y - 300.0) ** 2) / (2.0 * 200.0**2))
    path = tmp_path / "a.jpg"
    image = np.clip(np.rint(noisy(px, mag, SIZE, 1) + glow), 0, 255).astype(np.uint8)
    write_image(path, image, quality=10)
    assert not first_search(matcher, path).ok
    [answer] = answer_file(path, matcher)
    assert answer.attempt.without_blocks
    assert is_right(answer, matrix)


@pytest.mark.parametrize("shift", [(0, 0), (3, 5), (7, 1)])
def test_steps_between_blocks_are_taken_out(shift):
    rng = np.random.default_rng(5)
    stairs = np.kron(rng.integers(0, 40, (14, 12)), np.ones((BLOCK_PX, BLOCK_PX)))
    image = stairs[shift[0] : shift[0] + 101, shift[1] : shift[1] + 83].astype(np.float32)
    assert np.abs(without_block_edges(image)).max() == 0.0
    star = image.copy()
    star[50:53, 40:43] += 100.0
    left = without_block_edges(star)
    np.testing.assert_array_equal(left, star - image)
    star[:, :20] = np.nan
    left = without_block_edges(star)
    assert np.isnan(left[:, :20]).all()
    np.testing.assert_array_equal(left[:, 20:], (star - image)[:, 20:])


def test_an_image_without_blocks_stays_as_it_is():
    noise = np.random.default_rng(6).normal(100.0, 5.0, (200, 300))
    for image in (noise, np.zeros((64, 64)), np.full((64, 64), np.nan), np.ones((16, 9))):
        assert without_block_edges(image) is None


@pytest.mark.slow
def test_a_range_of_fields_finds_what_the_stated_scale_finds(sky_of, random_directions, tmp_path):
    """Pictures of the database's own field with false spots; some need further attempts."""
    own = Camera(640, 480, fov_x_deg=12.0)
    sky = sky_of(random_directions(7000, 3), own, boresights=2000)
    made = find_levels(
        sky.directions, sky.mag, own, level_fields(own, 30.0, 1.5),
        boresights=2000, stars_per_field=20, brightest=8,
    )  # fmt: skip
    sky = replace(sky, products={**sky.products, "levels": product_arrays(made)})
    matcher = Matcher(sky)
    found, stated = {}, LocalInputs(camera=own)
    for seed in range(12):
        px, mag, matrix = stars_of(matcher, seed, 12)
        mag = 2.0 + 2.0 * (mag - mag.min()) / np.ptp(mag)
        size = own.width_px, own.height_px
        spots = with_false_spots(px, mag, size, 40 * (seed % 4), (5.0, 8.5), seed)
        path = tmp_path / f"{seed}.fits"
        write_image(path, noisy(*spots, size, seed).astype(np.float32))
        [known] = answer_file(path, matcher, local=stated)
        [blind] = answer_file(path, matcher, IdentifyOptions(fov_deg=(11.0, 30.0)))
        found[seed] = known.result.ok, blind.result.ok
        for answer in (known, blind):
            assert not answer.result.ok or is_right(answer, matrix)
    assert sum(known for known, _ in found.values()) >= 10
    assert all(blind for known, blind in found.values() if known)
