"""TAP_SCHEMA: the tables that say which tables there are, out of the views of a session.

References
----------
TAP 1.1, section 4.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from starcat.errors import SchemaError
from starcat.exchange.columns import unit_text
from starcat.query.names import identifier
from starcat.query.result import Facts, column_facts
from starcat.query.session import Session
from starcat.query.targets import View
from starcat.storage.parquet import write_parquet
from starcat.vo.tables import (
    Column,
    Key,
    Schema,
    Table,
    Tables,
    adql_name,
    full_name,
    is_time,
    votable_type,
)

if TYPE_CHECKING:
    import pyarrow as pa

NAME = "tap_schema"
UPLOADS = "tap_upload"

_TEXT = ("unicodeChar", "*")
_INT = ("int", "")

_COLUMNS: dict[str, dict[str, tuple[tuple[str, str], str]]] = {
    "schemas": {
        "schema_name": (_TEXT, "Name of the schema, as ADQL writes it"),
        "utype": (_TEXT, "Concept of a data model; empty here"),
        "description": (_TEXT, "What the schema holds"),
        "schema_index": (_INT, "Place in the list of schemas"),
    },
    "tables": {
        "schema_name": (_TEXT, "Schema of the table"),
        "table_name": (_TEXT, "Name of the table with its schema, as ADQL writes it"),
        "table_type": (_TEXT, "table or view"),
        "utype": (_TEXT, "Concept of a data model; empty here"),
        "description": (_TEXT, "What a row is"),
        "table_index": (_INT, "Place in the list of tables"),
    },
    "columns": {
        "table_name": (_TEXT, "Table of the column"),
        "column_name": (_TEXT, "Name of the column, as ADQL writes it"),
        "datatype": (_TEXT, "Type of the values, as VOTable calls it"),
        "arraysize": (_TEXT, "Size of arrays and texts, as VOTable writes it"),
        "xtype": (_TEXT, "What a value of that type means, as DALI calls it"),
        "size": (_INT, "Fixed length of a text, where it has one"),
        "description": (_TEXT, "Meaning of the column"),
        "utype": (_TEXT, "Concept of a data model; empty here"),
        "unit": (_TEXT, "Unit of the values, as VOUnit writes it"),
        "ucd": (_TEXT, "Unified content descriptor"),
        "indexed": (_INT, "1 where files tell which values they have, else 0"),
        "principal": (_INT, "1 for columns to look at first, else 0"),
        "std": (_INT, "1 for columns that a standard defines, else 0"),
        "column_index": (_INT, "Place in the table"),
    },
    "keys": {
        "key_id": (_TEXT, "Name of the reference"),
        "from_table": (_TEXT, "Table that refers"),
        "target_table": (_TEXT, "Table that is referred to"),
        "utype": (_TEXT, "Concept of a data model; empty here"),
        "description": (_TEXT, "What the reference means"),
    },
    "key_columns": {
        "key_id": (_TEXT, "Name of the reference"),
        "from_column": (_TEXT, "Column that refers"),
        "target_column": (_TEXT, "Column that is referred to"),
    },
}

_ABOUT = {
    "schemas": "The schemas that there are",
    "tables": "The tables that there are",
    "columns": "The columns of all tables",
    "keys": "References between tables",
    "key_columns": "The columns of these references",
}

_KEYS = {
    "tables": (Key("schema_name", f"{NAME}.schemas", "schema_name"),),
    "columns": (Key("table_name", f"{NAME}.tables", "table_name"),),
    "keys": (
        Key("from_table", f"{NAME}.tables", "table_name"),
        Key("target_table", f"{NAME}.tables", "table_name"),
    ),
    "key_columns": (Key("key_id", f"{NAME}.keys", "key_id"),),
}


def own_schema() -> Schema:
    """Return TAP_SCHEMA itself, as it says of itself."""
    tables = tuple(
        Table(
            NAME,
            name,
            tuple(
                Column(column, *kind, description=told, is_standard=True)
                for column, (kind, told) in columns.items()
            ),
            _ABOUT[name],
            _KEYS.get(name, ()),
            view=identifier(name),
        )
        for name, columns in _COLUMNS.items()
    )
    return Schema(NAME, "The tables that say which tables there are", tables)


def session_schemas(session: Session, about: Mapping[str, str]) -> tuple[Schema, ...]:
    """Return the schemas of the targets of a session."""
    return tuple(
        Schema(
            target.name,
            about.get(target.name, ""),
            tuple(_table(session, target.name, view) for view in target.views),
        )
        for target in session.targets
    )


def _table(session: Session, schema: str, view: View) -> Table:
    with session.ask(f'SELECT * FROM "{schema}"."{view.name}"') as asked:
        found = list(zip(asked.columns, asked.types, strict=True))
    known = {
        column.name: Facts(column.unit, column.description, column.ucd)
        for column in (view.schema.columns if view.schema else ())
    }
    first = view.schema.order[:1] if view.schema else ()
    position = view.position or ("ra_deg", "dec_deg")
    columns = []
    for name, kind in found:
        facts = known.get(name) or column_facts(name, {})
        columns.append(
            Column(
                name,
                *votable_type(kind),
                xtype="timestamp" if is_time(kind) else "",
                unit=_unit(name, facts.unit),
                ucd=facts.ucd,
                description=facts.description,
                is_indexed=name in first,
                is_principal=name in (*first, *position, "mag", "designation"),
            )
        )
    return Table(schema, view.name, tuple(columns), view.schema.description if view.schema else "")


def _unit(column: str, text: str) -> str:
    """Return a unit as VOTable writes it, which clients compare with answers."""
    try:
        return unit_text(column, text, "vounit") or ""
    except SchemaError:
        return ""


def write_tap_schema(tables: Tables, folder: Path) -> None:
    """Write the tables of TAP_SCHEMA as Parquet files."""
    import pyarrow as pa

    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in _rows(tables).items():
        write_parquet(
            pa.Table.from_pylist(rows, schema=_arrow_schema(name)), folder / f"{name}.parquet"
        )


def _arrow_schema(name: str) -> pa.Schema:
    import pyarrow as pa

    kinds = {_TEXT: pa.string(), _INT: pa.int32()}
    return pa.schema([(column, kinds[kind]) for column, (kind, _) in _COLUMNS[name].items()])


def _rows(tables: Tables) -> dict[str, list[dict[str, object]]]:
    rows: dict[str, list[dict[str, object]]] = {name: [] for name in _COLUMNS}
    for number, schema in enumerate(tables.schemas):
        row = {"schema_name": adql_name(schema.name), "description": schema.description or None}
        rows["schemas"].append({**row, "schema_index": number})
        for place, table in enumerate(schema.tables):
            rows["tables"].append(
                {
                    "schema_name": adql_name(schema.name),
                    "table_name": full_name(table),
                    "table_type": "table",
                    "description": table.description or None,
                    "table_index": place,
                }
            )
            rows["columns"] += _column_rows(table)
            for one, key in enumerate(table.keys):
                key_id = f"{table.schema}.{table.name}.{one}"
                rows["keys"].append(
                    {"key_id": key_id, "from_table": full_name(table), "target_table": key.target,
                     "description": key.description or None}
                )  # fmt: skip
                rows["key_columns"].append(
                    {"key_id": key_id, "from_column": key.column,
                     "target_column": key.target_column}
                )  # fmt: skip
    return rows


def _column_rows(table: Table) -> list[dict[str, object]]:
    return [
        {
            "table_name": full_name(table),
            "column_name": adql_name(column.name),
            "datatype": column.datatype,
            "arraysize": column.arraysize or None,
            "xtype": column.xtype or None,
            "description": column.description or None,
            "unit": column.unit or None,
            "ucd": column.ucd or None,
            "indexed": int(column.is_indexed),
            "principal": int(column.is_principal),
            "std": int(column.is_standard),
            "column_index": place,
        }
        for place, column in enumerate(table.columns)
    ]
