"""The process that runs the queries of a session, as the session sees it.

It is started once and asked many times. One that takes too long is killed, and so is one whose
question was dropped halfway; the next question starts another.
"""

from __future__ import annotations

import atexit
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

from starcat.errors import QueryError, QueryLimitError
from starcat.progress import Progress, no_progress
from starcat.query.frames import (
    READ_BYTES,
    MalformedMessage,
    Receiver,
    decoded_rows,
    encoded,
    from_json,
    json_content,
    send_message,
    write_message,
)
from starcat.query.messages import (
    ARROW,
    BROKEN,
    DONE,
    ENDINGS,
    HARMLESS,
    INTERRUPT,
    LARGE,
    PART,
    PROGRESS,
    REQUEST,
    SHORT,
    Opening,
)

CLOCK_TIMES = 10  # how much longer something short may take than its time of a processor
HEARING_S = 0.5  # how long a process may take to hear that it is interrupted
TICKS = os.sysconf("SC_CLK_TCK") if os.name == "posix" else 1
MESSAGE_BYTES = 1 << 30  # size of a message of the process at most
PATIENT = 19  # the priority of a process that leaves the processors to others
GONE_S = 1.0  # after this time nothing of a process that ended is read any more
MAX_SAID_BYTES = 1 << 16  # what is read of the last words of a process
OPENING_S = 60.0  # how long a process may take until it has opened the targets, seconds
_PROGRAM = "import sys; sys.path[:] = sys.argv[1:]; from starcat.query.worker import serve; serve()"


@dataclass
class Allowance:
    """The time that a query may take; only waiting for the answer counts.

    One that is ``short`` may take so many seconds of a processor, or ten times that of the clock;
    then ``prolong`` says whether it may go on.
    """

    total_s: float
    short_s: float | None = None
    prolong: Callable[[], bool] = bool
    is_patient: bool = False  # whether it leaves the processors to others where they want them

    def __post_init__(self) -> None:
        self.left_s, self.used_s = self.total_s, 0.0
        self._begun_s = time.monotonic()

    def is_overdue(self, used_s: float) -> bool:
        """Return whether it is not short any more, after some time of a processor more."""
        if self.short_s is None:
            return False
        ends_s = self._begun_s + CLOCK_TIMES * self.short_s
        return self.used_s + used_s >= self.short_s or time.monotonic() >= ends_s

    def is_prolonged(self) -> bool:
        """Have the rest, if that may be had."""
        if self.prolong():
            self.short_s, self.is_patient = None, True
        return self.short_s is None


@dataclass(frozen=True)
class _Question:
    """What a process is asked now."""

    number: int
    allowance: Allowance
    begun_s: float  # `time.monotonic`
    used_s: float  # what the process had taken of processors


_waiting: list[subprocess.Popen[bytes]] = []
"""A process that was started before it is known what for."""


def warm_up(count: int = 1) -> None:
    """Start the processes of the next `Engine`s now, while other work is done."""
    while len(_waiting) < count:
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


class AnswerTooLarge(QueryLimitError):  # noqa: N818 - the name reads as the fact
    """The answer of a query is larger than it may be."""


class Engine:
    """A process with a DuckDB, started again when it was ended."""

    def __init__(
        self, scratch: Path, memory_gb: float, disk_gb: float, message_bytes: int = MESSAGE_BYTES
    ) -> None:
        spill = scratch / "spill"
        self._opening = Opening(spill, memory_gb, disk_gb, os.getpid(), message_bytes)
        self._opened: tuple[Any, ...] | None = None
        self._asking = threading.RLock()
        self._ending = threading.Lock()
        self._question = 0
        self._is_late = False
        self._process = self._started()
        self.is_patient = False

    def open(self, sql: str, folder: str, files: list[str], macros: frozenset[str]) -> None:
        """Make views and macros by SQL; from here on the process reads nothing but some files.

        The SQL names them from a folder on; ``macros`` are those that stand after FROM.
        """
        opened = sql, folder, files, sorted(macros)
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
        """Ask the process for something, and wait for the answer.

        The last item is the answer: plain values as JSON has them, or the bytes of an Arrow stream.
        Those before it are rows, in parts. `AnswerTooLarge` if there are more than ``max_bytes``.
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
        return self._process.poll() is None

    def yield_processors(self) -> None:
        """Let the process run where nobody else wants to; that cannot be taken back."""
        self.is_patient = True
        with suppress(OSError):
            for thread in Path(f"/proc/{self._process.pid}/task").iterdir():
                os.setpriority(os.PRIO_PROCESS, int(thread.name), PATIENT)

    def close(self) -> None:
        """End the process."""
        _end(self._process)

    def _started(self) -> subprocess.Popen[bytes]:
        shutil.rmtree(self._opening.spill, ignore_errors=True)
        self._opening.spill.mkdir()
        try:
            process = _waiting.pop(0)
        except IndexError:
            process = _spawned()
        self.is_patient, self._gone_s = False, 0.0
        opening = json_content({**asdict(self._opening), "spill": str(self._opening.spill)})
        with suppress(OSError):
            if process.stdin is not None:
                write_message(process.stdin, REQUEST, opening)
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
        except Exception as error:  # whatever somebody's own class does
            raise QueryError(f"a value of the query cannot be passed on: {error}") from error
        parts: list[Any] = []
        kind, is_over = "", False
        try:
            with self._within(allowance):
                if self._process.stdin is None:
                    raise EOFError
                request = json_content([name, allowance.left_s, given])
                send_message(self._process.stdin, REQUEST, request, self._is_gone)
                for kind, content in self._replies(max_bytes):
                    if kind == PROGRESS:
                        progress("query", _percent(content), 100)
                    elif kind == PART:
                        parts.append(decoded_rows(content))
                    elif kind == ARROW:
                        parts.append(content)
                    else:
                        parts.append(from_json(content))
            is_over = kind in HARMLESS
        except (EOFError, OSError) as error:
            raise self._ended(allowance) from error
        finally:
            # A question that was dropped halfway, as by Ctrl-C, would be answered to the next.
            if not is_over:
                self.close()
        if kind in (DONE, ARROW):
            return parts
        if kind == LARGE:
            raise _too_large(max_bytes or self._opening.message_bytes)
        if kind == SHORT:
            raise QueryLimitError(
                f"the query needs more than {self._opening.memory_gb:g} GB of memory and "
                f"{self._opening.disk_gb:g} GB of disk; ask for less, or allow more with "
                "memory_limit_gb",
                fields=("memory_limit_gb",),
            )
        if self._is_late:
            raise _late(allowance)
        raise _refusal(parts[-1], kind)

    def _replies(self, max_bytes: int | None) -> Iterator[tuple[str, bytes | bytearray]]:
        """Give what the process sends until it is at an end."""
        stream, kind, size = self._process.stdout, "", 0
        if stream is None:
            raise EOFError
        receiver = Receiver(stream, self._opening.message_bytes, self._is_gone)
        while kind not in ENDINGS:
            if kind and self._is_gone():
                raise EOFError
            kind, content = receiver.receive()
            if kind not in ENDINGS | {PART, PROGRESS}:
                raise MalformedMessage("the process of the query sent a message of no known kind")
            size += len(content) if kind == PART else 0
            if max_bytes is not None and size > max_bytes:
                raise _too_large(max_bytes)
            yield kind, content

    def _is_gone(self) -> bool:
        """Return whether the process ended some time ago, so that nothing of it is on its way."""
        if self.is_running:
            return False
        self._gone_s = self._gone_s or time.monotonic()
        return time.monotonic() - self._gone_s > GONE_S

    @contextmanager
    def _within(self, allowance: Allowance) -> Iterator[None]:
        """End the question when its time is over, and count the time."""
        self._question += 1
        self._is_late = False
        if allowance.is_patient and not self.is_patient:
            self.yield_processors()
        asked = _Question(self._question, allowance, time.monotonic(), self._used_s())
        self._watch(asked)
        try:
            yield
        finally:
            with self._ending:
                self._question += 1
                self._timer.cancel()
            allowance.left_s -= time.monotonic() - asked.begun_s
            allowance.used_s += max(0.0, self._used_s() - asked.used_s)

    def _watch(self, asked: _Question) -> None:
        wait_s = asked.allowance.left_s - (time.monotonic() - asked.begun_s)
        if asked.allowance.short_s is not None:
            wait_s = min(wait_s, asked.allowance.short_s / 2)
        self._begin_timer(wait_s, self._look, asked)

    def _begin_timer(self, wait_s: float, function: Callable[..., None], *given: object) -> None:
        self._timer = threading.Timer(max(0.0, wait_s), function, given)
        self._timer.daemon = True
        self._timer.start()

    def _look(self, asked: _Question) -> None:
        """End a question that takes too long."""
        allowance = asked.allowance
        with self._ending:
            if asked.number != self._question:
                return
            if time.monotonic() - asked.begun_s >= allowance.left_s:
                self._stop(asked)
            elif not allowance.is_overdue(self._used_s() - asked.used_s):
                self._watch(asked)
            elif allowance.is_prolonged():
                self.yield_processors()
                self._watch(asked)
            else:
                self._is_late = True
                # The process is kept, if it hears in time.
                self._process.send_signal(INTERRUPT)
                self._begin_timer(HEARING_S, self._stop_later, asked)

    def _stop_later(self, asked: _Question) -> None:
        with self._ending:
            if asked.number == self._question:
                self._stop(asked)

    def _stop(self, asked: _Question) -> None:
        self._is_late = True
        self._process.kill()

    def _used_s(self) -> float:
        """Return the time of processors that it has taken, where that can be read, or any time."""
        try:
            # Twice for each question, so without what `Path` and decoding take.
            descriptor = os.open(f"/proc/{self._process.pid}/stat", os.O_RDONLY)
        except OSError:
            return time.monotonic()
        try:
            text = os.read(descriptor, READ_BYTES)
        finally:
            os.close(descriptor)
        user, system = text.rpartition(b")")[2].split()[11:13]
        return (int(user) + int(system)) / TICKS

    def _ended(self, allowance: Allowance) -> QueryError:
        """Return what to say of a process that ended before it answered."""
        # The pipe is closed a moment before the process is gone.
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        self._process.kill()
        pipe = self._process.stderr
        lines = _last_lines(pipe) if pipe else []
        self.close()
        code = self._process.returncode
        name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        if self._is_late or name == "SIGXCPU":
            return _late(allowance)
        if name == "SIGKILL":
            return QueryLimitError(
                "the process of the query was killed from outside, as a system does that runs out "
                "of memory; ask for less, or allow less with memory_limit_gb",
                fields=("memory_limit_gb",),
            )
        last = f": {lines[-1][:200]}" if lines else ""
        return WorkerEnded(
            f"the process of the query ended by itself ({name}{last}); DuckDB cannot answer it. "
            "Ask in another way; other queries are answered as before"
        )


def _late(allowance: Allowance) -> QueryLimitError:
    return QueryLimitError(
        f"stopped after {allowance.total_s:g} s; ask for less, or allow more with time_limit_s",
        fields=("time_limit_s",),
    )


def _too_large(max_bytes: int) -> AnswerTooLarge:
    return AnswerTooLarge(
        f"the answer has more than {max_bytes / 1e6:,.0f} MB; ask for fewer rows or columns"
    )


def _refusal(found: Any, kind: str) -> QueryError:
    """Return the error that a process has sent; MalformedMessage if it is none."""
    try:
        words, fields = found
        failed = "DuckDB failed: " if kind == BROKEN else ""
        return QueryError(f"{failed}{words}", fields=tuple(map(str, fields)))
    except (TypeError, ValueError):
        return MalformedMessage("the process of the query sent no error that can be read")


def _percent(content: bytes | bytearray) -> int:
    found = from_json(content)
    if not isinstance(found, int):
        raise MalformedMessage("the process of the query sent a progress that is not a number")
    return min(max(found, 0), 100)


def _last_lines(pipe: IO[bytes]) -> list[str]:
    """Return what is in the pipe of a process that ended, which a child of it may keep open."""
    if os.name == "posix":
        os.set_blocking(pipe.fileno(), False)
    try:
        found = os.read(pipe.fileno(), MAX_SAID_BYTES)
    except OSError:
        return []
    return found.decode(errors="replace").strip().splitlines()
