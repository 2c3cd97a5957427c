"""The process that runs queries: a DuckDB in memory behind two pipes, with hard limits.

`starcat.query.engine` starts it, writes requests to its standard input and reads replies from its
standard output. It opens only the files of the views, loads no extension, and its settings are
locked before the first query. The operating system limits the resources that it takes
(`starcat.workers.confinement`), so that a single call of a function cannot take more either.
"""

from __future__ import annotations

import os
import re
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb

from starcat.errors import QueryError
from starcat.query.messages import Opening, too_large
from starcat.query.names import quoted_name
from starcat.query.statement import check_statement
from starcat.query.values import decoded, encoded_rows
from starcat.workers.channel import Channel
from starcat.workers.confinement import forbid_writing, limit_memory, limit_time
from starcat.workers.messages import ARROW, DONE, ERROR, PART, PROGRESS, error_content

if TYPE_CHECKING:
    import pyarrow as pa

ROWS_AT_ONCE = 1 << 12

WATCH_S = 0.2  # seconds between checks of a running query
NESTED_CALLS = 10_000  # recursion limit with which Python reads a syntax tree
BESIDE_BYTES = 512 << 20  # memory for Python, Arrow and the stacks of threads, without DuckDB
SCHEMA_KEY = "starcat.schema"

_ZONED = re.compile(r"TIMESTAMP\w* WITH TIME ZONE")
_ODD = re.compile(rf"{_ZONED.pattern}|\bINTERVAL\b")
"""Types that the Python client of DuckDB converts to other values, or cannot convert."""


def serve_queries() -> None:
    """Answer requests until there are no more."""
    channel = Channel()
    sys.setrecursionlimit(NESTED_CALLS)
    try:
        worker = QueryWorker(Opening(**channel.receive()), channel)
        while True:
            worker.answer(*channel.receive())
    except (EOFError, BrokenPipeError):
        # The other end is closed. Threads of a query that still runs are not waited for.
        os._exit(0)


class QueryWorker:
    """A DuckDB with the methods that a session calls."""

    def __init__(self, opening: Opening, channel: Channel) -> None:
        self._opening = opening
        self._channel = channel
        self._is_running = False
        self._reader: pa.RecordBatchReader | None = None
        self._streams: Iterator[bytes] = iter(())  # the rest of a batch of the reader
        self._macros: frozenset[str] = frozenset()
        self._numbers: dict[str, list[str]] = {}
        self._sql_by_word: dict[str, str] = {}  # runs before the first query with the word
        # Before DuckDB starts its threads.
        forbid_writing(except_in=Path(opening.spill))
        self._connection = duckdb.connect(":memory:", config=_settings(opening))
        # As part of the configuration DuckDB 2.0 shows the limit but does not keep it.
        limit = f"{round(1e9 * opening.disk_gb)}B"
        self._connection.execute(f"SET max_temp_directory_size = '{limit}'")
        limit_memory(int(opening.memory_gb * 1e9) + BESIDE_BYTES)
        threading.Thread(target=self._watch, daemon=True).start()

    def answer(self, name: str, time_s: float, arguments: list[Any]) -> None:
        """Answer a request; the arguments are as `starcat.query.values.encoded` writes them."""
        limit_time(max(1.0, time_s) * (os.cpu_count() or 1) + 1.0)
        self._is_running = True
        try:
            if name != "next_batch":
                self._let_go()
            found = getattr(self, name)(*map(decoded, arguments))
            kind = ARROW if isinstance(found, bytes) else DONE
        except Exception as error:
            kind, found = ERROR, _failure(error)
        with self._channel.sending:
            self._is_running = False
            self._channel.send(kind, found)

    def footer(self, path: str) -> tuple[str, dict[str, str]]:
        """Return the schema's name, or nothing, and the columns with their types from a footer."""
        # DuckDB fails in the middle of an answer where the name of a column is not UTF-8.
        self._connection.execute("SELECT max(name) FROM parquet_schema($path)", {"path": path})
        asked = "SELECT decode(value) FROM parquet_kv_metadata($path) WHERE key = encode($key)"
        values = {"path": path, "key": SCHEMA_KEY}
        found = self._connection.execute(asked, values).fetchall()
        self.look_at([path])
        columns = {str(one[0]): str(one[1]) for one in self._connection.description or ()}
        return (str(found[0][0]) if found else ""), columns

    def look_at(self, files: list[str]) -> None:
        """Read the columns of the Parquet files of a table, as a view would."""
        self._connection.execute(
            "FROM read_parquet($files, hive_partitioning = false) LIMIT 0", {"files": files}
        )

    def open(
        self,
        sql: str,
        folder: str,
        files: list[str],
        macros: list[str],
        numbers: dict[str, list[str]],
        sql_by_word: dict[str, str],
    ) -> None:
        """Make the views, and allow no other file and no other setting from here on.

        Views name their files from the folder on.
        """
        os.chdir(folder or os.sep)
        # A footer is read once, when a query first reaches its file.
        self._connection.execute("SET parquet_metadata_cache = true")
        self._connection.execute(sql)
        self._macros, self._numbers = frozenset(macros), numbers
        self._sql_by_word = sql_by_word
        # DuckDB keeps the progress, and the caller prints it. Times have the zone UTC everywhere.
        self._connection.execute(
            "SET enable_progress_bar = true; SET enable_progress_bar_print = false; "
            "SET TimeZone = 'UTC'"
        )
        self._connection.execute("SET allowed_paths = $files", {"files": files})
        self._connection.execute("SET enable_external_access = false")
        self._connection.execute("SET lock_configuration = true")

    def statements(self, text: str) -> list[str]:
        """Return the queries of a text; a text that is not SQL counts as a single query."""
        try:
            return [statement.query for statement in self._connection.extract_statements(text)]
        except duckdb.Error:
            return [text]

    def check(self, text: str) -> dict[str, Any]:
        """Return the checked statement of a text, for `Statement.from_json`."""
        self._prepare_for(text)
        return asdict(check_statement(text, self._connection, self._macros, self._numbers))

    def _prepare_for(self, text: str) -> None:
        """Make the views that a query needs and most queries do not."""
        for word in [word for word in self._sql_by_word if word in text.lower()]:
            self._connection.execute(self._sql_by_word.pop(word))

    def columns(self, text: str, values: dict[str, Any] | None) -> list[tuple[str, str]]:
        """Return names and types of the columns of a query."""
        self._prepare_for(text)
        bound = self._connection.sql(text, params=values)
        return [(name, str(kind)) for name, kind in zip(bound.columns, bound.types, strict=True)]

    def rows(
        self, text: str, values: dict[str, Any] | None, count: int, max_bytes: int | None = None
    ) -> list[tuple[str, str]]:
        """Send the first rows of a query in parts; return its columns."""
        self._prepare_for(text)
        running = self._connection.execute(text, values)
        columns = [(str(column[0]), str(column[1])) for column in running.description]
        zoned = [k for k, (_, kind) in enumerate(columns) if _ZONED.search(kind)]
        if any(_ODD.search(kind) for _, kind in columns):
            running = self._connection.execute(_without_odd_types(text, columns), values)
        size, types = 0, [kind for _, kind in columns]
        for part in _parts(running, count):
            for content in self._contents(_in_utc(part, zoned) if zoned else part, types):
                size += len(content)
                if max_bytes is not None and size > max_bytes:
                    raise too_large(max_bytes)
                self._channel.send(PART, content, more=True)
        self._connection.abort()
        return columns

    def _contents(self, rows: list[tuple[Any, ...]], types: list[str]) -> Iterator[bytes]:
        """Give rows as contents of messages."""
        if not rows:
            return
        content = encoded_rows(rows, types)
        if len(content) <= self._opening.message_bytes:
            yield content
        elif len(rows) == 1:
            raise too_large(self._opening.message_bytes)
        else:
            half = len(rows) // 2
            yield from self._contents(rows[:half], types)
            yield from self._contents(rows[half:], types)

    def batches(self, text: str, values: dict[str, Any] | None) -> bytes:
        """Begin to read all rows as Arrow batches; return their schema as an Arrow stream."""
        from starcat.query.arrow_stream import BATCH_ROWS, stream_of

        self._prepare_for(text)
        relation = self._connection.sql(text, params=values)
        self._reader = relation.to_arrow_reader(BATCH_ROWS)
        return stream_of(self._reader.schema)

    def next_batch(self) -> bytes | None:
        """Return the next rows as an Arrow stream; none at the end."""
        from starcat.query.arrow_stream import RowTooLarge, streams_of

        if self._reader is None:
            raise QueryError("rows were asked for after the end, or after another query")
        try:
            for stream in self._streams:
                return stream
            for batch in self._reader:
                self._streams = streams_of(batch, self._opening.message_bytes)
                for stream in self._streams:
                    return stream
        except RowTooLarge as error:
            raise too_large(self._opening.message_bytes) from error
        return None

    def _let_go(self) -> None:
        """Drop the rest of an answer, which DuckDB keeps open otherwise."""
        if self._reader is not None:
            self._reader.close()
            self._reader, self._streams = None, iter(())
        self._connection.abort()

    def _watch(self) -> None:
        """Send the progress of a query; end this process when its parent is gone."""
        while True:
            time.sleep(WATCH_S)
            if os.name == "posix" and os.getppid() != self._opening.parent:
                os._exit(1)
            with self._channel.sending:
                percent = self._connection.query_progress() if self._is_running else -1.0
                if percent >= 0.0:
                    try:
                        self._channel.send(PROGRESS, int(percent))
                    except OSError:  # the parent has ended since the check
                        os._exit(1)


def _settings(opening: Opening) -> dict[str, Any]:
    return {
        "memory_limit": f"{opening.memory_gb}GB",
        "temp_directory": opening.spill,
        "autoinstall_known_extensions": False,
        "autoload_known_extensions": False,
        "allow_community_extensions": False,
        "python_enable_replacements": False,
    }


def _parts(running: Any, count: int) -> Iterator[list[tuple[Any, ...]]]:
    left = count
    while left > 0:
        asked = min(left, ROWS_AT_ONCE)
        part = running.fetchmany(asked)
        yield part
        left = left - asked if len(part) == asked else 0


def _without_odd_types(text: str, columns: list[tuple[str, str]]) -> str:
    """Return a query whose times with a zone are times in UTC, or text if they are in lists.

    DuckDB makes them with a package that starcat does not need otherwise. Intervals are text too:
    DuckDB makes a timedelta of them, which has no months, so that a year would have 360 days.
    """
    chosen = []
    for k, (name, kind) in enumerate(columns, start=1):
        if _ZONED.fullmatch(kind):
            value = f"#{k} AT TIME ZONE 'UTC'"
        else:
            value = f"CAST(#{k} AS VARCHAR)" if _ODD.search(kind) else f"#{k}"
        chosen.append(f"{value} AS {quoted_name(name)}")
    return f"SELECT {', '.join(chosen)} FROM ({text})"


def _in_utc(rows: list[tuple[Any, ...]], zoned: list[int]) -> list[tuple[Any, ...]]:
    """Give times their zone; values that are not times, such as infinity, stay."""
    given = set(zoned)
    return [
        tuple(
            value.replace(tzinfo=UTC) if k in given and isinstance(value, datetime) else value
            for k, value in enumerate(row)
        )
        for row in rows
    ]


def _failure(error: Exception) -> dict[str, Any]:
    """Return an error as a reply; after ``is_last`` the process should answer nothing more."""
    words = str(error).strip() or type(error).__name__
    line = words.splitlines()[0]
    told, is_last = error, False
    if isinstance(error, (duckdb.OutOfMemoryException, MemoryError)) or words.startswith(
        ("Out of Memory", "std::bad_alloc", "malloc of size")
    ):
        told, is_last = MemoryError(words), True
    elif isinstance(error, duckdb.PermissionException):
        told = QueryError(f"refused: {line}; a query reads the named targets only")
    elif isinstance(error, (duckdb.InternalException, duckdb.FatalException)):
        told, is_last = QueryError(f"DuckDB failed: {line}"), True
    elif isinstance(error, duckdb.Error):
        told = QueryError(words)
    elif not isinstance(error, QueryError):
        told = QueryError(f"{type(error).__name__}: {words}")
    return {**error_content(told), "is_last": is_last}
