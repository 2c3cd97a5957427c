"""Specs as something to write: keys explained, TOML that reads back, keys changed, starters."""

from __future__ import annotations

import json
import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from starcat.catalog.ingest import ingest_catalog
from starcat.errors import ConfigError
from starcat.pipeline import starter
from starcat.pipeline.specs.build_spec import BuildSpec, CameraSpec
from starcat.pipeline.specs.keys import REQUIRED, spec_sections, spec_toml, toml_value
from starcat.pipeline.specs.reading import preset, read_spec, spec_from_dict
from starcat.pipeline.starter import ENOUGH_STARS, boresight_count


@pytest.fixture(scope="module", autouse=True)
def sky_read_once():
    """The bright part of the embedded sky, which every first spec begins with."""
    read = {}

    def once(source, paths, **options):
        if source not in read:
            read[source] = ingest_catalog(source, paths, read_limit_mag=8.5, neighbours=False)
        return read[source]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(starter, "read_catalog", once)
        yield


def all_keys():
    return [key for section in spec_sections() for key in section.keys]


def test_keys_are_explained():
    keys = all_keys()
    assert all(len(key.description) > 8 for key in keys)
    assert [k.path for k in keys if k.default is REQUIRED and k.example is None] == []
    numbers = [key for key in keys if key.kind in ("number", "whole number")]
    assert len(numbers) > 40
    assert [key.path for key in numbers if " to " not in key.range] == []


def test_the_keys_are_those_of_the_model():
    assert str(preset("gaia-12deg")).startswith("<BuildSpec gaia-12deg-1.0.0: gaia to 6 mag")
    dumped = preset("gaia-12deg").model_dump(mode="json")

    def paths(values, before=()):
        for name, value in values.items():
            if isinstance(value, dict):
                yield from paths(value, (*before, name))
            else:
                yield ".".join((*before, name))

    assert {key.path for key in all_keys()} == set(paths(dumped))


@given(st.one_of(st.text(), st.booleans(), st.integers(-(2**62), 2**62), st.floats(-1e300, 1e300)))
def test_a_value_is_written_as_toml_reads_it(value):
    assert tomllib.loads(f"value = {toml_value(value)}")["value"] == value


@pytest.mark.parametrize(
    ("key", "text", "found"),
    [
        ("camera.fov_x_deg", "16", lambda spec: spec.camera.fov_x_deg == 16.0),
        ("name", "other", lambda spec: spec.name == "other"),
        ("name", '"quoted"', lambda spec: spec.name == "quoted"),
        ("version", "1.2.3", lambda spec: spec.version == "1.2.3"),
        ("products.grid.enabled", "false", lambda spec: not spec.products.grid.enabled),
        ("selection.variables.join", '["gcvs"]', lambda s: s.selection.variables.join == ("gcvs",)),
        ("self_test.seed", "", lambda spec: spec.self_test.seed == 20_000),
    ],
)
def test_a_key_is_changed(key, text, found):
    assert found(preset("sao-12deg", {key: text}))


def test_a_scale_takes_the_place_of_another():
    changes = {"camera.focal_length_mm": "", "camera.pixel_um": "", "camera.fov_x_deg": "16"}
    assert preset("2mass-8x6", changes).camera.camera().fov_x_deg == pytest.approx(16.0)


@pytest.mark.parametrize(
    ("key", "words"),
    [("camera.fov_y", "did you mean 'fov_x_deg'"), ("name.first", "name is a value, not a table")],
)
def test_a_change_that_makes_no_sense_is_refused(key, words):
    with pytest.raises(ConfigError, match=words):
        preset("sao-12deg", {key: "six"})


@pytest.mark.parametrize(
    "path",
    [
        *(f"products.neighbours.{key}_deg" for key in ("angle_bin", "separation_bin", "radius")),
        *("products.grid.radius_deg", "products.pairs.max_separation_deg", "camera.fov_x_deg"),
        *(f"products.crossmatch.{key}" for key in ("radius_arcsec", "colour_spread_mag")),
        "boresights.fov_x_deg",
    ],
)
@pytest.mark.parametrize("value", ["1e-300", "5e-324"])
def test_numbers_next_to_nothing_are_refused(path, value):
    with pytest.raises(ConfigError, match=path.rpartition(".")[2]):
        preset("gaia-12deg", {path: value})
    with pytest.raises(ValueError, match=r"fov_x_deg is .*check the units"):
        CameraSpec(width_px=16, height_px=16, focal_length_mm=1e6, pixel_um=0.01)


@pytest.mark.parametrize(("fov_deg", "count"), [(60.0, 2000), (12.0, 2700), (2.0, 30_000)])
def test_narrow_fields_get_more_boresights(fov_deg, count):
    camera = CameraSpec(width_px=1000, height_px=1000, fov_x_deg=fov_deg)
    assert boresight_count(camera) == count


def test_init_writes_a_spec_and_says_how_many_stars_a_field_has(starcat, tmp_path):
    path = tmp_path / "mycam.toml"
    lens = ["--size", "1280x960", "--focal-mm", "25", "--pixel-um", "5.5"]
    done = starcat(["init", path, *lens])
    assert done.code == 0, done.err
    spec = read_spec(path)
    assert (spec.name, spec.camera.focal_length_mm, spec.camera.pixel_um) == ("mycam", 25.0, 5.5)
    assert f"{spec.selection.faint_limit_mag:.3f} mag" in done.out
    assert "16.03 x 12.06 deg" in done.out
    assert f"starcat build {path}" in done.err


def test_init_finds_a_limit_with_enough_stars(starcat, tmp_path):
    size = ["--size", "1280x960", "--fov-x-deg", "30", "--json"]
    found = json.loads(starcat(["init", tmp_path / "a.toml", *size]).out)
    limit = found["checked"]["spec"]["selection"]["faint_limit_mag"]
    (own,) = [row for row in found["limits"] if row["faint_limit_mag"] == limit]
    fainter = [row for row in found["limits"] if row["faint_limit_mag"] < limit]
    # Doubles are taken out after the limit was chosen.
    assert own["stars"]["one_percent"] >= ENOUGH_STARS - 2
    assert max(row["stars"]["one_percent"] for row in fainter) < ENOUGH_STARS


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--size", "wide"], "--size is 'wide'; expected WIDTHxHEIGHT in pixels"),
        (["--size", "8x8", "--fov-x-deg", "10"], "--size WIDTH: found 8; expected at least 16"),
        (
            ["--size", "640x480", "--focal-mm", "0.001", "--pixel-um", "5"],
            "--focal-mm: found 0.001",
        ),
    ],
)
def test_init_says_what_is_wrong_with_a_camera(starcat, tmp_path, options, words):
    done = starcat(["init", tmp_path / "a.toml", *options])
    assert done.code == 2
    assert words in done.err
    assert not (tmp_path / "a.toml").exists()


def test_a_name_that_no_database_may_have_is_made_one(starcat, tmp_path):
    """A file that is there is kept."""
    size = ["--size", "640x480", "--fov-x-deg", "40", "--faint-limit", "4"]
    path = tmp_path / "My Cam_2.toml"
    assert starcat(["init", path, *size]).code == 0
    assert read_spec(path).name == "my-cam-2"
    text = path.read_text()
    done = starcat(["init", path, *size[:2], "--fov-x-deg", "30"])
    assert (done.code, "--replace" in done.err, path.read_text()) == (1, True, text)


def test_presets_prints_one(starcat):
    done = starcat(["presets", "sao-12deg"])
    assert "12 x 12 deg" in done.out
    text = starcat(["presets", "sao-12deg", "--toml"]).out
    assert spec_from_dict(tomllib.loads(text), "text") == preset("sao-12deg")
    assert BuildSpec.model_validate(json.loads(starcat(["presets", "sao-12deg", "--json"]).out))
    assert starcat(["presets", "--toml"]).code == 2


def test_build_changes_a_key(starcat):
    asked = ["build", "--preset", "sao-12deg", "--explain", "--json"]
    done = starcat([*asked, "--set", 'selection.variables.join=["gcvs"]', "--set", "name=own"])
    assert done.code == 0, done.err
    assert "gcvs" in {source for stage in json.loads(done.out) for source in stage["reads"]}
    assert starcat([*asked, "--set", "version"]).code == 2


def test_a_section_of_defaults_can_be_appended_to_a_written_spec():
    spec = preset("gaia-12deg")
    text = spec_toml(spec)
    assert "\n# [selection.observed]\n" in text
    patched = tomllib.loads(text + "\n[selection.observed]\nnoise_mag = 0.2\n")
    assert patched["selection"]["observed"] == {"noise_mag": 0.2}
    headers = [n for n, line in enumerate(text.splitlines()) if line.startswith("[")]
    lines = text.splitlines()
    for start, end in zip(headers, [*headers[1:], len(lines)], strict=True):
        assert any(line and line[0] != "#" for line in lines[start + 1 : end]), lines[start]
