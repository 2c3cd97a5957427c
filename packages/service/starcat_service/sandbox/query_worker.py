"""The process that runs queries: a `LockedDuckdb` behind two pipes, with hard limits.

`starcat_service.sandbox.query_engine` starts it, writes requests to its standard input and reads
replies from its standard output. The operating system limits the resources that it takes
(`starcat_service.sandbox.confinement`), so that a single call of a function cannot take more
either.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcat.query import Columns, LockedDuckdb, Rows, Views
from starcat_service.sandbox.channel import Channel
from starcat_service.sandbox.confinement import forbid_writing, limit_memory, limit_time
from starcat_service.sandbox.messages import ARROW, DONE, ERROR, PART, PROGRESS, error_content
from starcat_service.sandbox.query_messages import Opening, too_large
from starcat_service.sandbox.query_values import decoded, encoded_rows

if TYPE_CHECKING:
    import pyarrow as pa

WATCH_S = 0.2  # seconds between checks of a running query
BESIDE_BYTES = 512 << 20  # memory for Python, Arrow and the stacks of threads, without DuckDB


def serve_queries() -> None:
    """Answer requests until there are no more."""
    channel = Channel()
    try:
        worker = QueryWorker(Opening(**channel.receive()), channel)
        while True:
            worker.answer(*channel.receive())
    except (EOFError, BrokenPipeError):
        # The other end is closed. Threads of a query that still runs are not waited for.
        os._exit(0)


class QueryWorker:
    """A DuckDB with the methods that the server calls."""

    def __init__(self, opening: Opening, channel: Channel) -> None:
        self._opening = opening
        self._channel = channel
        self._is_running = False
        self._reader: pa.RecordBatchReader | None = None
        self._streams: Iterator[bytes] = iter(())  # the rest of a batch of the reader
        # Before DuckDB starts its threads.
        forbid_writing(except_in=Path(opening.spill))
        self._duckdb = LockedDuckdb(Path(opening.spill), opening.memory_gb, opening.disk_gb)
        self.statements, self.columns = self._duckdb.statements, self._duckdb.columns
        self.footer, self.look_at = self._duckdb.footer, self._duckdb.look_at
        limit_memory(int(opening.memory_gb * 1e9) + BESIDE_BYTES)
        threading.Thread(target=self._watch, daemon=True).start()

    def answer(self, name: str, time_s: float, arguments: list[Any]) -> None:
        """Answer a request; the arguments are as `query_values.encoded` writes them."""
        limit_time(max(1.0, time_s) * (os.cpu_count() or 1) + 1.0)
        self._is_running = True
        try:
            if name != "next_batch":
                self._streams, self._reader = iter(()), None
                self._duckdb.let_go()
            answer = getattr(self, name)(*map(decoded, arguments))
            kind = ARROW if isinstance(answer, bytes) else DONE
        except Exception as error:
            failure, is_last = self._duckdb.failure(error)
            kind, answer = ERROR, {**error_content(failure), "is_last": is_last}
        with self._channel.sending:
            self._is_running = False
            self._channel.send(kind, answer)

    def open(self, folder: str, views: dict[str, Any]) -> None:
        """Make the views, which name their files from the folder on."""
        os.chdir(folder or os.sep)
        self._duckdb.open(Views(**views))

    def check(self, text: str) -> dict[str, Any]:
        """Return the checked statement of a text, for `query_messages.read_statement`."""
        return asdict(self._duckdb.check(text))

    def rows(
        self, text: str, values: dict[str, Any] | None, count: int, max_bytes: int | None = None
    ) -> Columns:
        """Send the first rows of a query in parts; return its columns."""
        columns, parts = self._duckdb.rows(text, values, count)
        size, types = 0, [kind for _, kind in columns]
        for part in parts:
            for content in self._contents(part, types):
                size += len(content)
                if max_bytes is not None and size > max_bytes:
                    raise too_large(max_bytes)
                self._channel.send(PART, content, more=True)
        return columns

    def _contents(self, rows: Rows, types: list[str]) -> Iterator[bytes]:
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
        from starcat_service.sandbox.arrow_stream import stream_of

        self._reader = self._duckdb.reader(text, values)
        return stream_of(self._reader.schema)

    def next_batch(self) -> bytes | None:
        """Return the next rows as an Arrow stream; none at the end."""
        from starcat_service.sandbox.arrow_stream import RowTooLarge, streams_of

        try:
            for stream in self._streams:
                return stream
            while (batch := self._duckdb.next_batch(self._reader)) is not None:
                self._streams = streams_of(batch, self._opening.message_bytes)
                for stream in self._streams:
                    return stream
        except RowTooLarge as error:
            raise too_large(self._opening.message_bytes) from error
        return None

    def _watch(self) -> None:
        """Send the progress of a query; end this process when its parent is gone."""
        while True:
            time.sleep(WATCH_S)
            if os.name == "posix" and os.getppid() != self._opening.parent:
                os._exit(1)
            with self._channel.sending:
                percent = self._duckdb.percent() if self._is_running else -1.0
                if percent >= 0.0:
                    try:
                        self._channel.send(PROGRESS, int(percent))
                    except OSError:  # the parent has ended since the check
                        os._exit(1)
