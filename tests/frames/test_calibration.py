"""Calibration: frames of known cameras, and the cameras that are fitted to these frames alone."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import starcat as starcat_package
from starcat.errors import CalibrationError, ConfigError, OutputError
from starcat.frames.calibration import files
from starcat.frames.calibration import fit as model
from starcat.frames.calibration.calibrate import calibrate_frames
from starcat.frames.calibration.files import calibrate, starting_camera
from starcat.frames.calibration.fit import CENTRE, FOCAL, PARAMETERS, project, values_of
from starcat.frames.images.image_file import write_image
from starcat.frames.images.render import Optics, render_image
from starcat.geometry.attitude import matrix_from_quaternion
from starcat.geometry.camera import Camera
from starcat.geometry.distortion import Distortion
from starcat.matcher.centroids import MeasuredFrame, write_centroids
from starcat.matcher.database import open_database
from starcat.matcher.matcher import Matcher
from starcat.pipeline.simulation.simulate import Noise, simulate_frames
from starcat.pipeline.specs.camera_file import read_camera
from starcat.progress import no_progress

SIZE = (1280, 960)
LENS = Distortion(k1=-0.2, k2=0.05)
AS_PHOTOGRAPHED = Noise(0.3, drop_probability=0.05, false_stars=3)


@pytest.fixture(scope="module")
def skies(sky_of, random_directions):
    """Databases for 1280 x 960 px: of 20 deg with 28 stars per frame, of 50 deg with 38."""
    stars = {20.0: 4000, 50.0: 800}
    cameras = {fov: Camera(*SIZE, fov_x_deg=fov) for fov in stars}
    return {fov: sky_of(random_directions(stars[fov], 5), cameras[fov]) for fov in stars}


def real_camera(database, lens=LENS, off_px=(30.0, -20.0)):
    """A camera of the database's focal length that is not what it was built for."""
    centre = 0.5 * np.array(SIZE) + off_px
    focal_px = database.camera.focal_length_px
    return Camera(*SIZE, focal_px, principal_point_px=centre, distortion=lens)


def photographs(database, camera, count, seed, noise=AS_PHOTOGRAPHED):
    frames = simulate_frames(database.directions, camera, count, noise, seed, mag=database.mag)
    return [MeasuredFrame(f"photo {k}", f.centroids_px, f.mag) for k, f in enumerate(frames)]


def stars_seen(database, camera, count, seed, noise_px=0.3):
    """What a perfect matcher would find in frames, with attitudes that are 0.1 deg wrong."""
    frames = list(simulate_frames(database.directions, camera, count, Noise(noise_px), seed))
    generator = np.random.default_rng(seed)
    q = np.append(np.zeros(3), 1.0) + 1e-3 * generator.normal(size=(count, 4))
    return model.Seen(
        np.repeat(np.arange(count), [len(frame.centroids_px) for frame in frames]),
        np.concatenate([frame.centroids_px for frame in frames]),
        database.directions[np.concatenate([frame.star_index for frame in frames])],
        np.array([matrix_from_quaternion(turn) for turn in q])
        @ np.array([frame.matrix for frame in frames]),
    )


def pulls(fit, camera):
    """How many standard errors each parameter is away from the truth."""
    truth = dict(zip(PARAMETERS, values_of(camera), strict=True))
    found = dict(zip(PARAMETERS, fit.values, strict=True))
    return {name: (found[name] - truth[name]) / fit.errors[name] for name in fit.free}


def within_five_percent(camera):
    """The description of a camera by a user who knows only its focal length, to 5 %."""
    focal_px = camera.focal_length_px
    return Camera(*SIZE, 1.02 * focal_px), (0.95 * focal_px, 1.05 * focal_px)


VALUES = np.array([1400.0, 650.0, 470.0, -0.2, 0.05, 0.02, 0.004, -0.003, 0.002, -0.001])


def directions_ahead(count=40):
    generator = np.random.default_rng(1)
    plane = generator.uniform(-0.5, 0.5, (count, 2))
    return np.column_stack([plane, np.ones(count)]) * generator.uniform(0.5, 2.0, (count, 1))


def test_numbers_project_as_the_camera_does():
    values = np.append(VALUES[:8], [0.0, 0.0])
    camera = model.camera_of(values, SIZE)
    body = directions_ahead()
    expected = camera.pixels_from_directions(body)
    np.testing.assert_allclose(project(values, body), expected, atol=1e-9)
    np.testing.assert_array_equal(values_of(camera), values)


def test_derivatives_are_differences():
    body = directions_ahead()
    by_value, by_turn = model.value_derivatives(VALUES, body), model.turn_derivatives(VALUES, body)
    for row, step in enumerate(1e-5 * np.eye(len(VALUES))):
        change = (project(VALUES + step, body) - project(VALUES - step, body)) / 2e-5
        # Rounding of pixels of 1e3 over a step of 1e-5.
        np.testing.assert_allclose(by_value[:, :, row], change, atol=1e-6)
    for axis, half in enumerate(0.5e-5 * np.eye(3)):
        # A quaternion of starcat turns the axes; its inverse turns the directions.
        matrices = (matrix_from_quaternion(np.append(sign * half, 1.0)) for sign in (-1.0, 1.0))
        there, back = (project(VALUES, body @ matrix.T) for matrix in matrices)
        np.testing.assert_allclose(by_turn[:, :, axis], (there - back) / 2e-5, atol=1e-5)


def test_a_fit_of_perfect_stars_is_the_camera(skies):
    camera = real_camera(skies[50.0], Distortion(k1=-0.2, k2=0.05, p1=1e-3, p2=-2e-3))
    seen = stars_seen(skies[50.0], camera, 4, 1, noise_px=0.0)
    fit = model.fit_camera(seen, values_of(skies[50.0].camera), model.COMPLETE)
    np.testing.assert_allclose(fit.values, values_of(camera), rtol=1e-6, atol=1e-7)
    assert fit.noise_px < 1e-6


def test_wrong_stars_do_not_pull(skies):
    camera = real_camera(skies[50.0])
    seen = stars_seen(skies[50.0], camera, 20, 2)
    start, terms = values_of(skies[50.0].camera), (*FOCAL, *CENTRE, "k1", "k2")
    good = model.fit_camera(seen, start, terms)
    px = seen.centroids_px.copy()
    px[::50] += 9.0
    wrong = model.fit_camera(replace(seen, centroids_px=px), start, terms)
    assert wrong.noise_px == pytest.approx(good.noise_px, rel=0.05)
    rows = [PARAMETERS.index(name) for name in terms]
    moved = np.abs(wrong.values - good.values)[rows] / list(good.errors.values())
    assert moved.max() < 2.0
    assert max(map(abs, pulls(wrong, camera).values())) < 3.0


@pytest.mark.slow
def test_parameters_are_off_by_as_much_as_their_errors_say(skies):
    """The pulls of 7 parameters of 40 calibrations are of a normal distribution."""
    for fov in (20.0, 50.0):
        camera = real_camera(skies[fov])
        found = []
        for seed in range(40):
            seen = stars_seen(skies[fov], camera, 10, 100 + seed)
            fit = model.fit_camera(seen, values_of(skies[fov].camera), model.COMPLETE)
            found.append(list(pulls(fit, camera).values()))
        # Of 40 draws the standard deviation is 1 +- 0.11, the mean 0 +- 0.16.
        spread, mean = np.std(found, axis=0, ddof=1), np.mean(found, axis=0)
        assert np.all((spread > 0.65) & (spread < 1.35)), spread
        assert np.std(found) == pytest.approx(1.0, abs=0.12)
        assert np.abs(mean).max() < 0.6


@pytest.mark.parametrize(
    ("lens", "off_px", "terms"),
    [
        (Distortion(), (0.0, 0.0), FOCAL),
        (Distortion(k1=-0.1), (0.0, 0.0), (*FOCAL, "k1")),
        pytest.param(LENS, (0.0, 0.0), (*FOCAL, "k1", "k2"), marks=pytest.mark.slow),
        (LENS, (30.0, -20.0), (*FOCAL, "k1", "k2", *CENTRE)),
        (Distortion(k1=-0.1, p1=2e-3, p2=1e-3), (0.0, 0.0), (*FOCAL, "k1", "p1", "p2")),
    ],
)
def test_frames_support_the_terms_that_the_lens_has(skies, lens, off_px, terms):
    seen = stars_seen(skies[50.0], real_camera(skies[50.0], lens, off_px), 12, 4)
    trials = model.choose_model(seen, values_of(skies[50.0].camera), SIZE, 0.3)
    assert model.chosen_terms(trials) == terms
    (best,) = (trial for trial in trials if trial.is_chosen)
    assert best.held_out_px == pytest.approx(0.3, rel=0.1)


@pytest.mark.parametrize("fov", [20.0, pytest.param(50.0, marks=pytest.mark.slow)])
def test_twenty_frames_give_the_camera_and_it_identifies_others(skies, fov):
    """The acceptance of the command: k1, k2, a principal point and 5 % of focal length."""
    database = skies[fov]
    camera = real_camera(database)
    frames = photographs(database, camera, 20, 3)
    found = calibrate_frames(Matcher(database), frames, *within_five_percent(camera))
    assert found.n_identified == 20
    assert found.fit.noise_px == pytest.approx(0.3, rel=0.1)
    assert {"k1", *CENTRE} <= set(found.fit.free)
    for fit in (found.fit, found.complete):
        assert max(map(abs, pulls(fit, camera).values())) < 3.0, pulls(fit, camera)
    assert found.has_square_pixels
    # Frames that it has not seen, and the same sky through a lens that does not distort.
    plain, matcher = database.camera, Matcher(database, tolerance_px=1.0)
    answers = []
    for real, told in ((camera, found.camera), (plain, plain)):
        unseen = photographs(database, real, 20, 77)
        results = [matcher.identify(frame.centroids_px, told, mag=frame.mag) for frame in unseen]
        answers.append(sum(result.status == "identified" for result in results))
    assert answers[0] == answers[1] >= 19
    grid = np.stack(np.meshgrid(*(np.linspace(1, s - 1, 9) for s in SIZE)), axis=-1).reshape(-1, 2)
    told, real = (c.directions_from_pixels(grid) for c in (found.camera, camera))
    # A shift of the principal point is also a turn of the camera: angles between directions count.
    difference = np.abs(told @ told.T - real @ real.T).max() * camera.focal_length_px
    assert difference < 0.5


@pytest.mark.parametrize(("method", "fov", "count"), [("triangle", 50.0, 8), ("pairs", 20.0, 4)])
def test_without_magnitudes_and_by_a_method_that_has_to_know_the_focal_length(
    skies, method, fov, count
):
    camera = real_camera(skies[fov])
    frames = photographs(skies[fov], camera, count, 6)
    if method == "triangle":
        frames = [replace(frame, mag=None) for frame in frames]
    matcher = Matcher(skies[fov], method=method)
    found = calibrate_frames(matcher, frames, *within_five_percent(camera))
    assert found.n_identified == count
    assert max(map(abs, pulls(found.complete, camera).values())) < 3.5


@pytest.mark.parametrize("aspect", [0.0, 0.002])
def test_an_undistorted_camera_gets_no_distortion_and_pixels_that_are_not_square_are_said(
    skies, aspect
):
    database = skies[50.0]
    middle = np.array([0.0, 480.0])
    frames = [
        replace(frame, centroids_px=middle + (frame.centroids_px - middle) * [1.0, 1.0 + aspect])
        for frame in photographs(database, database.camera, 8, 8)
    ]
    found = calibrate_frames(Matcher(database), frames, *within_five_percent(database.camera))
    assert found.has_square_pixels == (aspect == 0.0)
    stretch = found.axes.values[PARAMETERS.index("aspect")]
    assert stretch == pytest.approx(aspect, abs=4 * found.axes.errors["aspect"])
    if aspect == 0.0:
        assert found.fit.free == FOCAL
        assert found.camera.distortion.is_none
        assert found.camera.principal_point_px == (640.0, 480.0)
        assert abs(pulls(found.fit, database.camera)["focal_length_px"]) < 3.0


def test_a_calibration_does_not_depend_on_the_order_of_stars(skies):
    database = skies[20.0]
    frames = photographs(database, real_camera(database), 4, 9)
    turned = [MeasuredFrame(f.name, f.centroids_px[::-1], f.mag[::-1]) for f in frames]
    about = within_five_percent(database.camera)
    one, other = (calibrate_frames(Matcher(database), given, *about) for given in (frames, turned))
    assert one.fit.free == other.fit.free
    np.testing.assert_allclose(one.fit.values, other.fit.values, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_ten_photographs_and_a_range_of_fields_are_enough(skies, tmp_path):
    """1280 x 960 px, between 5 and 20 degrees: nothing else is known."""
    database = skies[20.0]
    camera = Camera(*SIZE, fov_x_deg=17.0, distortion=Distortion(k1=-0.3))
    paths = []
    for k, frame in enumerate(
        simulate_frames(database.directions, camera, 10, Noise(), 12, mag=database.mag)
    ):
        paths.append(tmp_path / f"{k}.png")
        write_image(paths[-1], render_image(frame.centroids_px, frame.mag, SIZE, Optics(), k))
    found = calibrate(Matcher(database), paths, fov_deg=(5.0, 20.0))
    assert found.n_identified >= 9
    assert found.camera.focal_length_px == pytest.approx(camera.focal_length_px, rel=2e-3)
    assert found.fit.noise_px < 0.3


def test_frames_that_are_not_identified_are_named_with_the_reason(skies):
    database = skies[50.0]
    generator = np.random.default_rng(3)
    bad = [MeasuredFrame("clouds", generator.uniform(0, 960, (12, 2)))]
    few = [MeasuredFrame("night", np.array([[1.0, 2.0], [3.0, 4.0]]))]
    good = photographs(database, database.camera, 2, 5)
    focal_px = (database.camera.focal_length_px,) * 2
    with pytest.raises(CalibrationError) as caught:
        calibrate_frames(Matcher(database), [*bad, *few, *good], database.camera, focal_px)
    said = str(caught.value)
    assert said.startswith("2 of 4 frames are identified with fields of 50 to 50 deg")
    assert "clouds (12 centroids: " in said
    assert "night (2 centroids: fewer than 4 centroids of the frame are usable)" in said
    with pytest.raises(CalibrationError, match=r"^0 of 2 frames are identified"):
        calibrate_frames(Matcher(database), [*bad, *few], database.camera, focal_px)


def test_a_calibration_starts_with_what_is_known_of_the_camera():
    own, other = Camera(1024, 1024, fov_x_deg=12.0), Camera(*SIZE, fov_x_deg=16.0)
    assert starting_camera(own)[0] is own
    assert starting_camera(own, camera=other, image_size_px=SIZE)[0] is other
    known, (shortest, longest) = starting_camera(own, image_size_px=SIZE, fov_deg=(5.0, 20.0))
    assert (known.width_px, known.height_px) == SIZE
    assert Camera(*SIZE, shortest).fov_x_deg == pytest.approx(20.0)
    assert Camera(*SIZE, longest).fov_x_deg == pytest.approx(5.0)
    for fov_deg in ((20.0, 5.0), (0.0, 5.0), (5.0, 180.0), (float("nan"), 5.0)):
        with pytest.raises(ConfigError, match="expected the smaller one first"):
            starting_camera(own, fov_deg=fov_deg)


@pytest.fixture(scope="module")
def small_frames(small_database, tmp_path_factory):
    """Files of centroids of a lens with k1 = -0.15, of the small database's sky."""
    folder = tmp_path_factory.mktemp("frames")
    database = open_database(small_database)
    focal_px = 1.03 * database.camera.focal_length_px
    camera = Camera(512, 512, focal_px, distortion=Distortion(k1=-0.15))
    paths = []
    for k, frame in enumerate(
        simulate_frames(database.directions, camera, 8, Noise(0.2), 1, mag=database.mag)
    ):
        paths.append(folder / f"frame{k}.csv")
        write_centroids(frame.centroids_px, paths[-1], frame.mag)
    return camera, paths


def test_the_command_writes_a_camera_that_identifies(
    starcat, small_database, small_frames, tmp_path
):
    camera, paths = small_frames
    output, plot = tmp_path / "camera.toml", tmp_path / "left.svg"
    run = starcat(["calibrate", small_database, *paths[:-1], "-o", output, "--plot", plot])
    assert run.code == 0, run.err
    assert run.out.split()[:4] == ["frames", "7", "identified", "7"], run.out
    assert "chosen" in run.out
    found = read_camera(output)
    assert found.focal_length_px == pytest.approx(camera.focal_length_px, rel=2e-3)
    assert found.distortion.k1 == pytest.approx(-0.15, abs=0.03)
    assert "+-" in output.read_text()
    assert plot.read_text().startswith("<?xml")
    answer = starcat(["identify", small_database, paths[-1], "--camera", output, "--json"])
    assert '"identified"' in answer.out
    texts = [str(path) for path in paths[:-1]]
    known = starcat_package.calibrate(str(small_database), texts)
    assert known.camera.focal_length_px == pytest.approx(found.focal_length_px, rel=1e-9)
    assert repr(known).startswith("<Calibration 512 x 512 px")
    assert files.calibrated_toml(known).startswith("# Calibrated from 7 frames")


@pytest.fixture(scope="module")
def larger_frames(small_database, tmp_path_factory):
    """Frames of 640 x 480 px of the small database's sky, and a file of them."""
    folder, database = tmp_path_factory.mktemp("larger"), open_database(small_database)
    camera = Camera(640, 480, database.camera.focal_length_px)
    frames = list(simulate_frames(database.directions, camera, 12, Noise(0.2), 1, mag=database.mag))
    path = folder / "larger.csv"
    rows = [
        f"{k},{x:.4f},{y:.4f},{mag:.3f}"
        for k, frame in enumerate(frames)
        for (x, y), mag in zip(frame.centroids_px, frame.mag, strict=True)
    ]
    path.write_text("\n".join(["frame,x_px,y_px,mag", *rows]) + "\n")
    return camera, frames, path


def test_frames_that_are_larger_than_the_camera_are_refused(
    starcat, small_database, larger_frames, tmp_path
):
    _, frames, path = larger_frames
    output = tmp_path / "camera.toml"
    run = starcat(["calibrate", small_database, path, "-o", output])
    assert (run.code, output.exists()) == (2, False)
    said = " ".join(run.err.split())
    outside = sum(int((frame.centroids_px >= 512.0).any(axis=1).sum()) for frame in frames)
    assert f"{outside} of " in said
    assert "lie outside of 512 x 512 px, the size of the camera of the database, by up to" in said
    assert (
        "state the size of the frames (--size), with the field across their width (--fov)" in said
    )
    run = starcat(
        ["calibrate", small_database, path, "-o", output, "--size", "640x480", "--fov", "40:60"]
    )
    assert run.code == 0, run.err
    assert "outside" not in run.err + run.out
    assert (read_camera(output).width_px, read_camera(output).height_px) == (640, 480)
    # With a size that is stated, stray centroids are dropped, with a remark.
    known = calibrate(small_database, frames, size_px=(512, 512))
    noted = [frame for frame in known.frames if frame.remarks]
    assert len(noted) > 3
    assert "outside of the frame of 512 x 512 px" in noted[0].remarks[0]


def test_results_are_calibrated_with_the_size_of_their_camera(small_database, larger_frames):
    camera, frames, _ = larger_frames
    matcher = Matcher.open(small_database)
    results = [matcher.identify(frame, camera) for frame in frames]
    found = calibrate(small_database, results).camera
    assert (found.width_px, found.height_px) == (640, 480)
    assert found.focal_length_px == pytest.approx(camera.focal_length_px, rel=2e-3)
    others = [matcher.identify(frame) for frame in frames]
    with pytest.raises(ConfigError, match=r"cameras of 640 x 480 and 512 x 512 px.*\(camera\)"):
        calibrate(small_database, [*results, *others])
    assert calibrate(small_database, [*results, *others[:1]], camera=camera).camera.width_px == 640
    with pytest.raises(ConfigError, match=r"size of the camera of the results.*\(size_px\)"):
        calibrate(small_database, others)


def test_json_has_the_covariance_and_every_model(starcat, small_database, small_frames, tmp_path):
    _, paths = small_frames
    dark = {"centroids_px": [[1, 2], [300, 400], [50, 60]], "light": [1, 2, 3]}
    (tmp_path / "dark.json").write_text(json.dumps(dark))
    command = ["calibrate", small_database, *paths, tmp_path / "dark.json"]
    said = json.loads(starcat([*command, "-o", tmp_path / "camera.toml", "--json"]).out)
    names = said["supported"]["names"]
    assert names[:1] == ["focal_length_px"]
    assert "k1" in names
    covariance = np.array(said["supported"]["covariance"])
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), said["supported"]["errors"])
    assert len(said["models"]) == 16
    assert sum(model["is_chosen"] for model in said["models"]) == 1
    assert [frame["status"] for frame in said["frames"][:8]] == ["identified"] * 8
    assert {frame["reason"] for frame in said["frames"][:8]} == {None}
    assert said["frames"][8]["reason"] == "fewer than 4 centroids of the frame are usable"
    assert [len(frame["remarks"]) for frame in said["frames"]] == [0] * 8 + [1]
    assert said["frames"][8]["remarks"][0].startswith("not used: light; used are centroids_px")


def test_the_plot_has_residuals_along_and_across_the_radius():
    generator = np.random.default_rng(3)
    px, residual_px = generator.uniform(0.0, 1024.0, (50, 2)), generator.normal(0.0, 1.0, (50, 2))
    camera = Camera(1024, 1024, fov_x_deg=12.0)
    fit = SimpleNamespace(seen=SimpleNamespace(centroids_px=px), residual_px=residual_px)
    along, across = files._polar(SimpleNamespace(fit=fit, camera=camera))
    angle = np.angle((px - camera.principal_point_px) @ [1.0, 1.0j])
    turned = residual_px @ [1.0, 1.0j] * np.exp(-1.0j * angle)
    np.testing.assert_allclose(along + 1.0j * across, turned, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_plots_are_the_same_bytes_and_refuse_what_they_cannot_be(
    small_database, small_frames, tmp_path
):
    found = calibrate(Matcher.open(small_database), small_frames[1], progress=no_progress)
    for name in ("a.png", "b.png", "a.svg", "b.svg"):
        files.draw_residuals(found, tmp_path / name)
    for kind, start in (("png", b"\x89PNG"), ("svg", b"<?xml")):
        one, other = ((tmp_path / f"{name}.{kind}").read_bytes() for name in "ab")
        assert one == other
        assert one.startswith(start)
    with pytest.raises(OutputError, match="cannot be written"):
        files.draw_residuals(found, tmp_path / "nowhere" / "left.png")
