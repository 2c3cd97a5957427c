"""What an answer says of the shape of its frame, and whether its errors are right."""

from __future__ import annotations

import json
import logging
import math
import pickle
from dataclasses import asdict, replace

import numpy as np
import pytest
from frames import both_engines, error_arcsec, needs_c
from shaped import shaped_px, sky_of_stars, slewed_frame, terms_of

from starcat.cli import matches
from starcat.geometry.attitude import random_attitudes
from starcat.geometry.camera import Camera
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.frame_shape import FRACTIONS, FrameShape, turn_in_words
from starcat.matcher.matcher import Matcher
from starcat.matcher.result import MatchResult
from starcat.pipeline.simulation.simulate import Noise, simulate_frame

log = logging.getLogger(__name__)

NOISE = Noise(0.3)
CAMERA = Camera(1024, 1024, fov_x_deg=20.0)

LENS = {"scale": 0.01, "radial": 0.04}
SHUTTER = {"scale": 0.005, "radial": 0.005, "stretch": 0.02, "shear": 0.02}
TILT = {"radial": 0.005, "stretch": 0.005, "shear": 0.005, "tilt_x": 0.03, "tilt_y": 0.03}
EACH = pytest.mark.parametrize("largest", [LENS, SHUTTER, TILT], ids=["lens", "shutter", "tilt"])


@pytest.fixture(scope="module")
def dense(sky_of, random_directions):
    """A sky with 28 stars in a frame, so that nearly all frames of a shape are identified."""
    return sky_of(random_directions(3500, 1))


def answers(
    sky: MatcherDatabase, largest: dict[str, float], count: int, seed: int, **stated: object
) -> list[tuple[MatchResult, np.ndarray, np.ndarray]]:
    """Return answers to frames of shapes up to the largest terms, with attitudes and terms."""
    matcher, generator = Matcher(sky, **stated), np.random.default_rng(seed)  # type: ignore[arg-type]
    told, most = [], terms_of(**largest)
    for matrix in random_attitudes(count, generator):
        frame = simulate_frame(sky_of_stars(sky), CAMERA, matrix, Noise(), generator)
        terms = generator.uniform(-most, most)
        px = shaped_px(frame.centroids_px, terms, CAMERA)
        px += generator.normal(scale=NOISE.noise_px, size=px.shape)
        inside = CAMERA.contains(px)
        found = matcher.identify(px[inside], CAMERA, mag=frame.mag[inside])
        if found.ok:
            told.append((found, matrix, terms))
    return told


def chi_squares(found: list[tuple[MatchResult, np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return the mean square of the errors of attitudes in their standard errors, per axis.

    A few of a thousand answers are to a part of the frame, with fewer terms than its shape has.
    """
    errors = [
        error_arcsec(one, matrix) / np.sqrt(one.covariance_arcsec2.diagonal())
        for one, matrix, _ in found
    ]
    is_near = (np.abs(errors) < 5.0).all(axis=1)
    assert np.count_nonzero(~is_near) <= max(1, 0.003 * len(errors))
    return np.asarray(np.square(errors)[is_near].mean(axis=0))


@EACH
def test_errors_of_frames_of_a_shape_are_the_stated_errors(dense, largest):
    found = answers(dense, largest, 200, 11, noise_px=NOISE.noise_px)
    assert len(found) > 180
    shaped = [one for one in found if one[0].shape is not None]
    assert len(shaped) > 0.95 * len(found)
    chi_square = chi_squares(found)
    log.info("%d of %d: %s", len(shaped), len(found), chi_square.round(2))
    # Three standard deviations of a mean of 200 chi-squares are 0.3.
    assert (np.abs(chi_square - 1.0) < 0.3).all()


@pytest.mark.slow
@EACH
def test_chi_square_of_many_frames_of_a_shape_is_1(dense, largest):
    found = answers(dense, largest, 2000, 12, noise_px=NOISE.noise_px)
    chi_square = chi_squares(found)
    log.info("%d answers, chi-square %s", len(found), chi_square.round(3))
    assert (np.abs(chi_square - 1.0) <= 0.1).all()


@needs_c
@EACH
def test_engines_tell_the_same_shape(dense, largest):
    in_c = answers(dense, largest, 12, 18, engine="c", noise_px=NOISE.noise_px)
    in_numpy = answers(dense, largest, 12, 18, engine="numpy", noise_px=NOISE.noise_px)
    assert len(in_c) == len(in_numpy) > 8
    for (one, *_), (other, *_) in zip(in_c, in_numpy, strict=True):
        a, b = asdict(one.frame_shape), asdict(other.frame_shape)
        assert [name for name in a if a[name] is None] == [name for name in b if b[name] is None]
        told = [name for name in a if a[name] is not None]
        np.testing.assert_allclose([a[n] for n in told], [b[n] for n in told], rtol=1e-4, atol=1e-6)
        # The library has the noise at the places without the shape: up to 3 % of another scale.
        np.testing.assert_allclose(
            one.covariance_arcsec2, other.covariance_arcsec2, rtol=0.1, atol=0.02
        )


@pytest.mark.parametrize("engine", ["numpy", pytest.param("c", marks=needs_c)])
def test_stars_beyond_the_stated_field_are_named_too(dense, engine):
    matcher, generator = Matcher(dense, engine=engine), np.random.default_rng(21)
    wider = Camera(CAMERA.width_px, CAMERA.height_px, fov_x_deg=21.0)
    n_beyond, n_answers = 0, 0
    for matrix in random_attitudes(6, generator):
        frame = simulate_frame(sky_of_stars(dense), wider, matrix, Noise(0.1), generator)
        answer = matcher.identify(frame.centroids_px, CAMERA, mag=frame.mag)
        if answer.ok:
            np.testing.assert_array_equal(answer.star_index, frame.star_index)
            body = dense.directions[answer.star_index] @ answer.matrix.T
            n_beyond += int(np.sum(~CAMERA.contains(CAMERA.pixels_from_directions(body))))
            n_answers += 1
    assert n_answers >= 3
    assert n_beyond > 0


def test_terms_are_told_with_their_errors(dense):
    pulls: dict[str, list[float]] = {name: [] for name in (*FRACTIONS[:3], "focal_length_px")}
    for found, _, terms in answers(dense, SHUTTER, 200, 13, noise_px=NOISE.noise_px):
        shape = found.frame_shape
        if shape is None or found.shape.free < 4:
            continue
        left = 1.0 - terms[0]
        truth = dict(zip(FRACTIONS, (terms[1:] / left).tolist(), strict=True))
        truth["focal_length_px"] = CAMERA.focal_length_px / left
        for name, values in pulls.items():
            error = getattr(shape, f"{name}_error", shape.focal_length_error_px)
            values.append((getattr(shape, name) - truth[name]) / error)
        assert found.focal_length_px == shape.focal_length_px
        assert found.focal_length_error_px == shape.focal_length_error_px
        assert shape.turn_deg_s is None
    for name, values in pulls.items():
        assert len(values) > 120, name
        assert np.mean(np.square(values)) == pytest.approx(1.0, abs=0.3), name


def test_a_frame_of_the_stated_camera_has_no_shape(dense):
    found = answers(dense, {}, 30, 14, noise_px=NOISE.noise_px)
    assert len(found) > 25
    assert all(one.frame_shape is None for one, _, _ in found)
    assert found[0][0].to_dict()["frame_shape"] is None


@both_engines
def test_a_turn_during_the_readout_is_told(dense, engine):
    camera = replace(CAMERA, readout_s=0.1)
    matcher = Matcher(dense, engine=engine, noise_px=NOISE.noise_px)
    generator, count = np.random.default_rng(15), 0
    for matrix in random_attitudes(20, generator):
        turn = generator.uniform(0.0, 2.0 * math.pi)
        rate_deg_s = generator.uniform(3.0, 5.0)
        rate = math.radians(rate_deg_s) * np.array([math.cos(turn), math.sin(turn), 0.0])
        frame = slewed_frame(sky_of_stars(dense), camera, matrix, rate, NOISE, generator)
        found = matcher.identify(frame.centroids_px, camera, mag=frame.mag)
        if not found.ok:
            continue
        assert max(abs(error_arcsec(found, matrix)[:2])) < 60.0
        shape = found.frame_shape
        # Away from the axis stars move faster, by 1 % on average in a field of 20 deg.
        assert shape.turn_deg_s == pytest.approx(
            rate_deg_s, abs=4.0 * shape.turn_error_deg_s + 0.02 * rate_deg_s
        )
        count += 1
        [remark] = [one for one in found.remarks if "rows" in one]
        assert f"the camera turned by {shape.turn_deg_s:.2g} +- " in remark
        assert remark.endswith("if the readout takes 0.1 s (readout_s)")
        [told] = [value for name, value in rows_of(found) if name == "turn deg/s"]
        assert told.startswith(f"{shape.turn_deg_s:.3g} +- ")
        # Without a stated time it has the same shape, and no rate.
        plain = matcher.identify(frame.centroids_px, CAMERA, mag=frame.mag)
        assert plain.frame_shape == replace(shape, turn_deg_s=None, turn_error_deg_s=None)
        assert not [one for one in plain.remarks if "rows" in one]
    assert count > 15


def rows_of(found: MatchResult) -> list[tuple[str, str]]:
    return matches._rows_of_fact("frame_shape", found.to_dict()["frame_shape"])


def test_a_table_has_the_terms_beyond_their_errors(dense):
    [(found, *_), *_] = answers(dense, {"stretch": 0.0}, 3, 16)
    assert rows_of(found) == []
    shape = FrameShape(2900.0, 1.0, 0.012, 0.001, -0.0301, 0.002, 0.003, 0.002)
    assert matches._rows_of_shape(shape) == [
        ("corner distortion %", "+1.20 +- 0.10"),
        ("stretch %", "-3.01 +- 0.20"),
    ]
    turned = replace(shape, turn_deg_s=2.5, turn_error_deg_s=0.1)
    assert matches._rows_of_shape(turned)[-1] == ("turn deg/s", "2.5 +- 0.1")
    camera = replace(CAMERA, readout_s=0.1)
    assert turn_in_words(turned, camera) == [
        "the rows are compressed by 3.0 %: the camera turned by 2.5 +- 0.1 deg/s across its axis "
        "if the readout takes 0.1 s (readout_s)"
    ]
    assert turn_in_words(replace(turned, turn_error_deg_s=1.0), camera) == []


def test_an_answer_keeps_its_shape_in_json_and_in_another_process(dense):
    found = next(one for one, *_ in answers(dense, LENS, 20, 17) if one.shape is not None)
    told = json.loads(json.dumps(found.to_dict()))["frame_shape"]
    assert FrameShape(**told) == found.frame_shape
    assert pickle.loads(pickle.dumps(found)).frame_shape == found.frame_shape
