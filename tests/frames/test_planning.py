"""Plans: against simulated frames and by hand, files of other programs, and refused input."""

from __future__ import annotations

import json
import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from frames import error_arcsec
from scipy.spatial.transform import Rotation

import starcat as face
from starcat.errors import ConfigError
from starcat.frames.planning.acquisition import ENOUGH_STARS, detected_counts
from starcat.frames.planning.attitudes import attitudes_of, orbit_of
from starcat.frames.planning.choice import STAGES, broken_limit
from starcat.frames.sky.bodies import bodies_seen
from starcat.frames.sky.in_time import earth_limb_angle_deg
from starcat.frames.sky.observer import Observer
from starcat.geometry import attitude
from starcat.geometry.attitude import quaternion_from_matrix
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import separation
from starcat.matcher.chance import (
    largest_squares_px,
    log_false_match_probability,
    place_information,
)
from starcat.matcher.shape import derivatives
from starcat.matcher.stars import ARCSEC
from starcat.pipeline.simulation.simulate import Noise, Sky, simulate_frame
from starcat.results import to_dict

DATA = Path(__file__).parents[1] / "data"
TIME = "2027-03-01T06:31:30"


def quaternions(count, seed=4):
    turned = attitude.random_attitudes(count, np.random.default_rng(seed))
    return np.array([quaternion_from_matrix(matrix) for matrix in turned])


def test_counts_of_detected_stars_are_those_of_all_subsets():
    p, group = np.array([0.9, 0.2, 0.5, 0.7]), np.array([0, 0, 0, 2])
    counts = detected_counts(p, group, 3)
    by_hand = np.zeros(4)
    for seen in np.ndindex(2, 2, 2):
        chosen = np.array(seen, dtype=bool)
        by_hand[sum(seen)] += np.prod(np.where(chosen, p[:3], 1.0 - p[:3]))
    assert counts[0, :4] == pytest.approx(by_hand, abs=1e-15)
    assert counts[1, 0] == 1.0
    assert counts[2, :2] == pytest.approx([0.3, 0.7])
    many = detected_counts(np.ones(50), np.zeros(50, dtype=np.int64), 1)
    assert many[0, ENOUGH_STARS] == 1.0


def test_the_largest_residual_is_the_one_that_the_bound_permits():
    camera = Camera(1024, 1024, fov_x_deg=12.0)
    px = np.random.default_rng(1).random((6, 2)) * 1024.0
    body = camera.directions_from_pixels(px)
    gram = np.empty((3, 3))
    for (i, j), term in place_information(body).items():
        gram[i, j] = gram[j, i] = term.sum()
    determinant = np.array([np.linalg.det(gram)])
    (square,) = largest_squares_px(6, 8, 15, determinant, camera, 0.5, 1e-9)
    rows = derivatives(px, body, camera, 0)
    log_chance = log_false_match_probability(float(square), rows, 8, 15, camera, noise_px=0.5)
    assert log_chance == pytest.approx(np.log(1e-9), abs=1e-6)


def test_simulated_frames_are_identified_as_often_and_as_well_as_planned(small_database):
    """Of 60 attitudes with 20 frames each; the benchmark has more, of a larger database."""
    q, limit = quaternions(60), 3.6
    given = {"noise_px": 0.3, "noise_mag": 0.2, "limit_mag": limit, "false_stars": 1}
    plan = face.plan(small_database, q, **given)
    assert 0.3 < plan.acquisition.mean() < 0.95
    matcher = face.Matcher.open(small_database, noise_px=0.3)
    stars = matcher.database
    sky = Sky(stars.directions, stars.mag, np.arange(len(stars.mag), dtype=np.int32))
    noise, generator = Noise(0.3, 0.0, 1, noise_mag=0.2, limit_mag=limit), np.random.default_rng(2)
    rate, ratios = [], []
    for row, matrix in enumerate(plan.attitudes.matrices):
        turns = []
        for _ in range(20):
            frame = simulate_frame(sky, stars.camera, matrix, noise, generator)
            answer = matcher.identify(frame.centroids_px, mag=frame.mag)
            if answer.ok:
                turns.append(error_arcsec(answer, matrix))
        rate.append(len(turns) / 20)
        if len(turns) > 10:
            error = np.sqrt(np.mean(np.square(turns), axis=0))
            ratios.append(error / plan.error_arcsec[row])
    assert plan.acquisition.mean() == pytest.approx(np.mean(rate), abs=0.03)
    assert np.median(ratios, axis=0) == pytest.approx(np.ones(3), abs=0.1)


def test_stars_of_a_frame_are_those_that_the_camera_sees(small_database):
    plan = face.plan(small_database, quaternions(20), limit_mag=5.0, noise_mag=0.3)
    stars, camera = plan.database, plan.camera
    for row, matrix in enumerate(plan.attitudes.matrices):
        px = camera.pixels_from_directions(stars.directions @ matrix.T)
        rows = np.flatnonzero(camera.contains(px) & (stars.mag < 5.92))
        found = plan.stars_of(row)
        assert [one["mag"] for one in found] == np.sort(stars.mag[rows]).tolist()
        total = sum(one["detection_probability"] for one in found)
        assert plan.stars_expected[row] == pytest.approx(total)
    star = plan.stars_of(0)[0]
    brightest = int(np.flatnonzero(stars.mag == star["mag"])[0])
    apart = separation(stars.directions, stars.directions[brightest]) * ARCSEC
    alike = (apart < plan.expected.window_arcsec) & (np.abs(stars.mag - star["mag"]) <= 1.0)
    assert star["lookalikes"] >= alike.sum() - 1  # rejected records count too


def test_angles_are_those_of_the_observer_and_gaps_name_the_body(small_database):
    orbit = orbit_of(DATA / "orbit.oem")
    start = datetime(2027, 3, 1, 6, 30, 30, tzinfo=UTC)
    times = [start + timedelta(minutes=k) for k in range(6)]
    table = {"time": times, "q_body_from_icrs": quaternions(6)}
    given = {"orbit": DATA / "orbit.oem", "keep_out_deg": {"Sun": 180.0}, "min_acquisition": 0.0}
    # It is interpolated to metres.
    (at,) = orbit.observers([datetime(2027, 3, 1, 6, 34, 30, tzinfo=UTC)])
    angle, tilt = np.sqrt(398600.4418 / 7000.0**3) * 270.0, np.radians(98.0)
    c, s = np.cos(angle), np.sin(angle)
    place = 7000.0 * np.array([c, s * np.cos(tilt), s * np.sin(tilt)])
    exact = Observer.at("2027-03-01T06:34:30", position_km=place)
    assert np.abs(at.position_au - exact.position_au).max() * 149_597_870.7 < 0.002
    plan = face.plan(small_database, table, **given)
    assert [gap.reasons for gap in plan.gaps] == [("Sun",)]
    assert (plan.gaps[0].first, plan.gaps[0].last) == (0, 5)
    assert plan.gaps[0].start == "2027-03-01T06:30:30Z"
    for row, observer in enumerate(orbit.observers(times)):
        boresight = plan.attitudes.matrices[row][2]
        seen = bodies_seen(observer)
        for name in ("Sun", "Moon", "Jupiter"):
            angle = np.degrees(separation(seen.directions[seen.row(name)], boresight))
            assert plan.angles_deg[name][row] == pytest.approx(angle)
        assert plan.angles_deg["Earth"][row] == earth_limb_angle_deg(boresight, observer)


def test_a_frame_that_looks_at_the_earth_has_no_stars(small_database):
    orbit = orbit_of(DATA / "orbit.oem")
    observer = orbit.observers([datetime(2027, 3, 1, 6, 31, 30, tzinfo=UTC)])[0]
    down = observer.earth_au - observer.position_au
    ra, dec = np.degrees([np.arctan2(down[1], down[0]), np.arcsin(down[2] / np.linalg.norm(down))])
    table = {"time": [TIME], "ra_deg": [ra], "dec_deg": [dec], "roll_deg": [0.0]}
    plan = face.plan(small_database, table, orbit=DATA / "orbit.oem")
    assert plan.acquisition[0] == 0.0
    assert plan.stars_of(0) == []
    assert plan.gaps[0].reasons == ("acquisition",)
    assert plan.attitude(0)["error_arcsec"] == [None] * 3


def test_a_file_of_attitudes_that_ccsds_ndm_wrote_is_read_with_its_scalar_last_or_first(tmp_path):
    q = np.random.default_rng(1).normal(size=(5, 4))
    q /= np.linalg.norm(q, axis=1)[:, None]
    found = attitudes_of(DATA / "five_attitudes.aem")
    assert found.times[0] == datetime(2027, 3, 1, 6, 30, tzinfo=UTC)
    assert len(found.times) == 5
    exact = Rotation.from_quat(q).inv().as_matrix()
    assert np.abs(found.matrices - exact).max() < 1e-8
    lines = (DATA / "five_attitudes.aem").read_text().replace("= LAST", "= FIRST").splitlines()
    for k, line in enumerate(lines):
        if line.startswith("2027-"):
            time, x, y, z, w = line.split()
            lines[k] = " ".join((time, w, x, y, z))
    (tmp_path / "first.aem").write_text("\n".join(lines))
    assert np.array_equal(attitudes_of(tmp_path / "first.aem").matrices, found.matrices)


@pytest.mark.parametrize(
    ("changes", "is_inverse"),
    [
        ({"A2B": "B2A"}, True),
        ({"= EME2000": "= X", "= INSTRUMENT_1": "= ICRF", "= X": "= SC_BODY_1"}, True),
        ({"ATTITUDE_DIR             = A2B\n": "", "= QUATERNION": "= QUATERNION/RATE"}, False),
        ({"TIME_SYSTEM              = UTC": "TIME_SYSTEM = TAI"}, False),
        ({"2027-03-01T06:30:00.000  ": "2027-060T06:30:00.000  "}, False),
    ],
)
def test_the_headers_of_an_aem_are_heeded(tmp_path, changes, is_inverse):
    text = (DATA / "five_attitudes.aem").read_text()
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "changed.aem"
    path.write_text(text)
    found, plain = attitudes_of(path), attitudes_of(DATA / "five_attitudes.aem")
    expected = plain.matrices.transpose(0, 2, 1) if is_inverse else plain.matrices
    assert np.abs(found.matrices - expected).max() < 1e-12
    late = timedelta(seconds=37 if "TAI" in text else 0)
    assert found.times[0] == plain.times[0] - late


def test_tables_of_angles_and_of_quaternions_are_the_same_attitudes(tmp_path):
    table = tmp_path / "angles.csv"
    table.write_text(f"time,ra_deg,dec_deg,roll_deg\n{TIME},10,20,30\n{TIME},350,-80,0\n")
    angles = attitudes_of(table)
    q = np.array([quaternion_from_matrix(matrix) for matrix in angles.matrices])
    columns = dict(zip(("qx", "qy", "qz", "qw"), q.T, strict=True))
    for given in (q, {"q_body_from_icrs": q}, columns):
        assert np.abs(attitudes_of(given).matrices - angles.matrices).max() < 1e-12
    turned = attitudes_of(q, alignment=[0.0, 0.0, 0.6, 0.8]).matrices
    assert np.allclose(
        turned, attitude.matrix_from_quaternion(np.array([0, 0, 0.6, 0.8])) @ angles.matrices
    )


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ((10, 20, 30), r"its shape is \(3,\); expected \(K, 4\)$"),
        ([0, 0, 0, 1], r"its shape is \(4,\); expected \(K, 4\); a single row is a list of one"),
        (np.ones((2, 3, 3)), r"its shape is \(2, 3, 3\); expected \(K, 4\)$"),
        ([], "has 0 rows; expected 1 to"),
        (
            {"time": [TIME], "q_body_from_icrs": quaternions(2)},
            "time has 1 row, q_body_from_icrs has 2 rows; expected columns of one length$",
        ),
        (
            {"time": TIME, "ra_deg": [1, 2], "dec_deg": [3, 4], "roll_deg": [5]},
            "time has 1 row, ra_deg has 2 rows, dec_deg has 2 rows, roll_deg has 1 row; expected",
        ),
    ],
)
def test_attitudes_of_another_shape_are_refused(given, words):
    with pytest.raises(ConfigError, match=f"^attitudes: {words}"):
        attitudes_of(given)


def test_columns_of_an_orbit_are_equally_long():
    columns = {name: [1.0, 2.0] for name in ("x_km", "y_km", "z_km", "vx_km_s", "vy_km_s")}
    with pytest.raises(ConfigError, match=r"^orbit: time has 2 rows, .* vz_km_s has 1 row; expect"):
        orbit_of({"time": [TIME, TIME], **columns, "vz_km_s": [1.0]})


def test_every_star_is_taken_or_has_a_reason(small_database):
    plan = face.plan(small_database, quaternions(10), limit_mag=5.5)
    for row in range(10):
        choice = plan.best(6, row)
        stars = {one["star"] for one in plan.stars_of(row)}
        assert {one["star"] for one in (*choice.taken, *choice.left)} == stars
        assert len(choice.taken) + len(choice.left) == len(stars)
        assert len(choice.taken) == min(6, len(choice.taken))
        for number, star in enumerate(choice.taken):
            stage = STAGES[star["stage"] - 1]
            assert broken_limit(star, stage, choice.taken[:number], plan.camera) == ""
        assert all(one["reason"] for one in choice.left)
    with pytest.raises(ConfigError, match="count is 0"):
        plan.best(0)


def test_a_star_that_breaks_a_limit_is_left_with_its_value():
    star = {"star": "A", "x_px": 3.0, "y_px": 500.0, "detection_probability": 1.0, "lookalikes": 0,
            "contamination": None, "centroid_offset_px": None}  # fmt: skip
    camera = Camera(1000, 1000, 5000.0)
    assert broken_limit(star, STAGES[0], [], camera) == "edge px 3, limit 20"
    assert broken_limit(star, STAGES[-1], [], camera) == ""
    near = {**star, "star": "B", "x_px": 8.0}
    assert broken_limit(near, STAGES[2], [star], camera) == "5 px from A, limit 20"
    blended = {**star, "contamination": 0.6}
    assert broken_limit(blended, STAGES[-1], [], camera) == "contamination 0.6, limit 0.5"


def test_the_command_prints_a_table_json_and_a_plot(small_database, starcat, tmp_path):
    plot = tmp_path / "plan.svg"
    given = ["plan", small_database, DATA / "five_attitudes.aem", "--keep-out", "Sun=40,Moon=10"]
    ran = starcat([*given, "--row", 2, "--best", 5, "--plot", plot])
    assert ran.code == 0, ran.err
    assert max(map(len, ran.out.splitlines())) <= 100
    assert "Guide stars: 5 taken" in ran.out
    assert plot.read_text().lstrip().startswith("<?xml")
    told = json.loads(starcat([*given, "--row", 2, "--best", 5, "--json"]).out)
    keep_out = {"Sun": 40.0, "Moon": 10.0}
    plan = face.plan(small_database, DATA / "five_attitudes.aem", keep_out_deg=keep_out)
    assert told.pop("best") == json.loads(json.dumps(to_dict(plan.best(5, 1))))
    assert told == json.loads(json.dumps(plan.to_dict()))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["10,20,30", "--keep-out", "Sun=30"],
            "--keep-out: the angle of Sun needs attitudes with a time",
        ),
        (
            ["10,20,30", "--time", TIME, "--keep-out", "Earth=30"],
            "needs an orbit; give it with --orbit",
        ),
        (["10,20,30", "--time", TIME, "--keep-out", "Pluto=30"], "--keep-out: Pluto has"),
        (["10,20,30", "--keep-out", "Sun"], "--keep-out 'Sun' is not BODY=DEG"),
        (["10,120,30"], "expected -90 to 90"),
        (["nothing.csv"], "nothing.csv: no such file"),
        ([DATA / "five_attitudes.aem", "--best", 3], "choose one of the 5 with --row"),
        ([DATA / "five_attitudes.aem", "--row", 6], "the table has 5 attitudes"),
        ([DATA / "five_attitudes.aem", "--time", TIME], "in a table use the column time"),
        ([DATA / "five_attitudes.aem", "--orbit", DATA / "orbit.oem"], "the time of attitude 2"),
        ([DATA / "orbit.oem"], "ATTITUDE_TYPE is missing"),
        (["10,20,30", "--orbit", DATA / "orbit.oem"], "the attitudes have no time"),
        (["10,20,30", "--alignment", "1,1,1,1"], "--alignment is [1.0, 1.0, 1.0, 1.0]"),
        (["10,20,30", "--alignment", "1,2"], "error: --alignment is '1,2'"),
        (["10,20,30", "--plot", "plan.pdf"], "plan.pdf: a plot is one of"),
    ],
)
def test_what_is_wrong_is_said_in_the_words_of_the_command_line(
    small_database, starcat, arguments, words
):
    ran = starcat(["plan", small_database, *arguments])
    assert ran.code != 0
    assert words in ran.err


def test_an_orbit_in_metres_is_refused_by_its_time(small_database, starcat, tmp_path):
    text = (DATA / "orbit.oem").read_text()
    numbers = re.compile(r"(?<= )(-?[0-9]+\.[0-9]+)")
    (tmp_path / "orbit.oem").write_text(numbers.sub(lambda n: f"{1000 * float(n[1]):.6f}", text))
    attitude = ["10,20,30", "--time", "2027-03-01T06:30:00"]
    ran = starcat(["plan", small_database, *attitude, "--orbit", tmp_path / "orbit.oem"])
    assert "--orbit is [" in ran.err
    assert ran.err.strip().endswith(
        "at 2027-03-01T06:30:00; expected at most 100 km/s relative to the earth; divide a "
        "velocity in m/s by 1000"
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected qx, qy, qz, qw"),
        ("time,ra_deg\n", "has the columns time, ra_deg; expected qx, qy, qz, qw"),
        ("ra_deg,dec_deg,roll_deg\n1,2\n", "row 1 has 2 fields, not 3"),
        ("ra_deg,dec_deg,roll_deg\n1,2,x\n", "roll_deg is 'x' in row 1"),
        ("ra_deg,dec_deg,roll_deg\n1,2,nan\n", "roll_deg is not finite in row 1"),
        ("ra_deg,dec_deg,roll_deg\n", "has 0 rows"),
        ("qx,qy,qz,qw\n0,0,0,2\n", "the quaternion in row 1 has the length 2"),
        ("time,qx,qy,qz,qw\ntoday,0,0,0,1\n", "row 1: time is 'today'"),
        ("<?xml version='1.0'?>\n", "is XML"),
    ],
)
def test_a_table_that_is_not_a_table_of_attitudes_is_refused(tmp_path, text, words):
    (tmp_path / "given.csv").write_text(text)
    with pytest.raises(ConfigError, match=r"given\.csv") as refused:
        attitudes_of(tmp_path / "given.csv")
    assert words in str(refused.value)
