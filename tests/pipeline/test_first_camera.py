"""An unknown camera: from pictures or centroids to a database."""

from __future__ import annotations

import json
import os
import re
import tomllib

import numpy as np
import pytest
from archives import file_header

import starcat as starcat_api
from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.source import data_source
from starcat.errors import CalibrationError, ConfigError, OutputError, ProductError
from starcat.frames.calibration.first_camera import _reach, first_camera
from starcat.frames.images.batch import identify_files
from starcat.frames.images.render import write_simulated
from starcat.frames.images.solve_files import answer_file
from starcat.geometry.camera import Camera
from starcat.matcher.matcher import Matcher
from starcat.matcher.options import IdentifyOptions
from starcat.pipeline.blind import FIELDS_DEG, blind_database
from starcat.pipeline.simulation.simulate import Noise, simulate_frames
from starcat.pipeline.specs.build_spec import CameraSpec
from starcat.pipeline.starter import StarterCatalog

TRUE = Camera(1024, 768, fov_x_deg=31.7)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def blind(cache):
    """The database of all fields, built by the first test."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STARCAT_CACHE", str(cache))
        return Matcher.open(blind_database())


@pytest.fixture(scope="module")
def few_fields(tmp_path_factory):
    """A database of few fields and the brightest stars, which is built quickly."""
    folder, layout = tmp_path_factory.mktemp("few"), data_source("gaia").main_file
    kinds = np.dtype([(column.name, column.format) for column in layout.columns])
    sky = np.frombuffer(embedded_sky().read_bytes(), kinds, offset=layout.header_bytes)
    bright = sky[sky["mag_g"] <= 6.5]
    content = file_header(layout, len(bright)) + bright.tobytes()
    (folder / "gaia_merged.bin").write_bytes(content)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STARCAT_CATALOGS", str(folder))
        patch.setattr("starcat.pipeline.blind.FIELDS_DEG", (30.0, 34.0))
        patch.setattr(
            "starcat.pipeline.blind.CAMERA",
            CameraSpec(width_px=1024, height_px=768, fov_x_deg=30.0),
        )
        return Matcher.open(blind_database(cache=folder))


def frames_of(matcher, limit_mag=4.8):
    sky, noise = matcher.database, Noise(0.2, noise_mag=0.1, limit_mag=limit_mag)
    return list(simulate_frames(sky.directions, TRUE, 3, noise, 11, mag=sky.mag))


@pytest.fixture(scope="module")
def frames(blind):
    return frames_of(blind)


def write_centroids(path, rows):
    np.savetxt(path, rows, delimiter=",", header="x_px,y_px,mag", comments="")
    return path


def pictures_of(frames, folder):
    paths = [folder / f"photo{number}.png" for number in range(len(frames))]
    for number, (frame, path) in enumerate(zip(frames, paths, strict=True)):
        write_simulated(path, frame, TRUE, number)
    return paths


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_pictures_become_a_database_that_identifies_the_next(
    starcat, blind, frames, cache, tmp_path, monkeypatch
):
    made = list(cache.glob("blind/*/blind-1.0.0/database.h5"))
    first, second, third = pictures_of(frames, tmp_path)
    monkeypatch.setenv("STARCAT_CACHE", str(cache))  # the command has one of its own otherwise
    spec = tmp_path / "mycam.toml"
    run = starcat(["init", spec, "--from", first, second])
    assert run.code == 0, run.err
    assert list(cache.glob("blind/*/*/database.h5")) == made  # kept
    text = spec.read_text()
    given = tomllib.loads(text)
    assert (given["camera"]["width_px"], given["camera"]["height_px"]) == (1024, 768)
    assert given["camera"]["fov_x_deg"] == pytest.approx(TRUE.fov_x_deg, rel=0.003)
    assert 0.02 < given["self_test"]["noise_px"] < 0.6
    for key in ("camera.fov_x_deg", "selection.faint_limit_mag", "self_test.noise_px"):
        assert f"# {key} = " in text
    assert "2 identified: photo0, photo1." in text
    assert starcat(["build", spec, "-o", tmp_path]).code == 0
    [found] = json.loads(starcat(["identify", tmp_path / "mycam-1.0.0", third, "--json"]).out)
    assert found["status"] == "identified"
    q = np.array(found["q_body_from_icrs"])
    boresight = frames[2].matrix[2]
    ra, dec = np.radians([found["boresight_ra_deg"], found["boresight_dec_deg"]])
    seen = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
    assert np.degrees(np.linalg.norm(boresight - seen)) < 0.1
    assert np.linalg.norm(q) == pytest.approx(1.0)


@pytest.mark.timeout(120)
def test_one_file_of_centroids_is_enough(few_fields, tmp_path):
    frame, *_ = frames_of(few_fields, 4.0)
    path = write_centroids(tmp_path / "frame.csv", np.column_stack([frame.centroids_px, frame.mag]))
    found = first_camera(few_fields, [path], (30.0, 34.0), (1024, 768))
    assert abs(found.camera.fov_x_deg - TRUE.fov_x_deg) < found.fov_error_deg
    assert found.reach_mag == pytest.approx(4.0, abs=0.3)
    assert found.noise_px == pytest.approx(0.2, abs=0.1)
    assert not found.has_distortion


@pytest.mark.timeout(120)
@pytest.mark.parametrize("shape", [(1024, 576), (1024, 640), (576, 1024)])
def test_frames_of_every_shape_are_searched_in_the_part_that_is_served(few_fields, tmp_path, shape):
    eye = Camera(*shape, fov_x_deg=36.0 if shape[0] == 1024 else 26.0)
    sky, noise = few_fields.database, Noise(0.2, noise_mag=0.1, limit_mag=4.5)
    [frame] = simulate_frames(sky.directions, eye, 1, noise, 4, mag=sky.mag)
    rows = np.column_stack([frame.centroids_px, frame.mag])
    path = write_centroids(tmp_path / "frame.csv", rows)
    found = first_camera(few_fields, [path], FIELDS_DEG, shape)
    assert found.camera.fov_x_deg == pytest.approx(eye.fov_x_deg, rel=0.01)


@pytest.mark.timeout(120)
def test_a_shape_that_the_database_does_not_serve_is_named(few_fields, tmp_path):
    path = write_centroids(tmp_path / "strip.csv", np.random.default_rng(3).random((12, 2)) * 50.0)
    with pytest.raises(CalibrationError, match=r"strip\.csv: these fields are not searched"):
        first_camera(few_fields, [path], (8.0, 20.0), (1024, 64))


@pytest.mark.timeout(120)
def test_fields_that_are_not_served_are_refused_before_stars_are_searched(
    few_fields, small_database, tmp_path, monkeypatch
):
    [path] = pictures_of(frames_of(few_fields)[:1], tmp_path)
    monkeypatch.setattr(
        "starcat.frames.images.centroiding.find_spots", lambda *_, **__: pytest.fail("searched")
    )
    for fov_deg in ((2.0, 5.0), (5.0, 33.0)):
        with pytest.raises(
            ConfigError, match=r"; blind-1\.0\.0 is for fields of 30 to 34 deg across"
        ):
            answer_file(path, few_fields, IdentifyOptions(fov_deg=fov_deg))
    one_field = Matcher.open(small_database)
    for run in (answer_file, lambda *given: list(identify_files([given[0]], *given[1:]))):
        with pytest.raises(ProductError, match="it serves one field of view"):
            run(path, one_field, IdentifyOptions(fov_deg=(2.0, 5.0)))


@pytest.fixture
def built_specs(monkeypatch):
    """The specs of the databases that `blind_database` builds; none of them is built."""
    specs = []

    def build(spec, folder, *, inputs, progress):
        specs.append(spec)
        (folder / f"{spec.name}-{spec.version}").mkdir()

    monkeypatch.setattr("starcat.pipeline.blind.build", build)
    return specs


def test_a_database_of_another_range_and_catalog_is_built_once(built_specs, sao_file, tmp_path):
    catalog = StarterCatalog("sao", {"sao": [sao_file]})
    first, again = (
        blind_database(cache=tmp_path, fields_deg=(44.0, 60.0), catalog=catalog) for _ in range(2)
    )
    assert first == again
    [spec] = built_specs
    assert (spec.catalog.source, spec.catalog.band) == ("sao", "V")
    assert spec.camera.fov_x_deg == pytest.approx(40.0)  # for frames that are not square
    assert spec.products.levels.widest_fov_x_deg == pytest.approx(66.0)
    os.utime(sao_file, (1, 1))  # another file
    assert blind_database(cache=tmp_path, fields_deg=(44.0, 60.0), catalog=catalog) != first
    with pytest.raises(ConfigError, match=r"fields of 0.1 to 119 deg can be found"):
        blind_database(cache=tmp_path, fields_deg=(130.0, 150.0), catalog=catalog)


def test_init_takes_the_catalog_that_is_named(starcat, sao_file, tmp_path):
    catalog = tmp_path / "mein katalog.dat"
    catalog.write_bytes(sao_file.read_bytes())
    spec, given = tmp_path / "own.toml", f"sao={catalog}"
    camera = ["--size", "512x512", "--fov-x-deg", "40"]
    run = starcat(["init", spec, *camera, "--catalog", "sao", "--input", given])
    assert run.code == 0, run.err
    content = tomllib.loads(spec.read_text())
    assert (content["catalog"]["source"], content["catalog"]["band"]) == ("sao", "V")
    assert f"starcat build {spec} --input '{given}'" in run.err
    assert "limits in V" in run.out
    spec.unlink()
    for options, words in (
        (["--input", given], "--input and --source go with --catalog SOURCE"),
        (["--catalog", "vsx"], "a first spec has one catalog of stars"),
        (["--catalog", "gaia", "--input", given], "--input sao: a first spec has one catalog"),
    ):
        run = starcat(["init", spec, *camera, *options])
        assert (run.code, words in run.err) == (2, True), run.err
        assert not spec.exists()


def test_init_looks_for_its_file_first(starcat, tmp_path, monkeypatch):
    spec = tmp_path / "own.toml"
    spec.write_text("mine")
    monkeypatch.setattr("starcat.pipeline.starter.starter_spec", lambda *_: pytest.fail("computed"))
    run = starcat(["init", spec, "--size", "512x512", "--fov-x-deg", "40"])
    assert (run.code, "is there already" in run.err) == (1, True), run.err
    assert spec.read_text() == "mine"


@pytest.mark.parametrize("given", ["90:80", "0:20", "5:200", "x:y", "20"])
def test_a_range_is_refused_in_the_words_of_its_option(starcat, tmp_path, given):
    run = starcat(["init", tmp_path / "own.toml", "--size", "512x512", "--fov-range", given])
    assert run.code == 2
    assert re.search(f"--fov-range (?:is {given};|{given!r} is (?:not|a single))", run.err), run.err
    assert "fov_deg" not in run.err


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_distortion_is_found_where_the_stars_support_it(blind, frames, tmp_path):
    paths = []
    for number, frame in enumerate(frames):
        away = frame.centroids_px - [512.0, 384.0]
        square = (away**2).sum(axis=1) / TRUE.focal_length_px**2
        rows = np.column_stack([away * (1.0 + 0.05 * square)[:, None] + [512.0, 384.0], frame.mag])
        paths.append(write_centroids(tmp_path / f"bent{number}.csv", rows))
    found = first_camera(blind, paths, FIELDS_DEG, (1024, 768))
    assert found.lens.distortion.k1 == pytest.approx(0.05, abs=0.01)
    assert any("k1 = 0.0" in line for line in found.remarks("G"))
    assert found.fit.noise_px < 0.3


@pytest.mark.timeout(120)
def test_centroids_of_no_sky_tell_no_camera(few_fields, tmp_path):
    rows = np.random.default_rng(3).random((12, 3)) * [1024.0, 768.0, 5.0]
    path = write_centroids(tmp_path / "noise.csv", rows)
    with pytest.raises(CalibrationError, match=r"none of 1 pictures .* 30 to 34 deg \(noise"):
        first_camera(few_fields, [path], (30.0, 34.0), (1024, 768))


def test_the_reach_disregards_what_hides_bright_stars_too():
    mag = np.linspace(0.0, 6.0, 601)
    is_hidden = np.arange(601) % 5 < 2
    assert _reach(mag, mag < 4.0) == pytest.approx(4.0, abs=0.02)
    assert _reach(mag, (mag < 4.0) & ~is_hidden) == pytest.approx(4.0, abs=0.05)


@pytest.mark.timeout(300)
def test_photographs_of_a_real_camera(starcat, nights, blind, cache, tmp_path, monkeypatch):
    monkeypatch.setenv("STARCAT_CACHE", str(cache))
    spec = tmp_path / "imx219.toml"
    chosen = [nights / "spel" / f"img_{number}.jpg" for number in (7, 23, 40)]
    assert starcat(["init", spec, "--from", *chosen]).code == 0
    # The scale is the mean over the detector; without the distortion of the lens it is 50.5 deg.
    assert tomllib.loads(spec.read_text())["camera"]["fov_x_deg"] == pytest.approx(50.3, abs=0.3)
    assert starcat(["build", spec, "-o", tmp_path]).code == 0
    others = [nights / "spel" / f"img_{number}.jpg" for number in (1, 11, 26, 31, 50)]
    run = starcat(["identify", tmp_path / "imx219-1.0.0", *others, "--json"])
    found = [json.loads(line) for line in run.out.splitlines()]
    assert [one["status"] for one in found] == 5 * ["identified"]


def test_python_names_the_catalog_too(sao_file, tmp_path):
    camera = Camera(512, 512, fov_x_deg=40.0)
    made = starcat_api.init(camera, catalog="sao", inputs=sao_file)
    assert made.spec.catalog.source == "sao"
    with pytest.raises(ConfigError, match="name it with catalog"):
        starcat_api.init(camera, inputs=sao_file)
    (tmp_path / "own.toml").write_text("mine")
    with pytest.raises(OutputError, match="is there already"):
        starcat_api.init(camera, output=tmp_path / "own.toml", catalog="vsx")
