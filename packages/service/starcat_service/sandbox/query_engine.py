"""The process that runs the queries of a session, as the server sees it: an `Engine`.

It is started once and runs many queries. It is killed if a query takes too long, or if the caller
drops a query halfway; the next query starts a new process.
"""

from __future__ import annotations

import atexit
import math
import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcat.errors import QueryError, QueryLimitError
from starcat.progress import Progress, no_progress
from starcat.query import Allowance, Columns, Rows, Statement, Values, Views, sql_quoted
from starcat_service.sandbox.messages import (
    ARROW,
    ENDINGS,
    ERROR,
    PART,
    PROGRESS,
    MalformedMessage,
    error_of,
    from_json,
)
from starcat_service.sandbox.process import WorkerProcess
from starcat_service.sandbox.query_messages import (
    Opening,
    read_columns,
    read_footer,
    read_statement,
    too_large,
)
from starcat_service.sandbox.query_values import decoded_rows, encoded

if TYPE_CHECKING:
    import pyarrow as pa

MAX_MESSAGE_BYTES = 1 << 30  # size of a message of the process
OPENING_S = 60.0  # seconds that a process may take to open the targets
LOOK_S = 0.25  # seconds between two checks whether a process is starved
STARVED_FRACTION = 0.5  # a process whose processor time is less of its time is starved
ENDING_S = 1.0  # seconds that a process may take to end after its pipe is closed
_FUNCTION = "starcat_service.sandbox.query_worker:serve_queries"


_waiting: list[WorkerProcess] = []
"""Processes that were started in advance."""


def warm_up(count: int = 1) -> None:
    """Start the processes of the next engines now, while other work is done."""
    while len(_waiting) < count:
        _waiting.append(_spawned())


def _spawned() -> WorkerProcess:
    return WorkerProcess(_FUNCTION, stderr=subprocess.PIPE)


@atexit.register
def _end_waiting() -> None:
    while _waiting:
        _waiting.pop().close()


class ConfinedEngine:
    """A process with a DuckDB, started again when it was ended.

    ``message_bytes`` is the largest size of a row and of a message, ``rows_bytes`` the size of all
    rows that are not read in batches.
    """

    def __init__(
        self,
        scratch: Path,
        memory_gb: float,
        disk_gb: float,
        *,
        message_bytes: int = MAX_MESSAGE_BYTES,
        rows_bytes: int | None = None,
    ) -> None:
        spill = str(scratch / "spill")
        self._opening = Opening(spill, memory_gb, disk_gb, os.getpid(), message_bytes)
        self._rows_bytes = rows_bytes
        self._opened: tuple[Any, ...] | None = None
        self._asking = threading.RLock()
        self._process = self._started()

    @property
    def is_running(self) -> bool:
        """Whether the process is there, with full priority; a limit or a failure ends it."""
        return self._process.is_running and not self._is_patient

    def footer(self, path: str) -> tuple[str, dict[str, str]]:
        """Return the schema's name, or nothing, and the columns with their types from a footer."""
        return read_footer(self.ask("footer", path)[0])

    def look_at(self, files: Sequence[str]) -> None:
        """Read the columns of the Parquet files of a table, as a view would."""
        self.ask("look_at", list(files))

    def open(self, views: Views) -> None:
        """Make views and macros; from then on the process reads only ``files``."""
        folder = _common_folder(views.files)
        # Files are named relative to it: DuckDB shows the text of a view, but not its folder.
        sql = views.sql
        text = sql.replace(sql_quoted(folder + os.sep)[:-1], "'") if folder else sql
        opened = folder, asdict(replace(views, sql=text))
        self.ask("open", *opened)
        self._opened = opened

    def statements(self, text: str) -> list[str]:
        """Return the queries of a text."""
        return list(map(str, self.ask("statements", text)[0]))

    def check(self, text: str, allowance: Allowance) -> Statement:
        """Check that a text is a query that may run."""
        return read_statement(self.ask("check", text, allowance=allowance)[0])

    def columns(self, text: str, values: Values, allowance: Allowance) -> Columns:
        """Return names and types of the columns of a query."""
        return read_columns(self.ask("columns", text, values, allowance=allowance)[0])

    def rows(
        self,
        text: str,
        values: Values,
        count: int,
        allowance: Allowance,
        progress: Progress = no_progress,
    ) -> tuple[Columns, Rows]:
        """Return the columns and the first rows of a query."""
        *parts, columns = self.ask(
            "rows", text, values, count, self._rows_bytes, allowance=allowance, progress=progress
        )
        return read_columns(columns), list(chain(*parts))

    def batches(
        self, text: str, values: Values, allowance: Allowance, progress: Progress = no_progress
    ) -> pa.RecordBatchReader:
        """Return all rows of a query as Arrow batches, to be read before the next query."""
        import pyarrow as pa

        from starcat_service.sandbox.arrow_stream import batches_of, schema_of

        [begun] = self.ask("batches", text, values, allowance=allowance, progress=progress)
        schema = schema_of(begun)

        def batches() -> Iterator[pa.RecordBatch]:
            while (
                stream := self.ask("next_batch", allowance=allowance, progress=progress)[0]
            ) is not None:
                yield from batches_of(stream, schema)

        return pa.RecordBatchReader.from_batches(schema, batches())

    def close(self) -> None:
        """End the process."""
        self._process.close()

    def ask(
        self,
        name: str,
        *arguments: Any,
        allowance: Allowance | None = None,
        progress: Progress = no_progress,
    ) -> list[Any]:
        """Send a request to the process, and wait for the answer.

        The last item is the answer: plain values for JSON, or the bytes of an Arrow stream. The
        items before are rows, in parts. `AnswerTooLarge` if they exceed ``rows_bytes``.
        """
        with self._asking:
            if not self._process.is_running:
                self.close()
                self._process = self._started()
                if self._opened is not None:
                    self._answered("open", self._opened, Allowance(OPENING_S))
            return self._answered(name, arguments, allowance or Allowance(OPENING_S), progress)

    def _started(self) -> WorkerProcess:
        shutil.rmtree(self._opening.spill, ignore_errors=True)
        Path(self._opening.spill).mkdir()
        try:
            process = _waiting.pop(0)
        except IndexError:
            process = _spawned()
        self._is_patient = False
        process.max_bytes = self._opening.message_bytes
        with suppress(OSError):  # the next query finds out that it ended
            process.send(asdict(self._opening))
        return process

    def _answered(
        self,
        name: str,
        arguments: tuple[Any, ...],
        allowance: Allowance,
        progress: Progress = no_progress,
    ) -> list[Any]:
        try:
            values = [encoded(argument) for argument in arguments]
        except Exception as error:  # a user's own class can raise anything
            raise QueryError(f"a value of the query cannot be passed on: {error}") from error
        parts: list[Any] = []
        is_over = False
        begun_s, used_s = time.monotonic(), self._process.used_s()
        try:
            self._process.send([name, allowance.left_s, values], begun_s + allowance.left_s)
            for kind, content in self._replies(allowance, begun_s, used_s):
                if kind == PROGRESS:
                    progress("query", _percent(content), 100)
                elif kind == ERROR:
                    reported = from_json(content)
                    is_over = isinstance(reported, dict) and reported.get("is_last") is False
                    cause = error_of(reported)
                    raise cause if isinstance(cause, QueryError) else QueryError(str(cause))
                elif kind == PART:
                    parts.append(decoded_rows(content))
                else:
                    parts.append(content if kind == ARROW else from_json(content))
            is_over = True
        except TimeoutError:
            taken_s = self._process.used_s() - used_s
            raise _late(allowance, time.monotonic() - begun_s, taken_s) from None
        except (EOFError, OSError) as error:
            raise self._ended(allowance) from error
        finally:
            allowance.left_s -= time.monotonic() - begun_s
            allowance.used_s += max(0.0, self._process.used_s() - used_s)
            # If a request is dropped halfway, as by Ctrl-C, the next would get its answer.
            if not is_over:
                self.close()
        return parts

    def _replies(
        self, allowance: Allowance, begun_s: float, used_s: float
    ) -> Iterator[tuple[str, bytes | bytearray]]:
        """Yield the messages of the process up to the last; TimeoutError if it takes too long."""
        until_s, kind, size = begun_s + allowance.left_s, "", 0
        last_s = begun_s + allowance.starved * allowance.left_s
        while kind not in ENDINGS:
            left_s = until_s - time.monotonic()
            if left_s <= 0.0:
                waited_s, taken_s = time.monotonic() - begun_s, self._process.used_s() - used_s
                if time.monotonic() >= last_s or not _is_starved(allowance, waited_s, taken_s):
                    raise TimeoutError
                left_s = LOOK_S
            if not self._is_patient and allowance.patient_after_s < math.inf:
                taken_s = allowance.used_s + self._process.used_s() - used_s
                if taken_s >= allowance.patient_after_s:
                    self._process.yield_processors()
                    self._is_patient = True
                left_s = min(left_s, allowance.patient_after_s / 2)
            message = self._process.receive(left_s)
            if message is None:
                continue
            kind, content = message
            if kind not in ENDINGS | {PART, PROGRESS}:
                raise MalformedMessage("the process of the query sent a message of no known kind")
            size += len(content) if kind == PART else 0
            if self._rows_bytes is not None and size > self._rows_bytes:
                raise too_large(self._rows_bytes)
            yield kind, content

    def _ended(self, allowance: Allowance) -> QueryError:
        """Return the exception for a process that ended before it answered."""
        # The pipe is closed a moment before the process is gone.
        self._process.wait(ENDING_S)
        self._process.kill()
        lines = self._process.last_words()
        code = self._process.wait() or 0
        name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        if name == "SIGXCPU":
            return _late(allowance, allowance.total_s, allowance.total_s)
        if name == "SIGKILL":
            return QueryLimitError(
                "the process of the query was killed from outside, as a system does that runs out "
                "of memory",
                hint=("ask for less", "allow less with {memory_limit_gb}"),
            )
        last = f": {lines[-1][:200]}" if lines else ""
        return QueryError(
            f"the process of the query ended by itself ({name}{last}); DuckDB cannot answer it. "
            "Ask in another way; other queries are answered as before"
        )


def _is_starved(allowance: Allowance, waited_s: float, taken_s: float) -> bool:
    return allowance.starved > 1.0 and taken_s < STARVED_FRACTION * waited_s


def _late(allowance: Allowance, waited_s: float, taken_s: float) -> QueryLimitError:
    if _is_starved(allowance, waited_s, taken_s):
        return QueryLimitError(
            f"stopped after {waited_s:.2g} s, in which a busy machine left it {taken_s:.1f} s of "
            "processor time; ask again later"
        )
    return allowance.late()


def _percent(content: bytes | bytearray) -> int:
    percent = from_json(content)
    if not isinstance(percent, int):
        raise MalformedMessage("the process of the query sent a progress that is not a number")
    return min(max(percent, 0), 100)


def _common_folder(files: Sequence[str]) -> str:
    """Return the folder that all files are in; empty for the root, or if there is none."""
    try:
        return os.path.commonpath([os.path.dirname(file) for file in files]).rstrip(os.sep)
    except ValueError:  # no files, or files of several drives
        return ""
