"""What a query may say: one statement that only reads, and only what was named.

DuckDB is told to open no other file (`starcat.query.session`), but a COPY over a file that it
may read would be within its rights, and DuckDB takes a COPY in a WITH for a SELECT. So the
statement is parsed first, and every part of it has to be of a kind that reads.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from starcat.errors import QueryError

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

READING_NODES = {"SELECT_NODE", "SET_OPERATION_NODE", "RECURSIVE_CTE_NODE", "CTE_NODE"}
"""Nodes of DuckDB's syntax tree that read; COPY_QUERY_NODE and the like write."""

TABLE_FUNCTIONS = {
    "range",
    "generate_series",
    "unnest",
    "json_each",
    "json_tree",
    "repeat",
    "repeat_row",
    "histogram",
    "histogram_values",
    "duckdb_columns",
    "duckdb_functions",
    "duckdb_schemas",
    "duckdb_settings",
    "duckdb_tables",
    "duckdb_types",
    "duckdb_views",
    "parquet_file_metadata",
    "parquet_kv_metadata",
    "parquet_metadata",
    "parquet_schema",
    "pragma_version",
}
"""Those of DuckDB that make rows or tell about tables. None reads a file that a view does not."""

_EXPLAIN = re.compile(r"explain\b", re.IGNORECASE)
_EXPLAIN_OPTIONS = re.compile(r"analyze\b|\([^)]*\)", re.IGNORECASE)
_COMMENT = re.compile(r"\s*(?:--[^\n]*(?:\n|$)|/\*.*?\*/)", re.DOTALL)


@dataclass(frozen=True)
class Statement:
    """A query that may run.

    Attributes
    ----------
    text : str
        As it was given, without comments before it.
    is_description : bool
        Whether it is a DESCRIBE, whose rows are columns.
    parameters : tuple of str
        Names of the ``$name`` in it.
    """

    text: str
    is_description: bool = False
    parameters: tuple[str, ...] = ()


def check_statement(
    text: str, connection: DuckDBPyConnection, macros: frozenset[str] = frozenset()
) -> Statement:
    """Check that a text is one statement that reads.

    Parameters
    ----------
    text : str
        SQL: SELECT, FROM, WITH, VALUES, DESCRIBE, SHOW, SUMMARIZE or EXPLAIN of one.
    connection : duckdb.DuckDBPyConnection
        Parses it.
    macros : frozenset of str
        Table macros of starcat, allowed after FROM as views are.

    Returns
    -------
    Statement
        What is known of it.

    Raises
    ------
    QueryError
        If it is no SQL, more than one statement, or does more than read.
    """
    text = _without_comments_before(text)
    read = _explained(text)
    tree = _syntax_tree(read, connection)
    if len(tree["statements"]) != 1:
        raise QueryError(
            f"found {len(tree['statements'])} statements; give one query, such as "
            '"SELECT count(*) FROM stars"'
        )
    for part in _parts(tree):
        _check_part(part, macros)
    statement = tree["statements"][0]
    source = statement["node"].get("from_table") or {}
    describes = source.get("type") == "SHOW_REF" and source.get("show_type") == "DESCRIBE"
    parameters = tuple(sorted(entry["key"] for entry in statement.get("named_param_map", ())))
    return Statement(text, describes and read == text, parameters)


def _explained(text: str) -> str:
    """Return the query after EXPLAIN and its options, or the text where it has none."""
    word = _EXPLAIN.match(text)
    if not word:
        return text
    rest = _without_comments_before(text[word.end() :])
    options = _EXPLAIN_OPTIONS.match(rest)
    return _without_comments_before(rest[options.end() :]) if options else rest


def _without_comments_before(text: str) -> str:
    while comment := _COMMENT.match(text):
        text = text[comment.end() :]
    return text.strip()


def _syntax_tree(text: str, connection: DuckDBPyConnection) -> Any:
    if not text:
        raise QueryError('the query is empty; try "SELECT count(*) FROM stars"')
    [(found,)] = connection.execute("SELECT json_serialize_sql(?)", [text]).fetchall()
    tree = json.loads(found)
    if not tree["error"]:
        return tree
    if tree["error_type"] == "not implemented":
        raise QueryError(_refusal(text))
    raise QueryError(f"no valid SQL: {tree['error_message']}{_pointer(text, tree)}")


def _refusal(text: str) -> str:
    """Return why a statement that is no SELECT is refused."""
    word = (re.match(r"\w+", text) or [text[:12]])[0].upper()
    if word in ("PIVOT", "FROM", "WITH"):
        return f"{word}: give the values of a pivot, as in PIVOT t ON band IN ('V', 'G') USING ..."
    return (
        f"{word} is refused: a query only reads. SELECT, FROM, WITH, VALUES, DESCRIBE, SHOW, "
        "SUMMARIZE and EXPLAIN are allowed; -o writes the answer to a file"
    )


def _pointer(text: str, tree: Any) -> str:
    """Return the line of an error with a mark under the place."""
    position = tree.get("position")
    if position is None or not str(position).isdigit():
        return ""
    before = text[: int(position)]
    line = text.splitlines()[before.count("\n")]
    column = len(before) - (before.rfind("\n") + 1)
    return f"\n  {line}\n  {' ' * column}^"


def _parts(tree: Any) -> Iterator[dict[str, Any]]:
    """Give every node of a syntax tree."""
    if isinstance(tree, dict):
        yield tree
        for value in tree.values():
            yield from _parts(value)
    elif isinstance(tree, list):
        for value in tree:
            yield from _parts(value)


def _check_part(part: dict[str, Any], macros: frozenset[str]) -> None:
    kind = str(part.get("type"))
    if kind.endswith("_NODE") and kind not in READING_NODES:
        word = kind.removesuffix("_NODE").removesuffix("_QUERY")
        raise QueryError(f"{word} is refused: a query only reads; -o writes the answer to a file")
    if kind == "TABLE_FUNCTION":
        name = str(part["function"].get("function_name") or "").lower()
        if name not in TABLE_FUNCTIONS | macros:
            raise QueryError(
                f"{name}() is refused: a query reads the named targets only. Name a file before "
                "the query to read it; 'starcat sql --macros' lists what may stand after FROM"
            )
