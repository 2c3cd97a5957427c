"""What answers the queries of a session: a DuckDB in this process, or another `Engine`.

A query that takes too long is interrupted, and so is one during which Ctrl-C is pressed. Limits of
the operating system need a process of their own, which a service has.
"""

from __future__ import annotations

import math
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar

from starcat.errors import QueryLimitError
from starcat.progress import Progress, no_progress
from starcat.query.locked_duckdb import Columns, LockedDuckdb, Rows, Values, Views
from starcat.query.statement import Statement

if TYPE_CHECKING:
    import pyarrow as pa

LOOK_S = 0.1  # seconds between two looks at the progress of a query
STOPPING_S = 3.0
"""Seconds that an interrupted query may take to end. After that it is left to itself: it may be
inside a call of a function that takes minutes."""

T = TypeVar("T")


@dataclass
class Allowance:
    """The time that all queries together may take; only waiting for the answer counts.

    An engine that shares the processors with others gives a query a low priority after
    ``patient_after_s`` of processor time. If a busy machine leaves the queries little processor
    time, they may take ``starved`` times as long there.
    """

    total_s: float
    patient_after_s: float = math.inf
    starved: float = 1.0

    def __post_init__(self) -> None:
        self.left_s, self.used_s = self.total_s, 0.0

    def late(self) -> QueryLimitError:
        """Return the error for a query that took all of the time."""
        return QueryLimitError(
            f"stopped after {self.total_s:g} s",
            hint=("ask for less", "allow more with {time_limit_s}"),
        )


class Engine(Protocol):
    """A DuckDB that answers one query at a time; see `LockedDuckdb` for what each method does.

    Every method raises QueryError, or QueryLimitError if a limit is exceeded.
    """

    @property
    def is_running(self) -> bool:
        """Whether it can answer the next query as it answered the last one."""

    def footer(self, path: str) -> tuple[str, dict[str, str]]:
        """Return the schema's name, or nothing, and the columns with their types from a footer."""

    def look_at(self, files: Sequence[str]) -> None:
        """Read the columns of the Parquet files of a table, as a view would."""

    def open(self, views: Views) -> None:
        """Make views and macros; from here on allow no other file and no other setting."""

    def statements(self, text: str) -> list[str]:
        """Return the queries of a text."""

    def check(self, text: str, allowance: Allowance) -> Statement:
        """Check that a text is a query that may run."""

    def columns(self, text: str, values: Values, allowance: Allowance) -> Columns:
        """Return names and types of the columns of a query."""

    def rows(
        self, text: str, values: Values, count: int, allowance: Allowance, progress: Progress
    ) -> tuple[Columns, Rows]:
        """Return the columns and the first rows of a query."""

    def batches(
        self, text: str, values: Values, allowance: Allowance, progress: Progress
    ) -> pa.RecordBatchReader:
        """Return all rows of a query as Arrow batches, to be read before the next query."""

    def close(self) -> None:
        """End it."""


class LocalEngine:
    """A DuckDB in this process, made anew after it failed or did not stop."""

    def __init__(self, scratch: Path, memory_gb: float, disk_gb: float) -> None:
        self._spill, self._memory_gb, self._disk_gb = scratch / "spill", memory_gb, disk_gb
        self._views: Views | None = None
        self._asking = threading.RLock()
        self._duckdb: LockedDuckdb | None = None

    @property
    def is_running(self) -> bool:
        """Whether the same DuckDB answers the next query."""
        return self._duckdb is not None

    def footer(self, path: str) -> tuple[str, dict[str, str]]:
        """Return the schema's name, or nothing, and the columns with their types from a footer."""
        return self._answer(lambda duckdb: duckdb.footer(path))

    def look_at(self, files: Sequence[str]) -> None:
        """Read the columns of the Parquet files of a table, as a view would."""
        self._answer(lambda duckdb: duckdb.look_at(files))

    def open(self, views: Views) -> None:
        """Make views and macros; from here on allow no other file and no other setting."""
        self._answer(lambda duckdb: duckdb.open(views))
        self._views = views

    def statements(self, text: str) -> list[str]:
        """Return the queries of a text."""
        return self._answer(lambda duckdb: duckdb.statements(text))

    def check(self, text: str, allowance: Allowance) -> Statement:
        """Check that a text is a query that may run."""
        return self._answer(lambda duckdb: duckdb.check(text), allowance)

    def columns(self, text: str, values: Values, allowance: Allowance) -> Columns:
        """Return names and types of the columns of a query."""
        return self._answer(lambda duckdb: duckdb.columns(text, values), allowance)

    def rows(
        self,
        text: str,
        values: Values,
        count: int,
        allowance: Allowance,
        progress: Progress = no_progress,
    ) -> tuple[Columns, Rows]:
        """Return the columns and the first rows of a query."""

        def read(duckdb: LockedDuckdb) -> tuple[Columns, Rows]:
            columns, parts = duckdb.rows(text, values, count)
            return columns, list(chain.from_iterable(parts))

        return self._answer(read, allowance, progress)

    def batches(
        self, text: str, values: Values, allowance: Allowance, progress: Progress = no_progress
    ) -> pa.RecordBatchReader:
        """Return all rows of a query as Arrow batches, to be read before the next query."""
        import pyarrow as pa

        reader = self._answer(lambda duckdb: duckdb.reader(text, values), allowance, progress)

        def batches() -> Iterator[pa.RecordBatch]:
            while (batch := self._answer(following, allowance, progress, begins=False)) is not None:
                yield batch

        def following(duckdb: LockedDuckdb) -> pa.RecordBatch | None:
            return duckdb.next_batch(reader)

        return pa.RecordBatchReader.from_batches(reader.schema, batches())

    def close(self) -> None:
        """Close the DuckDB."""
        if self._duckdb is not None:
            self._duckdb.close()
            self._duckdb = None

    def _answer(
        self,
        call: Callable[[LockedDuckdb], T],
        allowance: Allowance | None = None,
        progress: Progress = no_progress,
        *,
        begins: bool = True,
    ) -> T:
        """Make a call of DuckDB in a thread, so that this one can stop it.

        ``begins`` is false if the call continues the query before it.
        """
        with self._asking:
            duckdb = self._running()
            answers: list[T] = []
            errors: list[BaseException] = []
            # Not `Thread.join`: Ctrl-C during it marks a running thread as ended (Python 3.11).
            is_over = threading.Event()

            def answer() -> None:
                try:
                    if begins:
                        duckdb.let_go()
                    answers.append(call(duckdb))
                except BaseException as error:  # it is raised by the thread that waits
                    errors.append(error)
                finally:
                    is_over.set()

            threading.Thread(target=answer, daemon=True).start()
            try:
                _wait(is_over, duckdb, allowance, progress)
            except BaseException:
                self._stop(is_over, duckdb)
                raise
            if not errors:
                return answers[0]
            if not isinstance(errors[0], Exception):
                raise errors[0]
            failure, is_last = duckdb.failure(errors[0])
            if is_last:
                self.close()
            raise failure from (None if failure is errors[0] else errors[0])

    def _running(self) -> LockedDuckdb:
        """Return the DuckDB with its views; it is made if there is none."""
        if self._duckdb is None:
            shutil.rmtree(self._spill, ignore_errors=True)
            self._spill.mkdir(exist_ok=True)
            self._duckdb = LockedDuckdb(self._spill, self._memory_gb, self._disk_gb)
            if self._views is not None:
                self._duckdb.open(self._views)
        return self._duckdb

    def _stop(self, is_over: threading.Event, duckdb: LockedDuckdb) -> None:
        """Interrupt a query; a DuckDB that does not stop in time is not used again."""
        self._duckdb = None
        until_s = time.monotonic() + STOPPING_S
        while not is_over.is_set() and time.monotonic() < until_s:
            duckdb.interrupt()
            is_over.wait(LOOK_S)
        if is_over.is_set():
            self._duckdb = duckdb


def _wait(
    is_over: threading.Event, duckdb: LockedDuckdb, allowance: Allowance | None, progress: Progress
) -> None:
    """Wait for a query and show its progress; QueryLimitError if it takes too long."""
    begun_s = time.monotonic()
    left_s = math.inf if allowance is None else allowance.left_s
    try:
        while not is_over.is_set():
            wait_s = begun_s + left_s - time.monotonic()
            if allowance is not None and wait_s <= 0.0:
                raise allowance.late()
            if is_over.wait(min(LOOK_S, wait_s)):
                break
            percent = duckdb.percent()
            if percent >= 0.0:
                progress("query", min(int(percent), 100), 100)
    finally:
        if allowance is not None:
            allowance.left_s -= time.monotonic() - begun_s
