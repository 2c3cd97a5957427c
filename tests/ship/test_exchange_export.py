"""starcat export: files of every format, existing outputs, databases and Parquet files."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import pandas
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from folder_bytes import bytes_of

from starcat.database.reader import open_database_folder
from starcat.errors import ConfigError, OutputError
from starcat.ship.exchange.export import NamedTables, export_tables, tables_of
from starcat.ship.exchange.formats import EXPORT_FORMATS, FILE_FORMATS, FORMATS
from starcat.storage.schema import product_schema


@pytest.mark.parametrize("to", ["csv", "fits", "npz", "hats"])
def test_one_file_a_product(starcat, small_database, tmp_path, to):
    out = tmp_path / "out"
    ran = starcat(["export", small_database, "--format", to, "-o", out, "--json"])
    assert ran.code == 0, ran.err
    told = json.loads(ran.out)
    database = open_database_folder(small_database)
    products = ["rejected", "stars"] if to == "hats" else sorted(database.products)
    assert sorted(file["product"] for file in told["files"]) == products
    for file in told["files"]:
        rows = file["rows"] + file["left_out"]
        assert rows == database.manifest["products"][file["product"]]["rows"]
        path = out / file["name"]
        assert path.is_dir() if to == "hats" else file["bytes"] == path.stat().st_size
    others = {"columns.csv"} if to in ("csv", "npz") else set()
    assert {path.name for path in out.iterdir()} == others | {f["name"] for f in told["files"]}
    assert told["format"] == to
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    if others:  # the format has no units
        with (out / "columns.csv").open(newline="") as stream:
            names, *rows = csv.reader(stream)
        assert names == ["product", "column", "dtype", "unit", "description"]
        assert rows == [
            [product, column.name, column.dtype, column.unit, column.description]
            for product in database.products
            for column in database.schema(product).columns
        ]


def test_a_second_export_adds_to_the_columns(starcat, small_database, tmp_path):
    for product in ("stars", "pairs", "stars"):
        ran = starcat(["export", small_database, "--product", product, "-o", tmp_path])
        assert ran.code == 0, ran.err
    with (tmp_path / "columns.csv").open(newline="") as stream:
        rows = [(row["product"], row["column"]) for row in csv.DictReader(stream)]
    both = ((name, product_schema(name).columns) for name in ("stars", "pairs"))
    assert sorted(rows) == sorted((name, column.name) for name, known in both for column in known)


def test_what_is_there_stays_unless_it_may_be_replaced(starcat, small_database, tmp_path):
    command = ["export", small_database, "--format", "fits", "--product", "stars", "-o", tmp_path]
    (tmp_path / "notes.txt").write_text("mine")
    assert starcat(command).code == 0
    assert starcat(command).code == 0  # the same again is no conflict
    whole = bytes_of(tmp_path)
    (tmp_path / "stars.fits").write_text("another")
    refused = starcat(command)
    assert refused.code == 1
    assert "stars.fits already exists and differs" in refused.err
    assert (tmp_path / "stars.fits").read_text() == "another"
    assert starcat([*command, "--replace"]).code == 0
    assert bytes_of(tmp_path) == whole


def test_hats_replaces_a_hats_catalog_and_nothing_else(starcat, small_database, tmp_path):
    pytest.importorskip("cdshealpix")
    command = ["export", small_database, "--format", "hats", "--product", "stars", "-o", tmp_path]
    assert starcat(command).code == 0
    before = bytes_of(tmp_path)
    smaller = [*command, "--max-partition-rows", "20"]
    assert starcat(smaller).code == 1
    assert bytes_of(tmp_path) == before
    assert starcat([*smaller, "--replace"]).code == 0
    assert len(bytes_of(tmp_path)) > len(before)
    (tmp_path / "stars" / "notes.txt").write_text("mine")
    refused = starcat([*command, "--replace"])
    assert (refused.code, "did not write: notes.txt. Nothing" in refused.err) == (1, True)
    (tmp_path / "stars" / "notes.txt").unlink()
    (tmp_path / "stars" / "hats.properties").unlink()
    refused = starcat([*command, "--replace"])
    assert refused.code == 1
    assert "is something else" in refused.err


def test_rows_without_a_position_are_reported(starcat, tmp_path):
    pytest.importorskip("cdshealpix")
    table = pa.table({"star_id": [1, 2], "ra_deg": [5.0, None], "dec_deg": [5.0, None]})
    pq.write_table(table, tmp_path / "stars.parquet")
    stars, out = tmp_path / "stars.parquet", tmp_path / "out"
    ran = starcat(["export", stars, "--format", "hats", "-o", out])
    assert "stars: 1 row without a position left out" in ran.err
    assert ran.code == 0


def test_tables_without_stars_are_nothing_for_hats(tmp_path):
    tables = NamedTables("numbers", {"numbers": lambda: pa.table({"a": [1]})})
    with pytest.raises(ConfigError, match="no star table"):
        export_tables(tables, "hats", tmp_path / "out", products=None)


def test_what_people_and_pandas_see(starcat, small_database, tmp_path):
    ran = starcat(["export", small_database, "--product", "stars", "-o", tmp_path])
    assert "stars.csv" in ran.out
    assert "columns.csv describes the columns" in " ".join(ran.out.split())
    assert max(map(len, ran.out.splitlines())) <= 100
    read = pandas.read_csv(tmp_path / "stars.csv")
    stars = open_database_folder(small_database).table("stars")
    assert read["star_id"].tolist() == stars["star_id"].to_pylist()
    assert read["ra_deg"].tolist() == stars["ra_deg"].to_pylist()
    assert read["second_mag"].isna().tolist() == stars["second_mag"].is_null().to_pylist()


def test_every_format_has_a_name_of_its_own():
    names = [suffix for one in FILE_FORMATS for suffix in FORMATS[one].suffixes]
    assert len(names) == len(set(names))


def test_a_folder_that_cannot_be_made(small_database, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write there"):
        export_tables(tables_of(small_database), "csv", tmp_path / "file" / "out")


PAGE = Path(__file__).resolve().parents[2] / "docs" / "formats.md"


def test_the_examples_of_the_page_run(small_database, tmp_path, monkeypatch):
    examples = re.findall(r"```py\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    here = [example for example in examples if "lsdb" not in example]
    assert len(here) == len(examples) - 1 == 3
    tables, products = tables_of(small_database), ["stars", "neighbours", "boresights"]
    for to in ("fits", "votable", "csv", "npz", "parquet"):
        export_tables(tables, to, tmp_path / to, products=products)
    monkeypatch.chdir(tmp_path)
    for example in here:
        exec(example, {})


def test_the_page_lists_all_formats():
    listed = re.findall(r"^\| `(\w+)` \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(listed) == sorted(EXPORT_FORMATS)
