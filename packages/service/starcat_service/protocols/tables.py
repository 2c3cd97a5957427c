"""Descriptions of the tables that ADQL can query: schemas, tables, columns, keys, and TAP_SCHEMA.

TAP_SCHEMA consists of the tables that list all tables, made from the views of a session.

References
----------
TAP 1.1, section 4.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from starcat.errors import SchemaError
from starcat.query import Session, View, column_facts, facts_by_name, identifier
from starcat.ship.exchange import unit_text
from starcat.storage import DUCKDB_DATATYPES, write_parquet

if TYPE_CHECKING:
    import pyarrow as pa

_CASTS = {
    "TINYINT": "SMALLINT",
    "USMALLINT": "INTEGER",
    "UINTEGER": "BIGINT",
    "UBIGINT": "BIGINT",
    "HUGEINT": "BIGINT",
    "UHUGEINT": "BIGINT",
    "BIGNUM": "DOUBLE",
}
"""Types that other types become; any type that is not listed becomes a text."""

_LIST = re.compile(r"(.*)\[\d*\]")

_TIMES = ("DATE", "TIMESTAMP", "TIMESTAMP_S", "TIMESTAMP_MS", "TIMESTAMP_NS")
"""Types that are written as text in ISO 8601."""


@dataclass(frozen=True)
class TapColumn:
    """A column as TAP_SCHEMA and VOTable describe it."""

    name: str  # as in the table, without quotes
    # VOTable's name of the type, and the size if it is an array or a text; else empty.
    datatype: str = "double"
    arraysize: str = ""
    xtype: str = ""  # meaning of the values, as DALI names it; else empty
    # Empty if unknown.
    unit: str = ""
    ucd: str = ""
    description: str = ""
    # Whether a query by this column is fast, whether to look at it first, and whether a standard
    # defines it.
    is_indexed: bool = False
    is_principal: bool = False
    is_standard: bool = False

    @property
    def facts(self) -> dict[str, str]:
        """Its description in the metadata of an Arrow field."""
        texts = {
            "unit": self.unit,
            "ucd": self.ucd,
            "description": self.description,
            "xtype": self.xtype,
        }
        return {key: text for key, text in texts.items() if text}

    def named(self, name: str) -> TapColumn:
        """Return the same column under another name."""
        return replace(self, name=name)

    @classmethod
    def unknown(cls, name: str) -> TapColumn:
        """Return a column of which only the name is known: its suffix is its unit."""
        return cls(name, unit=column_facts(name, {}).get("unit", ""))


@dataclass(frozen=True)
class Key:
    """A reference of a table's column to a column of another table."""

    column: str  # the column that refers
    # Full name of the referenced table, and the column there.
    target: str
    target_column: str
    description: str = ""


@dataclass(frozen=True)
class TapTable:
    """A table."""

    # As in the session, without quotes.
    schema: str
    name: str
    columns: tuple[TapColumn, ...]
    description: str = ""
    keys: tuple[Key, ...] = ()  # references to other tables
    view: str = ""  # name of its view in a session if it differs; else empty


@dataclass(frozen=True)
class Schema:
    """A schema: the tables of a database, of a catalog, or of TAP itself."""

    name: str
    description: str
    tables: tuple[TapTable, ...]
    is_alias: bool = False  # whether its tables also belong to another schema


class Tables:
    """All tables that a query can name."""

    def __init__(self, schemas: tuple[Schema, ...]) -> None:
        self.schemas = schemas
        self._by_name = {(t.schema.lower(), t.name.lower()): t for t in self}

    def __iter__(self) -> Iterator[TapTable]:
        """Go through all tables."""
        for schema in self.schemas:
            yield from schema.tables

    def with_schema(self, schema: Schema) -> Tables:
        """Return these tables, and the tables of another schema."""
        return Tables((*self.schemas, schema))

    def subset(self, names: Sequence[str]) -> Tables:
        """Return some of the tables."""
        lower_names = {name.strip().replace('"', "").lower() for name in names}
        schemas = []
        for schema in self.schemas:
            kept = tuple(t for t in schema.tables if f"{t.schema}.{t.name}".lower() in lower_names)
            if kept:
                schemas.append(replace(schema, tables=kept))
        return Tables(tuple(schemas))

    def find(self, schema: str, name: str) -> TapTable | None:
        """Return a table."""
        if schema:
            return self._by_name.get((schema.lower(), name.lower()))
        named = [
            table
            for candidate in self.schemas
            for table in candidate.tables
            if not candidate.is_alias and table.name.lower() == name.lower()
        ]
        return named[0] if len(named) == 1 else None

    def names(self) -> list[str]:
        """Return the full names of all tables as ADQL writes them."""
        return [full_name(table) for table in self]


def full_name(table: TapTable) -> str:
    """Return the name of a table as ADQL writes it."""
    return f"{adql_name(table.schema)}.{adql_name(table.name)}"


def adql_name(name: str) -> str:
    """Return a name as ADQL writes it: in quotes if it is a keyword of ADQL or not a plain name."""
    from vo_models.adql.misc import ADQL_SQL_KEYWORDS

    is_plain = name.isascii() and name.isidentifier() and not name.startswith("_")
    if is_plain and name.upper() not in ADQL_SQL_KEYWORDS:
        return name
    return '"' + name.replace('"', '""') + '"'


def votable_type(kind: str) -> tuple[str, str, str]:
    """Return datatype, arraysize and xtype of VOTable for a type of DuckDB after `cast`.

    Examples
    --------
    >>> votable_type("INTEGER[]"), votable_type("DECIMAL(4,1)"), votable_type("DATE")
    (('int', '*', ''), ('double', '', ''), ('char', '*', 'timestamp'))
    """
    if kind in _TIMES:
        return "char", "*", "timestamp"
    plain = _plain(kind)
    name = DUCKDB_DATATYPES[plain.removesuffix("[]")]
    return name, "*" if plain.endswith("[]") or name == "unicodeChar" else "", ""


def cast(value: str, kind: str) -> str:
    """Return SQL of a value in a type that VOTable has."""
    plain = kind if kind in _TIMES else _plain(kind)
    return value if plain == kind else f"CAST({value} AS {plain})"


def _plain(kind: str) -> str:
    if kind in DUCKDB_DATATYPES:
        return kind
    if items := _LIST.fullmatch(kind):
        item = _plain(items[1])
        return "VARCHAR" if item == "VARCHAR" or item.endswith("[]") else f"{item}[]"
    return "DOUBLE" if kind.startswith("DECIMAL") else _CASTS.get(kind, "VARCHAR")


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
    """Return TAP_SCHEMA as it describes itself."""
    tables = tuple(
        TapTable(
            NAME,
            name,
            tuple(
                TapColumn(column, *kind, description=description, is_standard=True)
                for column, (kind, description) in columns.items()
            ),
            _ABOUT[name],
            _KEYS.get(name, ()),
            view=identifier(name),
        )
        for name, columns in _COLUMNS.items()
    )
    return Schema(NAME, "The tables that say which tables there are", tables)


def session_schemas(session: Session, about: Mapping[str, str]) -> tuple[Schema, ...]:
    """Return the schemas of the targets of a session: each under its own name and its alias."""
    schemas = []
    for target in session.targets:
        tables = tuple(_table(session, target.name, view) for view in target.views)
        description = about.get(target.name, "")
        schemas.append(Schema(target.name, description, tables))
        if target.alias:
            same = tuple(replace(table, schema=target.alias) for table in tables)
            description = f"The newest version: the tables of {target.name}. {description}"
            schemas.append(Schema(target.alias, description, same, is_alias=True))
    return tuple(sorted(schemas, key=lambda schema: schema.name))


def _table(session: Session, schema: str, view: View) -> TapTable:
    with session.ask(f'SELECT * FROM "{schema}"."{view.name}"') as asked:
        kinds = asked.columns
    view_facts = facts_by_name([view])
    first = view.schema.order[:1] if view.schema else ()
    columns = []
    for name, kind in kinds:
        facts = column_facts(name, view_facts)
        columns.append(
            TapColumn(
                name,
                *votable_type(kind),
                unit=_unit(name, facts.get("unit", "")),
                is_indexed=name in first,
                ucd=facts.get("ucd", ""),
                description=facts.get("description", ""),
                is_principal=name in (*first, *view.position, "mag", "designation"),
            )
        )
    return TapTable(
        schema, view.name, tuple(columns), view.schema.description if view.schema else ""
    )


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
        name = adql_name(schema.name)
        rows["schemas"].append(_row(schema, schema_name=name, schema_index=number))
        for table_number, table in enumerate(schema.tables):
            table_name = full_name(table)
            facts = {"schema_name": name, "table_name": table_name, "table_type": "table"}
            rows["tables"].append(_row(table, **facts, table_index=table_number))
            rows["columns"] += _column_rows(table)
            for key_number, key in enumerate(table.keys):
                named = {
                    "key_id": f"{table.schema}.{table.name}.{key_number}",
                    "from_column": key.column,
                }
                rows["keys"].append(
                    _row(key, **named, from_table=table_name, target_table=key.target)
                )
                rows["key_columns"].append(_row(key, **named))
    return rows


def _column_rows(table: TapTable) -> list[dict[str, object]]:
    return [
        _row(
            column,
            table_name=full_name(table),
            column_name=adql_name(column.name),
            indexed=int(column.is_indexed),
            principal=int(column.is_principal),
            std=int(column.is_standard),
            column_index=number,
        )
        for number, column in enumerate(table.columns)
    ]


def _row(about: Schema | TapTable | TapColumn | Key, **more: object) -> dict[str, object]:
    """Return a row; it has only the values for which the table has a column."""
    return {**{key: value or None for key, value in vars(about).items()}, **more}
