"""Schemas: the files are well-formed and never change; tables that break them are refused."""

from __future__ import annotations

import copy
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from jsonschema import Draft202012Validator
from release_schemas import LIST_NAME, broken, digests, release, released

from starcat.catalog.source import UNITS
from starcat.database.manifest import MANIFEST_VERSION
from starcat.database.reader import open_database_folder
from starcat.errors import SchemaError, SchemaVersionError
from starcat.resources import resource_folder
from starcat.storage.schema import ProductSchema, product_schema, read_schema

FOLDER = resource_folder("schemas")
MANIFEST = FOLDER / f"manifest-{MANIFEST_VERSION}.json"
FILES = sorted(path for path in FOLDER.glob("*.json") if not path.stem.startswith("manifest-"))
PRODUCTS = sorted({path.stem.rpartition("-")[0] for path in FILES})

NAME = re.compile("[a-z][a-z0-9_]*")
KEYS = {"product", "version", "description", "order", "columns"}
MORE_KEYS = {"extends", "extends_as_nullable", "extends_without"}
SUFFIXES = {
    "deg": "_deg", "rad": "_rad", "arcsec": "_arcsec", "mas/yr": "_mas_yr", "mag": "_mag",
    "px": "_px", "rad2": "_rad2", "mas": "_mas", "km/s": "_km_s",
}  # fmt: skip


def ids(path: Path) -> str:
    return path.stem


def table_of(schema: ProductSchema) -> pa.Table:
    """Two rows with a value in every column."""
    values: dict[str, Any] = {"bool": True, "string": "a"}
    arrays = []
    for column, field in zip(schema.columns, schema.arrow_schema, strict=True):
        value = values.get(column.item_dtype, 1)
        arrays.append(pa.array([[value], []] if column.is_list else [value, value], field.type))
    return pa.Table.from_arrays(arrays, schema=schema.arrow_schema)


def with_column(table: pa.Table, name: str, values: pa.Array) -> pa.Table:
    place = table.column_names.index(name)
    return table.set_column(place, pa.field(name, values.type), values)


# The files ----------------------------------------------------------------------------------


@pytest.mark.parametrize("path", FILES, ids=ids)
class TestEveryFile:
    def test_it_is_well_formed(self, path):
        content = json.loads(path.read_text())
        assert content.keys() - MORE_KEYS == KEYS
        assert path.name == f"{content['product']}-{content['version']}.json"
        assert len(content["description"]) >= 20
        for column in read_schema(path).columns:
            assert NAME.fullmatch(column.name)
            assert re.fullmatch(r"[A-Za-z.;]*", column.ucd)
            assert len(column.description) >= 8
            assert not column.description.endswith(".")
            assert {type(column.nullable), type(column.in_database)} == {bool}

    def test_columns_are_named_once_and_order_names_them(self, path):
        schema = read_schema(path)
        names = [column.name for column in schema.columns]
        assert len(names) == len(set(names))
        assert set(schema.order) <= set(names)
        assert schema.name == path.stem

    def test_units_stand_in_the_names(self, path):
        for column in read_schema(path).columns:
            if column.unit in SUFFIXES:
                suffix = SUFFIXES[column.unit]
                assert f"{suffix}_" in f"_{column.name}_", column.name
            for unit, suffix in SUFFIXES.items():
                if column.name.endswith(suffix):
                    assert column.unit == unit, column.name
            assert not column.unit or column.unit in UNITS | {"rad2", "px"}

    def test_arrow_schema_carries_units_and_meanings(self, path):
        schema = read_schema(path)
        assert schema.arrow_schema.metadata == {b"starcat.schema": path.stem.encode()}
        for column, field in zip(schema.columns, schema.arrow_schema, strict=True):
            assert field.nullable == column.nullable
            assert field.metadata[b"description"].decode() == column.description
            assert field.metadata.get(b"unit", b"").decode() == column.unit


# The contract -------------------------------------------------------------------------------


CHANGES = {
    "one less": lambda table: table.drop_columns(table.column_names[-1:]),
    "one more": lambda table: table.append_column("surplus", pa.array([1, 2])),
    "another order": lambda table: table.select(table.column_names[::-1]),
}


@pytest.mark.parametrize("product", PRODUCTS)
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_other_columns_are_refused(product, change):
    schema = product_schema(product)
    table = change(table_of(schema))
    with pytest.raises(SchemaError, match=f"{product}: columns differ") as caught:
        schema.check(table)
    assert caught.value.found == table.column_names
    assert caught.value.exit_code == 4
    odd = set(table.column_names) ^ {column.name for column in schema.columns}
    assert all(name in str(caught.value) for name in odd)


def test_each_column_of_another_type_is_refused():
    for product in PRODUCTS:
        schema = product_schema(product)
        for column in schema.columns:
            other = pa.array([1, 2], pa.int8())
            table = with_column(table_of(schema), column.name, other)
            with pytest.raises(SchemaError, match=rf"{product}\.{column.name}: found int8"):
                schema.check(table)


def test_a_row_without_a_value_is_refused_unless_nullable():
    for product in PRODUCTS:
        schema = product_schema(product)
        for column in schema.columns:
            kind = column.arrow_field.type
            table = with_column(table_of(schema), column.name, pa.nulls(2, kind))
            if column.nullable:
                schema.check(table)
                continue
            with pytest.raises(SchemaError, match="2 rows have no value") as caught:
                schema.check(table)
            assert caught.value.field == column.name


@pytest.mark.parametrize(("product", "version"), [("stars", "9.0.0"), ("stars", "one")])
def test_unknown_versions_name_both(product, version):
    with pytest.raises(SchemaVersionError) as caught:
        product_schema(product, version)
    assert version in str(caught.value)
    assert product_schema(product).version in str(caught.value)
    assert (caught.value.found, caught.value.product) == (version, product)
    with pytest.raises(SchemaVersionError, match="reads: none"):
        product_schema("constellations")


def test_the_newest_version_is_the_default(tmp_path, monkeypatch):
    content = json.loads((FOLDER / "pairs-1.0.0.json").read_text())
    for version in ("1.0.0", "1.9.0", "1.10.0"):
        changed = json.dumps({**content, "version": version})
        (tmp_path / f"pairs-{version}.json").write_text(changed)
    monkeypatch.setattr("starcat.storage.schema.resource_folder", lambda name: tmp_path)
    newest = product_schema.__wrapped__("pairs")
    assert newest.version == "1.10.0"
    assert product_schema.__wrapped__("pairs", "1.9.0").version == "1.9.0"


# The manifest -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def validator() -> Draft202012Validator:
    schema = json.loads(MANIFEST.read_text())
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


@pytest.fixture
def manifest(small_database: Path) -> dict[str, Any]:
    return copy.deepcopy(open_database_folder(small_database).manifest)


def test_a_built_manifest_follows_its_schema(validator, manifest):
    validator.validate(manifest)
    for part in manifest:
        assert not validator.is_valid({key: manifest[key] for key in manifest if key != part})
    assert json.loads(MANIFEST.read_text())["title"] == MANIFEST.stem
    for name, facts in manifest["products"].items():
        assert (FOLDER / f"{facts['schema']}.json").is_file()
        assert facts["schema"].rpartition("-")[0] == name
        assert facts["parquet"] in manifest["files"]


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("built_at",), "2026-01-01T00:00:00Z"),
        (("frame",), "FK5"),
        (("manifest_version",), "1.0"),
        (("version",), "1.0"),
        (("sources", 0, "kept"), -1),
        (("sources", 0, "role"), "guide"),
        (("sources", 0, "rejected", "double"), 0),
        (("sources", 0, "files", 0, "name"), "/home/me/sao.dat"),
        (("sources", 0, "files", 0, "sha256"), "0"),
        (("products", "stars", "rows"), 1.5),
        (("products", "stars", "schema"), "stars"),
        (("files", "/etc/passwd"), {"bytes": 1, "sha256": 64 * "0"}),
        (("files", "../up.parquet"), {"bytes": 1, "sha256": 64 * "0"}),
        (("software", "numpy"), 2),
    ],
    ids=str,
)
def test_other_manifests_are_refused(path, value, validator, manifest):
    place: Any = manifest
    for part in path[:-1]:
        place = place[part]
    place[path[-1]] = value
    assert not validator.is_valid(manifest)


# Released schemas: RELEASED.sha256 lists every one ---------------------------------------------


@pytest.fixture
def schemas(tmp_path: Path) -> Path:
    folder = tmp_path / "schemas"
    folder.mkdir()
    for name in ("stars-1.0.0.json", "pairs-1.0.0.json"):
        shutil.copy(FOLDER / name, folder)
    release(folder)
    return folder


def test_every_schema_is_released_and_none_changed_or_went():
    assert broken(FOLDER) == []
    assert list(digests(FOLDER).keys() - released(FOLDER).keys()) == [], "run 'make release'"


def test_the_list_is_one_that_sha256sum_checks(schemas: Path):
    if shutil.which("sha256sum") is None:
        pytest.skip("no sha256sum")
    subprocess.run(["sha256sum", "--check", "--strict", LIST_NAME], cwd=schemas, check=True)


def test_a_new_schema_is_appended(schemas: Path):
    before = (schemas / LIST_NAME).read_text()
    shutil.copy(schemas / "stars-1.0.0.json", schemas / "stars-1.1.0.json")
    assert release(schemas) == ["stars-1.1.0.json"]
    after = (schemas / LIST_NAME).read_text()
    assert after.startswith(before)
    assert len(after.splitlines()) == 3
    assert release(schemas) == []
    assert (schemas / LIST_NAME).read_text() == after


@pytest.mark.parametrize("damage", ["changed", "missing"])
def test_a_released_schema_is_not_released_again(damage: str, schemas: Path):
    before = (schemas / LIST_NAME).read_text()
    path = schemas / "pairs-1.0.0.json"
    if damage == "changed":
        path.write_text(path.read_text().replace("rad", "deg"))
    else:
        path.unlink()
    shutil.copy(schemas / "stars-1.0.0.json", schemas / "stars-1.1.0.json")
    assert [problem.split()[0] for problem in broken(schemas)] == ["pairs-1.0.0.json"]
    with pytest.raises(ValueError, match=f"pairs-1.0.0.json is released and {damage}"):
        release(schemas)
    assert (schemas / LIST_NAME).read_text() == before
