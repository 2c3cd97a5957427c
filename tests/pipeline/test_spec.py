"""Specs: accepted values, and that every key refuses values outside its range."""

from __future__ import annotations

import copy
import datetime
import math
import tomllib
from collections.abc import Iterator
from typing import Any

import pytest

from starcat.catalog.ingest import check_band
from starcat.catalog.source import data_source, source_names
from starcat.database.products.coverage import tiling_gap
from starcat.errors import ConfigError
from starcat.geometry.sphere import saff_kuijlaars
from starcat.pipeline.specs.build_spec import BuildSpec, CameraSpec
from starcat.pipeline.specs.camera_file import read_camera
from starcat.pipeline.specs.keys import spec_toml
from starcat.pipeline.specs.reading import preset, preset_names, put_key, read_spec, spec_from_dict

JSON_SCHEMA = BuildSpec.model_json_schema()


def resolved(entry: dict[str, Any]) -> dict[str, Any]:
    """An entry of the JSON schema, with its reference followed and null left out."""
    if "$ref" in entry:
        return dict(JSON_SCHEMA["$defs"][entry["$ref"].rpartition("/")[2]])
    if "anyOf" in entry:
        return resolved(next(part for part in entry["anyOf"] if part.get("type") != "null"))
    return entry


def walk(entry: dict[str, Any], path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every section and every key, with its dotted path."""
    yield path, entry
    for name, part in entry.get("properties", {}).items():
        yield from walk(resolved(part), f"{path}.{name}".lstrip("."))


SECTIONS = {path: entry for path, entry in walk(JSON_SCHEMA) if "properties" in entry}
KEYS = {path: entry for path, entry in walk(JSON_SCHEMA) if "properties" not in entry}
WRONG_TYPES = {
    "number": ["six", True, [1.0], math.nan, math.inf],
    "integer": ["six", True, 1.5],
    "boolean": ["yes", 1],
    "string": [5],
    "array": ["hipparcos", ["no such source"]],
}


def outside(entry: dict[str, Any]) -> list[Any]:
    """Values that a key has to refuse."""
    below = [entry["minimum"] - 1] if "minimum" in entry else []
    above = [entry["maximum"] + 1] if "maximum" in entry else []
    ends = [entry[key] for key in ("exclusiveMinimum", "exclusiveMaximum") if key in entry]
    other = ["no such"] if "enum" in entry or "pattern" in entry else []
    return [*below, *above, *ends, *other, *WRONG_TYPES[entry["type"]]]


def good() -> dict[str, Any]:
    return copy.deepcopy(preset("sao-12deg").model_dump(mode="json"))


def changed(path: str, value: object) -> dict[str, Any]:
    """A good spec with one key set."""
    spec = good()
    *sections, name = path.split(".")
    place = spec
    for section in sections:
        place = place.setdefault(section, {})  # a section out of use is not dumped
    place[name] = value
    return spec


def refusal(content: dict[str, Any]) -> ConfigError | None:
    """The message that refuses a spec; None if the spec is accepted."""
    try:
        spec_from_dict(content, "spec.toml")
    except ConfigError as error:
        return error
    return None


# Presets ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", preset_names())
def test_preset(name):
    spec = preset(name)
    assert spec.name == name
    assert spec.description
    source = data_source(spec.catalog.source)
    assert source.kind == "stars"
    check_band(source, spec.catalog.band)
    assert set(spec.selection.variables.join) <= set(source_names())
    assert spec.camera.camera().fov_x_deg < 120.0
    assert spec_from_dict(spec.model_dump(mode="json"), "manifest") == spec
    assert BuildSpec.model_validate_json(spec.model_dump_json()) == spec
    text = spec_toml(spec)
    assert spec_from_dict(tomllib.loads(text), "text") == spec
    assert max(map(len, text.splitlines())) <= 120
    assert "\n" not in repr(spec)
    assert len(repr(spec)) < 120


# Every key ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "value"),
    [(path, value) for path, entry in KEYS.items() for value in outside(entry)],
    ids=str,
)
def test_values_outside_are_refused(path, value):
    with pytest.raises(ConfigError) as caught:
        spec_from_dict(changed(path, value), "spec.toml")
    assert caught.value.key is not None
    assert caught.value.key.startswith(path)
    assert str(caught.value).startswith(f"spec.toml: {path}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("path", "value"),
    [(p, e[end]) for p, e in KEYS.items() for end in ("minimum", "maximum") if end in e],
    ids=str,
)
def test_ends_of_a_range_belong_to_it(path, value):
    # Two keys may contradict each other at the end of a range: that is for their section.
    error = refusal(changed(path, value))
    assert error is None or error.key != path


@pytest.mark.parametrize("path", SECTIONS, ids=lambda path: path or "top")
def test_unknown_keys_name_the_nearest_and_all(path):
    known = sorted(SECTIONS[path]["properties"])
    wrong = f"{known[0]}s_"
    with pytest.raises(ConfigError, match=f"did you mean {known[0]!r}") as caught:
        spec_from_dict(changed(f"{path}.{wrong}".lstrip("."), 1), "spec.toml")
    assert str(caught.value).endswith(f"known keys here: {', '.join(known)}")
    assert caught.value.key == f"{path}.{wrong}".lstrip(".")


def test_a_misspelt_key_is_named_before_the_one_it_leaves_missing():
    spec = good()
    spec["selection"]["faint_limit"] = spec["selection"].pop("faint_limit_mag")
    assert "did you mean 'faint_limit_mag'" in str(refusal(spec))
    like_no_other = str(refusal(changed("xyzzyx", 1)))
    assert "unknown key; known keys here" in like_no_other
    assert "did you mean" not in like_no_other


def test_sections_are_no_values_and_what_is_required_has_to_be_there():
    for path in filter(None, SECTIONS):
        assert path in str(refusal(changed(path, 3)))
    for key in JSON_SCHEMA["required"]:
        spec = good()
        del spec[key]
        assert f"{key}: missing; every spec needs it" in str(refusal(spec))


def test_every_key_has_its_unit_in_its_name():
    units = ("_deg", "_px", "_mag", "_jyear", "_mm", "_um", "_rad", "_arcsec", "_mas_yr",
             "_s", "_e")  # fmt: skip
    plain = {"min_identified", "outlier_share", "completeness", "ambiguous_odds", "min_probability",
             "max_ratio", "quantum_efficiency", "min_snr", "max_contamination",
             "colour_term"}  # fmt: skip
    for path, entry in KEYS.items():
        if entry["type"] == "number" and path.rpartition(".")[2] not in plain:
            assert path.endswith(units), path


# Keys that depend on each other -------------------------------------------------------------


SQUARE = {"width_px": 512, "height_px": 512}
ONE_SCALE = "either fov_x_deg, or focal_length_mm and pixel_um"


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("selection.bright_limit_mag", 6.0, "larger is fainter, so they may be swapped"),
        (
            "selection",
            {"bright_limit_mag": 2, "faint_limit_mag": 6, "doubles": {"companion_limit_mag": 2}},
            "companion_limit_mag 2 is not fainter than bright_limit_mag 2",
        ),
        ("products.pairs.min_separation_deg", 17.0, "is not below the field's diagonal, 16.91"),
        ("camera", SQUARE, ONE_SCALE),
        ("camera", {**SQUARE, "focal_length_mm": 40.0}, ONE_SCALE),
        ("camera", {**SQUARE, "pixel_um": 16.0}, ONE_SCALE),
        ("camera", {**SQUARE, "fov_x_deg": 12.0, "pixel_um": 16.0}, ONE_SCALE),
        (
            "camera",
            {**SQUARE, "focal_length_mm": 0.04, "pixel_um": 16.0},
            "field of 120 deg or more; check its units",
        ),
    ],
)
def test_keys_do_not_contradict_each_other(path, value, words):
    assert words in str(refusal(changed(path, value)))


@pytest.mark.parametrize("key", ["faint_limit_mag", "doubles.companion_limit_mag"])
def test_stars_up_to_a_limit_have_to_be_read(key):
    spec = good()
    spec["selection"]["faint_limit_mag"] = 4.0
    put_key(spec, f"selection.{key}", 6.0)
    spec["catalog"]["read_limit_mag"] = 6.0
    assert spec_from_dict(spec, "spec.toml").limit_notes == ()
    spec["catalog"]["read_limit_mag"] = 5.0
    words = f"catalog.read_limit_mag 5 is brighter than selection.{key} 6"
    assert words in str(refusal(spec))


def test_a_limit_of_reading_in_another_band_is_noted():
    spec = good()
    spec["catalog"]["read_limit_mag"] = 5.0
    spec["camera"]["response"] = {"name": "silicon-cmos"}
    [note] = spec_from_dict(spec, "spec.toml").limit_notes
    assert "catalog.read_limit_mag 5 is brighter than selection.faint_limit_mag 6" in note
    spec = changed("products.crossmatch.enabled", True)
    spec["products"]["crossmatch"] |= {"catalogs": ["hipparcos"], "read_limit_mag": 5.5}
    [note] = spec_from_dict(spec, "spec.toml").limit_notes
    assert "products.crossmatch.read_limit_mag 5.5 is brighter than" in note


def test_a_buffer_as_wide_as_the_pattern_is_noted():
    assert spec_from_dict(changed("products.grid.buffer_deg", 5.9), "spec.toml").limit_notes == ()
    [note] = spec_from_dict(changed("products.grid.buffer_deg", 6.1), "spec.toml").limit_notes
    assert "products.grid.buffer_deg 6.1 is not below the radius of a pattern, 6 deg" in note


NAMES = [
    "catalog.merged",
    "catalog.motions",
    "camera.response.photometry",
    "products.crossmatch.catalogs",
    "selection.doubles.join",
    "selection.variables.join",
    "selection.observed.results_sha256",
]


@pytest.mark.parametrize("path", NAMES)
def test_a_name_is_in_a_list_once(path):
    name = {"doubles": "wds", "observed": "0" * 64}.get(path.split(".")[1], "hipparcos")
    words = f"spec.toml: {path}: {name!r} is named twice; name each once"
    assert str(refusal(changed(path, [name, name]))) == words


def test_every_list_of_names_is_checked_for_repeats():
    texts = {
        path
        for path, entry in KEYS.items()
        if resolved(entry.get("items", {})).get("type") == "string"
    }
    assert texts == set(NAMES)


# Messages -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("catalog.motions", "tycho2", "expected a list; write motions = ['tycho2']"),
        ("selection.variables.join", 3, "found 3; expected a list"),
        ("selection.require", {"name": "a"}, "array of tables; write [[selection.require]], with"),
        ("camera", [SQUARE], "expected a table; write [camera], with single brackets"),
        ("camera.width_px", True, "found true; expected a whole number"),
        ("catalog.source", {"a": False}, "found {a = false}; expected a text in quotes"),
        ("catalog.source", datetime.date(2026, 1, 2), "found 2026-01-02; expected a text"),
        ("epoch_jyear", {"a": True}, "found {a = true}; give a Julian year"),
        ("selection.region.cone", [1.0, 2.0], "found a list of 2; expected a list of 3: right"),
        ("selection.region.zone", [1.0, 2.0, 3.0], "found a list of 3; expected a list of 2"),
        ("catalog.merged", list("abcdefghi"), "found a list of 9; expected a list of at most 8"),
    ],
    ids=str,
)
def test_messages_name_what_toml_has(path, value, words):
    told = str(refusal(changed(path, value)))
    assert words in told
    assert "uple" not in told


def test_a_table_that_is_like_no_other_gets_no_suggestion():
    assert "did you mean" not in str(refusal(changed("telescope.aperture_mm", 1.0)))
    assert "did you mean 'selection'" in str(refusal(changed("select.faint_limit_mag", 1.0)))


@pytest.mark.parametrize(
    ("key", "value"),
    [("pixel_um", [5.5, 6.5]), ("pixel_um", "5.5,6.5"), ("pixel_um", "5.5x6.5"), ("fov_y_deg", 9)],
)
def test_pixels_that_are_not_square_are_refused_with_advice(key, value):
    told = str(refusal(changed(f"camera.{key}", value)))
    assert f"camera.{key}: " in told
    assert "for pixels that are not square, scale the y coordinates" in told


def test_a_lens_and_its_field_are_the_same_camera():
    lens = CameraSpec(width_px=512, height_px=512, focal_length_mm=40.0, pixel_um=16.0).camera()
    # Half a detector of 512 * 0.016 mm over 40 mm.
    assert lens.fov_x_deg == pytest.approx(2.0 * math.degrees(math.atan(4.096 / 40.0)), rel=1e-14)
    field = CameraSpec(width_px=512, height_px=512, fov_x_deg=lens.fov_x_deg).camera()
    assert field.focal_length_px == pytest.approx(lens.focal_length_px, rel=1e-14)
    assert lens.focal_length_px == pytest.approx(2500.0)


# Files --------------------------------------------------------------------------------------


def test_a_byte_order_mark_is_left_out(tmp_path, small_spec):
    path, camera = tmp_path / "spec.toml", tmp_path / "camera.toml"
    path.write_text(small_spec, encoding="utf-8-sig", newline="\r\n")
    assert read_spec(path) == spec_from_dict(tomllib.loads(small_spec), "small.toml")
    camera.write_text("width_px = 9\nheight_px = 9\nfov_x_deg = 9.0", encoding="utf-8-sig")
    assert read_camera(camera).width_px == 9


@pytest.mark.parametrize(
    ("encoding", "words"), [("latin-1", "line 2 has the byte 0xf1"), ("utf-16", "it is in UTF-16")]
)
def test_a_spec_in_another_encoding_is_refused_in_plain_words(tmp_path, encoding, words):
    path = tmp_path / "spec.toml"
    path.write_text('name = "a"\ndescription = "ma\xf1ana"\n', encoding=encoding)
    with pytest.raises(ConfigError, match=f"not in UTF-8.*{words}; save it again as UTF-8"):
        read_spec(path)


def test_a_whole_number_will_do_for_a_magnitude(tmp_path, small_spec):
    path = tmp_path / "spec.toml"
    path.write_text(small_spec.replace("faint_limit_mag = 6.0", "faint_limit_mag = 6"))
    assert read_spec(path) == spec_from_dict(tomllib.loads(small_spec), "small.toml")


def test_narrow_fields_have_as_many_boresights_as_leave_no_hole():
    def count(**changes):
        return preset("gaia-12deg", {key.replace("__", "."): text for key, text in changes.items()})

    assert count().boresights.count == 10_000
    assert count(camera__fov_x_deg="3.2").boresights.count == 10_000
    narrow = count(camera__fov_x_deg="2")
    assert narrow.boresights.count == 23_700
    holes = tiling_gap(saff_kuijlaars(23_700), math.radians(1.0))
    assert not holes.has_holes
    assert tiling_gap(saff_kuijlaars(10_000), math.radians(1.0)).has_holes
    assert count(camera__fov_x_deg="2", boresights__count="500").boresights.count == 500
    # The fields of the tiling decide, where they are stated.
    wide = {"boresights__fov_x_deg": "5", "boresights__fov_y_deg": "5"}
    assert count(camera__fov_x_deg="2", **wide).boresights.count == 10_000
    # A recorded spec states its number: databases of earlier versions are built again as they were.
    content = narrow.recorded()
    content["boresights"]["count"] = 10_000
    assert type(narrow).model_validate(content).boresights.count == 10_000
