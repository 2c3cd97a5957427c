"""The report of a star sensor: noise and bias equal closed forms, and the files are complete."""

from __future__ import annotations

import csv
import json
import math
import runpy
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from starcat.cli.main import app
from starcat.errors import ConfigError
from starcat.frames.sky.bodies import bodies_seen
from starcat.geometry.attitude import quaternion_from_matrix, random_attitudes
from starcat.geometry.camera import Camera
from starcat.matcher.matcher import Matcher
from starcat.matcher.stars import ARCSEC
from starcat.pipeline.simulation.simulate import Sky
from starcat.pipeline.specs.star_sensor import Sensor, example_toml, read_sensor, sensor_from
from starcat_lab.ecss import bench as benches
from starcat_lab.ecss import trials
from starcat_lab.ecss.bench import Bench, Condition, bench_answer
from starcat_lab.ecss.report import expected_bias, spread, temporal_noise

PERFECT = {
    "zero_point_e_s": 6e6, "exposure_s": 0.1, "psf_sigma_px": 0.8, "pixel_um": 12.0,
    "read_noise_e": 8.0, "full_well_e": 1e6, "gain_e_adu": 8.0, "bits": 16, "update_rate_hz": 5.0,
}  # fmt: skip
SENSORS = {
    "bright": {},
    "noisy": {"psf_sigma_px": 1.2, "read_noise_e": 20.0, "sky_e_s": 1000.0, "zero_point_e_s": 3e7},
    "sharp": {"psf_sigma_px": 0.6, "read_noise_e": 3.0, "gain_e_adu": 4.0, "exposure_s": 0.2},
}
CAMERA = Camera(256, 256, fov_x_deg=20.0)


@pytest.fixture(scope="module")
def bench_of(random_directions, sky_of):
    """A bench with 1,500 stars at random places and a small detector: of what its sensor has."""
    database = sky_of(random_directions(1500, 3), CAMERA)
    matcher = Matcher(database)
    stars = np.arange(len(database.mag), dtype=np.int32)
    sky = Sky(database.directions, database.mag, stars)

    def make(**keys: object) -> Bench:
        return Bench(sensor_from({**PERFECT, **keys}, "test"), matcher, sky, 1)

    return make


def test_a_box_of_pixels_is_measured_as_the_spec_says(bench_of):
    """A wide box includes the light of the next star; a window includes hardly any of it."""
    window = bench_of()
    box = replace(window, box_px=9)
    places = np.array([[100.5, 100.5], [104.7, 100.5]])
    light = window.light(places, np.full(2, 3.0))
    moved = [trials._centroids(bench, light, places[:1]) - places[:1] for bench in (window, box)]
    alone = trials._centroids(box, window.light(places[:1], np.full(1, 3.0)), places[:1])
    assert alone == pytest.approx(places[:1], abs=1e-3)
    assert moved[0][0, 0] < 0.1 < 1.0 < moved[1][0, 0]
    image = box.recorded(light + box.sensor.background_e, np.random.default_rng(1))
    expected = trials._centroids(box, light, places)
    found, expected = np.sort(box.centroids(image), axis=0), np.sort(expected, axis=0)
    assert found == pytest.approx(expected, abs=0.1)


def test_the_noise_of_a_star_is_that_of_the_closed_form(bench_of):
    found = trials.star_noise(bench_of(), 3.0, 0.0)
    assert found["found"] == found["count"]
    assert found["noise_arcsec"] == pytest.approx(found["closed_form_arcsec"], rel=0.03)
    with pytest.raises(ConfigError, match="rates_deg_s: 20 deg/s draws trails of 2534 px in 10 s"):
        trials.trials_of(bench_of(rates_deg_s=[0.1, 20.0], exposure_s=10.0), 1)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", SENSORS)
def test_noise_of_three_sensors_is_within_3_percent_of_closed_forms(name, bench_of):
    bench = bench_of(**SENSORS[name])
    for mag in (2.0, 3.0, 4.0):
        found = trials.star_noise(bench, mag, 0.0)
        assert found["noise_arcsec"] == pytest.approx(found["closed_form_arcsec"], rel=0.03)
    generator = np.random.default_rng(4)
    fields = random_attitudes(400, generator)
    truth = next(matrix for matrix in fields if _has_stars_apart(bench, matrix))
    images = bench.exposures(truth, Condition(), generator, 1200)
    answers = [bench_answer(bench, image, truth) for image in images]
    named = [tuple(sorted(one.star_index)) for one in answers]
    usual = max(set(named), key=named.count)
    errors = np.array([one.error for one, own in zip(answers, named, strict=True) if own == usual])
    assert len(errors) > 800
    rows = np.array(usual)
    places = bench.camera.pixels_from_directions(bench.sky.directions[rows] @ truth.T)
    closed = trials.attitude_variance(
        bench, places, trials.centroid_noise_px(bench, bench.sky.mag[rows])
    )
    # The mean of the three axes, because the variance of one axis is known to 2 % only.
    assert math.sqrt((errors.var(axis=0) / closed).mean()) == pytest.approx(1.0, abs=0.03)


def _has_stars_apart(bench: Bench, matrix: np.ndarray) -> bool:
    """Whether a field has enough stars, none in the window of another.

    Two stars of one window are one spot in some frames and two in others, which is not noise.
    """
    _, places = bench.in_field(matrix)
    apart_px = np.sort(np.linalg.norm(places[:, None] - places, axis=-1), axis=1)[:, 1]
    return len(trials.guide_stars(bench, matrix)[1]) >= 12 and bool(apart_px.min() > 12.0)


SLOW = pytest.mark.slow
TURNED = {"alignment_arcsec": [0.0, 0.0, 900.0]}
BIASES = [
    pytest.param({"alignment_arcsec": [60.0, -40.0, 900.0]}, id="alignment", marks=SLOW),
    pytest.param({"principal_point_error_px": [0.5, -0.3], **TURNED}, id="axis", marks=SLOW),
    pytest.param(
        {"principal_point_error_px": [-0.4, -0.6], "alignment_arcsec": [90.0, 70.0, -1200.0]},
        id="both",
    ),
]


@pytest.mark.parametrize("bias", BIASES)
def test_bias_of_three_sensors_is_within_5_percent_of_closed_forms(bias, bench_of):
    bench = bench_of(**bias, zero_point_e_s=3e7)
    trial = trials.SensorTrial("bias", Condition(), 16, 1)
    records = [trials.point(bench, trial, number) for number in range(trial.pointings)]
    errors = [one["error"][0] for one in records if one["right"][0]]
    assert len(errors) == trial.pointings
    # Not the mean: a star that the border cuts, or two in one window, can be off by half a pixel,
    # which is a hundred times the noise of this sensor.
    assert np.median(errors, axis=0) == pytest.approx(expected_bias(bench), rel=0.05)


def test_each_contributor_is_nothing_where_the_sensor_knows_all(bench_of):
    truth = random_attitudes(1, np.random.default_rng(2))[0]
    bench = bench_of()
    places = bench.camera.pixels_from_directions(bench.sky.directions @ truth.T)
    stars = np.flatnonzero(bench.camera.contains(places))

    def sizes(**keys: object) -> dict[str, float]:
        made = trials.contributions(bench_of(**keys), truth, stars, np.random.default_rng(5))
        return {name: float(np.abs(error).max()) for name, error in made.errors.items()}

    perfect = sizes()
    unknown = {
        "prnu": {"prnu": 0.02}, "dsnu": {"dsnu_e_s": 300.0, "dark_e_s": 1000.0},
        "distortion": {"distortion_error_px": 0.5}, "catalog": {"catalog_error_arcsec": 5.0},
        "aberration": {"velocity_error_km_s": 1.0},
    }  # fmt: skip
    for name, keys in unknown.items():
        assert perfect[name] < 1e-6
        assert sizes(**keys)[name] > 0.05
    # The Earth moves by 30 km/s and an orbit by 7.6: 20.5 and 5.2 arcsec at most.
    assert perfect["no_orbit"] < 5.3
    assert 5.0 < perfect["no_aberration"] < 26.0


def test_a_motion_makes_trails_about_the_attitude_in_the_middle(bench_of):
    bench, generator = bench_of(), np.random.default_rng(3)
    truth = random_attitudes(1, generator)[0]
    still = next(bench.exposures(truth, Condition(), generator, 1)).astype(float)
    moved = next(bench.exposures(truth, Condition(rate_deg_s=3.0), generator, 1)).astype(float)
    assert moved.sum() == pytest.approx(still.sum(), rel=0.01)
    assert moved.max() < 0.8 * still.max()
    answer = bench_answer(bench, moved.astype(np.uint16), truth)
    assert answer.is_right
    assert np.abs(answer.error[:2]).max() < 20.0


def test_conditions_are_in_the_frames(bench_of):
    bench, truth = bench_of(hot_pixel_share=0.01), random_attitudes(1, np.random.default_rng(6))[0]

    def spots(condition: Condition) -> tuple[float, int]:
        image = next(bench.exposures(truth, condition, np.random.default_rng(7), 1))
        return float(image.sum()), len(bench.spots(image))

    (light, count), (_, more) = spots(Condition()), spots(Condition(false_stars=10))
    assert count + 5 <= more <= count + 10
    assert spots(Condition(missing_share=1.0))[1] == 0
    assert spots(Condition(is_old=True))[0] > light + 0.5 * 655 * 2000 / 8.0
    # 0.094 cm2 in 0.1 s: 94 particles of 3,000 electrons.
    hits = spots(Condition(radiation_cm2_s=10_000.0))[0] - light
    assert hits == pytest.approx(94 * 3000 / 8.0, rel=0.4)


def test_a_planet_is_in_the_field(bench_of):
    bench, generator = bench_of(), np.random.default_rng(8)
    for _ in range(10):
        observer = benches.random_day(generator)
        matrix = benches.planet_in_field(bench, observer, generator)
        assert matrix @ matrix.T == pytest.approx(np.eye(3), abs=1e-12)
        seen = bodies_seen(observer)
        bodies = seen.directions[[seen.row(name) for name in benches.PLANETS]]
        assert bench.camera.contains(bench.camera.pixels_from_directions(bodies @ matrix.T)).any()


def test_errors_and_spreads_by_hand():
    truth = random_attitudes(1, np.random.default_rng(1))[0]
    found = benches.turned(truth, (1.0 / ARCSEC, -2.0 / ARCSEC, 3.0 / ARCSEC))
    error = benches.error_arcsec(truth, quaternion_from_matrix(found))
    assert error == pytest.approx([1.0, -2.0, 3.0], abs=1e-6)
    records = [
        {"error": [[1.0, 0.0, 0.0], [3.0, 0.0, 4.0]], "right": [True, True]},
        {"error": [[9.0, 9.0, 9.0], [math.nan] * 3], "right": [True, False]},
    ]
    noise = temporal_noise(records, 0.997)
    assert noise is not None
    assert noise["sigma_arcsec"] == pytest.approx([math.sqrt(2.0), 0.0, math.sqrt(8.0)])
    assert noise["degrees"] == 1
    # Tables of chi-square with 10 degrees of freedom: 3.247 and 20.483.
    low, high = spread(np.ones(3), 10, 0.95)["interval"]
    assert (low, high) == pytest.approx((math.sqrt(10 / 20.483), math.sqrt(10 / 3.247)), rel=1e-3)


def test_the_example_is_a_sensor_with_every_key(tmp_path):
    text = CliRunner().invoke(app, ["evaluate", "--ecss-example"]).output
    assert text == example_toml()
    (tmp_path / "sensor.toml").write_text(text)
    sensor = read_sensor(tmp_path / "sensor.toml")
    # 314 mm2 of 19,100 electrons per second and mm2.
    assert sensor.zero_point_e == pytest.approx(600_000, rel=1e-3)
    said = set(tomllib.loads(text.replace("# zero_", "zero_").replace("# limit_", "limit_")))
    assert said == set(Sensor.model_fields)
    # The options of a sweep do not go with a sensor.
    command = ["evaluate", str(tmp_path), "--ecss", str(tmp_path / "sensor.toml")]
    for wrong in ([*command, "--noise-px", "1"], ["evaluate", "--paper", "S1", *command[2:]]):
        done = CliRunner().invoke(app, wrong, standalone_mode=False)
        assert isinstance(done.exception, ConfigError)
        assert "--ecss goes with a database" in str(done.exception)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"exposre_s": 1.0}, "s.toml: exposre_s: unknown key; did you mean 'exposure_s'"),
        ({"exposure_s": None}, "s.toml: exposure_s: missing; every sensor needs it"),
        ({"alignment_arcsec": [1.0]}, "s.toml: alignment_arcsec.1: found a list of 1; expected"),
        ({"aperture_mm": 20.0}, "give either zero_point_e_s, or both aperture_mm and quantum"),
        ({"zero_point_e_s": None}, "give either zero_point_e_s, or both aperture_mm and quantum"),
    ],
)
def test_a_wrong_sensor_is_reported(change, text):
    content = {key: value for key, value in {**PERFECT, **change}.items() if value is not None}
    with pytest.raises(ConfigError) as told:
        sensor_from(content, "s.toml")
    assert text in str(told.value)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_report_says_it_all(small_database, tmp_path):
    """Twice the same bytes with one worker and with two, and files that other tools read."""
    quick = {**PERFECT, "rates_deg_s": [0.0], "false_stars": [3], "missing_shares": [],
             "radiation_cm2_s": []}  # fmt: skip
    lines = [f"{key} = {json.dumps(value)}" for key, value in quick.items()]
    (tmp_path / "sensor.toml").write_text("\n".join(lines))
    folders = []
    for workers in ("1", "2"):
        command = ["evaluate", str(small_database), "--ecss", str(tmp_path / "sensor.toml")]
        command += ["--frames", "4", "--workers", workers, "-o", str(tmp_path / workers)]
        done = CliRunner().invoke(app, command)
        assert done.exit_code == 0, done.output
        folders.append(tmp_path / workers / f"{small_database.name}-ecss")
    names = sorted(path.name for path in folders[0].iterdir())
    assert names == sorted(path.name for path in folders[1].iterdir())
    for name in names:
        assert (folders[0] / name).read_bytes() == (folders[1] / name).read_bytes(), name
    content = json.loads((folders[0] / "report.json").read_text())
    assert content["trials"]["nominal"]["first_frame"]["hits"] >= 3
    assert content["frames"] == 4 * (3 + 1 + 1 + 2)
    sigma = next(r for r in content["budget"] if r["name"] == "temporal")["sigma_arcsec"]
    _check_simulators(folders[0], sigma)
    rows = list(csv.DictReader((folders[0] / "errors.csv").read_text().splitlines()))
    assert float(rows[0]["\u03c3 x, arcsec"]) == pytest.approx(sigma[0], rel=0.01)
    page = (folders[0] / "index.html").read_text()
    assert page.count("\u2610") == page.count("\u2610</td>") >= 12


def _check_simulators(folder: Path, sigma_arcsec: list[float]) -> None:
    lines = (folder / "SC_star_tracker_42.txt").read_text().splitlines()
    fields = [line.partition("!") for line in lines if "!" in line]
    by_label = {label.strip(): value.split() for value, _, label in fields}
    assert len(lines) == 10
    noise = [float(value) for value in by_label["Noise Equivalent Angle, arcsec RMS"]]
    assert noise == pytest.approx(sigma_arcsec, rel=1e-3)

    calls: dict[str, object] = {}
    tracker = SimpleNamespace(
        setAMatrix=lambda matrix: calls.update(memory=matrix),
        setWalkBounds=lambda bounds: calls.update(bounds=bounds),
    )
    runpy.run_path(str(folder / "star_tracker_basilisk.py"))["configure"](tracker)
    assert np.array(tracker.PMatrix) == pytest.approx(np.diag(sigma_arcsec) / ARCSEC, rel=1e-9)
    assert calls == {"memory": [[0.0] * 3] * 3, "bounds": [0.0] * 3}
