"""Check of a query: one statement that only reads, and only the tables of its session.

DuckDB may open no other file (`starcat.query.locked_duckdb`), but it would let a COPY overwrite a
file that it may read, and it treats a COPY in a WITH as a SELECT. So DuckDB parses the text, every
part of the syntax tree must be of a kind that reads, and DuckDB writes the text that runs from that
tree. The user's text never runs: it does no harm if starcat and DuckDB disagree on where a comment
ends.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from starcat.errors import QueryError

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

POINTED_CHARACTERS = 200  # characters of a line with an error that are shown
READING_NODES = {"SELECT_NODE", "SET_OPERATION_NODE", "RECURSIVE_CTE_NODE", "CTE_NODE"}
"""Nodes of DuckDB's syntax tree that read; COPY_QUERY_NODE and the like write."""

MAX_DEPTH = 1000
"""Brackets within each other. DuckDB parses tens of thousands of them for half a minute."""

WRITING = ("insert", "update", "delete", "merge", "copy")
"""Words after WITH that begin a statement that writes."""

PIVOTING = ("PIVOT", "FROM", "WITH")
ALLOWED = ("SELECT", "VALUES", "(")
"""First words of queries that DuckDB can parse, unless there is a pivot without values in them."""

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
    "duckdb_tables",
    "duckdb_types",
    "duckdb_views",
    "parquet_file_metadata",
    "parquet_kv_metadata",
    "parquet_metadata",
    "parquet_schema",
    "pragma_version",
}
"""Functions of DuckDB that make rows or describe tables; they read only the files of views."""

REFUSED_FUNCTIONS = {
    "sleep_ms": "it only waits",
    "pg_sleep": "it only waits",
    "write_log": "a query only reads",
    "setseed": "a query only reads",
    "setval": "a query only reads",
    "nextval": "a query only reads",
    "currval": "a query only reads",
    "current_setting": "settings are the operator's",
    "getvariable": "variables are not the query's",
    "json_serialize_plan": "EXPLAIN shows how a query is answered",
    "stats": "EXPLAIN shows how a query is answered",
}
"""Functions that only take time, or change or show the session, and why each is refused."""

REFUSED_TABLES = {"pg_settings", "pragma_database_list", "duckdb_databases", "duckdb_logs"}
"""Tables of DuckDB that describe the machine and not the targets."""

EXPLAIN_FORMATS = {"default", "text", "json", "html", "graphviz", "yaml", "mermaid"}


@dataclass(frozen=True)
class Statement:
    """A query that may run."""

    # SQL that DuckDB wrote from the checked syntax tree, after EXPLAIN if the user wrote that.
    # Nothing else of the user's text runs.
    text: str
    is_description: bool = False  # true for a DESCRIBE, whose rows are columns
    # Schema and name of the view of a DESCRIBE; the schema is empty if it is not given.
    view: tuple[str, str] | None = None
    parameters: tuple[str, ...] = ()  # names of the $name in it
    # For a $name that has to be a number: the argument of a macro that it is given for.
    numbers: dict[str, str] = field(default_factory=dict)


def check_number(where: str, value: Any) -> None:
    """Refuse a text that is no number for an argument of a macro.

    DuckDB's own message lists dozens of functions that the user did not call.
    """
    try:
        float(value if isinstance(value, str) else 0.0)
    except ValueError:
        raise QueryError(
            f"{where} is {value!r}; expected a number. Angles are in degrees: 5h 35m are 83.75"
        ) from None


def check_statement(
    text: str,
    connection: DuckDBPyConnection,
    macros: frozenset[str] = frozenset(),
    numbers: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> Statement:
    """Check that a text is a single statement that reads, and return it as DuckDB rewrites it.

    ``macros`` are the macros that may stand after FROM. ``numbers`` are the arguments of macros
    that have to be numbers, by position, as `Macro.numbers` has them.
    """
    from duckdb import StatementType

    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise QueryError(
            f"character {error.start + 1} of the query is half a character",
            hint="write it in UTF-8",
        ) from error
    explain, read = _explained(text)
    tree = _checked_tree(read, connection, macros)
    [(written,)] = connection.execute("SELECT json_deserialize_sql(?)", [tree]).fetchall()
    # Check the rewritten text too, in case DuckDB parses it differently.
    _checked_tree(written, connection, macros)
    runs = explain + written
    kind = StatementType.EXPLAIN if explain else StatementType.SELECT
    if [statement.type for statement in connection.extract_statements(runs)] != [kind]:
        raise QueryError(
            f"DuckDB writes the query as {runs!r}, which is not one", hint="write it simpler"
        )
    statement = json.loads(tree)["statements"][0]
    source = statement["node"].get("from_table") or {}
    describes = source.get("type") == "SHOW_REF" and source.get("show_type") == "DESCRIBE"
    parameters = tuple(sorted(entry["key"] for entry in statement.get("named_param_map", ())))
    view = _described_view(source) if describes else None
    needed = _check_numbers(statement, numbers)
    return Statement(runs, describes and not explain, view, parameters, needed)


def _checked_tree(text: str, connection: DuckDBPyConnection, macros: frozenset[str]) -> str:
    """Return the syntax tree of a query as DuckDB writes it; every part of it reads."""
    serialized = _syntax_tree(text, connection)
    try:
        tree = json.loads(serialized)
        if len(tree["statements"]) != 1:
            raise QueryError(
                f"found {len(tree['statements'])} statements",
                hint='give one query, such as "SELECT count(*) FROM stars"',
            )
        for part in _parts(tree):
            _check_part(part, macros)
    except RecursionError as error:
        raise QueryError(
            "the query is nested too deeply to be checked",
            hint="write it with fewer parentheses or functions within each other",
        ) from error
    return serialized


def _described_view(source: dict[str, Any]) -> tuple[str, str] | None:
    """Return schema and name of the view that a DESCRIBE is about, if it is about one."""
    query = source.get("query") or {}
    table = query.get("from_table") or {}
    stars = [column["type"] for column in query.get("select_list", ())] == ["STAR"]
    if table.get("type") != "BASE_TABLE" or not stars:
        return None
    return str(table["schema_name"]), str(table["table_name"])


def _explained(text: str) -> tuple[str, str]:
    """Return EXPLAIN with its options as we write it, and the query after it."""
    words = _words(text)
    if not words or words[0][1] != "explain":
        return "", text
    if [word for _, word in words[1:2]] == ["analyze"]:
        return "EXPLAIN ANALYZE ", _text_from(text, words, 2)
    if len(words) < 3 or words[1][1] != "(" or words[2][1] not in ("analyze", "format"):
        return "EXPLAIN ", _text_from(text, words, 1)
    end = next((k for k, (_, word) in enumerate(words) if word == ")"), len(words))
    options = " ".join(word for _, word in words[2:end]).split(" , ")
    for option in options:
        name, _, value = option.partition(" ")
        if not (option == "analyze" or (name == "format" and value in EXPLAIN_FORMATS)):
            raise QueryError(
                f"EXPLAIN with {option!r}",
                hint=f"give ANALYZE, FORMAT with one of {', '.join(sorted(EXPLAIN_FORMATS))}, or "
                "both",
            )
    return f"EXPLAIN ({', '.join(options)}) ", _text_from(text, words, end + 1)


def _words(text: str) -> list[tuple[int, str]]:
    """Return the words of a text, with the bytes before each, as DuckDB divides it."""
    import duckdb

    data = text.encode()
    tokens = duckdb.tokenize(text)
    starts = [start for start, _ in tokens] + [len(data)]
    return [
        (start, data[start:end].decode(errors="replace").strip().lower())
        for (start, kind), end in zip(tokens, starts[1:], strict=True)
        if kind != duckdb.token_type.comment
    ]


def _text_from(text: str, words: Sequence[tuple[int, str]], number: int) -> str:
    return text.encode()[words[number][0] :].decode() if number < len(words) else ""


def _syntax_tree(text: str, connection: DuckDBPyConnection) -> str:
    words = _words(text)
    if not words:
        raise QueryError("the query is empty", hint='try "SELECT count(*) FROM stars"')
    _check_depth(word for _, word in words)
    if "\0" in text:
        raise QueryError(
            "the query has a character NUL, which SQL cannot hold", hint="leave it out"
        )
    [(serialized,)] = connection.execute("SELECT json_serialize_sql(?)", [text]).fetchall()
    # An error is a flat object; a tree may be too deep to be read.
    if not serialized.startswith('{"error":true'):
        return str(serialized)
    tree = json.loads(serialized)
    if tree["error_type"] == "not implemented":
        raise QueryError(_refusal(text))
    raise QueryError(f"no valid SQL: {tree['error_message']}{_pointer(text, tree)}")


def _check_depth(words: Iterable[str]) -> None:
    """Count brackets: a parser takes long for a statement that is nested deep."""
    depth = 0
    for word in words:
        depth += (word[:1] in ("(", "[", "{")) - (word[:1] in (")", "]", "}"))
        if depth > MAX_DEPTH:
            raise QueryError(
                f"the query has more than {MAX_DEPTH:,} brackets within each other",
                hint="write it with fewer",
            )


def _refusal(text: str) -> str:
    """Return the reason why a statement other than SELECT is refused."""
    words = [word for _, word in _words(text)]
    word = words[0][:24].upper()
    if word == "WITH" and "pivot" not in words:
        word = next((candidate for candidate in words if candidate in WRITING), words[0]).upper()
    if word in PIVOTING or (word in ALLOWED and "pivot" in words):
        return f"{word}: give the values of a pivot, as in PIVOT t ON band IN ('V', 'G') USING ..."
    return (
        f"{word} is refused: a query only reads. SELECT, FROM, WITH, VALUES, DESCRIBE, SHOW, "
        "SUMMARIZE and EXPLAIN are allowed"
    )


def _pointer(text: str, tree: Any) -> str:
    """Return the line of an error with a mark under the place."""
    position = tree.get("position")
    if position is None or not str(position).isdigit():
        return ""
    before = text.encode()[: int(position)].decode(errors="ignore")
    line = text.split("\n")[before.count("\n")]
    column = len(before) - (before.rfind("\n") + 1)
    start = max(0, column - POINTED_CHARACTERS // 2)
    return f"\n  {line[start : start + POINTED_CHARACTERS]}\n  {' ' * (column - start)}^"


def _parts(tree: Any) -> Iterator[dict[str, Any]]:
    """Give every node of a syntax tree."""
    remaining = [tree]
    while remaining:
        part = remaining.pop()
        if isinstance(part, dict):
            yield part
            remaining += part.values()
        elif isinstance(part, list):
            remaining += part


def _check_numbers(statement: Any, numbers: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Refuse texts for arguments that are numbers; return the $name for such arguments."""
    parameters = {}
    for part in _parts(statement):
        macro = str(part.get("function_name") or "").lower()
        if macro not in numbers:
            continue
        for k, argument in enumerate(part.get("arguments") or ()):
            name = argument["name"] or (numbers[macro][k] if k < len(numbers[macro]) else "")
            if name not in numbers[macro] or not name:
                continue
            where, value = f"{name} of {macro}()", argument["expression"]
            literal = value.get("literal") or {}
            if literal.get("kind") == "STRING":
                check_number(where, literal["text"])
            elif value.get("type") == "VALUE_PARAMETER":
                parameters[str(value["identifier"])] = where
    return parameters


def _check_part(part: dict[str, Any], macros: frozenset[str]) -> None:
    kind = str(part.get("type"))
    if kind.endswith("_NODE") and kind not in READING_NODES:
        word = kind.removesuffix("_NODE").removesuffix("_QUERY")
        raise QueryError(f"{word} is refused: a query only reads", hint="leave it out")
    called = str(part.get("function_name") or "").lower()
    if called in REFUSED_FUNCTIONS:
        raise QueryError(f"{called}() is refused: {REFUSED_FUNCTIONS[called]}", hint="leave it out")
    if kind == "BASE_TABLE" and str(part.get("table_name")).lower() in REFUSED_TABLES:
        raise QueryError(
            f"{part['table_name']} is refused: a query reads the named targets only",
            hint="SHOW TABLES lists what they have",
        )
    if kind == "TABLE_FUNCTION":
        name = str(part["function"].get("function_name") or "").lower()
        if name not in TABLE_FUNCTIONS | macros:
            raise QueryError(
                f"{name}() is refused: a query reads the named targets only. Name a file before "
                "the query to read it",
                hint="after FROM may stand tables, and the functions "
                f"{', '.join(sorted(TABLE_FUNCTIONS | macros))}",
            )
