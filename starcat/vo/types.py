"""Types of columns: those of DuckDB, and what VOTable and TAP_SCHEMA call them.

An answer has only types that VOTable has; what is wider is brought to the nearest that it has, and
times become texts as DALI writes them.
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
    "VARCHAR": "char",
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

TIME_FORMAT = "%Y-%m-%dT%H:%M:%S.%f"


def votable_type(kind: str) -> tuple[str, str]:
    """Return what VOTable calls a type of DuckDB after `cast`.

    Parameters
    ----------
    kind : str
        DuckDB's name.

    Returns
    -------
    tuple of str
        Datatype and arraysize; the second is empty for single numbers.

    Examples
    --------
    >>> votable_type("INTEGER[]"), votable_type("DECIMAL(4,1)"), votable_type("DATE")
    (('int', '*'), ('double', ''), ('char', '*'))
    """
    found = _LIST.fullmatch(kind)
    if found:
        item = _plain(found[1])
        return (_SAME[item], "*") if item in _SAME and item != "VARCHAR" else ("char", "*")
    name = _SAME[_plain(kind)]
    return name, "*" if name == "char" else ""


def cast(value: str, kind: str) -> str:
    """Return SQL of a value in a type that VOTable has.

    Parameters
    ----------
    value : str
        SQL of the value.
    kind : str
        DuckDB's name of its type.

    Returns
    -------
    str
        SQL; the same where the type need not change.
    """
    found = _LIST.fullmatch(kind)
    if found:
        item = _plain(found[1])
        wanted = f"{item}[]" if item in _SAME and item != "VARCHAR" else "VARCHAR"
        return value if wanted == kind else f"CAST({value} AS {wanted})"
    if kind in ("TIMESTAMP", "DATE") or kind.startswith("TIMESTAMP_"):
        shown = "%Y-%m-%d" if kind == "DATE" else TIME_FORMAT
        return f"strftime({value}, '{shown}')"
    plain = _plain(kind)
    return value if plain == kind else f"CAST({value} AS {plain})"


def _plain(kind: str) -> str:
    if kind in _SAME:
        return kind
    if kind.startswith("DECIMAL"):
        return "DOUBLE"
    return _CASTS.get(kind, "VARCHAR")
