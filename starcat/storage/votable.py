"""The footer that makes a Parquet file a VOParquet 1.0 file, and one that astropy reads.

Units, meanings and UCDs of the columns go in as a VOTable without data, and again in the form
that astropy's own reader of Parquet looks for.
"""

from __future__ import annotations

import json
import re
from xml.etree import ElementTree

import pyarrow as pa
import pyarrow.compute as pc

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
"""The types that VOTable has words for; texts that are sure to be ASCII are ``char`` there."""

ARROW_DATATYPES = {arrow: name for name, arrow, _ in DATATYPES}
DUCKDB_DATATYPES = {duckdb: name for name, _, duckdb in DATATYPES}


def votable_metadata(table: pa.Table) -> dict[str, str]:
    """Return what makes a Parquet file a VOParquet file.

    References
    ----------
    VOParquet 1.0, IVOA Note, January 2025.
    """
    return {
        "IVOA.VOTable-Parquet.version": "1.0",
        "IVOA.VOTable-Parquet.content": votable_xml(table),
    }


def astropy_metadata(table: pa.Table) -> dict[str, str]:
    """Return what astropy's reader of Parquet looks for in the metadata of the schema."""
    columns = []
    for field in table.schema:
        known = {key: text for key, text in _facts(field).items() if key != "ucd"}
        columns.append({"name": field.name, "datatype": str(field.type), **known})
    # JSON is YAML, which is what astropy parses it as.
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
        # Parquet's texts are UTF-8, which VOParquet calls char.
        datatype = "char" if datatype == "unicodeChar" else datatype
        attributes = {"name": field.name, "datatype": datatype}
        if is_list or field.name in longest:
            # A reader makes room for texts by their longest one.
            attributes["arraysize"] = "*" if is_list else str(longest[field.name])
        if facts.get("unit"):
            # VOUnit writes powers with two stars.
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
