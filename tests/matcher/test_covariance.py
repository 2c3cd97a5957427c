"""The covariance of an attitude: how far attitudes are from the truth, in its standard errors."""

from __future__ import annotations

import logging
from dataclasses import fields, replace

import numpy as np
import pytest
from frames import both_engines, error_arcsec, needs_c
from scipy import stats

from starcat.geometry.camera import Camera
from starcat.geometry.distortion import Distortion
from starcat.matcher import c_engine, result
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.matcher import Matcher
from starcat.matcher.pose import student_widening
from starcat.pipeline.simulation.simulate import Noise, simulate_frames

log = logging.getLogger(__name__)

NOISE_PX = 0.3
CAMERA = Camera(1024, 1024, fov_x_deg=20.0)
LENS = Camera(1024, 1024, fov_x_deg=30.0, distortion=Distortion(k1=-0.3, p1=1e-3))


def errors_of(sky: MatcherDatabase, count: int, **stated: object) -> tuple[np.ndarray, np.ndarray]:
    """Return errors about x, y and z in their standard errors, and the free residuals."""
    matcher = Matcher(sky, **stated)  # type: ignore[arg-type]
    errors, free = [], []
    for frame in simulate_frames(sky.directions, CAMERA, count, Noise(NOISE_PX), 8, sky.mag):
        found = matcher.identify(frame.centroids_px, CAMERA, mag=frame.mag)
        if found.ok:
            deviations = np.sqrt(found.covariance_arcsec2.diagonal())
            errors.append(error_arcsec(found, frame.matrix) / deviations)
            free.append(2 * found.n_matched - 3)
    assert len(errors) > 0.95 * count
    return np.array(errors), np.array(free)


def test_a_standard_error_is_widened_as_the_quantile_of_student():
    three_sigma = stats.norm.cdf(3.0)
    for free in (4, 5, 7, 15, 40, 400):
        expected = stats.t.ppf(three_sigma, free) / 3.0
        assert student_widening(free) == pytest.approx(expected, rel=0.04 if free < 5 else 0.015)


@pytest.mark.slow
@both_engines
def test_errors_of_a_stated_noise_have_a_chi_square_of_1(sky, engine):
    errors, _ = errors_of(sky, 20_000, engine=engine, noise_px=NOISE_PX)
    chi_square = np.square(errors).mean(axis=0)
    log.info("%s, stated: %d attitudes, chi-square %s", engine, len(errors), chi_square.round(3))
    assert (np.abs(chi_square - 1.0) <= 0.03).all()
    beyond = (np.abs(errors) > 3.0).mean()
    assert beyond == pytest.approx(0.0027, rel=0.3)


@pytest.mark.slow
@both_engines
def test_errors_without_a_stated_noise_follow_student(sky, engine):
    errors, free = errors_of(sky, 20_000, engine=engine, tolerance_px=4.0 * NOISE_PX)
    widening = np.array([student_widening(int(one)) for one in free])[:, None]
    assert np.median(free) < 30
    beyond = (np.abs(errors) > 3.0).mean()
    narrow = (np.abs(errors * widening) > 3.0).mean()
    shares = stats.t.cdf(errors * widening, free[:, None])
    p_values = [stats.kstest(shares[:, axis], "uniform").pvalue for axis in range(3)]
    log.info(
        "%s, not stated: %d attitudes, %.2f %% beyond three standard errors, %.2f %% if these are "
        "not widened; Student's t by Kolmogorov and Smirnov: p from %.2g",
        *(engine, len(errors), 100.0 * beyond, 100.0 * narrow, min(p_values)),
    )
    # As many as of a normal distribution; without the widening three times as many.
    assert beyond == pytest.approx(0.0027, rel=0.2)
    assert narrow > 0.005
    assert min(p_values) > 0.01


@needs_c
@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("stated", [{}, {"noise_px": NOISE_PX}], ids=["not stated", "stated"])
@pytest.mark.parametrize("fov_error", [0.0, 0.02])
def test_what_the_library_writes_is_what_numpy_makes_of_the_answer(sky, camera, stated, fov_error):
    matcher, compared = Matcher(sky, engine="c", **stated), 0
    for frame in simulate_frames(sky.directions, camera, 12, Noise(NOISE_PX, 0.1, 2), 4, sky.mag):
        rng = np.random.default_rng(3)
        sigma_px = rng.uniform(0.1, 0.6, len(frame.mag))
        for sigma in (None, sigma_px, np.where(sigma_px > 0.5, np.nan, sigma_px)):
            given = {"mag": frame.mag, "sigma_px": sigma, "fov_error": fov_error}
            found = matcher.identify(frame.centroids_px, camera, **given)
            if not found.ok:
                continue
            compared += 1
            again = replace(found)  # without what the library has written
            assert again.star_ids.tolist() == found.star_ids.tolist()
            np.testing.assert_allclose(again.q_body_from_icrs, found.q_body_from_icrs, atol=1e-15)
            # The library has the derivative of the camera, numpy differences of directions.
            deviations = np.sqrt(found.covariance_arcsec2.diagonal())
            scaled = (again.covariance_arcsec2 - found.covariance_arcsec2) / deviations
            # The directions of an image are rounded. A shape is of the stated camera there, and of
            # the fitted focal length here.
            error = 1e-5 if found.shape is None else 2e-3
            assert np.abs(scaled / deviations[:, None]).max() < error
            chi_square = pytest.approx(again.reduced_chi_square, rel=error, nan_ok=True)
            assert found.reduced_chi_square == chi_square
    assert compared > 20


@needs_c
def test_arrays_are_where_the_library_writes_them():
    ffi = c_engine._onboard.ffi
    for name, at in (
        ("q_body_from_icrs", result.Q_AT),
        ("matrix", result.MATRIX_AT),
        ("covariance_arcsec2", result.COVARIANCE_AT),
        ("shape", result.SHAPE_AT),
    ):
        assert ffi.offsetof("starcat_frame_answer", name) == at
    size = ffi.sizeof("starcat_frame_answer")
    assert size == ffi.offsetof("starcat_memory", "stars") == result.IDS_AT
    assert c_engine._NUMBERS.size == result.Q_AT


@needs_c
def test_an_answer_of_the_library_is_an_ordinary_one(sky):
    [frame] = simulate_frames(sky.directions, CAMERA, 1, Noise(NOISE_PX), 8, sky.mag)
    found = Matcher(sky, engine="c").identify(frame.centroids_px, CAMERA)
    assert type(found) is result.MatchResult
    made = {field.name: getattr(found, field.name) for field in fields(found)}
    same = result.MatchResult(**made)
    assert repr(same) == repr(found)
    for name in ("star_ids", "q_body_from_icrs", "covariance_arcsec2", "matrix", "star_index"):
        assert getattr(found, name).flags.writeable
        assert getattr(found, name).dtype == getattr(same, name).dtype
        assert getattr(found, name).shape == getattr(same, name).shape
    assert not hasattr(found, "attitude")


@needs_c
def test_equal_cameras_share_a_prepared_search(sky):
    matcher = Matcher(sky, engine="c")
    [frame] = simulate_frames(sky.directions, CAMERA, 1, Noise(NOISE_PX), 8, sky.mag)
    expected = matcher.identify(frame.centroids_px, CAMERA)
    for _ in range(50):
        found = matcher.identify(frame.centroids_px, replace(CAMERA))
        assert found.matrix.tolist() == expected.matrix.tolist()
        assert found.camera == CAMERA
    assert len(set(map(id, matcher._searches.values()))) == 1
    for focal_length_px in np.linspace(2000.0, 3000.0, 50):
        camera = Camera(1024, 1024, focal_length_px)
        answer = matcher.identify(frame.centroids_px, camera)
        # A focal length that is off by up to 10 % can be found as the scale of the frame.
        off = abs(focal_length_px / CAMERA.focal_length_px - 1.0)
        assert answer.ok if off < 0.01 else not answer.ok or off < 0.1
        if answer.ok:
            found_px = answer.camera.focal_length_px
            assert found_px == pytest.approx(CAMERA.focal_length_px, rel=2e-3)
    assert len(matcher._searches) <= 32
