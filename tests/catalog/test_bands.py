"""The band of a sensor: responses, synthetic magnitudes, and relations on the genuine catalogs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import band_errors
import band_pairs
import bands as builder
import jsonschema
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from starcat.catalog.bands.catalogs import BANDS_AND_COLOURS, best_relation
from starcat.catalog.bands.exposure import PHOTONS_S_MM2, Exposure, photons_s_mm2
from starcat.catalog.bands.measured import colour_share, error_factors
from starcat.catalog.bands.relation import Prediction, combined, predict_by_type, relation
from starcat.catalog.bands.response import (
    checked_response,
    read_response,
    response_from_text,
    shipped,
    shipped_names,
)
from starcat.catalog.bands.synthetic import (
    checked_zero_point,
    library,
    parsed_type,
    synthetic_magnitudes,
)
from starcat.catalog.sensor_band import in_sensor_band, other_of
from starcat.catalog.stars.star_table import table_from_columns
from starcat.cli.specs import with_sensor
from starcat.database.verify import check_database
from starcat.errors import ConfigError, FileMissing
from starcat.frames.images.render import Optics, star_electrons
from starcat.pipeline.build import build
from starcat.pipeline.estimate import estimate_spec
from starcat.pipeline.rebuild import rebuild
from starcat.pipeline.specs.build_spec import BuildSpec, CameraSpec
from starcat.pipeline.specs.camera_file import read_camera
from starcat.pipeline.specs.keys import spec_toml
from starcat.pipeline.specs.reading import read_spec, spec_from_dict
from starcat.pipeline.specs.star_sensor import example_toml
from starcat.pipeline.starter import advice, starter_spec
from starcat.resources import resource_folder
from starcat.storage.parquet import read_parquet


@pytest.mark.parametrize(
    ("name", "first", "second", "colour_mag"),
    [
        # Colours of Pickles 1998, table 2, and of Gaia's dwarfs (Pecaut and Mamajek's table).
        ("a0v", "B", "V", 0.015), ("g2v", "B", "V", 0.642), ("k0iii", "B", "V", 1.0),
        ("m0iii", "B", "V", 1.5), ("g2v", "BP", "RP", 0.82), ("k0iii", "J", "Ks", 0.6),
        ("g2v", "V", "Ks", 1.5),
    ],
)  # fmt: skip
def test_colours_of_the_spectra_are_those_that_are_known(name, first, second, colour_mag):
    colour = synthetic_magnitudes(shipped(first)) - synthetic_magnitudes(shipped(second))
    assert colour[0, library().types.index(name)] == pytest.approx(colour_mag, abs=0.09)


def test_every_shipped_response_is_sound_and_says_where_it_is_from():
    assert len(shipped_names()) == 15
    for name in shipped_names():
        one = shipped(name)
        checked_response(name, one.wavelength_nm, one.value, one.counts, one.zero_point)
        assert one.source
        assert one.title
        assert np.isfinite(synthetic_magnitudes(one)).all()


def test_extinction_reddens_and_dims():
    b_v = synthetic_magnitudes(shipped("B")) - synthetic_magnitudes(shipped("V"))
    assert (np.diff(b_v, axis=0) > 0).all()
    dimmed = synthetic_magnitudes(shipped("V"))[-1] - synthetic_magnitudes(shipped("V"))[0]
    assert np.median(dimmed) == pytest.approx(3.1 * 0.8, abs=0.1)  # A(V) = 3.1 E(B-V)


def test_a_zero_point_is_vega_or_a_type():
    own = shipped("silicon-cmos")
    arguments = ("own", own.wavelength_nm, own.value, own.counts, checked_zero_point("G2V"))
    row = library().types.index("g2v")
    sunlike = synthetic_magnitudes(checked_response(*arguments))[0, row]
    assert sunlike == pytest.approx(synthetic_magnitudes(shipped("V"))[0, row])
    assert checked_zero_point("Vega") == "vega 0"
    with pytest.raises(ConfigError, match=r"the library has A0I, .*A2V"):
        checked_zero_point("A1V")
    with pytest.raises(ConfigError, match="expected 'vega'"):
        checked_zero_point("Sirius")


def test_a_response_per_energy_is_turned_into_photons():
    wavelength = np.linspace(400.0, 900.0, 51)
    per_photon, per_energy = (
        synthetic_magnitudes(checked_response("a", wavelength, value, counts))
        for value, counts in ((np.ones(51), "photon"), (wavelength, "energy"))
    )
    assert per_photon == pytest.approx(per_energy, abs=1e-9)


BAD = {
    "negative": ("wavelength_nm,response\n400,0.1\n500,-0.2\n600,0.1\n", "-0.2 at 500 nm"),
    "a wide gap": ("400,0.1\n500,0.9\n650,0.8\n700,0\n", "nothing between 500 and 650 nm"),
    "a blank value": ("400,0.1\n500,\n600,0.1\n", "row 2 has no number"),
    "angstroms": ("4000,0\n5000,1\n11000,0\n", "look like angstroms"),
    "angstroms in the header": ("wavelength [Angstrom],r\n4000,0\n", "wavelengths are in nm"),
    "micrometres": ("0.4,0\n0.5,1\n0.6,0\n", "look like micrometres"),
    "one wavelength": ("550,1\n", "1 wavelengths; a curve needs at least 3"),
    "no overlap": ("2600,0\n2650,1\n2700,0\n", "look like angstroms"),
    "ultraviolet": ("120,0\n180,1\n250,0\n", "outside of 300 to 2500 nm"),
    "unsorted": ("500,1\n400,1\n600,1\n", "500 nm is followed by 400 nm"),
    "only zeros": ("400,0\n500,0\n600,0\n", "all values are 0"),
    "text": ("wavelength_nm,response\n400,high\n", "found '400,high'"),
    "three columns": ("400,1,2\n", "expected a wavelength in nm, a comma"),
    "nothing": ("", "0 wavelengths"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_response_is_reported_with_a_sentence(case):
    text, said = BAD[case]
    with pytest.raises(ConfigError, match="response own: ") as caught:
        response_from_text("own", text, "photon")
    assert said in str(caught.value)


def test_a_response_has_to_say_what_it_is_relative_to(tmp_path):
    path = tmp_path / "own.csv"
    path.write_text("# title: a camera\n400,0\n500,1\n600,0\n", encoding="utf-8")
    with pytest.raises(ConfigError, match='set per="photon"'):
        read_response(path, None)
    with pytest.raises(ConfigError, match="choose photon or energy"):
        read_response(path, "watt")
    assert read_response(path, "energy").title == "a camera"
    with pytest.raises(FileMissing, match="no such response"):
        read_response(tmp_path / "none.csv", None)
    with pytest.raises(ConfigError, match="did you mean 'Hp'"):
        shipped("hp")


def test_optics_multiply():
    wavelength = np.arange(300.0, 2001.0, 50.0)
    lens = checked_response("lens", wavelength, 1.0 * (wavelength > 600.0), "photon")
    behind = shipped("silicon-cmos").behind(lens)
    assert behind.mean_nm > 700
    narrow = checked_response("filter", [1200, 1250, 1300], [0, 1, 0], "photon")
    with pytest.raises(ConfigError, match="let nothing through"):
        shipped("V").behind(narrow)


def test_a_band_predicts_itself_and_errors_grow_outside():
    mag, none = np.array([5.0, 6.0]), np.zeros(2)
    same = relation("G", ("BP", "RP"), shipped("G")).predict(mag, np.array([0.5, 3.0]), none, none)
    assert same.mag == pytest.approx(mag, abs=1e-9)
    assert same.error_mag == pytest.approx(none, abs=1e-9)
    made = relation("G", ("BP", "RP"), shipped("Hp"))
    colours = np.array([1.0, made.colour_mag[-1] + 1.0, np.nan, -2.0])
    found = made.predict(np.full(4, 6.0), colours, np.zeros(4), np.zeros(4))
    assert found.is_outside.tolist() == [False, True, False, True]
    assert found.has_colour.tolist() == [True, True, False, True]
    assert (found.error_mag[1:] > 10.0 * found.error_mag[0]).all()
    assert np.isfinite(found.mag).all()


def test_every_catalog_tells_of_every_response():
    for source in BANDS_AND_COLOURS:
        assert 0.0 < best_relation(source, shipped("red-ccd")).typical_error_mag < 0.6
    assert best_relation("2mass", shipped("J")).base == "J"


def test_spectral_types():
    assert parsed_type("B9p SiEu")[0] == 19.0
    assert parsed_type("K2III") == (52.0, 3.0)
    assert parsed_type("F8IV-V") == (38.0, 4.0)
    assert np.isnan(parsed_type("")[0])
    types = ["K2III", "A0", "", "M2Iab"]
    found = predict_by_type("V", shipped("J"), np.full(4, 5.0), types, np.full(4, 0.1))
    assert found.mag[0] == pytest.approx(5.0 - 2.1, abs=0.2)  # V - J of a K2 giant
    assert found.mag[1] == pytest.approx(5.0, abs=0.15)
    assert found.has_colour.tolist() == [True, True, False, True]
    assert found.error_mag[2] > 0.5


def test_predictions_are_combined_by_their_errors():
    no, yes = np.zeros(3, bool), np.ones(3, bool)
    far = np.array([False, True, True])
    one = Prediction(np.array([5.0, 5.0, np.nan]), np.full(3, 0.1), far, yes)
    two = Prediction(np.array([5.3, 6.0, np.nan]), np.full(3, 0.2), no, yes)
    both = combined([one, two])
    assert both.mag[:2] == pytest.approx([5.06, 6.0])
    assert both.error_mag[0] == pytest.approx(0.1 / np.sqrt(1.25))
    assert np.isnan(both.mag[2])
    assert both.is_outside.tolist() == [False, False, False]


SPEC = """
name = "own"
version = "1.0.0"
epoch_jyear = 2016.0
[catalog]
source = "gaia"
[selection]
faint_limit_mag = 4.5
[camera]
width_px = 1024
height_px = 1024
fov_x_deg = 20.0
[camera.response]
"""


def spec_of(tmp_path: Path, response: str) -> BuildSpec:
    path = tmp_path / "spec.toml"
    path.write_text(SPEC + response, encoding="utf-8")
    return read_spec(path)


def test_a_spec_takes_a_named_response_or_a_file_beside_it(tmp_path):
    assert spec_of(tmp_path, 'name = "Hp"').camera.response.response() is shipped("Hp")
    text = "".join(f"{w},{0.1 + w / 1e4:.3f}\n" for w in range(400, 900, 2))
    (tmp_path / "my-ccd.csv").write_text("wavelength_nm,response\n" + text, encoding="utf-8")
    (tmp_path / "lens.csv").write_text("550,0\n600,1\n700,1\n800,1\n900,1\n", encoding="utf-8")
    stated = 'file = "my-ccd.csv"\nper = "photon"\noptics_file = "lens.csv"\nzero_point = "A0V"'
    spec = spec_of(tmp_path, stated)
    made = spec.camera.response.response()
    assert made.name == "my-ccd"
    assert made.zero_point == "type a0v"
    assert 650 < made.mean_nm < 800
    # The numbers travel with the spec: as JSON, and as a TOML file with every key explained.
    again = spec_from_dict(spec.recorded(), "manifest")
    assert again == spec
    (tmp_path / "whole.toml").write_text(spec_toml(spec), encoding="utf-8")
    assert read_spec(tmp_path / "whole.toml") == spec
    assert read_camera(tmp_path / "spec.toml") == spec.camera.camera()


THREE = 'per = "photon"\nwavelength_nm = [400, 500, 600]'


@pytest.mark.parametrize(
    ("response", "said"),
    [
        ('name = "silicon"', "did you mean 'silicon-cmos'"),
        ('file = "none.csv"', "none.csv: no such response"),
        ("wavelength_nm = [400, 500, 600]", "name is missing and wavelength_nm stated"),
        ('name = "own"\nwavelength_nm = [400, 500, 600]\nvalue = [0, 1, 0]', "per is missing"),
        (f'name = "own"\n{THREE}\nvalue = [0, 1]', "3 wavelengths and 2 values"),
        (f'name = "V"\n{THREE}\nvalue = [0, 1, 0]', "name 'V' is that of a response that ships"),
        ('name = "V"\nzero_point = "Sirius"', "expected 'vega'"),
    ],
    ids=["unknown", "no file", "no name", "no unit", "uneven", "taken", "zero point"],
)
def test_a_bad_response_in_a_spec_is_reported(tmp_path, response, said):
    with pytest.raises(ConfigError) as caught:
        spec_of(tmp_path, response)
    assert said in str(caught.value)


def test_a_file_is_read_only_with_a_spec_that_is_a_file(tmp_path):
    plain = spec_of(tmp_path, "")
    assert plain.camera.response.response() is None
    assert "response" not in plain.recorded()["camera"]
    content = plain.model_dump(mode="json")
    content["camera"]["response"] = {"name": "own", "file": "/etc/passwd"}
    with pytest.raises(ConfigError, match="this key names a file, and no file is read here"):
        spec_from_dict(content, "form")


EXPOSURE = """
[camera.exposure]
aperture_mm = 20.0
quantum_efficiency = 0.5
exposure_s = 0.1
read_noise_e = 8.0
full_well_e = 50000.0
psf_sigma_px = 0.8
dark_e_s = 50.0
"""


def test_photons_are_those_that_are_known():
    # Bessell, Castelli and Plez 1998, table A2: 995.5 photons/s/cm2/A at V = 0, over 900 A or so.
    assert photons_s_mm2(shipped("V")) == pytest.approx(995.5 * 900 / 100, rel=0.05)
    assert photons_s_mm2(None) == PHOTONS_S_MM2


@given(st.floats(1.0, 1e9), st.floats(0.0, 1e4), st.floats(0.0, 1e3), st.floats(0.5, 100.0))
def test_a_limit_is_where_the_signal_to_noise_is(zero_point, background, noise, wanted):
    exposure = Exposure(zero_point, background, noise, 1.0, 1e5)
    found = exposure.signal_to_noise(np.array([exposure.limit_mag(wanted)]))
    assert found[0] == pytest.approx(wanted, rel=1e-9)


def test_a_saturated_pixel_holds_its_full_well():
    exposure = Exposure(1e6, 10.0, 5.0, 0.8, 50_000.0)
    star = (np.array([[4.5, 4.5]]), np.array([exposure.saturation_mag]))
    light = star_electrons(*star, (9, 9), Optics(0.8, 1e6))
    assert light.max() + 10.0 == pytest.approx(50_000.0, rel=1e-3)


def test_limits_follow_from_an_exposure(tmp_path):
    asked = 'name = "silicon-cmos"' + EXPOSURE + "min_snr = 5.0\nreject_saturated = true\n"
    path = tmp_path / "spec.toml"
    path.write_text((SPEC + asked).replace("faint_limit_mag = 4.5\n", ""), encoding="utf-8")
    spec = read_spec(path)
    exposure = spec.camera.exposure.exposure(spec.camera.response.response())
    assert spec.selection.faint_limit_mag == round(exposure.limit_mag(5.0), 2)
    assert spec.selection.bright_limit_mag == round(exposure.saturation_mag, 2)
    assert spec_from_dict(spec.recorded(), "manifest") == spec
    assert spec.exposure_notes == ()
    with pytest.raises(ConfigError, match=r"camera\.exposure\.min_snr makes it 9"):
        spec_of(tmp_path, asked)


def test_an_exposure_that_contradicts_the_limits_is_reported(tmp_path):
    plain = spec_of(tmp_path, EXPOSURE)
    assert plain.exposure_notes == ()
    assert "has a signal-to-noise of 5, and one of" in plain.exposure_proposal[0]
    deep = read_spec(tmp_path / "spec.toml", {"selection.faint_limit_mag": "12"})
    assert "selection.faint_limit_mag 12 is beyond the sensor" in deep.exposure_notes[0]
    with pytest.raises(ConfigError, match="full_well_e, psf_sigma_px missing or 0"):
        spec_of(tmp_path, EXPOSURE[: EXPOSURE.index("full_well")])


def star_table(count: int, **columns: Any) -> pa.Table:
    usual = {
        "star_id": np.arange(count), "catalog": "gaia", "designation": "x", "source_file": 0,
        "source_line": np.arange(count), "ra_deg": 1.0, "dec_deg": 2.0, "epoch_jyear": 2016.0,
        "x": 1.0, "y": 0.0, "z": 0.0, "mag": np.linspace(4.0, 8.0, count), "band": "G",
        "quality_flags": 0,
    }  # fmt: skip
    return table_from_columns("stars", {**usual, **columns}, count)


def test_stars_get_magnitudes_with_error_and_origin():
    colours = np.array([0.5, 1.5, np.nan, 9.0])
    stars = star_table(4, colour_mag=colours, colour_bands="BP-RP", amplitude_mag=[0, 0, 0, 2.0])
    made = in_sensor_band(stars, "gaia", shipped("red-ccd"))
    table = made.stars
    assert table["band"].to_pylist() == ["red-ccd"] * 4
    assert table["catalog_mag"].to_pylist() == stars["mag"].to_pylist()
    assert table["catalog_band"].to_pylist() == ["G"] * 4
    assert table["mag_source"].to_pylist() == ["G, BP-RP", "G, BP-RP", "G alone", "G, BP-RP"]
    assert table["quality_flags"].to_pylist() == [0, 0, 1, 2]
    fainter = np.array(table["mag"]) - np.array(stars["mag"])
    assert fainter[1] < fainter[0] < 0  # red stars are brighter there
    error = np.array(table["mag_error"])
    assert error[:2].max() < 0.05 < error[2]
    assert error[3] > 0.354 * 2.0
    assert (made.outside, made.counts) == (1, {"G alone": 1, "G, BP-RP": 3})


def doubt_of(**columns: Any) -> np.ndarray:
    """What companions and variability add to the errors of a star of one colour."""
    plain, doubtful = (
        np.array(in_sensor_band(star_table(5, colour_mag=[0.7] * 5, colour_bands="BP-RP", **more),
                                "gaia", shipped("silicon-cmos")).stars["mag_error"])
        for more in ({}, columns)
    )  # fmt: skip
    return np.sqrt(np.maximum(doubtful**2 - plain**2, 0.0))


def test_companions_of_red_stars_count_less():
    share = colour_share(np.array([0.9, 1.2, 1.7, 3.0, np.nan]))
    assert share[0] == share[4] == 1.0
    assert (share[1:4] < 0.6).all()
    assert (share > 0.2).all()


def test_companions_make_magnitudes_less_certain():
    nothing = np.nan
    doubt = doubt_of(
        is_flagged_double=[True, True, True, False, False],
        double_flag=pa.array(["H59:C", "H59:C", "H59:X", "CCDM:0", None]),
        companion_separation_arcsec=[2.0, 0.1, nothing, nothing, nothing],
        companion_delta_mag=[0.0, 0.0, nothing, nothing, nothing],
    )
    # Two equal stars are 0.753 mag brighter than one. Gaia resolves them at 2 arcsec.
    assert 0.6 < doubt[0] < 0.76
    assert 0.1 < doubt[1] < doubt[0]
    assert doubt[2] > doubt[3] > 0.02
    assert doubt[4] == 0.0


def test_variability_makes_magnitudes_less_certain():
    doubt = doubt_of(
        is_flagged_variable=[True, True, True, False, False],
        amplitude_mag=[2.0, 0.03, np.nan, 0.02, 0.5],
    )
    assert doubt == pytest.approx([0.708, 0.0106, doubt[2], 0.0, 0.177], abs=1e-3)
    assert doubt[2] > 0.05
    # 2 mag from end to end.
    light = np.sin(np.random.default_rng(4).uniform(0.0, 2.0 * np.pi, 4_000))
    assert 0.95 < np.mean((light / doubt[0]) ** 2) < 1.05


def test_what_another_catalog_knows_of_a_star_counts():
    stars = star_table(2, colour_mag=[0.5] * 2, colour_bands="BP-RP")
    theirs = star_table(
        1, mag=[4.0], band="V", colour_mag=[0.3], colour_bands="B-V", is_flagged_double=[True],
        companion_separation_arcsec=[3.0], companion_delta_mag=[0.2],
    )  # fmt: skip
    response = shipped("silicon-cmos")
    other = other_of(theirs, np.array([0]), "hipparcos", response)
    error = np.array(in_sensor_band(stars, "gaia", response, [other]).stars["mag_error"])
    assert error[0] > 0.5 > 10.0 * error[1]


def test_measured_factors_are_of_bins_of_colours():
    found = error_factors("G", ("BP", "RP"), shipped("VT"), np.array([-2.0, -0.1, 0.2, 9.0]))
    assert found[0] == found[1] > found[2] > found[3] >= 0.0
    # The response of a sensor is known less well, and of J - H nothing was measured.
    for base, colour in (("G", ("BP", "RP")), ("J", ("J", "H"))):
        assert (error_factors(base, colour, shipped("red-ccd"), np.arange(3.0)) >= 1.0).all()
    made = relation("G", ("BP", "RP"), shipped("VT"))
    assert made.error_mag == pytest.approx(made.measured * made.computed_error_mag)


def test_spectral_types_stand_in_for_colours():
    types = ["K2III", "A0", None]
    stars = star_table(3, band="V", catalog="sao", spectral_type=pa.array(types))
    made = in_sensor_band(stars, "sao", shipped("silicon-cmos"))
    assert made.counts == {"V alone": 1, "V, spectral type": 2}
    assert made.relation is None
    assert (np.array(made.stars["mag_error"]) >= 0.2).all()  # of visual magnitudes


def test_another_catalog_is_averaged_in():
    response = shipped("silicon-cmos")
    nothing = np.array([0.5, np.nan, 9.0, 0.5])
    stars = star_table(4, colour_mag=nothing, colour_bands="BP-RP")
    theirs = star_table(3, mag=[5.2, 6.6, 7.0], band="V", colour_mag=[0.6] * 3, colour_bands="B-V")
    other = other_of(theirs, np.array([1, 2, 3]), "hipparcos", response)
    own, both = (in_sensor_band(stars, "gaia", response, more) for more in ((), [other]))
    assert both.stars["mag_source"].to_pylist() == [
        "G, BP-RP",
        "G alone + hipparcos V, B-V",
        "hipparcos V, B-V",  # the own colour is outside of the relation's
        "G, BP-RP + hipparcos V, B-V",
    ]
    assert both.stars["quality_flags"].to_pylist() == [0, 0, 0, 0]
    error = [np.array(one.stars["mag_error"]) for one in (own, both)]
    assert error[1][0] == error[0][0]
    assert (error[1][1:] < error[0][1:]).all()
    assert both.stars["mag"][2].as_py() == pytest.approx(other.prediction.mag[1])


def test_a_catalog_without_colours_is_refused():
    with pytest.raises(ConfigError, match="no star of sao has a colour or a spectral type"):
        in_sensor_band(star_table(3, band="V"), "sao", shipped("silicon-cmos"))
    with pytest.raises(ConfigError, match="the passband of 2mass '\\(J\\+H\\)/2' is unknown"):
        in_sensor_band(star_table(3, band="(J+H)/2"), "2mass", shipped("ingaas"))


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_brightest_stars_get_their_colours_from_hipparcos(tmp_path, excerpts):
    # Vega is a Hipparcos star of the embedded sky, with a magnitude and no colour.
    asked = 'name = "silicon-cmos"\nphotometry = ["hipparcos"]\n'
    spec = spec_of(tmp_path, asked + "[boresights]\ncount = 500\n[self_test]\nframes = 20\n")
    inputs = {"hipparcos": [excerpts / "hip_main.dat.gz"]}
    built = build(spec, tmp_path / "dist", inputs=inputs)
    assert built.manifest["manifest_version"] == "1.3.0"
    schema = json.loads((resource_folder("schemas") / "manifest-1.0.0.json").read_text())
    jsonschema.validate(built.manifest, schema)
    stars = read_parquet(built.folder / "stars.parquet").to_pandas().set_index("designation")
    vega = stars.loc["HIP 91262"]
    # The zero point is Vega's, and the catalog has Hp = 0.087 for it.
    assert vega.mag == pytest.approx(0.0, abs=0.06)
    assert vega.mag_error < 0.1
    told = stars["mag_source"]
    assert told.str.contains("hipparcos").mean() > 0.9
    roles = [source["role"] for source in built.manifest["sources"]]
    assert roles == ["stars", "photometry"]
    check_database(built.folder)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_build_in_the_band_of_its_sensor(tmp_path):
    spec = spec_of(
        tmp_path, 'name = "red-ccd"\n[boresights]\ncount = 500\n[self_test]\nframes = 20\n'
    )
    built = build(spec, tmp_path / "dist")
    stars = read_parquet(built.folder / "stars.parquet")
    assert set(stars["band"].to_pylist()) == {"red-ccd"}
    assert max(stars["mag"].to_pylist()) <= 4.5 < max(stars["catalog_mag"].to_pylist())
    assert estimate_spec(spec, {}).cost.stars == len(stars)
    page = (built.folder / "report" / "index.html").read_text(encoding="utf-8")
    assert "Band of the sensor" in page
    assert (built.folder / "report" / "sensor_band.svg").is_file()
    assert rebuild(built.folder, {}).is_identical


@pytest.mark.slow
def test_hp_from_gaia_without_a_fit(excerpts):
    stars = band_pairs.measured(excerpts)
    found = band_pairs.pair(stars, "G, BP-RP", "Hp")
    usual = found.of(-0.5, 2.0)
    assert len(usual.residual_mag) > 4_900
    assert usual.rms_mag <= 0.03
    alone = stars["Hp"] - stars["G"]
    assert np.nanstd(alone) > 0.2  # what the colour explains
    for band in ("V", "VT"):
        assert band_pairs.pair(stars, "G, BP-RP", band).rms_mag <= 0.03
    red = found.of(2.0, 6.0)
    assert red.rms_mag <= 0.05


@pytest.mark.slow
def test_a_first_spec_is_in_the_band_of_its_sensor(tmp_path):
    path = tmp_path / "sensor.toml"
    path.write_text(example_toml(), encoding="utf-8")
    plain = CameraSpec(width_px=1024, height_px=1024, fov_x_deg=20.0)
    camera = with_sensor(plain, "red-ccd", path)
    starter = starter_spec("own", camera)
    assert starter.band == "red-ccd"
    assert "a signal-to-noise of 5" in advice(starter)[0]
    # A sensor that sees less than enough stars gets the limit that it sees.
    small = camera.exposure.model_copy(update={"aperture_mm": 2.0})
    dim = camera.model_copy(update={"exposure": small})
    limit = dim.exposure.exposure(shipped("red-ccd")).limit_mag(5.0)
    found = starter_spec("own", dim).spec.selection.faint_limit_mag
    assert found == round(limit, 2) < starter.spec.selection.faint_limit_mag
    text = example_toml().replace("# zero_point_e_s", "zero_point_e_s")
    text = text.replace("aperture_mm = ", "# a = ").replace("quantum_efficiency = ", "# q = ")
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match="zero_point_e_s does not determine the band"):
        with_sensor(plain, None, path)


@pytest.mark.slow
def test_infrared_from_visual(excerpts):
    stars = band_pairs.measured(excerpts, infrared=True)
    found = band_pairs.pair(stars, "V, B-V", "J")
    assert len(found.residual_mag) > 150
    assert found.rms_mag <= 0.10


def both_halves(catalogs: Path, case: band_errors.Case, *kinds: Any) -> list[band_errors.Line]:
    """Bins of colours with enough stars to judge chi-square by."""
    return [line for kind in kinds for line in band_errors.lines(catalogs, case, kind, fewest=50)]


@pytest.mark.slow
@pytest.mark.parametrize("case", band_errors.CASES, ids=lambda case: case.title)
def test_errors_of_single_stars_are_honest(case, excerpts):
    """The relations' errors are of one half of the stars; few were measured in J."""
    halves = (band_errors.single, band_errors.single_fitted)
    kinds = (lambda stars, target: stars.single_in(target),) if case.target == "J" else halves
    found = both_halves(excerpts, case, *kinds)
    assert found
    for line in found:
        assert 0.8 <= line.usual_chi_square <= 1.25, (line.low, line.high)
        assert line.outliers <= 1
        if not line.outliers:
            assert 0.8 <= line.chi_square <= 1.25


@pytest.mark.slow
@pytest.mark.parametrize("case", band_errors.CASES[:2], ids=lambda case: case.title)
def test_errors_of_flagged_stars_allow_for_companions_and_variability(case, excerpts):
    """Red ones vary: means over years agree better than two nights do."""
    for line in both_halves(excerpts, case, band_errors.flagged, band_errors.flagged_fitted):
        assert 0.25 <= line.chi_square <= 2.5, (line.low, line.high)
        assert line.low >= 1.0 or 0.5 <= line.usual_chi_square <= 2.0


@pytest.mark.slow
def test_the_measured_errors_are_those_of_the_records(excerpts):
    for name, text in band_errors.tables(excerpts).items():
        assert (resource_folder("catalog/bands/data") / name).read_text(encoding="utf-8") == text, (
            name
        )


@pytest.mark.slow
def test_the_tables_are_those_of_the_library(tmp_path, excerpts):
    builder.write_spectra(excerpts, tmp_path)
    for name in ("spectra.csv.gz", "types.csv"):
        shipped_file = resource_folder("catalog/bands/data") / name
        assert (tmp_path / name).read_bytes() == shipped_file.read_bytes()
