"""Cross-identification in databases and files: built, checked, rebuilt, compared, and printed."""

from __future__ import annotations

import json
import struct
from dataclasses import fields
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pytest
from database_copies import copied, seal
from drafts import spec_with
from jsonschema import Draft202012Validator

from starcat.catalog.ingest import ingest_catalog
from starcat.catalog.stars.proper_motion import Motion, propagate
from starcat.catalog.stars.star_table import with_columns
from starcat.database.manifest import MANIFEST_VERSION
from starcat.database.products.crossmatch import (
    ARCSEC,
    VERDICTS,
    Crossmatch,
    counterpart_problems,
    matched_rows,
)
from starcat.database.products.table import Products
from starcat.database.reader import open_database_folder
from starcat.database.verify import verify
from starcat.database.writer import content_sha256
from starcat.errors import ConfigError, ParseError, SchemaError, SourceMissing
from starcat.pipeline import counterparts
from starcat.pipeline.build import build
from starcat.pipeline.draft import Draft, run
from starcat.pipeline.selection.selecting import select_guide_stars
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.pipeline.specs.reading import spec_from_dict
from starcat.resources import resource_folder
from starcat.storage.parquet import read_parquet, write_parquet
from starcat.storage.schema import product_schema

FIRST_ID = 1000


def spec_of(text: str, **crossmatch: object) -> BuildSpec:
    return spec_with(text, products={"crossmatch": crossmatch}) if crossmatch else spec_with(text)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, sao_lines: list[bytes]) -> Path:
    """SAO as the small database has it, and 500 of the 600 stars as Gaia would: at J2016."""
    folder = tmp_path_factory.mktemp("crossmatch")
    (folder / "sao.dat").write_bytes(b"".join(sao_lines))
    stars = ingest_catalog("sao", [folder / "sao.dat"]).stars
    then = propagate(Motion(*(stars[field.name].to_numpy() for field in fields(Motion))), 16.0)
    generator = np.random.default_rng(16)
    records = []
    for row in range(500):
        dec = then.dec_deg[row] + generator.normal(scale=0.2) / 3600.0
        mag = stars["mag"][row].as_py() - 0.4
        values = (then.ra_deg[row], dec, mag, mag + 0.1, mag - 0.5)
        records.append(struct.pack("<qddfff", FIRST_ID + row, *values))
    header = b"GDR3" + struct.pack("<IQ", 1, len(records))
    (folder / "gaia_merged.bin").write_bytes(header + b"".join(records))
    return folder


@pytest.fixture(scope="module")
def database(files: Path, small_spec: str) -> Path:
    spec = spec_of(small_spec, enabled=True, catalogs=["gaia"])
    inputs = {name: [files] for name in ("sao", "gaia")}
    return build(spec, files / "dist", inputs=inputs).folder


@pytest.fixture
def copy(database: Path, tmp_path: Path) -> Path:
    return copied(database, tmp_path)


# In a database ------------------------------------------------------------------------------


def test_an_database_names_the_counterparts(database):
    opened = open_database_folder(database)
    table, stars = opened.table("crossmatch"), opened.table("stars")
    product_schema("crossmatch").check(table)
    best = table.filter(pa.array(table["rank"].to_numpy() == 1))
    star_id = stars["star_id"].to_numpy()[best["star"].to_numpy()]
    # Star numbers count from 1, and Gaia has the first 500 of them.
    assert best["counterpart_id"].to_numpy().tolist() == (star_id + FIRST_ID - 1).tolist()
    assert len(best) == (stars["star_id"].to_numpy() <= 500).sum()
    assert set(best["verdict"].to_pylist()) == {"unique"}
    assert set(best["compared_jyear"].to_pylist()) == {2016.0}
    assert set(best["catalog"].to_pylist()) == {"gaia"}
    assert best["delta_mag"].to_numpy() == pytest.approx(-0.4, abs=1e-5)
    assert best["designation"][0].as_py() == f"Gaia DR3 {star_id[0] + FIRST_ID - 1}"


def test_every_manifest_is_of_one_version(database, small_database):
    manifest = json.loads((database / "manifest.json").read_bytes())
    schema = json.loads(
        (resource_folder("schemas") / f"manifest-{MANIFEST_VERSION}.json").read_text()
    )
    Draft202012Validator(schema).validate(manifest)
    roles = [(source["source"], source["role"]) for source in manifest["sources"]]
    assert roles == [("sao", "stars"), ("gaia", "crossmatch")]
    assert manifest["sources"][1]["joined"] == len(
        open_database_folder(database).table("crossmatch")
    )
    assert manifest["products"]["crossmatch"]["in_database"] is False
    with h5py.File(database / "database.h5") as file:
        assert "crossmatch" not in file
    # A table without counterparts has the same version and states it.
    plain = json.loads((small_database / "manifest.json").read_bytes())
    assert plain["manifest_version"] == manifest["manifest_version"] == MANIFEST_VERSION
    assert plain["spec"]["products"]["crossmatch"]["enabled"] is False


def test_the_spec_of_a_manifest_is_whole(small_database, small_spec):
    plain = spec_of(small_spec)
    dumped = json.loads((small_database / "manifest.json").read_bytes())["spec"]
    assert dumped == plain.recorded()
    assert dumped.keys() == BuildSpec.model_fields.keys()
    # What a database has no part of since before there was such a product is not mentioned.
    assert dumped["products"].keys() == Products.model_fields.keys() - {"levels"}
    named = spec_of(small_spec, catalogs=["gaia"], radius_arcsec=5.0)
    assert named.sources == ("sao",)
    again = spec_from_dict(named.model_dump(mode="json"), "manifest.json")
    assert again == named
    assert spec_from_dict(plain.model_dump(mode="json"), "manifest.json") == plain


def test_a_database_passes(database):
    assert verify(database).findings == ()


def findings_with(folder: Path, table: pa.Table) -> str:
    """Replace the product, make every digest fit, and return the problems that verify finds."""
    content = content_sha256(table, product_schema("crossmatch"))
    write_parquet(table, folder / "crossmatch.parquet")
    facts = {"rows": len(table), "content_sha256": content}
    seal(folder, lambda manifest: manifest["products"]["crossmatch"].update(facts))
    return " | ".join(str(finding) for finding in verify(folder).findings)


def changed(table: pa.Table, name: str, row: int, value: object) -> pa.Table:
    values = table[name].to_pylist()
    values[row] = value
    return with_columns(table, {name: pa.array(values, table.schema.field(name).type)})


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("star", 90_000, "star refers to rows"),
        ("rank", 2, "rank of row 7 is not 1"),
        ("separation_arcsec", 3.0, "separation_arcsec of row 7 is not that of its star"),
        ("ra_deg", 12.0, "separation_arcsec of row 7 is not that of its star"),
        ("delta_mag", 0.1, "delta_mag of row 7 is not that of its star"),
        ("delta_mag", None, "delta_mag of row 7 is not that of its star"),
        ("n_candidates", 4, "n_candidates of row 7"),
        ("probability", 1.5, "probability of row 7"),
        ("probability", float("nan"), "crossmatch.probability: 1 rows have no value"),
        ("verdict", "sure", "verdict sure; expected one of unique, ambiguous, none"),
        ("verdict", "none", "stars have a counterpart, but the product crossmatch holds"),
    ],
)
def test_what_is_wrong_is_found(name, value, words, copy):
    table = read_parquet(copy / "crossmatch.parquet")
    assert words in findings_with(copy, changed(table, name, 7, value))


def test_verdicts_of_schema_1_are_read(database):
    opened = open_database_folder(database)
    table = changed(opened.table("crossmatch"), "verdict", 7, "best")
    assert list(counterpart_problems(table, opened.table("stars"))) == []
    assert len(matched_rows(table)) == len(table)
    table = changed(table, "verdict", 8, "taken")
    assert len(matched_rows(table)) == len(table) - 1


def test_rows_out_of_order_are_found(copy):
    table = read_parquet(copy / "crossmatch.parquet")
    swapped = table.take([1, 0, *range(2, len(table))])
    assert "in the order of star, catalog, rank" in findings_with(copy, swapped)


def test_an_empty_product_has_no_problems(database):
    opened = open_database_folder(database)
    none = opened.table("crossmatch").slice(0, 0)
    assert list(counterpart_problems(none, opened.table("stars"))) == []
    assert len(matched_rows(none)) == 0


@pytest.mark.slow
def test_the_radius_of_the_spec_is_kept(files, small_spec):
    text = small_spec.replace('"small"', '"both"').replace('"sao"', '"gaia"')
    spec = spec_of(text, enabled=True, catalogs=["sao"], radius_arcsec=3.0)
    inputs = {name: [files] for name in ("sao", "gaia")}
    folder = build(spec, files / "dist", inputs=inputs).folder
    table = open_database_folder(folder).table("crossmatch")
    assert set(table["catalog"].to_pylist()) == {"sao"}
    assert table["separation_arcsec"].to_numpy().max() <= 3.0
    # The stars stay at J2016, having no proper motion: their counterparts are moved there.
    assert set(table["compared_jyear"].to_pylist()) == {2016.0}
    assert verify(folder).findings == ()


def test_a_rejected_companion_is_a_rival(files, small_spec, sao_lines, tmp_path):
    # A star too faint for the guide stars, 3 arcsec from star 10, which Gaia has but once.
    dec = float(sao_lines[9][193:204]) + 3.0 * ARCSEC
    line = b"   601" + sao_lines[9][6:80] + b" 6.3" + sao_lines[9][84:193]
    (tmp_path / "sao.dat").write_bytes(b"".join([*sao_lines, line + f"{dec:+11.8f}\n".encode()]))
    stars = ingest_catalog("sao", [tmp_path / "sao.dat"]).stars
    spec = spec_of(small_spec, enabled=True, catalogs=["gaia"])
    selected = select_guide_stars(stars, spec.selection)
    assert 601 not in selected.guide_stars["star_id"].to_pylist()
    both = counterparts.with_rivals(stars, selected, 10.0 * ARCSEC)
    assert both["star_id"].to_pylist() == [*selected.guide_stars["star_id"].to_pylist(), 601]
    draft = Draft(spec, {"gaia": [files]})
    draft.paths, draft.stars, draft.selected = {"gaia": [files]}, stars, selected
    run(draft, (counterparts.find_counterparts,))
    table = draft.product("crossmatch")
    row = table["counterpart_id"].to_pylist().index(FIRST_ID + 9)
    assert table["star"][row].as_py() == 9
    assert (table["n_stars"][row].as_py(), table["verdict"][row].as_py()) == (2, "unique")
    assert table["star"].to_numpy().max() < len(selected.guide_stars)
    assert draft.sources[0].joined == len(matched_rows(table)) == len(table)


def test_a_missing_catalog_is_known_before_anything_is_read(
    files, small_spec, tmp_path, monkeypatch
):
    monkeypatch.setenv("STARCAT_CACHE", str(tmp_path / "none"))
    monkeypatch.delenv("STARCAT_CATALOGS", raising=False)
    spec = spec_of(small_spec, enabled=True, catalogs=["hipparcos"])
    stages: list[str] = []
    with pytest.raises(SourceMissing, match="hipparcos"):
        build(
            spec,
            tmp_path / "out",
            inputs={"sao": [files / "sao.dat"]},
            progress=lambda stage, *_: stages.append(stage),
        )
    assert stages == []


def test_a_catalog_named_twice_is_refused(small_spec):
    with pytest.raises(ConfigError, match="named twice"):
        spec_of(small_spec, enabled=True, catalogs=["gaia", "gaia"])


def test_a_catalog_that_has_no_stars_is_refused(files, small_spec, tmp_path):
    given = {name: [files / "sao.dat"] for name in ("sao", "gcvs")}
    spec = spec_of(small_spec, enabled=True, catalogs=["gcvs"])
    with pytest.raises(ConfigError, match="gcvs lists no stars; choose one of 2mass"):
        build(spec, tmp_path / "out", inputs=given)


# Of two files --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tables(files: Path) -> tuple[Path, Path]:
    made = []
    for name in ("sao", "gaia"):
        write_parquet(ingest_catalog(name, [files]).stars, files / f"{name}.parquet")
        made.append(files / f"{name}.parquet")
    return made[0], made[1]


def test_two_files_give_the_rows_of_the_product(tables, tmp_path, starcat):
    output = tmp_path / "made" / "x.parquet"
    made, found = counterparts.match_files(*tables, Crossmatch())
    ran = starcat(["crossmatch", *tables, "-o", output])
    assert ran.code == 0
    for word in (*VERDICTS[:2], "unmatched", "median separation", "completeness"):
        assert word in ran.out
    assert max(len(line) for line in ran.out.splitlines()) <= 100
    assert f"wrote {output}" in ran.err
    table = read_parquet(output)
    assert table.equals(made)
    assert table.column_names[:2] == ["star_id", "star_designation"]
    assert table.column_names[2:] == [c.name for c in product_schema("crossmatch").columns]
    assert table["star_id"].to_pylist() == list(range(1, 501))
    assert table["counterpart_id"].to_pylist() == list(range(FIRST_ID, FIRST_ID + 500))
    assert (found.stars, found.counterparts, found.matched, found.unmatched) == (600, 500, 500, 100)
    assert (found.verdicts["unique"], found.no_candidate, found.mutual) == (500, 100, 500)
    assert found.median_delta_mag == pytest.approx(-0.4, abs=1e-4)
    assert table.schema.field("star_id").metadata[b"description"].startswith(b"Permanent number")
    options = ["--radius-arcsec", 0.001, "--json", "--replace"]
    content = json.loads(starcat(["crossmatch", *tables, "-o", output, *options]).out)
    assert (content["a"], content["b"], content["radius_arcsec"]) == ("sao", "gaia", 0.001)
    assert content["matched"] + content["unmatched"] == 600
    assert content["matched"] < 100


def test_a_table_of_no_stars_is_matched_with_none(tables):
    stars, others = (counterparts.read_star_table(path) for path in tables)
    table, found = counterparts.match_tables(stars.slice(0, 0), others, Crossmatch())
    product_schema("crossmatch").check(table)
    assert (len(table), found.stars, found.matched) == (0, 0, 0)
    table, found = counterparts.match_tables(stars, others.slice(0, 0), Crossmatch())
    assert (len(table), found.unmatched, found.no_candidate) == (0, 600, 600)
    assert found.median_separation_arcsec is None


def test_the_tables_of_an_database_are_star_tables(database, tables):
    _, found = counterparts.match_files(database / "stars.parquet", tables[1], Crossmatch())
    assert found.matched == len(open_database_folder(database).table("crossmatch"))


def test_a_star_table_with_a_place_without_a_value_is_refused(tables, tmp_path):
    with pytest.raises(ParseError, match="cannot be read as Parquet"):
        counterparts.read_star_table(tmp_path)
    table = read_parquet(tables[0])
    for value in (None, float("nan"), float("inf")):
        values = pa.array([value, *table["ra_deg"].to_pylist()[1:]])
        place = table.column_names.index("ra_deg")
        write_parquet(table.set_column(place, "ra_deg", values), tmp_path / "blank.parquet")
        with pytest.raises(SchemaError, match="ra_deg: 1 rows have no value"):
            counterparts.read_star_table(tmp_path / "blank.parquet")
