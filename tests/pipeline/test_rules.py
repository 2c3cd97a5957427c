"""Rules of selection: the region of the sky, and conditions that guide stars meet."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pyarrow as pa
import pytest
from drafts import spec_with
from mocpy import MOC

from starcat.catalog.ingest import ingest_catalog
from starcat.catalog.stars.star_table import directions_of, with_columns
from starcat.errors import BuildError, ConfigError
from starcat.geometry.sphere import directions_from_radec, separation
from starcat.pipeline.selection.selecting import Selected, select_guide_stars
from starcat.pipeline.specs.keys import spec_toml
from starcat.pipeline.specs.reading import read_spec, spec_from_dict

CELLS = "0/1 1/20-22"


@pytest.fixture(scope="module")
def stars(sao_lines: list[bytes], tmp_path_factory: pytest.TempPathFactory) -> pa.Table:
    """Stars of SAO, every third with a poor fit, and every fifth with an unknown one."""
    path: Path = tmp_path_factory.mktemp("sao") / "sao.dat"
    path.write_bytes(b"".join(sao_lines))
    table = ingest_catalog("sao", [path]).stars
    ruwe = np.where(np.arange(len(table)) % 3 == 0, 2.0, 1.0)
    unknown = np.arange(len(table)) % 5 == 0
    return with_columns(table, {"ruwe": pa.array(ruwe, mask=unknown)})


def selected(text: str, stars: pa.Table, faint_limit_mag: float = 20.0, **rule: Any) -> Selected:
    spec = spec_with(text, selection={"faint_limit_mag": faint_limit_mag, **rule})
    return select_guide_stars(stars, spec.selection)


def within(text: str, stars: pa.Table, **region: Any) -> Selected:
    return selected(text, stars, region=region)


def meeting(text: str, stars: pa.Table, *conditions: dict[str, Any]) -> Selected:
    return selected(text, stars, require=list(conditions))


def test_a_zone_keeps_its_ends_and_what_is_between(stars, small_spec):
    found = within(small_spec, stars, zone=[-30.0, 10.0])
    dec = stars["dec_deg"].to_numpy()
    assert len(found.guide_stars) == ((dec >= -30.0) & (dec <= 10.0)).sum() > 0
    assert set(found.rejected["reason"].to_pylist()) == {"outside_region"}


def test_a_cone_keeps_what_is_within_its_radius(stars, small_spec):
    found = within(small_spec, stars, cone=[266.4, -29.0, 40.0])
    apart = separation(directions_of(stars), directions_from_radec(266.4, -29.0))
    assert len(found.guide_stars) == (apart <= np.radians(40.0)).sum() > 0


def test_a_moc_keeps_what_is_in_its_cells_and_all_regions_hold(stars, small_spec):
    moc = MOC.from_string(CELLS, "ascii")
    found = within(small_spec, stars, moc=CELLS, zone=[0.0, 90.0])
    ra, dec = (stars[name].to_numpy() for name in ("ra_deg", "dec_deg"))
    inside = moc.contains_lonlat(ra * u.deg, dec * u.deg) & (dec >= 0.0)
    assert len(found.guide_stars) == inside.sum() > 0


def test_a_star_beyond_the_limits_is_rejected_for_them_wherever_it_is(stars, small_spec):
    found = selected(small_spec, stars, 6.0, region={"zone": [0.0, 90.0]})
    faint = found.rejected.filter(pa.compute.greater(found.rejected["mag"], 6.0))
    assert set(faint["reason"].to_pylist()) == {"too_faint"}
    left = [len(step.directions) for step in found.steps]
    assert left == sorted(left, reverse=True)
    assert [step.name for step in found.steps][:2] == ["magnitude", "region"]


@pytest.mark.parametrize(("suffix", "form"), [("fits", "fits"), ("json", "json"), ("txt", "ascii")])
def test_a_file_of_a_moc_becomes_its_cells(small_spec, tmp_path, suffix, form):
    moc = MOC.from_string(CELLS, "ascii")
    moc.save(str(tmp_path / f"survey.{suffix}"), form)
    (tmp_path / "spec.toml").write_text(small_spec)
    spec = tmp_path / "spec.toml"
    region = read_spec(spec, {"selection.region.moc_file": f"survey.{suffix}"}).selection.region
    assert MOC.from_string(region.moc, "ascii") == moc
    assert region.moc_file is None
    (tmp_path / f"survey.{suffix}").write_bytes(b"no MOC")
    with pytest.raises(ConfigError, match=rf"survey\.{suffix}: is not a MOC in {form}"):
        read_spec(spec, {"selection.region.moc_file": f"survey.{suffix}"})


@pytest.mark.parametrize(
    ("region", "words"),
    [
        ({"zone": [10.0, -10.0]}, "the smaller first"),
        ({"cone": [0.0, 95.0, 1.0]}, "a declination from -90 to 90"),
        ({"moc": "eight"}, "is not a MOC in ASCII"),
        ({"moc": "30/1"}, "'30/1' has no order from 0 to 29"),
        ({"moc": "7"}, "'7' has no order from 0 to 29"),
        ({"moc": "3/4-1"}, "order 3 has the cells 0 to 767, the lower one first"),
        ({"moc": "3/768"}, "order 3 has the cells 0 to 767"),
        ({"moc": "3/"}, "has no cells"),
        ({"moc_file": "/etc/passwd"}, "no file is read here; state moc"),
    ],
)
def test_a_region_that_is_nowhere_is_refused(small_spec, stars, region, words):
    with pytest.raises(ConfigError, match=words):
        within(small_spec, stars, **region)


FITS_WELL = {"name": "good-fit", "expression": "ruwe < 1.4", "description": "single in Gaia"}


def test_stars_that_do_not_meet_a_condition_are_rejected_with_it(stars, small_spec):
    plain, found = meeting(small_spec, stars), meeting(small_spec, stars, FITS_WELL)
    lost = set(plain.guide_stars["star_id"].to_pylist())
    lost -= set(found.guide_stars["star_id"].to_pylist())
    assert lost
    rows = found.rejected.filter(pa.compute.equal(found.rejected["reason"], "requirement"))
    assert set(rows["star_id"].to_pylist()) == lost
    assert set(rows["detail"].to_pylist()) == {"good-fit: ruwe < 1.4"}
    assert all(ruwe is not None and ruwe < 1.4 for ruwe in found.guide_stars["ruwe"].to_pylist())
    assert [step.name for step in found.steps].count("require") == 1


def test_unknown_values_can_be_let_through(stars, small_spec):
    mild = {"name": "mild", "expression": "ruwe < 1.4 OR ruwe IS NULL"}
    found = meeting(small_spec, stars, mild)
    assert None in found.guide_stars["ruwe"].to_pylist()


@pytest.mark.parametrize(
    ("expression", "words"),
    [
        ("rue < 1.4", "did you mean 'ruwe'"),
        ("ruwe < (SELECT 1)", "not allowed"),
        ("read_text('/etc/passwd') = ''", "there is no function read_text"),
        ("ruwe <", "nor an expression"),
        ("- " * 400 + "ruwe < 1", "nested too deep"),
        ("designation < 3", "cannot be computed"),
        ("ruwe + 1", r"'ruwe \+ 1' gives double; write a condition"),
    ],
)
def test_an_expression_that_is_invalid_is_refused(small_spec, stars, expression, words):
    with pytest.raises(ConfigError, match=words):
        meeting(small_spec, stars, {"name": "odd", "expression": expression})


def test_a_value_that_no_star_has_is_reported_with_those_that_they_have(stars, small_spec):
    bare = with_columns(stars, {"spectral_type": pa.nulls(len(stars), pa.string())})
    with pytest.raises(BuildError, match=r"no star .* has spectral_type, .* have star_id, "):
        meeting(small_spec, bare, {"name": "cool", "expression": "spectral_type = 'M'"})


def test_two_conditions_have_two_names(stars, small_spec):
    with pytest.raises(ConfigError, match="'good-fit' is named twice; name each once"):
        meeting(small_spec, stars, FITS_WELL, FITS_WELL)


def test_conditions_are_written_as_tables(small_spec):
    assert "require" not in spec_with(small_spec).recorded()["selection"]
    other = {"name": "near", "expression": "parallax_mas > 5", "description": ""}
    spec = spec_with(small_spec, selection={"require": [FITS_WELL, other]})
    text = spec_toml(spec)
    assert text.count("\n[[selection.require]]\n") == 2
    assert "{" not in text
    assert spec_from_dict(tomllib.loads(text), "written.toml") == spec
