"""Conditions that guide stars meet: [[selection.require]]."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from drafts import spec_with

from starcat.catalog.ingest import ingest_catalog
from starcat.errors import BuildError, ConfigError
from starcat.selection.selecting import Selected, select_guide_stars
from starcat.specs.keys import spec_toml
from starcat.specs.reading import spec_from_dict
from starcat.stars.star_table import with_columns

FITS_WELL = {"name": "good-fit", "expression": "ruwe < 1.4", "description": "single in Gaia"}


@pytest.fixture(scope="module")
def stars(sao_lines: list[bytes], tmp_path_factory: pytest.TempPathFactory) -> pa.Table:
    path: Path = tmp_path_factory.mktemp("sao") / "sao.dat"
    path.write_bytes(b"".join(sao_lines))
    table = ingest_catalog("sao", [path]).stars
    ruwe = np.where(np.arange(len(table)) % 3 == 0, 2.0, 1.0)
    unknown = np.arange(len(table)) % 5 == 0
    return with_columns(table, {"ruwe": pa.array(ruwe, mask=unknown)})


def selected(text: str, stars: pa.Table, *require: dict[str, Any]) -> Selected:
    spec = spec_with(text, selection={"faint_limit_mag": 20.0, "require": list(require)})
    return select_guide_stars(stars, spec.selection)


def test_stars_that_do_not_meet_a_condition_are_rejected_with_it(stars, small_spec):
    plain, found = selected(small_spec, stars), selected(small_spec, stars, FITS_WELL)
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
    found = selected(small_spec, stars, mild)
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
        selected(small_spec, stars, {"name": "odd", "expression": expression})


def test_a_value_that_no_star_has_is_reported_with_those_that_they_have(stars, small_spec):
    bare = with_columns(stars, {"spectral_type": pa.nulls(len(stars), pa.string())})
    with pytest.raises(BuildError, match=r"no star .* has spectral_type, .* have star_id, "):
        selected(small_spec, bare, {"name": "cool", "expression": "spectral_type = 'M'"})


def test_two_conditions_have_two_names(stars, small_spec):
    with pytest.raises(ConfigError, match="a name is given twice: good-fit, good-fit"):
        selected(small_spec, stars, FITS_WELL, FITS_WELL)


def test_conditions_are_written_as_tables(small_spec):
    assert "require" not in spec_with(small_spec).recorded()["selection"]
    other = {"name": "near", "expression": "parallax_mas > 5", "description": ""}
    spec = spec_with(small_spec, selection={"require": [FITS_WELL, other]})
    text = spec_toml(spec)
    assert text.count("\n[[selection.require]]\n") == 2
    assert "{" not in text
    assert spec_from_dict(tomllib.loads(text), "written.toml") == spec
