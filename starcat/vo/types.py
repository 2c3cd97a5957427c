"""Types of columns: those of DuckDB, and what VOTable and TAP_SCHEMA call them.

An answer has only types that VOTable has, and times, which are written as text; what is wider is
brought to the nearest that it has.
"""

from __future__ import annotations

import re

_SAME = {
    "BOOLEAN": "boolean",
    "UTINYINT": "unsignedByte",
    "SMALLINT": "short",
    "INTEGER": "int",
    "BIGINT": "long",
    "FLOAT": "float",
    "DOUBLE": "double",
    "VARCHAR": "unicodeChar",
}
"""Types of DuckDB that VOTable has."""

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
        return ("unicodeChar" if item == "VARCHAR" else _SAME[item]), "*"
    if kind in _TIMES:
        return "char", "*"
    name = _SAME[_plain(kind)]
    return name, "*" if kind == "VARCHAR" or name == "unicodeChar" else ""


def is_time(kind: str) -> bool:
    """Return whether a type of DuckDB is a time that is written as a text."""
    return kind in _TIMES


def cast(value: str, kind: str) -> str:
    """Return SQL of a value in a type that VOTable has."""
    found = _LIST.fullmatch(kind)
    if found:
        item = _plain(found[1])
        wanted = f"{item}[]" if item in _SAME and item != "VARCHAR" else "VARCHAR"
        return value if wanted == kind else f"CAST({value} AS {wanted})"
    if kind in _TIMES:
        return value
    plain = _plain(kind)
    return value if plain == kind else f"CAST({value} AS {plain})"


def _plain(kind: str) -> str:
    if kind in _SAME:
        return kind
    if kind.startswith("DECIMAL"):
        return "DOUBLE"
    return _CASTS.get(kind, "VARCHAR")
