"""The process that runs the queries of a session, as the session sees it.

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
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from starcat.errors import QueryError, QueryLimitError
from starcat.progress import Progress, no_progress
from starcat.query.messages import Opening, too_large
from starcat.query.values import decoded_rows, encoded
from starcat.workers.messages import (
    ARROW,
    ENDINGS,
    ERROR,
    PART,
    PROGRESS,
    MalformedMessage,
    error_of,
    from_json,
)
from starcat.workers.process import WorkerProcess

MAX_MESSAGE_BYTES = 1 << 30  # size of a message of the process
OPENING_S = 60.0  # seconds that a process may take to open the targets
LOOK_S = 0.25  # seconds between two checks whether a process is starved
STARVED_FRACTION = 0.5  # a process whose processor time is less of its time is starved
ENDING_S = 1.0  # seconds that a process may take to end after its pipe is closed
_FUNCTION = "starcat.query.worker:serve_queries"


@dataclass
class Allowance:
    """The time that all queries together may take; only waiting for the answer counts.

    After ``patient_after_s`` of processor time the process gets a low priority. If a busy machine
    leaves the queries little processor time, they may take ``starved`` times as long.
    """

    total_s: float
    patient_after_s: float = math.inf
    starved: float = 1.0

    def __post_init__(self) -> None:
        self.left_s, self.used_s = self.total_s, 0.0


_waiting: list[WorkerProcess] = []
"""Processes that were started in advance."""


def warm_up(count: int = 1) -> None:
    """Start the processes of the next `Engine`s now, while other work is done."""
    while len(_waiting) < count:
        _waiting.append(_spawned())


def _spawned() -> WorkerProcess:
    return WorkerProcess(_FUNCTION, stderr=subprocess.PIPE)


@atexit.register
def _end_waiting() -> None:
    while _waiting:
        _waiting.pop().close()


class WorkerEnded(QueryError):  # noqa: N818 - the name reads as the fact
    """A process ended by itself during a query; the message has the reason if it is known."""


class Engine:
    """A process with a DuckDB, started again when it was ended."""

    def __init__(
        self,
        scratch: Path,
        memory_gb: float,
        disk_gb: float,
        message_bytes: int = MAX_MESSAGE_BYTES,
    ) -> None:
        spill = str(scratch / "spill")
        self._opening = Opening(spill, memory_gb, disk_gb, os.getpid(), message_bytes)
        self._opened: tuple[Any, ...] | None = None
        self._asking = threading.RLock()
        self._process = self._started()

    def open(
        self,
        sql: str,
        folder: str,
        files: list[str],
        macros: frozenset[str],
        numbers: Mapping[str, Sequence[str]],
        sql_by_word: Mapping[str, str],
    ) -> None:
        """Make views and macros by SQL; from then on the process reads only ``files``.

        The SQL names files relative to ``folder``; ``macros`` are the macros used after FROM,
        ``numbers`` the arguments of macros that have to be numbers (`Macro.numbers`).
        ``sql_by_word`` runs before the first query that contains the word (lower case).
        """
        opened = sql, folder, files, sorted(macros), dict(numbers), dict(sql_by_word)
        self.ask("open", *opened)
        self._opened = opened

    def ask(
        self,
        name: str,
        *arguments: Any,
        allowance: Allowance | None = None,
        progress: Progress = no_progress,
        max_bytes: int | None = None,
    ) -> list[Any]:
        """Send a request to the process, and wait for the answer.

        The last item is the answer: plain values for JSON, or the bytes of an Arrow stream. The
        items before are rows, in parts. `AnswerTooLarge` if they exceed ``max_bytes``.
        """
        with self._asking:
            if not self.is_running:
                self.close()
                self._process = self._started()
                if self._opened is not None:
                    self._answered("open", self._opened, Allowance(OPENING_S))
            given = allowance or Allowance(OPENING_S)
            return self._answered(name, arguments, given, progress, max_bytes)

    @property
    def is_running(self) -> bool:
        """Whether the process is there; after a limit, or a failure of DuckDB, it is not."""
        return self._process.is_running

    def close(self) -> None:
        """End the process."""
        self._process.close()

    def _started(self) -> WorkerProcess:
        shutil.rmtree(self._opening.spill, ignore_errors=True)
        Path(self._opening.spill).mkdir()
        try:
            process = _waiting.pop(0)
        except IndexError:
            process = _spawned()
        self.is_patient = False
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
        max_bytes: int | None = None,
    ) -> list[Any]:
        try:
            given = [encoded(argument) for argument in arguments]
        except Exception as error:  # a user's own class can raise anything
            raise QueryError(f"a value of the query cannot be passed on: {error}") from error
        parts: list[Any] = []
        is_over = False
        begun_s, used_s = time.monotonic(), self._process.used_s()
        try:
            self._process.send([name, allowance.left_s, given], begun_s + allowance.left_s)
            for kind, content in self._replies(allowance, begun_s, used_s, max_bytes):
                if kind == PROGRESS:
                    progress("query", _percent(content), 100)
                elif kind == ERROR:
                    found = from_json(content)
                    is_over = isinstance(found, dict) and found.get("is_last") is False
                    raise self._error(error_of(found))
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
        self, allowance: Allowance, begun_s: float, used_s: float, max_bytes: int | None
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
            if not self.is_patient and allowance.patient_after_s < math.inf:
                taken_s = allowance.used_s + self._process.used_s() - used_s
                if taken_s >= allowance.patient_after_s:
                    self._process.yield_processors()
                    self.is_patient = True
                left_s = min(left_s, allowance.patient_after_s / 2)
            message = self._process.receive(left_s)
            if message is None:
                continue
            kind, content = message
            if kind not in ENDINGS | {PART, PROGRESS}:
                raise MalformedMessage("the process of the query sent a message of no known kind")
            size += len(content) if kind == PART else 0
            if max_bytes is not None and size > max_bytes:
                raise too_large(max_bytes)
            yield kind, content

    def _error(self, error: Exception) -> QueryError:
        """Return the exception for an error that the process has sent."""
        if isinstance(error, MemoryError):
            return QueryLimitError(
                f"the query needs more than {self._opening.memory_gb:g} GB of memory and "
                f"{self._opening.disk_gb:g} GB of disk",
                hint=("ask for less", "allow more with {memory_limit_gb}"),
            )
        return error if isinstance(error, QueryError) else QueryError(str(error))

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
        return WorkerEnded(
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
    return QueryLimitError(
        f"stopped after {allowance.total_s:g} s",
        hint=("ask for less", "allow more with {time_limit_s}"),
    )


def _percent(content: bytes | bytearray) -> int:
    found = from_json(content)
    if not isinstance(found, int):
        raise MalformedMessage("the process of the query sent a progress that is not a number")
    return min(max(found, 0), 100)
