"""Photographs of real skies, from pictures to attitudes with the default settings.

The frames of ``spel`` are from an IMX219 on a Raspberry Pi (spel-uchile/Star_Tracker), about 48.8
deg wide. Their pointings are not recorded; one focal length has to fit them all.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from frames import both_engines

import starcat
from starcat.frames.images.picture import names_by_place
from starcat.frames.images.solve_files import answer_file
from starcat.geometry.camera import Camera
from starcat.matcher.matcher import Matcher
from starcat.matcher.observation import remarks_on_pixels
from starcat.pipeline.build import build
from starcat.pipeline.specs.build_spec import CameraSpec
from starcat.pipeline.starter import starter_spec


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    """What `starcat init` proposes for that camera, tested with the photographs alone."""
    camera = CameraSpec(width_px=1024, height_px=1024, fov_x_deg=48.8)
    spec = starter_spec("imx219", camera).spec
    short = spec.self_test.model_copy(update={"frames": 5})
    spec = spec.model_copy(update={"self_test": short})
    return build(spec, tmp_path_factory.mktemp("nights")).folder


def answers(starcat, database, paths, *options):
    run = starcat(["identify", database, *paths, *options, "--json"])
    assert run.code == 0, run.err
    return [json.loads(line) for line in run.out.splitlines()]


def assert_all_of_one_focal_length(found):
    assert [one["status"] for one in found] == 50 * ["identified"]
    assert_of_one_focal_length([one["focal_length_px"] for one in found])


def assert_of_one_focal_length(focal_px):
    assert np.abs(focal_px / np.median(focal_px) - 1.0).max() < 0.015


@pytest.fixture(scope="module")
def measured(nights):
    """The 60 brightest spots of each photograph, with their magnitudes."""
    found = []
    for number in range(1, 51):
        [frame] = starcat.read_frames(nights / "spel" / f"img_{number}.jpg")
        first = np.argsort(frame.mag, kind="stable")[:60]
        found.append((frame.centroids_px[first], frame.mag[first]))
    return found


def test_photographs_of_few_stars_among_many_spots_are_identified(starcat, nights, database):
    paths = [nights / "spel" / f"img_{number}.jpg" for number in (1, 26, 31)]
    found = answers(starcat, database, paths)
    assert [one["status"] for one in found] == 3 * ["identified"]


def test_alpha_centauri_has_its_name_though_it_is_no_guide_star(nights, database, tmp_path):
    """The brightest spot of the photograph is a double, which the database leaves out."""
    answers = answer_file(nights / "spel" / "img_1.jpg", Matcher.open(database))
    [answer] = answers
    assert answer.result.star_index[0] < 0
    found, known = answer.result, answer.result.database
    labels = [None if row < 0 else "a star" for row in found.star_index]
    names = names_by_place(
        answer.frame.centroids_px, labels, found.matrix, found.camera, known, found.residual_arcsec
    )
    assert names[0] == "Rigil Kentaurus"
    answers.draw(tmp_path / "a.svg", answer)
    assert "named by place" in (tmp_path / "a.svg").read_text()


def test_real_frames_have_no_remarks_on_their_pixels(nights):
    camera = Camera(1288, 1040, fov_x_deg=18.97)
    files = sorted((nights / "startracker" / "centroids").glob("*.csv"))
    frames = [frame for path in files for frame in starcat.read_frames(path)]
    assert len(frames) == 38
    assert not any(remarks_on_pixels(one.centroids_px, camera) for one in frames)
    assert not any(one.remarks for one in frames)
    photograph, camera = nights / "spel" / "img_1.jpg", Camera(1024, 1024, fov_x_deg=48.8)
    [frame] = starcat.read_frames(photograph)
    assert remarks_on_pixels(frame.centroids_px, camera) == ()


@both_engines
@pytest.mark.parametrize(("fov_error", "least"), [(0.05, 50), (0.03, 45)])
def test_one_search_of_the_brightest_spots_is_enough(measured, database, engine, fov_error, least):
    """The field is up to 3.4 % off: beyond the smaller error, which an answer then remarks."""
    matcher = Matcher.open(database, engine=engine)
    found = [matcher.identify(px, mag=mag, fov_error=fov_error) for px, mag in measured]
    assert sum(one.ok for one in found) >= least
    assert_of_one_focal_length([one.focal_length_px for one in found if one.ok])
    beyond = [one for one in found if any("(fov_error)" in remark for remark in one.remarks)]
    assert bool(beyond) == (fov_error == 0.03)


@pytest.mark.slow
def test_all_photographs_are_identified_and_of_one_focal_length(starcat, nights, database):
    found = answers(starcat, database, [nights / "spel"])
    assert_all_of_one_focal_length(found)
    assert max(one["false_match_probability"] for one in found) < 1e-9


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_range_of_fields_finds_what_the_stated_scale_finds(starcat, nights, tmp_path):
    camera = CameraSpec(width_px=1024, height_px=1024, fov_x_deg=30.0)
    spec = starter_spec("range", camera, widest_fov_x_deg=60.0).spec
    short = spec.self_test.model_copy(update={"frames": 5})
    built = build(spec.model_copy(update={"self_test": short}), tmp_path)
    found = answers(starcat, built.folder, [nights / "spel"], "--fov", "30:60")
    assert_all_of_one_focal_length(found)
