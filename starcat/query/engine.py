"""The process that runs the queries of a session, as the session sees it.

It is started once and asked many times. One that takes too long is killed, and so is one whose
question was dropped halfway; the next question starts another.
"""

from __future__ import annotations

import atexit
import os
import pickle
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from starcat.errors import QueryError, QueryLimitError
from starcat.progress import Progress, no_progress
from starcat.query.messages import BROKEN, DONE, ENDINGS, PART, PROGRESS, REFUSED, SHORT, Opening

OPENING_S = 60.0  # how long a process may take until it has opened the targets, seconds
_PROGRAM = "import sys; sys.path[:] = sys.argv[1:]; from starcat.query.worker import serve; serve()"


@dataclass
class Allowance:
    """The time that a query may take; only waiting for the answer counts.

    With ``first_s`` it has so much at first, in which what is done with the answer counts too. Then
    ``prolong`` says whether it may have the rest.
    """

    total_s: float
    first_s: float | None = None
    prolong: Callable[[], bool] = bool

    def __post_init__(self) -> None:
        self.left_s = self.total_s if self.first_s is None else self.first_s
        self._ends_s = time.monotonic() + self.left_s

    @property
    def most_s(self) -> float:
        """What is left of it, if it may have the rest."""
        return self.left_s + (0.0 if self.first_s is None else self.total_s - self.first_s)

    def begin(self) -> None:
        """Begin to wait for an answer."""
        if self.first_s is not None:
            self.left_s = min(self.left_s, self._ends_s - time.monotonic())

    def is_prolonged(self) -> bool:
        """Have the rest, if there is one and it may be had."""
        if self.first_s is None or not self.prolong():
            return False
        self.left_s, self.first_s = self.most_s, None
        return True


_waiting: list[subprocess.Popen[bytes]] = []
"""A process that was started before it is known what for."""


def warm_up() -> None:
    """Start the process of the next `Engine` now, while other modules are still imported."""
    if not _waiting:
        _waiting.append(_spawned())


def _spawned() -> subprocess.Popen[bytes]:
    # Arrow's own allocators reserve gigabytes, which count as memory that is used.
    return subprocess.Popen(
        [sys.executable, "-c", _PROGRAM, *sys.path],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "ARROW_DEFAULT_MEMORY_POOL": "system"},
    )


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout, process.stderr):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()


@atexit.register
def _end_waiting() -> None:
    while _waiting:
        _end(_waiting.pop())


class WorkerEnded(QueryError):  # noqa: N818 - the name reads as the fact
    """A process that ended by itself while it was asked, with what is known of why."""


class Engine:
    """A process with a DuckDB, started again when it was ended."""

    def __init__(self, scratch: Path, memory_gb: float, disk_gb: float) -> None:
        self._opening = Opening(scratch / "spill", memory_gb, disk_gb, os.getpid())
        self._opened: tuple[Any, ...] | None = None
        self._asking = threading.RLock()
        self._ending = threading.Lock()
        self._question = 0
        self._is_late = False
        self._process = self._started()

    def open(self, sql: str, folder: str, files: list[str], macros: frozenset[str]) -> None:
        """Make views and macros by SQL; from here on the process reads nothing but some files.

        The SQL names them from a folder on; ``macros`` are those that stand after FROM.
        """
        self.ask("open", sql, folder, files, macros)
        self._opened = sql, folder, files, macros

    def ask(
        self,
        name: str,
        *arguments: Any,
        allowance: Allowance | None = None,
        progress: Progress = no_progress,
    ) -> list[Any]:
        """Ask the process for something, and wait for the answer."""
        with self._asking:
            if not self.is_running:
                self.close()
                self._process = self._started()
                if self._opened is not None:
                    self._answered("open", self._opened, Allowance(OPENING_S))
            return self._answered(name, arguments, allowance or Allowance(OPENING_S), progress)

    @property
    def is_running(self) -> bool:
        """Whether the process is there; after a limit, or a failure of DuckDB, it is not."""
        return self._process.poll() is None

    def close(self) -> None:
        """End the process."""
        _end(self._process)

    def _started(self) -> subprocess.Popen[bytes]:
        shutil.rmtree(self._opening.spill, ignore_errors=True)
        self._opening.spill.mkdir()
        process = _waiting.pop() if _waiting else _spawned()
        with suppress(OSError):
            _write(process, self._opening)
        return process

    def _answered(
        self,
        name: str,
        arguments: tuple[Any, ...],
        allowance: Allowance,
        progress: Progress = no_progress,
    ) -> list[Any]:
        try:
            content = pickle.dumps(arguments)
        except Exception as error:  # whatever somebody's own class does
            raise QueryError(f"a value of the query cannot be passed on: {error}") from error
        parts: list[Any] = []
        kind = ""
        try:
            with self._within(allowance):
                _write(self._process, (name, allowance.most_s, content))
                while kind not in ENDINGS:
                    kind, found = pickle.load(self._process.stdout)  # type: ignore[arg-type]
                    if kind == PROGRESS:
                        progress("query", found, 100)
                    elif kind in (PART, DONE):
                        parts.append(found)
        except (EOFError, OSError, pickle.UnpicklingError) as error:
            raise self._ended(allowance) from error
        finally:
            # A question that was dropped halfway, as by Ctrl-C, would be answered to the next.
            if kind not in (DONE, REFUSED):
                self.close()
        if kind == DONE:
            return parts
        if kind == SHORT:
            raise QueryLimitError(
                f"the query needs more than {self._opening.memory_gb:g} GB of memory and "
                f"{self._opening.disk_gb:g} GB of disk; ask for less, or allow more with "
                "--memory-limit-gb"
            )
        told = "DuckDB failed: " if kind == BROKEN else ""
        raise QueryError(f"{told}{found}")

    @contextmanager
    def _within(self, allowance: Allowance) -> Iterator[None]:
        """Kill the process when the time is over, and count the time."""
        self._question += 1
        self._is_late = False
        allowance.begin()
        began = time.monotonic()
        self._watch(self._question, allowance, began)
        try:
            yield
        finally:
            with self._ending:
                self._question += 1
                self._timer.cancel()
            allowance.left_s -= time.monotonic() - began

    def _watch(self, question: int, allowance: Allowance, began: float) -> None:
        left_s = allowance.left_s - (time.monotonic() - began)
        self._timer = threading.Timer(max(0.0, left_s), self._stop, (question, allowance, began))
        self._timer.daemon = True
        self._timer.start()

    def _stop(self, question: int, allowance: Allowance, began: float) -> None:
        with self._ending:
            if question != self._question:
                return
            if allowance.is_prolonged():
                self._watch(question, allowance, began)
            else:
                self._is_late = True
                self._process.kill()

    def _ended(self, allowance: Allowance) -> QueryError:
        """Return what to say of a process that ended before it answered."""
        # The pipe is closed a moment before the process is gone.
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        self._process.kill()
        pipe = self._process.stderr
        lines = pipe.read().decode(errors="replace").strip().splitlines() if pipe else []
        self.close()
        code = self._process.returncode
        name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        if self._is_late or name == "SIGXCPU":
            return QueryLimitError(
                f"stopped after {allowance.total_s:g} s; ask for less, or allow more with "
                "--time-limit-s"
            )
        if name == "SIGKILL":
            return QueryLimitError(
                "the process of the query was killed from outside, as a system does that runs out "
                "of memory; ask for less, or allow less with --memory-limit-gb"
            )
        last = f": {lines[-1][:200]}" if lines else ""
        return WorkerEnded(
            f"the process of the query ended by itself ({name}{last}); DuckDB cannot answer it. "
            "Ask in another way; other queries are answered as before"
        )


def _write(process: subprocess.Popen[bytes], content: Any) -> None:
    if process.stdin is not None:
        pickle.dump(content, process.stdin, pickle.HIGHEST_PROTOCOL)
        process.stdin.flush()
