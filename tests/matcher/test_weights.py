"""Noise of centroids: weights of the attitude, covariance, chi-square, and messages."""

from __future__ import annotations

import math

import numpy as np
import pytest
from frames import ARCSEC, ENGINES, both_engines, error_arcsec

from starcat.database.onboard.layout import DIRECTION_SCALE
from starcat.errors import ConfigError
from starcat.frames.images.centroiding import find_spots
from starcat.frames.images.render import Optics, render_image
from starcat.frames.images.spots import weighed
from starcat.geometry.camera import Camera
from starcat.geometry.distortion import Distortion
from starcat.matcher.matcher import Matcher
from starcat.pipeline.simulation.simulate import Noise, simulate_frames

CAMERA = Camera(1024, 1024, fov_x_deg=20.0)
LENS = Camera(1024, 1024, fov_x_deg=30.0, distortion=Distortion(k1=-0.3))


def truth_of(sky, camera, seed=5):
    [frame] = simulate_frames(sky.directions, camera, 1, Noise(0.0), seed, mag=sky.mag)
    return frame


def growing(frame, _rng=None):
    """Noise that doubles in 1.5 mag, as photon noise does."""
    return 0.05 * 10.0 ** (0.2 * (frame.mag - frame.mag.min()))


MODELS = {
    "the same, small": lambda frame, rng: np.full(len(frame.mag), 0.08),
    "the same, large": lambda frame, rng: np.full(len(frame.mag), 0.5),
    "growing with magnitude": growing,
    "any": lambda frame, rng: 0.1 * np.exp(rng.normal(0.0, 0.8, len(frame.mag))),
    "some not known": lambda frame, rng: np.where(frame.mag > np.median(frame.mag), np.nan, 0.2),
}


def answers(sky, camera, model, count, engine="auto", *, is_told=True):
    """Yield the truth and the answers to one frame with noise after noise."""
    frame, rng = truth_of(sky, camera), np.random.default_rng(8)
    matcher = Matcher(sky, tolerance_px=4.0, engine=engine)
    for _ in range(count):
        sigma_px = model(frame, rng)
        true_px = np.where(np.isnan(sigma_px), 0.9, sigma_px)
        px = frame.centroids_px + rng.normal(size=(len(sigma_px), 2)) * true_px[:, None]
        found = matcher.identify(px, camera, sigma_px=sigma_px if is_told else None)
        assert found.ok
        yield frame, sigma_px, found


def bound_arcsec(frame, sigma_px):
    """Least errors about x, y and z (Cramer and Rao), by how the pixels move with each turn."""
    body, step = CAMERA.directions_from_pixels(frame.centroids_px), 1e-6
    turned = [body + step * np.cross(axis, body) for axis in np.eye(3)]
    moved = [(CAMERA.pixels_from_directions(one) - frame.centroids_px) / step for one in turned]
    slopes = (np.array(moved) / sigma_px[:, None]).reshape(3, -1)
    return ARCSEC * np.sqrt(np.linalg.inv(slopes @ slopes.T).diagonal())


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_chi_square_is_1_where_the_noise_is_stated_rightly(sky, camera, model):
    found = [found for _, _, found in answers(sky, camera, model, 150)]
    # The mean of 150 chi-squares of some 40 degrees has a standard deviation of 0.02.
    assert 0.93 <= np.mean([one.reduced_chi_square for one in found]) <= 1.07
    assert sum(bool(one.remarks) for one in found) <= 3


def test_weights_reach_the_bound_that_no_weights_miss(sky):
    rms = []
    for is_told in (True, False):
        found = answers(sky, CAMERA, growing, 2000, is_told=is_told)
        errors = [error_arcsec(one, frame.matrix) for frame, _, one in found]
        rms.append(np.sqrt(np.square(errors).mean(axis=0)))
    frame = truth_of(sky, CAMERA)
    bound = bound_arcsec(frame, growing(frame))
    np.testing.assert_allclose(rms[0], bound, rtol=0.04)
    assert (rms[1] > 1.1 * bound).all()


def test_both_engines_weigh_alike(sky):
    if len(ENGINES) < 2:
        pytest.skip("starcat was installed without a C compiler")
    for name in ("any", "some not known"):
        pair = [list(answers(sky, LENS, MODELS[name], 3, engine)) for engine in ENGINES]
        for (_, _, one), (_, _, other) in zip(*pair, strict=True):
            # The directions of an image are rounded.
            np.testing.assert_allclose(one.matrix, other.matrix, atol=1.0 / DIRECTION_SCALE)
            np.testing.assert_allclose(one.covariance_arcsec2, other.covariance_arcsec2, rtol=1e-5)
            assert one.reduced_chi_square == pytest.approx(other.reduced_chi_square, rel=1e-5)


def test_many_frames_are_weighed_as_one(sky):
    frame, rng = truth_of(sky, CAMERA), np.random.default_rng(3)
    sigma_px = growing(frame)
    frames = [frame.centroids_px + rng.normal(size=(len(sigma_px), 2)) * sigma_px[:, None]] * 2
    matcher = Matcher(sky)
    plain, told = matcher.identify_many(frames, sigma_px=[np.full(len(sigma_px), np.nan), sigma_px])
    one = matcher.identify(frames[1], sigma_px=sigma_px)
    assert told.q_body_from_icrs.tolist() == one.q_body_from_icrs.tolist()
    assert np.abs(plain.q_body_from_icrs - one.q_body_from_icrs).max() > 1e-9
    assert math.isnan(plain.reduced_chi_square)
    same = np.full(len(sigma_px), 0.2)
    known = matcher.identify(frames[1], sigma_px=same)
    one = matcher.identify(frames[1], sigma_px=0.2)
    assert one.frame.sigma_px.tolist() == same.tolist()
    assert one == known
    for told in matcher.identify_many(frames, sigma_px=[0.2, same]):
        assert told.covariance_arcsec2.tolist() == known.covariance_arcsec2.tolist()


@both_engines
def test_a_noise_stated_too_small_is_noticed(sky, engine):
    frame, rng = truth_of(sky, CAMERA), np.random.default_rng(4)
    noisy = frame.centroids_px + rng.normal(0.0, 0.5, frame.centroids_px.shape)
    found = Matcher(sky, noise_px=0.25, engine=engine).identify(noisy)
    assert found.reduced_chi_square == pytest.approx(4.0, rel=0.5)
    [remark] = found.remarks
    assert "times the stated noise" in remark
    assert Matcher(sky, noise_px=0.5, engine=engine).identify(noisy).remarks == ()


def test_one_spot_that_is_known_to_be_bad_hardly_counts(sky):
    frame = truth_of(sky, CAMERA)
    px = frame.centroids_px.copy()
    px[0] += 2.0
    sigma_px = np.full(len(px), 0.1)
    plain = error_arcsec(Matcher(sky).identify(px, sigma_px=sigma_px), frame.matrix)
    sigma_px[0] = np.nan
    told = error_arcsec(Matcher(sky).identify(px, sigma_px=sigma_px), frame.matrix)
    assert np.abs(told).max() < 1e-3 * np.abs(plain).max()


@pytest.mark.parametrize(
    ("sigma_px", "words"),
    [
        ([0.1, 0.2], r"sigma_px has shape \(2,\)"),
        ([0.1, 0.1, 0.0, 0.1], "sigma_px: 0 for centroid 2; expected above 0"),
        ([0.1, -0.1, 0.1, 0.1], "sigma_px: -0.1 for centroid 1"),
        (0.0, "sigma_px: 0 for centroid 0; expected above 0"),
        (["a", 1, 1, 1], "not an array of real numbers"),
    ],
)
def test_noises_that_cannot_be_are_refused(sky, sigma_px, words):
    px = [[1.0, 2.0], [300.0, 4.0], [50.0, 600.0], [700.0, 8.0]]
    with pytest.raises(ConfigError, match=words):
        Matcher(sky).identify(px, sigma_px=sigma_px)
    with pytest.raises(ConfigError, match=words):
        Matcher(sky).identify_many([px], sigma_px=[sigma_px])


@pytest.mark.slow
def test_spots_of_a_picture_weigh_by_their_light(sky):
    """If the noise of their light is their error; with an unknown lens they do not."""
    matcher, errors = Matcher(sky, tolerance_px=3.0), {"told": [], "untold": []}
    chi_squares = []
    for number in range(20):
        [frame] = simulate_frames(sky.directions, CAMERA, 1, Noise(0.0), number, mag=sky.mag)
        mag = 4.0 + 6.0 * np.random.default_rng(number).random(len(frame.mag))
        picture = render_image(frame.centroids_px, mag, (1024, 1024), Optics(), number)
        spots = find_spots(picture, gain_e_per_adu=1.0)
        found = matcher.identify(spots.centroids_px, mag=spots.mag)
        if not found.ok:
            continue
        told = weighed(found, spots.sigma_px)
        chi_squares.append(told.reduced_chi_square)
        errors["told"].append(error_arcsec(told, frame.matrix))
        errors["untold"].append(error_arcsec(found, frame.matrix))
    assert len(chi_squares) > 15
    assert 0.8 < np.nanmean(chi_squares) < 1.2
    told, untold = (np.square(errors[name]).sum(axis=1).mean() for name in ("told", "untold"))
    assert told < 0.8 * untold
    assert weighed(found, 0.01 * spots.sigma_px) is found
