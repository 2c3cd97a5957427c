"""Types that users name, and results that compare, print and index as users expect."""

from __future__ import annotations

import inspect
import pickle
import re
from dataclasses import replace
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest

import starcat
from starcat.errors import ConfigError

PAGES = {
    path.stem: path.read_text(encoding="utf-8")
    for path in (Path(__file__).parents[2] / "docs").glob("python*.md")
}
DIRECTIVE = re.compile(r"^\.\. (?:auto(?:class|function|exception)|py:class):: (\S+)", re.M)
NAMES = sorted(set(starcat.__all__) - {"__version__"})


@pytest.fixture(scope="module")
def matcher(small_database):
    return starcat.Matcher.open(small_database)


@pytest.fixture(scope="module")
def frames(small_database):
    return starcat.simulate(small_database, 4, seed=7)


def test_the_pages_document_every_public_name_once_and_no_private_module():
    found = [name for page in PAGES.values() for name in DIRECTIVE.findall(page)]
    assert sorted(name.removeprefix("starcat.") for name in found) == NAMES


def test_the_summary_lists_every_public_name_once_beside_the_link_to_its_page():
    parts = re.split(r"^### \[[^]]+\]\((\S+)\.md\)$", PAGES["python"], flags=re.M)
    listed = []
    for page, part in zip(parts[1::2], parts[2::2], strict=True):
        names = re.findall(r"^   (\w+)$", part.partition("\n## ")[0], re.M)
        documented = [name.removeprefix("starcat.") for name in DIRECTIVE.findall(PAGES[page])]
        assert sorted(names) == sorted(documented), page
        listed += names
    assert sorted([*listed, "StarcatError"]) == NAMES


def test_every_public_name_has_an_example():
    """Code uses the name, or prints an object of it; a slow test runs all pages."""
    blocks = [re.findall(r"```(python|text)\n(.*?)```", page, re.S) for page in PAGES.values()]
    code = "".join(text for page in blocks for kind, text in page if kind == "python")
    printed = "".join(text for page in blocks for kind, text in page if kind == "text")
    without = [
        name
        for name in NAMES
        if not re.search(rf"\bstarcat\.{name}\b", code) and not re.search(f"<{name}[ :]", printed)
    ]
    assert without == []


def documented_functions():
    """Return the public functions, and the methods that the pages list, by name."""
    for name in NAMES:
        if not inspect.isclass(getattr(starcat, name)):
            yield name, getattr(starcat, name)
    for page in PAGES.values():
        for name, members in re.findall(
            r"^\.\. autoclass:: starcat\.(\w+)\n +:members: (.*(?:\n {8,}.*)*)", page, re.M
        ):
            for member in re.split(r",\s*", members.strip()):
                yield f"{name}.{member}", getattr(getattr(starcat, name), member, None)


def test_every_public_function_states_parameters_returns_and_raises():
    without = []
    for name, function in documented_functions():
        if not (inspect.isfunction(function) or inspect.ismethod(function)):
            continue
        text, signature = inspect.getdoc(function) or "", inspect.signature(function)
        parameters = [one for one in signature.parameters if one != "self"]
        sections = ["Parameters"] if parameters else []
        if "." not in name:
            sections += ["Returns", "Raises"]
        elif parameters and signature.return_annotation not in ("None", None):
            sections += ["Returns"]
        without += [
            f"{name}: {section}"
            for section in sections
            if not re.search(rf"^(?:{section}|Yields)\n-+$", text, re.M)
        ]
        without += [f"{name}: {one}" for one in parameters if not re.search(rf"\b{one}\b", text)]
    assert without == []


@pytest.mark.parametrize("name", [name for name in NAMES if name[0].isupper()])
def test_every_public_class_describes_its_attributes(name):
    text = inspect.getdoc(getattr(starcat, name)) or ""
    assert re.search(r"^(?:Attributes|Parameters)\n-+$", text, re.M) or name in WITHOUT, name


WITHOUT = {"BuildSpec", "StarcatError"}
"""Classes whose attributes are on pages of their own: the keys of the spec, and the errors."""


def test_what_public_functions_return_can_be_named(small_database, matcher, frames, tmp_path):
    database, answers = starcat.open(small_database), matcher.identify_many(frames)
    camera = starcat.Camera(1280, 960, fov_x_deg=16.0)
    answer = answers[0]
    for value, kind in (
        (database, starcat.Database),
        (matcher.database, starcat.MatcherDatabase),
        (database.spec, starcat.BuildSpec),
        (database.coverage(), starcat.CoverageReport),
        (database.verify(), starcat.Verification),
        (database.sql("SELECT count(*) FROM stars"), starcat.QueryResult),
        (starcat.connect(small_database), starcat.Connection),
        (starcat.diff(database, database), starcat.Difference),
        (starcat.export(database, "csv", tmp_path / "csv"), starcat.Exported),
        (starcat.export(database, "onboard", tmp_path / "a.img"), starcat.ExportedImage),
        (starcat.publish(database, tmp_path / "registry"), starcat.Published),
        (starcat.pull("small", tmp_path / "registry", tmp_path / "pulled"), starcat.Pulled),
        (starcat.init(camera), starcat.Starter),
        (answers, starcat.BatchResult),
        (answer, starcat.MatchResult),
        (answer.stars, starcat.MatchedStars),
        (matcher.identify([[1.0, 2.0]]).refusal, starcat.Refusal),
        (matcher.settings, starcat.Settings),
        (matcher.settings.selection, starcat.TriangleOrder),
        (frames[0], starcat.SimulatedFrame),
        (camera.distortion, starcat.Distortion),
    ):
        assert isinstance(value, kind)
        text = repr(value)
        assert 10 < len(text) < 300
        assert "\n" not in text


def test_every_public_class_is_no_other_name_of_a_function():
    for name in starcat.__all__:
        if name[0].isupper():
            assert inspect.isclass(getattr(starcat, name)), name


@pytest.mark.parametrize(
    ("name", "hint"),
    [("simulat", "did you mean 'simulate'?"), ("Matchresult", "did you mean 'MatchResult'?")],
)
def test_a_misspelt_name_gets_the_right_one(name, hint):
    with pytest.raises(AttributeError, match=re.escape(f"no attribute {name!r}; {hint}")):
        getattr(starcat, name)


def test_a_camera_is_read_from_its_file(tmp_path):
    path = tmp_path / "camera.toml"
    path.write_text("width_px = 1280\nheight_px = 960\nfov_x_deg = 16.0\n[distortion]\nk1 = -0.1\n")
    for given in (path, str(path)):
        found = starcat.Camera.read(given)
        assert found == starcat.Camera(1280, 960, fov_x_deg=16.0, distortion={"k1": -0.1})
    with pytest.raises(starcat.StarcatError, match="no such camera file"):
        starcat.Camera.read(tmp_path / "none.toml")
    with pytest.raises(TypeError, match="path is of type int"):
        starcat.Camera.read(3)


def test_a_distortion_is_a_mapping_or_the_five_numbers_of_opencv():
    lens = starcat.Distortion(k1=-0.1, k2=0.02, k3=0.03, p1=1e-4, p2=2e-4)
    opencv = [-0.1, 0.02, 1e-4, 2e-4, 0.03]
    named = {"k1": -0.1, "k2": 0.02, "p1": 1e-4, "p2": 2e-4, "k3": 0.03}
    for given in (
        lens,
        opencv,
        tuple(opencv),
        np.array([opencv]),
        np.array(opencv)[:, None],
        named,
    ):
        assert starcat.Camera(1280, 960, 3000.0, distortion=given).distortion == lens
    for given, words in (
        ({"k4": 1.0}, "the key 'k4' is unknown; did you mean"),
        ([0.1, 0.2], r"five numbers \(k1, k2, p1, p2, k3, as in OpenCV\)"),
        ("barrel", "distortion: not an array of real numbers"),
        ({"k1": "a"}, "k1 is 'a'; expected a finite number"),
    ):
        with pytest.raises(ConfigError, match=words):
            starcat.Camera(1280, 960, 3000.0, distortion=given)


def test_quantities_are_accepted_for_every_number(small_database, matcher, frames):
    camera = starcat.Camera(
        1280 * u.pix, 960 * u.pix, fov_x_deg=960 * u.arcmin, principal_point_px=[640, 480] * u.pix
    )
    assert camera == starcat.Camera(1280, 960, fov_x_deg=16.0)
    for width in (1280.5 * u.pix, 1280 * u.m, 1280.0):
        with pytest.raises(ConfigError, match="width_px"):
            starcat.Camera(width, 960, fov_x_deg=16.0)
    given = {"noise_px": 0.3 * u.pix, "noise_mag": 0.1 * u.mag, "drop_probability": 10 * u.percent}
    plain = starcat.simulate(small_database, noise_px=0.3, noise_mag=0.1, drop_probability=0.1)
    [made] = starcat.simulate(small_database, **given)
    assert np.array_equal(made.centroids_px, plain[0].centroids_px)
    result = matcher.identify(frames[0])
    near = matcher.identify(frames[0], prior=result.rotation(), prior_error_deg=30 * u.arcmin)
    assert near.ok
    database, query = starcat.open(small_database), "SELECT count(*) FROM stars WHERE mag < "
    [(count,)] = database.sql(query + "4")
    for value in (4 * u.mag, np.float32(4), np.int64(4)):
        assert list(database.sql(query + "$limit_mag", limit_mag=value)) == [(count,)]
    with pytest.raises(ConfigError, match="m: its unit is 'mag'"):
        database.sql(query + "$m", m=4 * u.mag)
    with pytest.raises(starcat.StarcatError, match=r"give its value with m=\.\.\."):
        database.sql(query + "$m")


def test_a_field_is_named_as_it_was_given(matcher):
    for field in (-12, 179.9, np.nan):
        with pytest.raises(ConfigError, match=rf"^fov_deg is {field}; expected"):
            matcher.identify([[1.0, 2.0]], fov_deg=field)
    with pytest.raises(ConfigError, match=r"fov_x_deg is 179\.9; .* below 178\.8"):
        starcat.Camera(1280, 960, fov_x_deg=179.9)


def test_seeds_are_numbers_generators_or_nothing(small_database):
    first, second = (starcat.simulate(small_database, seed=None)[0] for _ in range(2))
    assert not np.array_equal(first.matrix, second.matrix)
    generator = np.random.default_rng(5)
    made = [starcat.simulate(small_database, seed=generator)[0] for _ in range(2)]
    expected = starcat.simulate(small_database, 2, seed=5)
    assert [one.matrix.tolist() for one in made] == [one.matrix.tolist() for one in expected]
    with pytest.raises(ConfigError, match=r"seed is 1\.5; expected a whole number"):
        starcat.simulate(small_database, seed=1.5)


def test_answers_are_equal_if_all_but_their_times_is(matcher, frames):
    answer, dark = matcher.identify(frames[0]), matcher.identify([[1.0, 2.0]])
    assert answer == matcher.identify(frames[0]) == pickle.loads(pickle.dumps(answer))
    assert hash(answer) == hash(matcher.identify(frames[0]))
    assert dark == matcher.identify([[1.0, 2.0]])
    assert answer not in (dark, matcher.identify(frames[1]), None)
    assert answer != matcher.identify(frames[0].centroids_px[::-1])


def test_the_stars_of_an_answer_are_gone_through_and_indexed(matcher, frames):
    answer = matcher.identify(frames[0])
    stars = answer.stars
    assert len(list(stars)) == len(stars) == answer.n_matched
    first, last = stars[0], stars[-1]
    assert (first.star, first.mag) == (stars.star[0], stars.mag[0])
    assert type(first.star_id) is int
    assert last[:-1] == list(stars)[-1][:-1] == stars[-2:][1][:-1]  # sigma_px is NaN
    with pytest.raises(IndexError):
        stars[len(stars)]
    assert list(matcher.identify([[1.0, 2.0]]).stars) == []
    assert answer.focal_length_px == matcher.database.camera.focal_length_px
    assert answer.focal_length_px == answer.to_dict()["focal_length_px"]
    assert matcher.identify([[1.0, 2.0]]).focal_length_px is None


def test_a_batch_has_arrays_and_a_short_repr(matcher, frames):
    answers = matcher.identify_many([*frames, [[1.0, 2.0]]])
    assert answers.ok.tolist() == [True] * len(frames) + [False]
    for name in ("boresight_ra_deg", "boresight_dec_deg"):
        expected = [getattr(one, name) for one in answers]
        np.testing.assert_allclose(getattr(answers, name), expected, atol=1e-9, equal_nan=True)
    assert repr(answers) == "<BatchResult: 4 of 5 frames identified>"
    assert answers._repr_html_().count("<tr>") == 6
    many = matcher.identify_many(frames * 10)
    assert many._repr_html_().count("<tr>") == 21
    assert "and 20 more rows" in many._repr_html_()


def test_a_frame_states_its_attitude_as_an_answer_does(matcher, frames):
    frame, answer = frames[0], matcher.identify(frames[0])
    assert abs(frame.q_body_from_icrs @ answer.q_body_from_icrs) == pytest.approx(1.0, abs=1e-6)
    angles = frame.boresight_ra_deg, frame.boresight_dec_deg, frame.roll_deg
    found = answer.boresight_ra_deg, answer.boresight_dec_deg, answer.roll_deg
    assert angles == pytest.approx(found, abs=0.5)
    text = "RA {:.4f}, Dec {:+.4f}, roll {:.4f} deg".format(*angles)
    assert text in repr(frame)


def test_a_frame_counts_its_guide_stars(frames):
    frame = replace(frames[0], star_index=np.array([0, 3, -1, 7, -1]))
    assert frame.n_stars == 3


def test_one_line_tells_what_a_thing_is(small_database, matcher, frames, tmp_path):
    (tmp_path / "one.csv").write_text("x_px,y_px,mag\n1,2,3\n")
    [read] = starcat.read_frames(tmp_path / "one.csv")
    camera = starcat.Camera(1280, 960, 3000.0, principal_point_px=(600, 400), distortion=[0.1] * 5)
    database, stars = starcat.open(small_database), matcher.identify(frames[0]).stars
    for thing, words in (
        (read, "<MeasuredFrame 'one': 1 centroid with magnitudes>"),
        (matcher.identify(read), "<MatchResult too_few_stars: 1 centroid>"),
        (stars, f"<MatchedStars: {len(stars)}: {', '.join(stars.star[:3])}, ...>"),
        (database.sql("SELECT count(*) AS n FROM stars"), "<QueryResult: 1 row of n>"),
        (starcat.diff(database, database), "<Difference: same>"),
        (
            starcat.Observer.at("2026-11-22T00:00"),
            "<Observer 2026-11-22T00:00:00Z: at the middle of",
        ),
        (camera, "<Camera 1280 x 960 px, 23.87 x 17.89 deg: focal length 3000 px, principal point"),
        (frames[0], f"<SimulatedFrame: {len(frames[0].mag)} centroids, {frames[0].n_stars} of"),
        (
            starcat.FrameShape(1000.0, 1.25, 0.02, 0.001, 0.003, 0.002, turn_deg_s=None),
            "<FrameShape: focal length 1000.0 +- 1.2 px, corner_distortion +0.0200 +- 0.001>",
        ),
    ):
        assert repr(thing).startswith(words)
    for thing in (read, frames[0], starcat.diff(database, database)):
        assert "<td>" in thing._repr_html_()


def test_a_spec_that_is_changed_says_how_to_change_it():
    spec = starcat.preset("gaia-12deg")
    for target, name in ((spec.selection, "faint_limit_mag"), (spec, "name"), (spec, "nothing")):
        with pytest.raises(starcat.StarcatError, match=f"^{name} cannot be set, because a spec"):
            setattr(target, name, 3)


def test_what_is_no_spec_or_no_database_says_what_to_give(small_database, tmp_path):
    camera = starcat.Camera(1280, 960, fov_x_deg=16.0)
    with pytest.raises(TypeError, match=r"starcat.init\(camera, name\)\.spec is one"):
        starcat.build(camera)
    starcat.export(small_database, "onboard", tmp_path / "s.img")
    with pytest.raises(starcat.StarcatError, match=r"onboard image.*starcat\.Matcher\.open"):
        starcat.open(tmp_path / "s.img")
    (tmp_path / "frame.csv").write_text("x_px,y_px\n1,2\n")
    with pytest.raises(starcat.StarcatError, match="a file, not the folder of a database"):
        starcat.open(tmp_path / "frame.csv")


@pytest.mark.parametrize(
    ("frames_", "more", "words"),
    [
        ([np.zeros((3, 2)), None], {}, r"^frame 1: centroids_px has shape \(\)"),
        ([np.zeros((3, 2)), np.zeros((3, 3))], {}, r"^frame 1: centroids_px has shape \(3, 3\)"),
        ([np.ones((2, 2))] * 3, {"sigma_px": [[1, 1], [1, 1], [1, -1]]}, "^frame 2: sigma_px: "),
        ([np.ones((2, 2))] * 2, {"mag": [[1, 1], [1]]}, r"^frame 1: mag has shape \(1,\)"),
    ],
)
def test_a_wrong_frame_of_many_is_named(matcher, frames_, more, words):
    with pytest.raises(ConfigError, match=words):
        matcher.identify_many(frames_, **more)
