"""What a spec will give, by estimate, against what its build gives."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from drafts import chosen, spec_with
from hypothesis import given
from hypothesis import strategies as st

from starcat.catalog.stars.star_table import with_columns
from starcat.database.manifest import DATABASE_NAME, MANIFEST_NAME
from starcat.errors import BuildError, ConfigError
from starcat.pipeline.build import build
from starcat.pipeline.draft import Draft, Inputs
from starcat.pipeline.estimate import (
    Estimate,
    choose_stars,
    count_rejected,
    estimate_draft,
    estimate_spec,
    read_draft,
    reading_keys,
)
from starcat.pipeline.guide_stars import brightest_of_fields
from starcat.pipeline.recipes import tile_guide_stars
from starcat.pipeline.specs.reading import preset, preset_names
from starcat.storage.parquet import read_parquet

FILES = {"2mass-8x6": {"2mass": "psc_estimated.gz"}}
"""Inputs that are not found by the names of their files."""

DEEP_PRESETS = ("2mass-8x6", "sao-6deg")
"""Presets that need fainter stars than the generated catalogs have."""


@pytest.fixture(scope="module")
def small(tmp_path_factory, sao_lines):
    path = tmp_path_factory.mktemp("sao") / "sao.dat"
    path.write_bytes(b"".join(sao_lines))
    return {"sao": [path]}


@pytest.fixture(scope="module")
def read(small, small_spec: str) -> Draft:
    return read_draft(spec_with(small_spec), small)


def check(found: Estimate, folder: Path, *, within: float = 0.1) -> None:
    """Compare an estimate with a database: stars to the last one, all files within 10 %.

    The figures of the report have their own size in a small database: it is left out.
    """
    manifest = json.loads((folder / MANIFEST_NAME).read_bytes())
    [stars, *_] = manifest["sources"]
    assert found.cost.stars == stars["kept"] == manifest["products"]["stars"]["rows"]
    assert found.rejected == stars["rejected"]
    names = {*(facts["parquet"] for facts in manifest["products"].values()), DATABASE_NAME}
    assert set(found.cost.files) == {*names, "report"}
    sizes = {name: (folder / name).stat().st_size for name in names}
    estimated = sum(found.cost.files[name] for name in names)
    assert estimated == pytest.approx(sum(sizes.values()), rel=within)
    for name, size in sizes.items():
        assert 0.4 < found.cost.files[name] / size < 2.5, name
    for name, rows in found.cost.rows.items():
        assert rows == pytest.approx(manifest["products"][name]["rows"], rel=0.06), name


# --- Against builds


FEWER = {"boresights": {"count": 300, "brightest": 5}, "products": {"pairs": {"enabled": False}}}
MERGE = {"min_separation_deg": 2.0, "action": "merge"}


def test_the_small_build_is_as_estimated(small, small_spec, small_database):
    check(estimate_spec(spec_with(small_spec), small), small_database, within=0.25)


@pytest.mark.parametrize(
    "sections",
    [
        pytest.param(FEWER, marks=pytest.mark.slow),
        {"selection": {"faint_limit_mag": 5.5, "max_stars_per_field": 6, "doubles": MERGE}},
    ],
    ids=["fewer", "thinned and merged"],
)
def test_a_small_build_is_as_estimated(small, small_spec, sections, tmp_path):
    spec = spec_with(small_spec, **sections)
    built = build(spec, tmp_path, inputs=small)
    check(estimate_spec(spec, small), built.folder, within=0.25)


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("name", preset_names())
def test_every_preset_is_as_estimated(name, catalogs, expected, tmp_path, monkeypatch):
    monkeypatch.setenv("STARCAT_CATALOGS", str(catalogs))
    inputs: Inputs = {source: [catalogs / file] for source, file in FILES.get(name, {}).items()}
    spec = preset(name)
    if name in expected(generated=DEEP_PRESETS, genuine=()):
        with pytest.raises(BuildError, match="identifies"):
            build(spec, tmp_path, inputs=inputs)
        return
    built = build(spec, tmp_path, inputs=inputs)
    check(estimate_spec(spec, inputs), built.folder)


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize(
    "changes",
    [
        {"camera.fov_x_deg": "6", "boresights.count": "30000", "selection.faint_limit_mag": "6.5"},
        {"camera.fov_x_deg": "25", "selection.faint_limit_mag": "5", "boresights.count": "3000"},
        {
            "selection.faint_limit_mag": "7", "selection.max_stars_per_field": "12",
            "boresights.brightest": "10", "products.grid.cells_per_side": "100",
            "products.grid.buffer_deg": "2.0", "products.radial.rings": "200",
            "products.pairs.min_separation_deg": "10.0", "products.levels.enabled": "true",
            "products.levels.widest_fov_x_deg": "40.0",
        },
    ],
    ids=["narrow", "wide", "thinned, with levels"],
)  # fmt: skip
def test_other_specs_are_as_estimated(changes, tmp_path):
    spec = preset("gaia-12deg", {**changes, "self_test.frames": "20"})
    built = build(spec, tmp_path)
    check(estimate_spec(spec, {}), built.folder)


# --- Stars


DOUBLES = {"min_separation_deg": 3.0, "max_delta_mag": 1.0}


@pytest.mark.parametrize("action", ["remove", "merge", "keep"])
@pytest.mark.parametrize(
    "rule",
    [
        *({"doubles": {**DOUBLES, "companion_limit_mag": limit}} for limit in (None, 4.0, 6.3)),
        {"neighbours": {"psf_sigma_px": 12.0}},  # so wide that many stars have neighbours
    ],
)
@pytest.mark.parametrize("most", [None, 5])
def test_stars_are_chosen_as_in_a_build(read, small_spec, action, rule, most):
    """An estimate looks only at stars that are bright enough; that must not show."""
    rule = {name: {**keys, "action": action} for name, keys in rule.items()}
    limits = {"faint_limit_mag": 5.0, "max_stars_per_field": most}
    spec = spec_with(small_spec, selection={**limits, **rule})
    built, found = chosen(read.stars, spec), choose_stars(read, spec)
    assert found.selected.guide_stars.equals(built.selected.guide_stars)
    assert np.array_equal(found.fields.star_index, built.fields.star_index)
    [source] = read.sources
    rejected = count_rejected(read, found)
    assert sum(rejected.values()) == len(built.selected.rejected) + sum(source.rejected.values())


def test_stars_without_a_magnitude_are_counted(read, small_spec):
    mag = read.stars["mag"].to_numpy().copy()
    known = pa.array(mag, mask=np.arange(len(mag)) < 7)
    spec = spec_with(small_spec)
    other = read.branch(spec)
    other.stars = with_columns(read.stars, {"mag": known})
    assert count_rejected(other, choose_stars(other, spec))["no_magnitude"] == 7


@given(
    mags=st.lists(st.sampled_from([3.0, 4.0, 4.5, 5.0]), min_size=1, max_size=60),
    most=st.integers(1, 6),
    seed=st.integers(0, 1000),
    count=st.integers(1, 40),
)
def test_the_brightest_of_fields_are_those_of_the_whole_tiling(read, mags, most, seed, count):
    rows = np.sort(np.random.default_rng(seed).permutation(len(read.stars))[: len(mags)])
    stars = with_columns(read.stars.take(pa.array(rows)), {"mag": pa.array(mags)})
    spec = preset("gaia-12deg", {"camera.fov_x_deg": "60", "boresights.count": str(count)})
    whole = np.unique(tile_guide_stars(stars, spec).brightest(most)[1])
    assert np.array_equal(brightest_of_fields(stars, spec, most), whole)


def test_too_few_stars_are_reported_in_the_words_of_the_build(read, small_spec):
    spec = spec_with(small_spec, selection={"faint_limit_mag": -2.0})
    with pytest.raises(BuildError) as built:
        chosen(read.stars, spec)
    with pytest.raises(BuildError) as estimated:
        choose_stars(read, spec)
    assert str(estimated.value) == str(built.value)


def test_sources_are_checked_even_if_the_catalogs_have_been_read_for_another_spec(read, small_spec):
    wanted = {"crossmatch": {"enabled": True, "catalogs": ["gcvs"]}}
    with pytest.raises(ConfigError, match="gcvs lists no stars"):
        choose_stars(read, spec_with(small_spec, products=wanted))


def test_fields_that_fall_short_and_memory_are_refusals(read, small_spec):
    spec = spec_with(small_spec, boresights={"count": 200, "min_stars_per_field": 10_000})
    found = estimate_draft(read, choose_stars(read, spec), spec, max_memory_bytes=1)
    assert "(boresights.min_stars_per_field)" in str(found.refusals[0])
    assert "more than the limit that was given" in str(found.refusals[1])


def test_what_is_read_depends_on_the_catalog_alone(small_spec):
    one = spec_with(small_spec)
    other = spec_with(small_spec, name="other", selection={"faint_limit_mag": 3.0})
    assert reading_keys(one) == reading_keys(other)
    joined = {"faint_limit_mag": 6.0, "variables": {"join": ["gcvs"]}}
    assert reading_keys(one) != reading_keys(spec_with(small_spec, selection=joined))
    assert reading_keys(one) != reading_keys(spec_with(small_spec, epoch_jyear=2000.0))


@pytest.mark.parametrize(
    ("fov_x_deg", "changes", "words"),
    [
        (30, {}, "too dense to estimate: the 1,000,000 fields of the tiling"),
        (30, {"selection.max_stars_per_field": "10000"}, "stars, limit 4,000,000; use a brighter"),
        (
            0.1,
            {"products.levels.enabled": "true", "products.levels.max_ratio": "1.1"},
            "fields of all levels",
        ),
    ],
)
def test_a_tiling_that_is_too_large_is_refused(read, fov_x_deg, changes, words):
    many = {"boresights.count": "1000000", "selection.variables.join": "[]"}
    spec = preset("sao-12deg", {**many, "camera.fov_x_deg": f"{fov_x_deg}", **changes})
    with pytest.raises(BuildError, match=words):
        choose_stars(read, spec)


def test_the_command_says_what_a_spec_gives(starcat, small, small_spec, small_database, tmp_path):
    (tmp_path / "small.toml").write_text(small_spec)
    arguments = ["estimate", tmp_path / "small.toml", "--input", f"sao={small['sao'][0]}"]
    run = starcat(arguments)
    assert run.code == 0
    assert "triangles.parquet" in run.out
    assert "the stars are as the build will have them" in run.err
    said = json.loads(starcat([*arguments, "--json"]).out)
    stars = read_parquet(small_database / "stars.parquet")
    assert said["guide_stars"] == said["filters"][-1]["stars"] == len(stars)
    assert said["total_bytes"] == sum(said["files"].values())
