"""A DuckDB that reads the files of some views, and can do nothing else.

It opens only the files of the views, loads no extension, and has a limit of memory and of disk. Its
settings are locked before the first query. A query of one call that takes much memory, such as
``repeat('x', 4000000000)``, can exceed the limit of memory: only the operating system can prevent
that.
"""

from __future__ import annotations

import re
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcat.errors import QueryError, QueryLimitError
from starcat.query.names import quoted_name
from starcat.query.statement import Statement, check_statement

if TYPE_CHECKING:
    import pyarrow as pa

ROWS_AT_ONCE = 1 << 12
BATCH_ROWS = 1 << 16  # rows that DuckDB puts into an Arrow batch
NESTED_CALLS = 10_000  # recursion limit with which Python reads a syntax tree
SCHEMA_KEY = "starcat.schema"

_ZONED = re.compile(r"TIMESTAMP\w* WITH TIME ZONE")
_ODD = re.compile(rf"{_ZONED.pattern}|\bINTERVAL\b")
"""Types that the Python client of DuckDB converts to other values, or cannot convert."""

_NO_VALUE = "Not implemented Error: Unable to transform python value"
_OUT_OF_MEMORY = ("Out of Memory", "std::bad_alloc", "malloc of size")
_nesting = threading.Lock()

Values = Mapping[str, Any] | None
"""Values of the parameters ``$name`` of a query."""

Columns = list[tuple[str, str]]
"""Names and DuckDB's types of columns."""

Rows = list[tuple[Any, ...]]


@dataclass(frozen=True)
class Views:
    """The views and macros of a DuckDB, and all that it may read."""

    sql: str  # makes them
    files: Sequence[str]  # the only files that are read from then on
    macros: Sequence[str] = ()  # names of the macros used after FROM
    # Arguments of macros that have to be numbers (`Macro.numbers`).
    numbers: Mapping[str, Sequence[str]] = field(default_factory=dict)
    # Runs before the first query that contains the word (lower case).
    sql_by_word: Mapping[str, str] = field(default_factory=dict)


class LockedDuckdb:
    """A DuckDB in memory, and the queries about its views; errors are DuckDB's own.

    `failure` returns the error for the user. Data that do not fit into memory are written to the
    folder ``spill``.
    """

    def __init__(self, spill: Path, memory_gb: float, disk_gb: float) -> None:
        import duckdb

        self._memory_gb, self._disk_gb = memory_gb, disk_gb
        self._reader: pa.RecordBatchReader | None = None
        self._macros: frozenset[str] = frozenset()
        self._numbers: Mapping[str, Sequence[str]] = {}
        self._sql_by_word: dict[str, str] = {}  # runs before the first query with the word
        self._connection = duckdb.connect(
            ":memory:",
            config={
                "memory_limit": f"{memory_gb}GB",
                "temp_directory": str(spill),
                "autoinstall_known_extensions": False,
                "autoload_known_extensions": False,
                "allow_community_extensions": False,
                "python_enable_replacements": False,
            },
        )
        # As part of the configuration DuckDB 2.0 shows the limit but does not keep it.
        self._connection.execute(f"SET max_temp_directory_size = '{round(1e9 * disk_gb)}B'")

    def footer(self, path: str) -> tuple[str, dict[str, str]]:
        """Return the schema's name, or nothing, and the columns with their types from a footer."""
        # DuckDB fails in the middle of an answer where the name of a column is not UTF-8.
        self._connection.execute("SELECT max(name) FROM parquet_schema($path)", {"path": path})
        asked = "SELECT decode(value) FROM parquet_kv_metadata($path) WHERE key = encode($key)"
        values = {"path": path, "key": SCHEMA_KEY}
        names = self._connection.execute(asked, values).fetchall()
        self.look_at([path])
        columns = {str(column[0]): str(column[1]) for column in self._connection.description or ()}
        return (str(names[0][0]) if names else ""), columns

    def look_at(self, files: Sequence[str]) -> None:
        """Read the columns of the Parquet files of a table, as a view would."""
        self._connection.execute(
            "FROM read_parquet($files, hive_partitioning = false) LIMIT 0", {"files": list(files)}
        )

    def open(self, views: Views) -> None:
        """Make views and macros; from here on allow no other file and no other setting."""
        # A footer is read once, when a query first reaches its file.
        self._connection.execute("SET parquet_metadata_cache = true")
        self._connection.execute(views.sql)
        self._macros, self._numbers = frozenset(views.macros), views.numbers
        self._sql_by_word = dict(views.sql_by_word)
        # DuckDB keeps the progress, and the caller prints it. Times have the zone UTC everywhere.
        self._connection.execute(
            "SET enable_progress_bar = true; SET enable_progress_bar_print = false; "
            "SET TimeZone = 'UTC'"
        )
        self._connection.execute("SET allowed_paths = $files", {"files": list(views.files)})
        self._connection.execute("SET enable_external_access = false")
        self._connection.execute("SET lock_configuration = true")

    def statements(self, text: str) -> list[str]:
        """Return the queries of a text; a text that is not SQL counts as a single query."""
        import duckdb

        try:
            return [statement.query for statement in self._connection.extract_statements(text)]
        except duckdb.Error:
            return [text]

    def check(self, text: str) -> Statement:
        """Check that a text is a query that may run."""
        self._prepare_for(text)
        with _deep_recursion():
            return check_statement(text, self._connection, self._macros, self._numbers)

    def columns(self, text: str, values: Values) -> Columns:
        """Return names and types of the columns of a query."""
        self._prepare_for(text)
        bound = self._connection.sql(text, params=_plain_values(values))
        return [(name, str(kind)) for name, kind in zip(bound.columns, bound.types, strict=True)]

    def rows(self, text: str, values: Values, count: int) -> tuple[Columns, Iterator[Rows]]:
        """Return the columns of a query, and its first rows in parts."""
        self._prepare_for(text)
        values = _plain_values(values)
        running = self._connection.execute(text, values)
        columns = [(str(column[0]), str(column[1])) for column in running.description]
        if any(_ODD.search(kind) for _, kind in columns):
            running = self._connection.execute(_without_odd_types(text, columns), values)
        return columns, self._parts(running, columns, count)

    def _parts(self, running: Any, columns: Columns, count: int) -> Iterator[Rows]:
        zoned = [k for k, (_, kind) in enumerate(columns) if _ZONED.search(kind)]
        remaining = count
        while remaining > 0:
            asked = min(remaining, ROWS_AT_ONCE)
            part = running.fetchmany(asked)
            yield _in_utc(part, zoned) if zoned else part
            remaining = remaining - asked if len(part) == asked else 0
        self._connection.abort()

    def reader(self, text: str, values: Values) -> pa.RecordBatchReader:
        """Begin to read all rows as Arrow batches, with `next_batch`."""
        self._prepare_for(text)
        asked = self._connection.sql(text, params=_plain_values(values))
        self._reader = asked.to_arrow_reader(BATCH_ROWS)
        return self._reader

    def next_batch(self, reader: pa.RecordBatchReader | None) -> pa.RecordBatch | None:
        """Return the next rows of a query; none at the end."""
        is_current = reader is self._reader
        if reader is None or not is_current:
            raise QueryError("rows were asked for after the end, or after another query")
        try:
            return reader.read_next_batch()
        except StopIteration:
            return None

    def let_go(self) -> None:
        """Drop the rest of an answer, which DuckDB keeps open otherwise."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None
        self._connection.abort()

    def percent(self) -> float:
        """Return how much of the running query is done, percent; negative if that is unknown."""
        return self._connection.query_progress()

    def interrupt(self) -> None:
        """Stop the running query; a call of a function that has begun is finished first."""
        self._connection.interrupt()

    def close(self) -> None:
        """Close it, and free its memory."""
        self._connection.close()

    def failure(self, error: Exception) -> tuple[QueryError, bool]:
        """Return the error for the user, and whether this DuckDB should answer nothing more."""
        import duckdb

        words = str(error).strip() or type(error).__name__
        line = words.splitlines()[0]
        if isinstance(error, QueryError):
            return error, False
        if isinstance(error, duckdb.OutOfMemoryException | MemoryError) or words.startswith(
            _OUT_OF_MEMORY
        ):
            limit = QueryLimitError(
                f"the query needs more than {self._memory_gb:g} GB of memory and "
                f"{self._disk_gb:g} GB of disk",
                hint=("ask for less", "allow more with {memory_limit_gb}"),
            )
            return limit, True
        if isinstance(error, duckdb.PermissionException):
            return QueryError(f"refused: {line}; a query reads the named targets only"), False
        if isinstance(error, duckdb.InternalException | duckdb.FatalException):
            return QueryError(f"DuckDB failed: {line}"), True
        if words.startswith(_NO_VALUE):
            return QueryError(f"a value of the query cannot be passed on: {line}"), False
        if isinstance(error, duckdb.Error):
            return QueryError(words), False
        return QueryError(words, where=type(error).__name__), False

    def _prepare_for(self, text: str) -> None:
        """Make the views that a query needs and most queries do not."""
        for word in [word for word in self._sql_by_word if word in text.lower()]:
            self._connection.execute(self._sql_by_word.pop(word))


def plain_value(value: Any) -> Any:
    """Return a value of numpy as one of Python; any other value stays."""
    if type(value).__module__.partition(".")[0] != "numpy":
        return value
    if type(value).__name__ == "datetime64":
        nanoseconds = "[ns]" in str(value.dtype)
        return (value.astype("datetime64[us]") if nanoseconds else value).item()
    return value.tolist()


def _plain_values(values: Values) -> Values:
    return None if values is None else {name: plain_value(value) for name, value in values.items()}


@contextmanager
def _deep_recursion() -> Iterator[None]:
    """Let Python read a syntax tree that is nested deep."""
    with _nesting:
        before = sys.getrecursionlimit()
        sys.setrecursionlimit(max(before, NESTED_CALLS))
        try:
            yield
        finally:
            sys.setrecursionlimit(before)


def _without_odd_types(text: str, columns: Columns) -> str:
    """Return a query whose times with a zone are times in UTC, or text if they are in lists.

    DuckDB makes them with a package that starcat does not need otherwise. Intervals are text too:
    DuckDB makes a timedelta of them, which has no months, so that a year would have 360 days.
    """
    expressions = []
    for k, (name, kind) in enumerate(columns, start=1):
        if _ZONED.fullmatch(kind):
            value = f"#{k} AT TIME ZONE 'UTC'"
        else:
            value = f"CAST(#{k} AS VARCHAR)" if _ODD.search(kind) else f"#{k}"
        expressions.append(f"{value} AS {quoted_name(name)}")
    return f"SELECT {', '.join(expressions)} FROM ({text})"


def _in_utc(rows: Rows, zoned: Sequence[int]) -> Rows:
    """Give times their zone; values that are not times, such as infinity, stay."""
    columns = set(zoned)
    return [
        tuple(
            value.replace(tzinfo=UTC) if k in columns and isinstance(value, datetime) else value
            for k, value in enumerate(row)
        )
        for row in rows
    ]
