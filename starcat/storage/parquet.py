"""Parquet files for SQL, analysis and archives; one file per product.

The footer makes them VOParquet 1.0 files that astropy reads too. It has units, meanings and UCDs
of the columns twice: as a VOTable without data, and in the form that astropy's reader expects.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from xml.etree import ElementTree

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from starcat.storage.atomic import whole_file

ROW_GROUP_ROWS = 1 << 17
"""Fixed, because the bytes of a file depend on the size of row groups."""


def write_parquet(table: pa.Table, path: Path) -> None:
    """Write a table; the same table and library version give the same bytes."""
    with _writer(table, path) as writer:
        writer.write_table(table.replace_schema_metadata(None), row_group_size=ROW_GROUP_ROWS)


def write_parts(parts: Iterable[pa.Table], example: pa.Table, path: Path) -> None:
    """Write a table that is given in parts; the bytes do not depend on the division into parts."""
    waiting = example.schema.empty_table()
    groups = 0
    with _writer(example, path) as writer:
        for part in parts:
            waiting = pa.concat_tables([waiting, part.cast(example.schema)])
            while len(waiting) >= ROW_GROUP_ROWS:
                _write_group(writer, waiting.slice(0, ROW_GROUP_ROWS))
                waiting = waiting.slice(ROW_GROUP_ROWS)
                groups += 1
        if len(waiting) or not groups:
            _write_group(writer, waiting)


def _write_group(writer: pq.ParquetWriter, rows: pa.Table) -> None:
    """Write a row group; the division into pages depends only on its rows."""
    writer.write_table(rows.combine_chunks(), row_group_size=ROW_GROUP_ROWS)


def parquet_bytes(table: pa.Table) -> int:
    """Return the size of the file for a table."""
    counter = pa.MockOutputStream()
    with _writer(table, counter) as writer:
        writer.write_table(table.replace_schema_metadata(None), row_group_size=ROW_GROUP_ROWS)
    return int(counter.size())


@contextmanager
def _writer(table: pa.Table, path: Path | pa.NativeFile) -> Iterator[pq.ParquetWriter]:
    """Open a file for the rows of a table, and describe its columns in the footer."""
    floating = [field.name for field in table.schema if pa.types.is_floating(field.type)]
    # No dictionary for names: they differ in every row.
    dictionary = [
        field.name
        for field in table.schema
        if pa.types.is_string(field.type) and field.name != "designation"
    ]
    metadata = {**(table.schema.metadata or {}), **astropy_metadata(table)}
    with pq.ParquetWriter(
        path,
        table.schema.with_metadata(metadata),
        compression="zstd",
        compression_level=1,
        use_dictionary=dictionary or False,
        column_encoding=dict.fromkeys(floating, "BYTE_STREAM_SPLIT") or None,
        write_statistics=True,
    ) as writer:
        yield writer
        writer.add_key_value_metadata(votable_metadata(table))


def read_parquet(path: Path) -> pa.Table:
    """Read a whole Parquet file."""
    try:
        with pq.ParquetFile(path) as file:
            return file.read()
    except UnicodeDecodeError as error:  # damaged bytes in names of columns
        raise pa.ArrowInvalid(f"a name in it is not UTF-8: {error}") from error


def write_table(table: pa.Table, path: Path) -> None:
    """Write a table as a Parquet file."""
    with whole_file(path) as partial:
        write_parquet(table, partial)


VOTABLE_NAMESPACE = "http://www.ivoa.net/xml/VOTable/v1.3"
DATATYPES = (
    # VOTable, Arrow, DuckDB
    ("boolean", pa.bool_(), "BOOLEAN"),
    ("unsignedByte", pa.uint8(), "UTINYINT"),
    ("short", pa.int16(), "SMALLINT"),
    ("int", pa.int32(), "INTEGER"),
    ("long", pa.int64(), "BIGINT"),
    ("float", pa.float32(), "FLOAT"),
    ("double", pa.float64(), "DOUBLE"),
    ("unicodeChar", pa.string(), "VARCHAR"),
)
"""Types of VOTable, Arrow and DuckDB; in VOTable a text that is certainly ASCII is a ``char``."""

ARROW_DATATYPES = {arrow: name for name, arrow, _ in DATATYPES}
DUCKDB_DATATYPES = {duckdb: name for name, _, duckdb in DATATYPES}


def votable_metadata(table: pa.Table) -> dict[str, str]:
    """Return the metadata that make a Parquet file a VOParquet file.

    References
    ----------
    VOParquet 1.0, IVOA Note, January 2025.
    """
    return {
        "IVOA.VOTable-Parquet.version": "1.0",
        "IVOA.VOTable-Parquet.content": votable_xml(table),
    }


def astropy_metadata(table: pa.Table) -> dict[str, str]:
    """Return the metadata of the schema that astropy's Parquet reader expects."""
    columns = []
    for field in table.schema:
        facts = {key: text for key, text in _facts(field).items() if key != "ucd"}
        columns.append({"name": field.name, "datatype": str(field.type), **facts})
    # astropy parses it as YAML; JSON is valid YAML.
    header = {"table_meta_yaml": json.dumps({"datatype": columns}, sort_keys=True)}
    lengths = {f"table::len::{name}": str(n) for name, n in _longest_texts(table).items()}
    return {**header, **lengths}


def votable_xml(table: pa.Table) -> str:
    """Return a VOTable without data that describes the columns of a table."""
    root = ElementTree.Element("VOTABLE", {"version": "1.4", "xmlns": VOTABLE_NAMESPACE})
    fields = ElementTree.SubElement(ElementTree.SubElement(root, "RESOURCE"), "TABLE")
    longest = _longest_texts(table)
    for field in table.schema:
        facts = _facts(field)
        is_list = pa.types.is_list(field.type)
        datatype = ARROW_DATATYPES[field.type.value_type if is_list else field.type]
        # Texts in Parquet are UTF-8; VOParquet calls this char.
        datatype = "char" if datatype == "unicodeChar" else datatype
        attributes = {"name": field.name, "datatype": datatype}
        if is_list or field.name in longest:
            # Readers reserve memory for texts by the longest one.
            attributes["arraysize"] = "*" if is_list else str(longest[field.name])
        if facts.get("unit"):
            # In VOUnit a power is written with two asterisks.
            attributes["unit"] = re.sub(r"(?<=[a-z])(\d)", r"**\1", facts["unit"])
        if facts.get("ucd"):
            attributes["ucd"] = facts["ucd"]
        element = ElementTree.SubElement(fields, "FIELD", attributes)
        if facts.get("description"):
            ElementTree.SubElement(element, "DESCRIPTION").text = facts["description"]
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=False)


def _facts(field: pa.Field) -> dict[str, str]:
    return {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}


def _longest_texts(table: pa.Table) -> dict[str, int]:
    """Return the length of the longest text of each text column, at least 1."""
    return {
        field.name: pc.max(pc.utf8_length(table[field.name])).as_py() or 1
        for field in table.schema
        if pa.types.is_string(field.type)
    }
