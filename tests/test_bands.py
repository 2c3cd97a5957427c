"""The band of a sensor: responses, synthetic magnitudes, and relations on the genuine catalogs."""

from __future__ import annotations

import os
from itertools import pairwise
from pathlib import Path

import band_pairs
import bands as builder
import numpy as np
import pytest

from starcat.bands.catalogs import BANDS_AND_COLOURS, best_relation
from starcat.bands.relation import Prediction, combined, predict_by_type, relation
from starcat.bands.response import (
    checked_response,
    read_response,
    response_from_text,
    shipped,
    shipped_names,
)
from starcat.bands.spectra import library, parsed_type
from starcat.bands.synthetic import checked_zero_point, magnitudes
from starcat.errors import ConfigError, FileMissing
from starcat.resources import resource_folder

CATALOGS = Path(
    os.environ.get("STARCAT_CATALOGS") or Path(__file__).parents[2] / "shared" / "catalogs"
)
NAMES = ("hip_main.dat.gz", "tyc_main.dat.gz", "psc_measured.gz", "pickles_uvklib.tar.xz")

genuine = pytest.mark.skipif(
    not all((CATALOGS / name).is_file() for name in NAMES),
    reason=f"the genuine catalogs are not at {CATALOGS}; set STARCAT_CATALOGS",
)

COLOUR_BINS = (-0.5, 0.5, 1.0, 1.5, 2.0)


def spectrum(name: str, first: str, second: str) -> float:
    """Return a colour of a type of the library, without reddening."""
    row = library().types.index(name)
    return float((magnitudes(shipped(first)) - magnitudes(shipped(second)))[0, row])


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
    assert spectrum(name, first, second) == pytest.approx(colour_mag, abs=0.09)


def test_every_shipped_response_is_sound_and_says_where_it_is_from():
    assert len(shipped_names()) == 15
    for name in shipped_names():
        one = shipped(name)
        checked_response(name, one.wavelength_nm, one.value, one.counts, one.zero_point)
        assert one.source
        assert one.title
        assert np.isfinite(magnitudes(one)).all()


def test_extinction_reddens_and_dims():
    b_v = magnitudes(shipped("B")) - magnitudes(shipped("V"))
    assert (np.diff(b_v, axis=0) > 0).all()
    dimmed = magnitudes(shipped("V"))[-1] - magnitudes(shipped("V"))[0]
    assert np.median(dimmed) == pytest.approx(3.1 * 0.8, abs=0.1)  # A(V) = 3.1 E(B-V)


def test_a_zero_point_is_vega_or_a_type():
    own = shipped("silicon-cmos")
    sunlike = checked_response(
        "own", own.wavelength_nm, own.value, own.counts, checked_zero_point("G2V")
    )
    row = library().types.index("g2v")
    assert magnitudes(sunlike)[0, row] == pytest.approx(magnitudes(shipped("V"))[0, row])
    assert checked_zero_point("Vega") == "vega 0"
    with pytest.raises(ConfigError, match=r"the library has A0I, .*A2V"):
        checked_zero_point("A1V")
    with pytest.raises(ConfigError, match="expected 'vega'"):
        checked_zero_point("Sirius")


def test_a_response_per_energy_is_turned_into_photons():
    wavelength = np.linspace(400.0, 900.0, 51)
    per_photon = checked_response("a", wavelength, np.ones(51), "photon")
    per_energy = checked_response("b", wavelength, wavelength, "energy")
    assert magnitudes(per_photon) == pytest.approx(magnitudes(per_energy), abs=1e-9)


BAD = {
    "negative": ("wavelength_nm,response\n400,0.1\n500,-0.2\n600,0.1\n", "-0.2 at 500 nm"),
    "a wide gap": ("400,0.1\n500,0.9\n650,0.8\n700,0\n", "nothing between 500 and 650 nm"),
    "a blank value": ("400,0.1\n500,\n600,0.1\n", "row 2 has no number"),
    "angstroms": ("4000,0\n5000,1\n11000,0\n", "look like angstroms"),
    "angstroms in the header": ("wavelength [Angstrom],r\n4000,0\n", "wavelengths are in nm"),
    "micrometres": ("0.4,0\n0.5,1\n0.6,0\n", "look like micrometres"),
    "one wavelength": ("550,1\n", "1 wavelengths; a curve needs 3"),
    "no overlap": ("2600,0\n2650,1\n2700,0\n", "look like angstroms"),
    "ultraviolet": ("120,0\n180,1\n250,0\n", "outside of 300 to 2500 nm"),
    "unsorted": ("500,1\n400,1\n600,1\n", "500 nm is followed by 400 nm"),
    "only zeros": ("400,0\n500,0\n600,0\n", "all values are 0"),
    "text": ("wavelength_nm,response\n400,high\n", "found '400,high'"),
    "three columns": ("400,1,2\n", "expected a wavelength in nm, a comma"),
    "nothing": ("", "0 wavelengths"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_response_is_told_with_a_sentence(case):
    text, said = BAD[case]
    with pytest.raises(ConfigError, match="response own: ") as caught:
        response_from_text("own", text, "photon")
    assert said in str(caught.value)


def test_a_response_has_to_say_what_it_is_relative_to(tmp_path):
    path = tmp_path / "own.csv"
    path.write_text("# title: a camera\n400,0\n500,1\n600,0\n", encoding="utf-8")
    with pytest.raises(ConfigError, match='per = "photon"'):
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
        for name in ("silicon-cmos", "red-ccd", "ingaas"):
            assert 0.0 < best_relation(source, shipped(name)).typical_error_mag < 0.6
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


@genuine
def test_hp_from_gaia_without_a_fit():
    stars = band_pairs.measured(CATALOGS)
    found = band_pairs.pair(stars, "G, BP-RP", "Hp")
    usual = found.of(-0.5, 2.0)
    assert len(usual.residual_mag) > 4_900
    assert usual.rms_mag <= 0.03
    for low, high in pairwise(COLOUR_BINS):
        assert 0.8 <= found.of(low, high).chi_square <= 1.25, (low, high)
    alone = stars["Hp"] - stars["G"]
    assert np.nanstd(alone) > 0.2  # what the colour explains
    for band in ("V", "VT"):
        assert band_pairs.pair(stars, "G, BP-RP", band).rms_mag <= 0.03
    red = found.of(2.0, 6.0)
    assert red.rms_mag <= 0.05


@pytest.mark.slow
@genuine
def test_infrared_from_visual():
    stars = band_pairs.measured(CATALOGS, infrared=True)
    found = band_pairs.pair(stars, "V, B-V", "J")
    assert len(found.residual_mag) > 150
    assert found.rms_mag <= 0.10


@pytest.mark.slow
@genuine
def test_the_tables_are_those_of_the_library(tmp_path):
    builder.write_spectra(CATALOGS, tmp_path)
    for name in ("spectra.csv.gz", "types.csv"):
        shipped_file = resource_folder("bands/data") / name
        assert (tmp_path / name).read_bytes() == shipped_file.read_bytes()
