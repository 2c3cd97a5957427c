"""Verification: a good database passes, and nothing that is done to one goes unnoticed."""

from __future__ import annotations

import json
import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import database_copies
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest

from starcat.database.manifest import DATABASE_NAME, MANIFEST_NAME
from starcat.database.products.layouts import LAYOUTS
from starcat.database.products.table import PRODUCTS
from starcat.database.reader import open_database_folder
from starcat.database.verify import Finding, check_database, verify
from starcat.database.writer import content_sha256
from starcat.errors import ProductError
from starcat.resources import resource_folder
from starcat.results import to_dict
from starcat.storage.atomic import json_bytes
from starcat.storage.parquet import read_parquet, write_parquet

SCHEMAS = resource_folder("schemas")

Change = Callable[[dict[str, Any]], object]


@pytest.fixture
def copy(database_copy: Path) -> Path:
    return database_copy


@pytest.fixture(scope="module")
def files(small_database: Path) -> list[str]:
    paths = (path for path in small_database.rglob("*") if path.is_file())
    return sorted(path.relative_to(small_database).as_posix() for path in paths)


def product_of(file: str) -> str:
    if file == DATABASE_NAME:
        return "database"
    return Path(file).stem if file.endswith(".parquet") else ""


def seal(folder: Path, change: Change = lambda manifest: None) -> None:
    """Make all digests right, also the digests of the contents, for any contents."""
    database = open_database_folder(folder)

    def contents(manifest: dict[str, Any]) -> None:
        for product, held in manifest["products"].items():
            before = database.manifest["files"][held["parquet"]]["sha256"]
            if manifest["files"][held["parquet"]]["sha256"] == before:
                continue
            table, schema = database.table(product), database.schema(product)
            held["rows"] = len(table)
            if table.column_names == [column.name for column in schema.columns]:
                held["content_sha256"] = content_sha256(table, schema)
        change(manifest)

    database_copies.seal(folder, contents)


def rewrite(folder: Path, product: str, change: Callable[[pa.Table], pa.Table]) -> None:
    """Change a product's Parquet file, with digests that are right again."""
    path = folder / f"{product}.parquet"
    write_parquet(change(read_parquet(path)), path)
    seal(folder)


def edit_database(folder: Path, change: Callable[[h5py.File], object]) -> None:
    with h5py.File(folder / DATABASE_NAME, "r+") as file:
        change(file)
    seal(folder)


def with_value(name: str, row: int, value: object) -> Callable[[pa.Table], pa.Table]:
    def change(table: pa.Table) -> pa.Table:
        values, field = table[name].to_pylist(), table.schema.field(name)
        values[row] = value
        place = table.schema.get_field_index(name)
        return table.set_column(place, field, pa.array(values, field.type))

    return change


def expect(folder: Path, file: str, product: str, words: str) -> tuple[Finding, ...]:
    """Check that verification finds a problem, and return all that it finds."""
    found = verify(folder).findings
    named = [f for f in found if (f.file, f.product) == (file, product)]
    assert any(words in f.problem for f in named), f"{words!r} is in none of {found}"
    return found


def test_every_index_that_is_written_is_named(small_database):
    """The table of indices is the file's own table, and contains no column."""
    database = open_database_folder(small_database)
    with h5py.File(small_database / DATABASE_NAME, "r") as file:
        for name in file:
            columns = set()
            for column in database.schema(name).columns:
                columns |= set(column.datasets)
            assert set(file[name]) - columns == set(PRODUCTS[name].layout.indices)
    schemas = {path.stem.partition("-")[0] for path in SCHEMAS.glob("*.json")}
    assert set(LAYOUTS) <= set(PRODUCTS) == schemas - {"manifest"}


# Whole and damaged files --------------------------------------------------------------------


def test_a_good_database_passes(small_database):
    found = verify(small_database)
    assert found.findings == ()
    assert found.checks > 60
    assert to_dict(found) == {
        "folder": str(small_database), "checks": found.checks, "findings": []
    }  # fmt: skip
    assert check_database(small_database).manifest["name"] == "small"


@pytest.mark.slow
def test_200_flipped_bytes_are_all_found(copy, files):
    """Some in every file, the places drawn at random; each is put back before the next."""
    generator = random.Random(200)
    drawn = [files[n % len(files)] for n in range(200)]
    for name in drawn:
        path = copy / name
        whole = path.read_bytes()
        place = generator.randrange(len(whole))
        data = bytearray(whole)
        data[place] ^= 1 << generator.randrange(8)
        path.write_bytes(data)
        found = verify(copy).findings
        path.write_bytes(whole)
        assert (name, product_of(name)) in {(f.file, f.product) for f in found}, (name, place)
        assert {f.file for f in found} == {name}, (name, place, found)
    assert verify(copy).findings == ()


SOME = (MANIFEST_NAME, DATABASE_NAME, "stars.parquet", "report/index.html")
"""One file of each kind."""


def emptied(path: Path) -> None:
    os.truncate(path, 0)


def halved(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


@pytest.mark.parametrize("damage", [emptied, halved, Path.unlink])
def test_every_damaged_file_is_found(damage, copy, files):
    for name in SOME:
        whole = (copy / name).read_bytes()
        damage(copy / name)
        found = verify(copy).findings
        (copy / name).write_bytes(whole)
        assert (name, product_of(name)) in {(f.file, f.product) for f in found}
        assert {f.file for f in found} == {name}
        assert damage is not Path.unlink or [f.problem[:7] for f in found] == ["missing"]
    assert verify(copy).findings == ()
    listed = [name for name in files if name != MANIFEST_NAME]
    for name in listed:
        damage(copy / name)
    found = verify(copy).findings
    assert {(f.file, f.product) for f in found} == {(name, product_of(name)) for name in listed}
    assert damage is not Path.unlink or all(f.problem.startswith("missing") for f in found)


@pytest.mark.parametrize("name", ["notes.txt", "report/late.json", "grid2.parquet", "link"])
def test_an_unlisted_file_is_found(name, copy):
    if name == "link":
        (copy / name).symlink_to(copy / "nowhere")
    else:
        (copy / name).write_bytes(b"{}")
    (finding,) = verify(copy).findings
    assert (finding.file, finding.problem) == (name, "not listed in the manifest")


def test_a_folder_in_place_of_a_file_is_found(copy):
    (copy / "pairs.parquet").unlink()
    (copy / "pairs.parquet").mkdir()
    expect(copy, "pairs.parquet", "pairs", "missing")


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_an_unreadable_file_is_found(copy):
    (copy / "pairs.parquet").chmod(0)
    expect(copy, "pairs.parquet", "pairs", "cannot be read: PermissionError")


def test_a_check_stops_with_the_first_problems(copy):
    for path in copy.glob("*.parquet"):
        os.truncate(path, 10)
    count = len(list(copy.glob("*.parquet")))
    with pytest.raises(
        ProductError, match=rf"boresights.parquet .*; and {count - 5} more"
    ) as error:
        check_database(copy)
    assert (error.value.product, error.value.path) == ("boresights", copy / "boresights.parquet")


# The manifest -------------------------------------------------------------------------------


def test_an_edited_manifest_is_found_by_its_own_digest(copy):
    manifest = json.loads((copy / MANIFEST_NAME).read_bytes())
    manifest["products"]["pairs"]["rows"] += 1
    (copy / MANIFEST_NAME).write_bytes(json_bytes(manifest))
    (finding,) = expect(copy, MANIFEST_NAME, "", "manifest_sha256 is not its digest")
    assert finding.product == ""


@pytest.mark.parametrize(
    "data",
    [b"", b"null", b"[]", b'"name"', b"{}", b'{"manifest_version": "1.0.0"}', b"\xff", b"[" * 9999],
    ids=range(8),
)
def test_a_manifest_of_something_else_is_found(data, copy):
    (copy / MANIFEST_NAME).write_bytes(data)
    expect(copy, MANIFEST_NAME, "", "")


@pytest.mark.parametrize("key", ["files", "products", "sources", "spec", "name"])
@pytest.mark.parametrize("value", [None, [], {"x": None}], ids=str)
def test_a_senseless_manifest_with_a_right_digest_is_found(key, value, copy):
    seal(copy, lambda manifest: manifest.update({key: value}))
    assert MANIFEST_NAME in {f.file for f in verify(copy).findings} or key == "files"
    assert verify(copy).findings


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m.update(manifest_version=1), "manifest_version is '1'"),
        (lambda m: m.pop("spec"), "no spec"),
        (lambda m: m["products"]["pairs"].pop("rows"), "no products.pairs.rows"),
        (lambda m: m["products"]["pairs"].update(rows=True), "products.pairs.rows is 'True'"),
        (lambda m: m["products"].update(pairs=[]), "products.pairs is no object"),
        (lambda m: m["sources"][0]["rejected"].update(x="1"), "sources[0].rejected.x is '1'"),
        (lambda m: m.update(sources={}), "sources is no list"),
        (lambda m: m["products"]["pairs"].update(parquet="../a"), "parquet is '../a'"),
        (lambda m: m["products"].update({"../a": m["products"]["pairs"]}), "products.../a.parquet"),
    ],
)
def test_a_manifest_of_another_shape_is_refused(change, words, copy):
    """Whoever opens the database hears it, before anything relies on it."""
    seal(copy, change)
    with pytest.raises(ProductError) as caught:
        open_database_folder(copy)
    assert words in str(caught.value)
    assert f"{MANIFEST_NAME}: not a starcat manifest (" in str(caught.value)


def test_newer_versions_are_named_with_the_known_ones(copy):
    seal(copy, lambda manifest: manifest["products"]["pairs"].update(schema="pairs-2.0.0"))
    expect(copy, "pairs.parquet", "pairs", "version 2.0.0 found; this starcat reads: 1.0.0")
    seal(copy, lambda manifest: manifest.update(manifest_version="2.0.0"))
    expect(copy, MANIFEST_NAME, "", "manifest version 2.0.0; this starcat reads 1.0.0")


def rename(new: str) -> Callable[[dict[str, Any]], object]:
    """Give the records that are too faint another reason."""

    def change(manifest: dict[str, Any]) -> None:
        rejected = manifest["sources"][0]["rejected"]
        rejected[new] = rejected.pop("too_faint")

    return change


@pytest.mark.parametrize(
    ("words", "change"),
    [
        ("rows read", lambda m: m["sources"][0].update(rows_read=601)),
        ("kept, but", lambda m: m["sources"][0].update(kept=600, rejected={})),
        ("in its files", lambda m: m["sources"][0]["files"][0].update(rows=5)),
        ("product rejected holds", rename("too_bright")),
        # No read limit counts any.
        ("'beyond_read_limit'", rename("beyond_read_limit")),
        ("the spec says 201", lambda m: m["spec"]["boresights"].update(count=201)),
        ("its spec says", lambda m: m.update(epoch_jyear=2000.0)),
        ("not among the files", lambda m: m["files"].pop("pairs.parquet")),
    ],
)
def test_counts_that_do_not_add_up(words, change, copy):
    seal(copy, change)
    expect(copy, MANIFEST_NAME, "", words)


# Products whose files are whole but whose content is not right -------------------------------


def taken(*first: int) -> Callable[[pa.Table], pa.Table]:
    return lambda table: table.take(pa.array([*first, *range(2, len(table))]))


def shifted(column: str) -> Callable[[pa.Table], pa.Table]:
    """Change a number in the first row by a little."""

    def change(table: pa.Table) -> pa.Table:
        value = table[column][0].as_py()
        return with_value(column, 0, value - 1e-9 * (1.0 + abs(value)))(table)

    return change


@pytest.mark.parametrize(
    ("product", "words", "change"),
    [
        ("pairs", "row 1 does not come after row 0", taken(1, 0)),
        ("triangles", "row 1 does not come after row 0", taken(0, 0, 1)),
        ("pairs", "j refers to rows", with_value("j", 5, 100_000)),
        ("pairs", "i refers to rows", with_value("i", 5, -1)),
        ("boresights", "brightest refers to rows", with_value("brightest", 5, [100_000])),
        ("stars", "is not a unit vector", shifted("x")),
        ("stars", "is not the direction of its ra_deg", shifted("ra_deg")),
        ("boresights", "is not the direction of its ra_deg", shifted("dec_deg")),
        ("pairs", "separation_rad of row 0 is not that of its stars", shifted("separation_rad")),
    ],
)
def test_a_product_whose_content_is_wrong(product, words, change, copy):
    rewrite(copy, product, change)
    found = expect(copy, f"{product}.parquet", product, words)
    if product in ("pairs", "triangles"):  # the database has no ra_deg, and no boresights
        assert (DATABASE_NAME, product) in {(f.file, f.product) for f in found}


def test_nulls_come_last_in_the_order(copy):
    rewrite(copy, "rejected", with_value("star_id", -1, None))
    assert verify(copy).findings == ()
    first = [("star_id", "ascending", "at_start")]
    rewrite(copy, "rejected", lambda table: table.take(pc.sort_indices(table, sort_keys=first)))
    expect(copy, "rejected.parquet", "rejected", "row 1 does not come after row 0")


def test_values_that_are_not_those_of_the_content_digest(copy):
    rewrite(copy, "stars", with_value("mag", 3, 9.0))
    seal(copy, lambda m: m["products"]["stars"].update(content_sha256="0" * 64))
    expect(copy, "stars.parquet", "stars", "not those of the manifest's content_sha256")
    expect(copy, DATABASE_NAME, "stars", "/stars/mag differs from the Parquet file")
    seal(copy, lambda m: m["products"]["stars"].update(rows=7))
    expect(copy, "stars.parquet", "stars", "rows; the manifest says 7")


@pytest.mark.parametrize(
    ("words", "change"),
    [
        ("columns differ", lambda t: t.drop_columns(["mag"])),
        ("says int64", lambda t: t.cast(pa.schema([*map(as_float, t.schema)]))),
        ("rows have no value", lambda t: t.set_column(
            1, pa.field("catalog", pa.string()), pa.nulls(len(t), pa.string()))),
    ],
)  # fmt: skip
def test_columns_that_break_the_schema(words, change, copy):
    path = copy / "stars.parquet"
    write_parquet(change(read_parquet(path)), path)
    database_copies.seal(copy)
    expect(copy, "stars.parquet", "stars", words)


def as_float(field: pa.Field) -> pa.Field:
    return pa.field(field.name, pa.float64()) if field.name == "star_id" else field


@pytest.mark.parametrize("name", ["pairs.parquet", "stars.parquet", DATABASE_NAME])
def test_rubbish_with_a_right_digest(name, copy):
    (copy / name).write_bytes(b"PAR1" + bytes(range(256)) + b"PAR1")
    database_copies.seal(copy)
    expect(copy, name, product_of(name), "cannot be read")


# The database -------------------------------------------------------------------------------


def put(place: str, row: int, value: float) -> Callable[[h5py.File], object]:
    return lambda file: file[place].__setitem__(row, value)


def attribute(place: str, name: str, value: object) -> Callable[[h5py.File], object]:
    return lambda file: file[place].attrs.__setitem__(name, value)


def replace(place: str, change: Callable[[Any], Any]) -> Callable[[h5py.File], object]:
    def run(file: h5py.File) -> None:
        values = change(file[place][()])
        del file[place]
        file[place] = values

    return run


def remove(place: str) -> Callable[[h5py.File], object]:
    return lambda file: file.__delitem__(place)


@pytest.mark.parametrize(
    ("product", "words", "change"),
    [
        ("pairs", "/pairs/i differs from the Parquet file", put("pairs/i", 3, 0)),
        ("pairs", "/pairs/i holds (31583,) int32; expected (31583,) uint16",
         replace("pairs/i", lambda v: v.astype("i4"))),
        ("pairs", "/pairs/j is missing", remove("pairs/j")),
        ("stars", "/stars/x holds (551,) float64; expected (552,)",
         replace("stars/x", lambda v: v[:-1])),
        ("pairs", "attribute units is 'deg'", attribute("pairs/separation_rad", "units", "deg")),
        ("pairs", "attribute description", attribute("pairs/i", "description", "a star")),
        ("pairs", "attribute rows is 3", attribute("pairs", "rows", 3)),
        ("stars", "attribute schema", attribute("stars", "schema", "stars-0.9.0")),
        ("database", "attribute name is 'other'", attribute("/", "name", "other")),
        ("database", "attribute layout_version", attribute("/", "layout_version", "9.0.0")),
        ("database", "group extra is not in the manifest", lambda f: f.create_group("extra")),
        ("database", "group pairs is missing", remove("pairs")),
        ("pairs", "kvector_counts[2] is 9", put("pairs/kvector_counts", 2, 9)),
        ("pairs", "is not ascending", put("pairs/kvector_counts", 2, 9)),
        ("pairs", "ends with 5", put("pairs/kvector_counts", -1, 5)),
        ("pairs", "entries for", replace("pairs/kvector_counts", lambda v: v[1:])),
        ("pairs", "/pairs/kvector_counts is missing", remove("pairs/kvector_counts")),
        ("pairs", "values lie on or below", attribute("pairs", "kvector_slope", 1e-3)),
        ("triangles", "values lie on or below", attribute("triangles", "kvector_intercept", 1e-3)),
        ("neighbours", "does not say where", put("neighbours/star_offsets", 1, 99)),
        ("neighbours", "does not ascend from 0", put("neighbours/lookup_offsets", 0, 1)),
        ("neighbours", "lookup_rows has rows -7", put("neighbours/lookup_rows", 0, -7)),
        ("neighbours", "does not ascend within its bin",
         replace("neighbours/lookup_rows", lambda v: v[::-1])),
        ("neighbours", "lookup_rows is missing", remove("neighbours/lookup_rows")),
        ("grid", "cells_values differs", put("grid/cells_values", 0, 0)),
    ],
)  # fmt: skip
def test_a_wrong_database(product, words, change, copy):
    edit_database(copy, change)
    expect(copy, DATABASE_NAME, product, words)


def test_an_empty_product_is_sound(copy):
    """No pair at all: an empty table, an empty K-vector."""
    empty = {"i": np.empty(0, "<u2"), "j": np.empty(0, "<u2"), "separation_rad": np.empty(0)}

    def change(file: h5py.File) -> None:
        for name, values in {**empty, "kvector_counts": np.empty(0, "<i4")}.items():
            kept = dict(file[f"pairs/{name}"].attrs)
            del file[f"pairs/{name}"]
            file[f"pairs/{name}"] = values
            file[f"pairs/{name}"].attrs.update(kept)
        file["pairs"].attrs["rows"] = 0

    rewrite(copy, "pairs", lambda table: table.slice(0, 0))
    edit_database(copy, change)
    assert verify(copy).findings == ()


# The command --------------------------------------------------------------------------------


def test_the_command_says_what_it_found(small_database, copy, starcat):
    ran = starcat(["verify", small_database])
    assert ran.code == 0
    assert "small-1.0.0: sound (" in ran.out
    os.truncate(copy / "pairs.parquet", 10)
    ran = starcat(["verify", copy])
    assert ran.code == 5
    assert "1 problem" in ran.out
    assert "pairs.parquet" in ran.out
    ran = starcat(["verify", copy, "--json"])
    assert ran.code == 5
    (finding,) = json.loads(ran.out)["findings"]
    assert (finding["file"], finding["product"]) == ("pairs.parquet", "pairs")
