"""What is known of tables that ADQL may ask: schemas, tables, columns and keys."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from starcat.query.result import column_facts
from starcat.storage.parquet import DUCKDB_DATATYPES

_CASTS = {
    "TINYINT": "SMALLINT",
    "USMALLINT": "INTEGER",
    "UINTEGER": "BIGINT",
    "UBIGINT": "BIGINT",
    "HUGEINT": "BIGINT",
    "UHUGEINT": "BIGINT",
    "BIGNUM": "DOUBLE",
}
"""What the others become; any that is not named becomes a text."""

_LIST = re.compile(r"(.*)\[\d*\]")

_TIMES = ("DATE", "TIMESTAMP", "TIMESTAMP_S", "TIMESTAMP_MS", "TIMESTAMP_NS")
"""What is written as a text of ISO 8601."""


@dataclass(frozen=True)
class Column:
    """A column as TAP_SCHEMA and VOTable describe it."""

    name: str  # as the table has it, without quotes
    # VOTable's name of the type, and the size where it is an array or a text; else empty.
    datatype: str = "double"
    arraysize: str = ""
    # Empty where there is none.
    unit: str = ""
    ucd: str = ""
    description: str = ""
    xtype: str = ""
    # Whether asking for it is fast, whether it is one to look at first, and whether a standard
    # defines it.
    is_indexed: bool = False
    is_principal: bool = False
    is_standard: bool = False

    @property
    def facts(self) -> dict[str, str]:
        """What the metadata of an Arrow field holds of it."""
        known = {
            "unit": self.unit,
            "ucd": self.ucd,
            "description": self.description,
            "xtype": self.xtype,
        }
        return {key: text for key, text in known.items() if text}

    def named(self, name: str) -> Column:
        """Return the same under another name."""
        return replace(self, name=name)

    @classmethod
    def unknown(cls, name: str) -> Column:
        """Return a column of which its name is known: the unit is that which it ends with."""
        return cls(name, unit=column_facts(name, {}).unit)


@dataclass(frozen=True)
class Key:
    """A reference of a table's column to that of another table."""

    column: str  # the column that refers
    # Full name of the table that it refers to, and the column there.
    target: str
    target_column: str
    description: str = ""


@dataclass(frozen=True)
class Table:
    """A table."""

    # As the session has them, without quotes.
    schema: str
    name: str
    columns: tuple[Column, ...]
    description: str = ""
    keys: tuple[Key, ...] = ()  # references to other tables
    view: str = ""  # name of its view in a session, where it has another; else empty


@dataclass(frozen=True)
class Schema:
    """A schema: the tables of a database, of a catalog, or those of TAP itself."""

    name: str
    description: str
    tables: tuple[Table, ...]


class Tables:
    """All tables that a query may name."""

    def __init__(self, schemas: tuple[Schema, ...]) -> None:
        self.schemas = schemas
        self._found = {(t.schema.lower(), t.name.lower()): t for t in self}

    def __iter__(self) -> Iterator[Table]:
        """Go through all tables."""
        for schema in self.schemas:
            yield from schema.tables

    def with_schema(self, schema: Schema) -> Tables:
        """Return these tables, and those of another schema."""
        return Tables((*self.schemas, schema))

    def chosen(self, names: Sequence[str]) -> Tables:
        """Return some of the tables."""
        wanted = {name.strip().replace('"', "").lower() for name in names}
        schemas = []
        for schema in self.schemas:
            kept = tuple(t for t in schema.tables if f"{t.schema}.{t.name}".lower() in wanted)
            if kept:
                schemas.append(replace(schema, tables=kept))
        return Tables(tuple(schemas))

    def find(self, schema: str, name: str) -> Table | None:
        """Return a table."""
        if schema:
            return self._found.get((schema.lower(), name.lower()))
        named = [table for (_, one), table in self._found.items() if one == name.lower()]
        return named[0] if len(named) == 1 else None

    def names(self) -> list[str]:
        """Return the full names of all tables as ADQL writes them."""
        return [full_name(table) for table in self]


def full_name(table: Table) -> str:
    """Return the name of a table as ADQL writes it.

    Examples
    --------
    >>> full_name(Table("_2mass", "stars", ()))
    '"_2mass".stars'
    """
    return f"{adql_name(table.schema)}.{adql_name(table.name)}"


def adql_name(name: str) -> str:
    """Return a name as ADQL writes it: in quotes where it is a word of ADQL, or no plain name."""
    from vo_models.adql.misc import ADQL_SQL_KEYWORDS

    is_plain = name.isascii() and name.isidentifier() and not name.startswith("_")
    if is_plain and name.upper() not in ADQL_SQL_KEYWORDS:
        return name
    return '"' + name.replace('"', '""') + '"'


def votable_type(kind: str) -> tuple[str, str]:
    """Return what VOTable calls a type of DuckDB after `cast`.

    Examples
    --------
    >>> votable_type("INTEGER[]"), votable_type("DECIMAL(4,1)"), votable_type("DATE")
    (('int', '*'), ('double', ''), ('char', '*'))
    """
    found = _LIST.fullmatch(kind)
    if found:
        item = _plain(found[1])
        return ("unicodeChar" if item == "VARCHAR" else DUCKDB_DATATYPES[item]), "*"
    if kind in _TIMES:
        return "char", "*"
    name = DUCKDB_DATATYPES[_plain(kind)]
    return name, "*" if kind == "VARCHAR" or name == "unicodeChar" else ""


def is_time(kind: str) -> bool:
    """Return whether a type of DuckDB is a time that is written as a text."""
    return kind in _TIMES


def cast(value: str, kind: str) -> str:
    """Return SQL of a value in a type that VOTable has."""
    found = _LIST.fullmatch(kind)
    if found:
        item = _plain(found[1])
        wanted = f"{item}[]" if item in DUCKDB_DATATYPES and item != "VARCHAR" else "VARCHAR"
        return value if wanted == kind else f"CAST({value} AS {wanted})"
    if kind in _TIMES:
        return value
    plain = _plain(kind)
    return value if plain == kind else f"CAST({value} AS {plain})"


def _plain(kind: str) -> str:
    if kind in DUCKDB_DATATYPES:
        return kind
    if kind.startswith("DECIMAL"):
        return "DOUBLE"
    return _CASTS.get(kind, "VARCHAR")
