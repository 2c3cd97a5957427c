"""Expressions of the columns of a table, checked and computed by DuckDB.

An expression is a single scalar expression of SQL: arithmetic, comparisons, CASE, and the functions
of `FUNCTIONS`. It cannot hold a query, an aggregate, or a function that varies between runs.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from starcat.errors import ConfigError, suggest

if TYPE_CHECKING:
    import duckdb

FUNCTIONS = (
    *("+", "-", "*", "/", "//", "%", "**", "^", "||", "~~", "!~~", "~~*", "!~~*"),
    *("abs", "sign", "round", "floor", "ceil", "trunc", "sqrt", "exp", "ln", "log10", "power"),
    *("pow", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "degrees", "radians", "pi"),
    *("greatest", "least", "nullif", "ifnull", "isnan", "lower", "upper", "trim", "left", "right"),
    *("substr", "length", "contains", "starts_with", "regexp_matches", "add_mags"),
)
"""Allowed functions; ``add_mags`` is the magnitude of the light of two or three bands."""

_CLASSES = {
    *("COLUMN_REF", "CONSTANT", "FUNCTION", "COMPARISON", "CONJUNCTION", "OPERATOR", "CASE"),
    *("CAST", "BETWEEN", "TYPE"),
}
_MACROS = """
CREATE MACRO add_mags(a, b) AS -2.5 * log10(pow(10.0, -0.4 * a) + pow(10.0, -0.4 * b)),
  (a, b, c) AS -2.5 * log10(pow(10.0, -0.4 * a) + pow(10.0, -0.4 * b) + pow(10.0, -0.4 * c))
"""
_SETTINGS = {
    "enable_external_access": False,
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    "python_enable_replacements": False,
    "threads": 1,
}


@cache
def _database() -> duckdb.DuckDBPyConnection:
    import duckdb

    connection = duckdb.connect(":memory:", config=dict(_SETTINGS))
    connection.execute(_MACROS)
    return connection


def columns_in(
    text: str, names: Sequence[str], key: str, where: str
) -> tuple[tuple[str, ...], bool]:
    """Return the columns that an expression names, and whether it is nothing but one of them."""
    if text in names:
        return (text,), True
    cursor = _database().cursor()
    [(tree,)] = cursor.execute("SELECT json_serialize_sql(?)", [_query(text)]).fetchall()
    try:
        return _columns(json.loads(tree), text, names, key, where)
    except RecursionError:
        raise _refused(key, text, "it is nested too deep", where) from None


def _columns(
    tree: dict[str, Any], text: str, names: Sequence[str], key: str, where: str
) -> tuple[tuple[str, ...], bool]:
    if tree.get("error"):
        message = str(tree["error_message"]).splitlines()[0]
        several = "Only SELECT" in message
        raise _refused(key, text, "it is more than one" if several else message, where)
    statements = tree["statements"]
    listed = statements[0]["node"].get("select_list", ())
    if len(statements) != 1 or len(listed) != 1:
        raise _refused(key, text, "it is more than one", where)
    named: dict[str, None] = {}
    for part in _parts(listed[0]):
        if part["class"] not in _CLASSES:
            raise _refused(key, text, f"{part['class'].lower()} is not allowed in one", where)
        function = part.get("function_name")
        if function is not None and function not in FUNCTIONS:
            hint = suggest(function, FUNCTIONS).strip() or f"there are {', '.join(FUNCTIONS[13:])}"
            raise _refused(key, text, f"there is no function {function}; {hint}", where)
        if part["class"] == "COLUMN_REF":
            named[_column(".".join(part["column_names"]), names, key, text, where)] = None
    return tuple(named), listed[0]["class"] == "COLUMN_REF"


def _column(name: str, columns: Sequence[str], key: str, text: str, where: str) -> str:
    same = [column for column in columns if column == name] or [
        column for column in columns if column.lower() == name.lower()
    ]
    if len(same) == 1:
        return same[0]
    whole = f" of {text!r}" if name != text else ""
    hint = suggest(name, columns)
    what = "is two columns" if same else "is no column"
    raise ConfigError(
        f"{name!r}{whole} {what} of {where}; {hint}it has {', '.join(columns[:40])}",
        where=key,
        key=key,
        value=text,
        hint="Names with other signs than letters, digits and _ stand in double quotes, texts in "
        "single ones",
    )


def _parts(part: Any) -> Iterator[dict[str, Any]]:
    if isinstance(part, dict):
        if "class" in part:
            yield part
        for child in part.values():
            yield from _parts(child)
    elif isinstance(part, list):
        for child in part:
            yield from _parts(child)


def _query(text: str) -> str:
    # A line end, so that a comment in the text ends before the bracket.
    return f"SELECT ({text}\n)"


def _refused(key: str, text: str, why: str, where: str) -> ConfigError:
    return ConfigError(
        f"{text!r} is neither a column of {where} nor an expression: {why}. Name a column, "
        'or write an expression such as "a - b" or "flag = \'D\'"',
        where=key,
        key=key,
        value=text,
    )


def evaluate_expression(
    text: str, columns: Mapping[str, pa.Array], count: int, key: str
) -> pa.Array:
    """Return the value of an expression, which was checked, for every row."""
    import duckdb

    cursor = _database().cursor()
    table = pa.table({**columns, "every row": pa.nulls(count)})
    try:
        cursor.register("given_rows", table)
        values = cursor.sql(f"{_query(text)} FROM given_rows").to_arrow_table().column(0)
    except duckdb.Error as error:
        raise ConfigError(
            f"{text!r} cannot be computed: {str(error).splitlines()[0]}",
            where=key,
            key=key,
            value=text,
        ) from error
    return values.combine_chunks()
