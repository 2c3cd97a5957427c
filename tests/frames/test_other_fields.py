"""Frames of another lens than the stated one: the field that explains them, and what to try."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from starcat.frames.images.measure import LocalInputs
from starcat.frames.images.solve_files import answer_file
from starcat.geometry.camera import Camera
from starcat.matcher import other_fields
from starcat.matcher.matcher import Matcher
from starcat.matcher.options import IdentifyOptions
from starcat.matcher.other_fields import SEARCHES, parts_of_fields
from starcat.matcher.refusal import HINTS, Refusal, stated_facts
from starcat.pipeline.simulation.simulate import Noise, simulate_frames

OWN = Camera(1024, 1024, fov_x_deg=12.0)
NOISE = Noise(0.5, noise_mag=0.2, false_stars=2)


@pytest.fixture(scope="module")
def sky(sky_of, random_directions):
    return sky_of(random_directions(6700, 3), OWN, boresights=10_000)


def frame_of(sky, fov_deg, seed):
    camera = Camera(1024, 1024, fov_x_deg=fov_deg)
    return next(simulate_frames(sky.directions, camera, 1, NOISE, seed, mag=sky.mag))


@pytest.mark.parametrize(
    ("fov_deg", "engine"),
    [
        *((fov_deg, "auto") for fov_deg in (7.5, 13.4, 16.0)),
        pytest.param(8.0, "numpy", marks=pytest.mark.slow),
    ],
)
def test_the_field_of_another_lens_is_named(sky, fov_deg, engine):
    matcher, frame = Matcher(sky, engine=engine), frame_of(sky, fov_deg, 5)
    given = {"mag": frame.mag}
    assert matcher.identify(frame.centroids_px, **given).fits_fov_deg is None
    found = matcher.identify(frame.centroids_px, **given, explain=True)
    assert (found.status, found.camera) == ("no_match", None)
    assert found.refusal.reason == ("scale" if fov_deg == 13.4 else "other_field")
    assert found.fits_fov_deg == pytest.approx(fov_deg, rel=0.005)
    assert found.refusal.message.startswith(
        f"the frame fits a field of {found.fits_fov_deg:.4g} deg; the database is for 12 deg"
    )
    stated = float(f"{found.fits_fov_deg:.4g}")
    assert f"(fov_deg={stated:g})" in found.refusal.hint
    assert matcher.identify(frame.centroids_px, **given, fov_deg=stated, fov_error=0.01).ok


def test_a_lens_of_almost_the_stated_field_is_answered_or_named(sky):
    """A scale within the range of shapes can be found with the attitude; then it is the answer."""
    matcher, answered = Matcher(sky), 0
    for seed in range(5, 9):
        frame = frame_of(sky, 12.5, seed)
        found = matcher.identify(frame.centroids_px, mag=frame.mag, explain=True)
        if not found.ok:
            assert found.refusal.reason == "scale"
            assert found.fits_fov_deg == pytest.approx(12.5, rel=0.005)
            continue
        answered += 1
        assert found.camera.fov_x_deg == pytest.approx(12.5, rel=0.005)
        has_star = found.star_index >= 0
        assert (found.star_index == frame.star_index)[has_star].all()
        error_deg = np.degrees(np.arccos(min(1.0, found.matrix[2] @ frame.matrix[2])))
        assert error_deg < 0.01
    assert answered >= 2


def test_every_field_from_half_to_twice_is_searched_once():
    for camera in (OWN, Camera(640, 480, fov_x_deg=70.0), Camera(100, 100, fov_x_deg=2.0)):
        parts = parts_of_fields(camera)
        assert parts[0] == (camera, other_fields.WIDE_FOV_ERROR)
        ends = sorted((c.focal_length_px * (1 - e), c.focal_length_px / (1 - e)) for c, e in parts)
        np.testing.assert_allclose([low for low, _ in ends[1:]], [high for _, high in ends[:-1]])
        reach = 2 * np.degrees(np.arctan(0.5 * camera.width_px / np.sort(ends, axis=None)))
        assert reach[0] > min(2 * camera.fov_x_deg, 120.0)
        assert reach[-1] < 0.5 * camera.fov_x_deg


def test_a_finding_passes_the_bound_with_all_searches(sky):
    frame = frame_of(sky, 8.0, 5)
    given = {"mag": frame.mag, "explain": True}
    told = Matcher(sky).identify(frame.centroids_px, **given).refusal
    count = SEARCHES + 2 + len(parts_of_fields(OWN))
    chance = told.false_match_probability
    least = Matcher(sky, max_false_match_probability=1.01 * chance)
    assert least.identify(frame.centroids_px, **given).fits_fov_deg is not None
    # The search itself would accept this, as one of its own.
    strict = Matcher(sky, max_false_match_probability=1.01 * chance / count)
    found = strict.identify(frame.centroids_px, **given)
    assert found.fits_fov_deg is None
    px = frame_of(sky, 12.0, 5).centroids_px * [1.0, -1.0] + [0.0, 1024.0]
    mirrored = Matcher(sky).identify(px, explain=True)
    assert (mirrored.refusal.reason, mirrored.fits_fov_deg) == ("mirrored", None)
    assert "fields of 5.88 to 24.5 deg and the mirrored frame were tried" in found.refusal.hint


def test_advice_is_only_what_is_new_to_the_caller():
    nothing = Refusal("chance")
    assert nothing.hint.startswith("give magnitudes, state the noise of centroids")
    assert "explain" in nothing.hint
    given = stated_facts(True, 0.3, None, has_dropped=False)
    told = Refusal("chance", facts=given | {"explained"}, tried_fov_deg=(6.0, 24.0)).hint
    assert told == (
        "state the noise of magnitudes (noise_mag), check the field of view and the size of the "
        "camera (camera), or find more stars; fields of 6 to 24 deg and the mirrored frame were "
        "tried"
    )
    assert any("dropped" in text for text in HINTS["too_few_stars"])
    assert "dropped" not in Refusal("too_few_stars").hint
    assert "dropped" in Refusal("too_few_stars", facts=stated_facts(True, None, None, True)).hint


def test_the_command_states_the_field_and_takes_it(starcat, small_database, tmp_path):
    database = Matcher.open(small_database).database
    own = database.camera
    camera = Camera(own.width_px, own.height_px, fov_x_deg=1.4 * own.fov_x_deg)
    frame = next(simulate_frames(database.directions, camera, 1, NOISE, 3, mag=database.mag))
    path = tmp_path / "frame.csv"
    rows = np.column_stack([frame.centroids_px, frame.mag])
    np.savetxt(path, rows, delimiter=",", header="x_px,y_px,mag", comments="")
    [found] = json.loads(starcat(["identify", small_database, path, "--json"]).out)
    assert found["fits_fov_deg"] == pytest.approx(camera.fov_x_deg, rel=0.01)
    printed = " ".join(starcat(["identify", small_database, path]).out.split())
    option = f"--fov {found['fits_fov_deg']:.4g}"
    assert f"({option}), or build a database for it" in printed
    assert "magnitudes" not in printed
    run = starcat(["identify", small_database, path, *option.split(), "--json"])
    assert json.loads(run.out)[0]["status"] == "identified"


def exchanged_of(sky, camera, seed=5):
    """A frame of a camera, and the same with x and y exchanged."""
    frame = next(simulate_frames(sky.directions, camera, 1, NOISE, seed, mag=sky.mag))
    return frame, frame.centroids_px[:, ::-1]


def test_on_a_square_detector_both_readings_of_a_mirrored_frame_are_named(sky):
    frame, yx = exchanged_of(sky, OWN)
    matcher, up = Matcher(sky), frame.centroids_px * [1.0, -1.0] + [0.0, 1024.0]
    true_deg = matcher.identify(frame.centroids_px, mag=frame.mag).roll_deg
    for px, is_exchanged in ((yx, True), (up, False)):
        found = matcher.identify(px, mag=frame.mag, explain=True)
        assert (found.refusal.reason, found.ok) == ("mirrored", False)
        assert "its y counts up, or its x and y are exchanged" in found.refusal.message
        assert found.refusal.rolls_deg[is_exchanged] == pytest.approx(true_deg, abs=0.01)
        for roll_deg in found.refusal.rolls_deg:
            assert f"{roll_deg:.4f} deg" in found.refusal.hint
        assert "{flip}" in found.refusal.advice[0]


def test_on_another_detector_an_exchange_is_told_from_y_that_counts_up(sky):
    camera = Camera(1024, 600, OWN.focal_length_px)
    frame, yx = exchanged_of(sky, camera)
    given = {"mag": frame.mag, "explain": True}
    found = Matcher(sky).identify(yx, camera, **given).refusal
    assert (found.reason, found.rolls_deg) == ("exchanged", None)
    assert "only with x and y exchanged" in found.message
    assert "give x, to the right, first" in found.hint
    up = frame.centroids_px * [1.0, -1.0] + [0.0, 600.0]
    found = Matcher(sky).identify(up, camera, **given).refusal
    assert (found.reason, found.rolls_deg) == ("mirrored", None)
    assert found.hint == "turn the frame over (flip)"


def test_an_exchanged_frame_that_is_turned_over_has_a_remark(sky, tmp_path):
    frame, yx = exchanged_of(sky, OWN)
    matcher, path = Matcher(sky), tmp_path / "frame.json"
    path.write_text(json.dumps({"centroids_px": yx.tolist(), "mag": frame.mag.tolist()}))
    [answer] = answer_file(path, matcher, IdentifyOptions(flip=True))
    right = matcher.identify(frame.centroids_px, mag=frame.mag)
    assert answer.result.ok
    assert abs(answer.result.roll_deg - right.roll_deg) > 80.0
    [remark] = answer.content()["remarks"]
    [roll_deg] = re.findall(r"x and y are exchanged instead, the roll is ([0-9.]+) deg", remark)
    assert float(roll_deg) == pytest.approx(right.roll_deg, abs=0.02)
    camera = Camera(1024, 600, OWN.focal_length_px)
    wide, _ = exchanged_of(sky, camera)
    up = wide.centroids_px * [1.0, -1.0] + [0.0, 600.0]
    path.write_text(json.dumps({"centroids_px": up.tolist(), "mag": wide.mag.tolist()}))
    [answer] = answer_file(path, matcher, IdentifyOptions(flip=True), LocalInputs(camera=camera))
    assert answer.result.ok
    assert answer.result.remarks == ()  # only one reading fits


PICTURES = {
    "white": np.full((256, 256), 255, dtype=np.uint8),
    "negative": 255 - (np.random.default_rng(3).random((256, 256)) > 0.9995) * np.uint8(200),
    "black": np.zeros((256, 256), dtype=np.uint8),
}


@pytest.mark.parametrize("name", PICTURES)
def test_a_bright_picture_is_called_one(sky, tmp_path, name):
    from PIL import Image

    path = tmp_path / f"{name}.png"
    Image.fromarray(PICTURES[name].astype(np.uint8)).save(path)
    [answer] = answer_file(path, Matcher(sky), IdentifyOptions(fov_deg=(12.0, 12.0)))
    assert answer.result.refusal.reason == "too_few_stars"
    hint = answer.result.refusal.hint
    assert hint.startswith("use a shorter exposure, or invert the picture") == (name != "black")


def test_advice_for_pictures_begins_with_field_flip_and_lights():
    for reason in ("chance", "no_candidate", "steps", "time"):
        plain = Refusal(reason, facts=frozenset(["picture"]))
        assert (
            plain.hint.index("(fov_deg)") < plain.hint.index("(flip)") < plain.hint.index("light")
        )
        assert "noise" not in plain.hint
        assert "state the range" in plain.hint
        known = Refusal(reason, facts=frozenset(["picture", "range"]))
        assert "state a wider range" in known.hint
    assert "(tolerance_px)" in Refusal("chance", facts=frozenset(["picture"])).hint
    assert "check the field of view" in Refusal("chance").hint


def test_a_picture_that_is_refused_gets_the_advice_for_pictures(sky, tmp_path):
    from PIL import Image

    generator, image = np.random.default_rng(6), np.zeros((512, 512))
    for x, y in generator.integers(10, 500, (12, 2)):
        image[y - 1 : y + 2, x - 1 : x + 2] += [[40, 90, 40], [90, 200, 90], [40, 90, 40]]
    path = tmp_path / "spots.png"
    Image.fromarray(
        np.clip(image + generator.normal(10, 2, image.shape), 0, 255).astype("u1")
    ).save(path)
    [answer] = answer_file(path, Matcher(sky), IdentifyOptions(fov_deg=(12.0, 12.0)))
    assert not answer.result.ok
    assert {"picture"} <= answer.result.refusal.facts
    assert "(flip)" in answer.result.refusal.hint
