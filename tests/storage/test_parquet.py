"""Parquet files: what other programs see in them."""

from __future__ import annotations

import io
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import duckdb
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from starcat.database.reader import open_database_folder
from starcat.storage.parquet import VOTABLE_NAMESPACE, read_parquet, votable_xml, write_parquet
from starcat.storage.schema import product_schema


@pytest.fixture(scope="module")
def files(small_database: Path) -> list[Path]:
    return sorted(small_database.glob("*.parquet"))


def table() -> pa.Table:
    """A column of every type that a schema can have, with nulls and texts that are not ASCII."""
    return pa.table(
        {
            "flag": pa.array([True, None]),
            "number": pa.array([1, None], pa.int32()),
            "long": pa.array([1, None], pa.int64()),
            "single": pa.array([1.5, None], pa.float32()),
            "double": pa.array([1.5, None]),
            "text": pa.array(["α Cen", None]),
            "empty": pa.array([None, None], pa.string()),
            "list": pa.array([[1, 2], []], pa.list_(pa.int32())),
        }
    )


def test_what_is_written_is_read_and_has_the_same_bytes_again(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_parquet(table(), tmp_path / name)
        assert read_parquet(tmp_path / name).equals(table())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_duckdb_reads_a_whole_database(files: list[Path]) -> None:
    for path in files:
        counted = duckdb.sql(f"SELECT count(*) FROM '{path}'").fetchall()
        assert counted == [(pq.read_metadata(path).num_rows,)]
        pairs = duckdb.sql(f"SELECT key, value FROM parquet_kv_metadata('{path}')").fetchall()
        footer = dict(pairs)
        assert footer[b"IVOA.VOTable-Parquet.version"] == b"1.0"
        assert footer[b"starcat.schema"].startswith(path.stem.encode())
    everything = duckdb.sql(
        f"SELECT DISTINCT filename FROM read_parquet('{files[0].parent}/*.parquet', "
        "filename = true, union_by_name = true)"
    ).fetchall()
    assert sorted(name for (name,) in everything) == [str(path) for path in files]


def test_pandas_reads_every_product(files: list[Path]) -> None:
    """Values and nulls; pandas has no units, which stay in the file's metadata."""
    for path in files:
        found, expected = pd.read_parquet(path), pq.read_table(path)
        assert list(found.columns) == expected.column_names
        assert len(found) == expected.num_rows
        for name in found.columns:
            assert int(found[name].isna().sum()) == expected[name].null_count, (path.name, name)
        if path.stem == "stars":
            assert found["star_id"].tolist() == expected["star_id"].to_pylist()


def test_the_votable_is_one_without_data(files: list[Path]) -> None:
    """As VOParquet 1.0 asks: one TABLE whose FIELDs are the columns, in their order."""
    from astropy import units
    from astropy.io import votable

    for path in files:
        footer = pq.ParquetFile(path).metadata.metadata
        xml = footer[b"IVOA.VOTable-Parquet.content"]
        (described,) = votable.parse(io.BytesIO(xml), verify="exception").iter_tables()
        schema = open_database_folder(path.parent).schema(path.stem)
        assert [field.name for field in described.fields] == [c.name for c in schema.columns]
        for field, column in zip(described.fields, schema.columns, strict=True):
            assert (field.description or "").split() == column.description.split()
            assert (field.ucd or "") == column.ucd
            assert field.unit == (units.Unit(column.unit) if column.unit else None)
        root = ElementTree.fromstring(xml)
        assert root.find(f".//{{{VOTABLE_NAMESPACE}}}DATA") is None


def test_types_in_the_votable() -> None:
    root = ElementTree.fromstring(votable_xml(table()))
    fields = [dict(field.attrib) for field in root.iter(f"{{{VOTABLE_NAMESPACE}}}FIELD")]
    assert fields == [
        {"name": "flag", "datatype": "boolean"},
        {"name": "number", "datatype": "int"},
        {"name": "long", "datatype": "long"},
        {"name": "single", "datatype": "float"},
        {"name": "double", "datatype": "double"},
        {"name": "text", "datatype": "char", "arraysize": "5"},
        {"name": "empty", "datatype": "char", "arraysize": "1"},
        {"name": "list", "datatype": "int", "arraysize": "*"},
    ]


@pytest.mark.parametrize("form", ["parquet", "parquet.votable"])
def test_astropy_reads_units(form: str, files: list[Path]) -> None:
    from astropy.table import Table

    for path in files:
        found = Table.read(path, format=form)
        schema = product_schema(path.stem)
        assert len(found) == pq.read_metadata(path).num_rows
        for column in schema.columns:
            unit = found[column.name].unit
            assert (str(unit).replace(" ", "") if unit else "") == column.unit
            assert found[column.name].description.split() == column.description.split()
