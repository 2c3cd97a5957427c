"""Arguments of public functions: units, masks, tables, types, and refused values."""

from __future__ import annotations

import inspect

import astropy.units as u
import numpy as np
import pyarrow as pa
import pytest
from astropy.table import MaskedColumn, QTable, Table

import starcat
from starcat.arguments import numbers_of
from starcat.errors import ConfigError, ProductError, StarcatError

TIME = "2026-11-22T10:00:00"


@pytest.fixture(scope="module")
def frame(small_database):
    return starcat.simulate(small_database, seed=7)[0]


@pytest.fixture(scope="module")
def matcher(small_database):
    return starcat.Matcher.open(small_database)


def test_a_unit_is_converted_or_refused(matcher, frame):
    where = {"position_km": [6778.0, 0.0, 0.0], "velocity_km_s": [0.0, 4.7, 6.0]}
    expected = starcat.Observer.at(TIME, **where)
    units = {"position_km": u.m, "velocity_km_s": u.m / u.h}
    factors = {"position_km": 1e3, "velocity_km_s": 3.6e6}
    given = {name: np.array(where[name]) * factors[name] * units[name] for name in where}
    found = starcat.Observer.at(TIME, **given)
    assert np.allclose(found.position_au, expected.position_au, rtol=1e-15)
    assert np.allclose(found.velocity_km_s, expected.velocity_km_s, rtol=1e-14)
    px = frame.centroids_px
    same = matcher.identify(px * u.pix, mag=frame.mag * u.mag)
    assert same.star_index.tolist() == matcher.identify(px).star_index.tolist()
    refused = [
        lambda: matcher.identify(px * u.deg),
        lambda: matcher.identify_many([px, px * u.deg]),
        lambda: matcher.identify([[1.0 * u.deg, 2.0 * u.deg]]),
        lambda: matcher.identify(px, mag=frame.mag * u.Jy),
        lambda: matcher.identify(px, sigma_px=np.ones(len(px)) * u.arcsec),
        lambda: matcher.identify(px, prior=np.ones(4) * u.m, prior_error_deg=1.0),
        lambda: matcher.identify(px, prior=same.q_body_from_icrs, prior_error_deg=1.0 * u.s),
        lambda: matcher.identify(px, fov_error=1.0 * u.deg),
        lambda: starcat.calibrate(matcher.database, frame, fov_deg=(8.0 * u.deg, 16.0 * u.mag)),
        lambda: starcat.Camera(1280, 960, fov_x_deg=3.0 * u.pix),
        lambda: starcat.Matcher.open(matcher.database, noise_px=0.5 * u.arcsec),
        lambda: starcat.Tracker(matcher, max_turn_deg=1.0 * u.m),
        lambda: starcat.Tracker(matcher).identify(px, time_s=1.0 * u.km),
        lambda: starcat.Observer.at(TIME, position_km=[1, 2, 3] * u.s),
        lambda: starcat.simulate(matcher.database, noise_px=0.5 * u.mag),
        lambda: starcat.ingest("sao", read_limit_mag=5.0 * u.pix),
        lambda: starcat.init(matcher.database.camera, faint_limit_mag=5.0 * u.Jy),
        lambda: expected.apparent(np.eye(3), np.ones(3) * u.m),
    ]
    for ask in refused:
        with pytest.raises(ConfigError):
            ask()


def test_a_single_number_has_its_unit_converted(matcher, frame):
    assert starcat.Camera(64, 64, fov_x_deg=180 * u.arcmin) == starcat.Camera(64, 64, fov_x_deg=3.0)
    stated = starcat.Matcher(matcher.database, noise_px=0.5 * u.pix, time_limit_s=100 * u.ms)
    assert (stated.settings.noise_px, stated.settings.time_limit_s) == (0.5, 0.1)
    assert starcat.Tracker(matcher, max_turn_deg=60 * u.arcmin).max_turn_deg == 1.0
    tracker = starcat.Tracker(matcher)
    assert tracker.identify(frame, time_s=1.0 * u.min).ok
    with pytest.raises(ConfigError, match=r"above 60\.0, the time of the frame before"):
        tracker.identify(frame, time_s=59.0)
    made = starcat.simulate(matcher.database, seed=7, noise_px=0.5 * u.pix, noise_mag=200 * u.mmag)
    assert made[0].centroids_px.tolist() == frame.centroids_px.tolist()
    off = matcher.identify(frame, fov_error=5 * u.percent)
    assert off.camera == matcher.identify(frame, fov_error=0.05).camera


def test_an_array_without_dimensions_is_a_number(matcher):
    number = np.array(0.5)
    stated = starcat.Matcher(matcher.database, noise_px=number, max_steps=np.array(1000))
    assert (stated.settings.noise_px, stated.settings.max_steps) == (0.5, 1000)
    assert starcat.Camera(64, np.array(64), fov_x_deg=number) == starcat.Camera(
        64, 64, None, fov_x_deg=0.5
    )
    assert starcat.simulate(matcher.database, np.array(1), noise_px=number, seed=7)
    for wrong in (np.array(99.0), np.array([0.5]), np.array(True), np.array("0.5")):
        with pytest.raises(ConfigError, match=r"noise_px is .*; expected 0\.001 to 50"):
            starcat.Matcher(matcher.database, noise_px=wrong)


def test_masked_entries_are_not_used(matcher, frame):
    px = np.ma.array(frame.centroids_px, mask=False)
    px[0] = np.ma.masked
    mag = MaskedColumn(frame.mag, unit="mag", mask=np.arange(len(frame.mag)) == 1)
    found = matcher.identify(px, mag=mag)
    assert found.ok
    assert found.star_index[0] == -1
    assert found.dropped == ((0, "not_finite"),)
    assert matcher.identify_many([px])[0].dropped == ((0, "not_finite"),)
    assert np.isnan(numbers_of("mag", mag, "(N,)")[1])
    assert np.isnan(numbers_of("mag", [3.0, None], "(N,)")[1])


def test_tables_are_read_by_the_names_of_their_columns(matcher, frame):
    pandas = pytest.importorskip("pandas")
    x, y = frame.centroids_px.T
    columns = {"flux": x, "mag": frame.mag, "y_px": y, "x_px": x}
    tables = [
        columns,
        Table(columns),
        QTable({**columns, "x_px": x * u.pix, "mag": frame.mag * u.mag}),
        pa.table(columns),
        pandas.DataFrame(columns),
        np.rec.fromarrays(list(columns.values()), names=list(columns)),
    ]
    expected = matcher.identify(frame.centroids_px, mag=frame.mag)
    for table in tables:
        found = matcher.identify(table)
        assert found.star_index.tolist() == expected.star_index.tolist()
        assert found.frame.mag.tolist() == frame.mag.tolist()
    many = matcher.identify_many(tables)
    assert [one.star_index.tolist() for one in many] == [expected.star_index.tolist()] * len(tables)
    for lacking in (Table({"x": x, "y_px": y}), pandas.DataFrame({"col": x, "row": y})):
        with pytest.raises(ConfigError, match="expected the columns x_px and y_px"):
            matcher.identify(lacking)
    with pytest.raises(TypeError, match="expected a sequence with one array per frame"):
        matcher.identify_many(tables[4])


def test_what_starcat_opens_its_functions_take(small_database, tmp_path):
    opened = starcat.open(small_database)
    matcher = starcat.Matcher.open(opened)
    for given in (matcher.database, str(small_database)):
        assert len(starcat.simulate(given, 2)) == 2
        assert not starcat.verify(given).findings
        assert starcat.diff(given, opened).is_same
    assert len(starcat.plan(opened, {"ra_deg": [10.0], "dec_deg": [20.0], "roll_deg": [0.0]})) == 1
    assert starcat.export(opened, "csv", tmp_path / "csv", products=["stars"])
    assert starcat.publish(opened, tmp_path / "registry")
    with starcat.connect(opened) as connection:
        assert connection.sql("SELECT count(*) AS n FROM stars").to_table()["n"].tolist() == [
            len(matcher.database.mag)
        ]
    [frame] = starcat.simulate(opened, seed=7)
    observer = starcat.Observer.at(TIME)
    answer = starcat.with_planets(matcher.identify(frame), observer)
    assert starcat.sky_in_time(answer, observer)


class Other:
    """An object of a class that starcat does not have."""


WRONG = [
    lambda db: starcat.Camera(1280, 960),
    lambda db: starcat.Camera(1280, 960, 100.0, fov_x_deg=3.0),
    lambda db: starcat.Camera(1280, 960, 100.0, distortion=Other()),
    lambda db: starcat.Camera(1280, 960, 100.0, principal_point_px=Other()),
    lambda db: starcat.Matcher(db),
    lambda db: starcat.Matcher(starcat.Matcher.open(db).database, selection=3),
    lambda db: starcat.Matcher(starcat.Matcher.open(db).database, method="triangles"),
    lambda db: starcat.Matcher(starcat.Matcher.open(db).database, method=["triangle"]),
    lambda db: starcat.Matcher.open(Other()),
    lambda db: starcat.Matcher.open(db, Other()),
    lambda db: starcat.Matcher.open(db).identify(Other()),
    lambda db: starcat.Matcher.open(db).identify([[1, 2]], Other()),
    lambda db: starcat.Matcher.open(db).identify_many(Other()),
    lambda db: starcat.Matcher.open(db).identify_many(iter([Other()])),
    lambda db: starcat.Matcher.open(db).identify_many([], threads=0),
    lambda db: starcat.Matcher.open(db).identify_many([], mag=3.0),
    lambda db: starcat.Observer.at(Other()),
    lambda db: starcat.Observer.at(TIME, position_km=Other()),
    lambda db: starcat.build(Other()),
    lambda db: starcat.build({}),
    lambda db: starcat.build(starcat.preset("gaia-12deg"), inputs=5),
    lambda db: starcat.calibrate(db, starcat.simulate(db, 3), size_px="x"),
    lambda db: starcat.calibrate(db, starcat.simulate(db, 3), size_px=3),
    lambda db: starcat.calibrate(db, starcat.simulate(db, 3), camera=Other()),
    lambda db: starcat.calibrate(db, Other()),
    lambda db: starcat.calibrate(db, [Other()]),
    lambda db: starcat.connect(Other()),
    lambda db: starcat.diff(db, Other()),
    lambda db: starcat.export(db, "csv", Other()),
    lambda db: starcat.export(db, "csv", "x", colour="red"),
    lambda db: starcat.export(db, Other()),
    lambda db: starcat.export(db, "csv", products=5),
    lambda db: starcat.export(db, "hats", max_partition_rows="x"),
    lambda db: starcat.export(db, "onboard", max_bytes="x"),
    lambda db: starcat.export(db, "onboard", sign=5),
    lambda db: starcat.with_planets(Other(), starcat.Observer.at(TIME)),
    lambda db: starcat.with_planets(starcat.Matcher.open(db).identify([[1, 2]]), Other()),
    lambda db: starcat.sky_in_time(None, starcat.Observer.at(TIME)),
    lambda db: starcat.sky_in_time(starcat.Matcher.open(db).identify([[1, 2]]), Other()),
    lambda db: starcat.ingest(Other()),
    lambda db: starcat.ingest("sao", Other()),
    lambda db: starcat.ingest("sao", epoch_jyear="soon"),
    lambda db: starcat.init(Other()),
    lambda db: starcat.init(starcat.Camera(9, 9, 9.0), 5),
    lambda db: starcat.learn(db, Other()),
    lambda db: starcat.open(Other()),
    lambda db: starcat.plan(db, Other()),
    lambda db: starcat.plan(db, [[0, 0, 0, 1]], best=3),
    lambda db: starcat.preset(Other()),
    lambda db: starcat.publish(db, Other()),
    lambda db: starcat.publish(db, "registry", sign=Other()),
    lambda db: starcat.pull(Other(), "registry"),
    lambda db: starcat.pull("a@1.0.0", Other()),
    lambda db: starcat.read_frames(Other()),
    lambda db: starcat.read_spec(Other()),
    lambda db: starcat.simulate(db, -1),
    lambda db: starcat.simulate(db, 1.5),
    lambda db: starcat.simulate(db, noise_px=-1.0),
    lambda db: starcat.simulate(db, drop_probability=2.0),
    lambda db: starcat.simulate(db, false_stars=-1),
    lambda db: starcat.simulate(db, seed=-1),
    lambda db: starcat.simulate(Other()),
    lambda db: starcat.Tracker(Other()),
    lambda db: starcat.Tracker(starcat.Matcher.open(db)).follow(5),
    lambda db: starcat.Matcher.open(db).identify([[1, 2]]).to_dict(5),
    lambda db: starcat.Matcher.open(db).identify(starcat.simulate(db)[0]).with_noise("x"),
    lambda db: starcat.Matcher.open(db).identify([[1, 2]]).plot(5),
    lambda db: starcat.verify(Other()),
]


@pytest.mark.parametrize("ask", WRONG, ids=lambda ask: inspect.getsource(ask).strip()[11:60])
def test_every_wrong_argument_is_refused(ask, small_database):
    """A wrong value is an error of starcat, a wrong type Python's TypeError."""
    with pytest.raises((StarcatError, TypeError)) as refused:
        ask(small_database)
    assert isinstance(refused.value, ValueError | TypeError)
    assert str(refused.value)


def test_a_database_that_was_changed_is_not_opened(database_copy, small_database):
    path = database_copy / "database.h5"
    data = bytearray(path.read_bytes())
    names = starcat.Matcher.open(small_database).database.star_id.tobytes()
    at = bytes(data).index(names)
    data[at : at + len(names)] = np.frombuffer(names, np.int64)[::-1].tobytes()
    path.write_bytes(data)
    with pytest.raises(ProductError, match="The file was changed after the build"):
        starcat.Matcher.open(database_copy)
    assert starcat.Matcher.open(database_copy, verify=False).database.star_id[0]
    (database_copy / "manifest.json").write_text("{}")
    with pytest.raises(ProductError, match="does not state the digest"):
        starcat.Matcher.open(database_copy)
