"""The process of a job, from outside: starting it, reading its messages, ending it.

It is ended when the job is cancelled, when it takes too long or too much of the disk, or when the
service stops. Only finished results of an attempt remain.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from starcat.storage import make_folder
from starcat_service.jobs.job import Outcome, failed
from starcat_service.jobs.work import Order, out_of_memory
from starcat_service.sandbox.messages import DONE, ERROR, MalformedMessage, from_json
from starcat_service.sandbox.process import WorkerProcess

TASK = "starcat_service.jobs.work:work_main"

TICK_S = 0.2
"""Seconds between checks whether a process must end."""

TAIL_BYTES = 4096

NO_MEMORY = ("bad_alloc", "out of memory", "memory allocation", "cannot allocate memory")
"""Lower-case parts of messages of libraries that end a process if they get no memory."""

STOPPED, CANCELLED = Outcome("queued"), Outcome("cancelled")

Report = Callable[[dict[str, Any]], None]
"""Called with each message of a process: a stage, or a line of the log."""

ReasonToEnd = Callable[[], Outcome | None]
"""Called each tick; returns an outcome if the attempt must end, else None."""


def limit_exceeded(detail: str) -> Outcome:
    """Return the end of an attempt that took more than allowed."""
    return failed("Limit exceeded", 422, detail)


def time_exceeded(began_s: float, job_time_s: float) -> Outcome | None:
    """Return the end of an attempt that takes too long; ``began_s`` is a `time.monotonic`."""
    if time.monotonic() - began_s <= job_time_s:
        return None
    return limit_exceeded(
        f"the job took more than {job_time_s:g} s (job_time_s); ask for less, or ask the operator "
        "for more"
    )


class Processes:
    """The processes of jobs that run."""

    def __init__(self) -> None:
        self.running: set[WorkerProcess] = set()
        self._lock = threading.Lock()

    def run(self, order: Order, report: Report, reason_to_end: ReasonToEnd) -> Outcome:
        """Run the process of a job until it ends or must end."""
        ended: Outcome | None = None
        outcome: Outcome | None = None
        looked_s = time.monotonic()
        with self._started(order) as worker, suppress(EOFError, MalformedMessage):
            while True:
                reply = worker.receive(TICK_S)
                if reply is not None:
                    outcome = _outcome_of(*reply, report) or outcome
                if time.monotonic() - looked_s >= TICK_S and ended is None and outcome is None:
                    looked_s = time.monotonic()
                    ended = reason_to_end()
                    if ended is not None:
                        worker.kill()
        if outcome is not None and (outcome.state == "done" or ended is None):
            return outcome  # it was finished before it could be ended
        return ended or _death(worker.wait() or 0, order)

    def end_all(self) -> None:
        """End all processes at once."""
        with self._lock:
            for worker in self.running:
                worker.kill()

    @contextmanager
    def _started(self, order: Order) -> Iterator[WorkerProcess]:
        """Start the process of a job in a process group of its own, and make sure that it ends."""
        make_folder(order.paths.job(order.job_id))
        with order.paths.job_stderr(order.job_id).open("wb") as stderr:
            worker = WorkerProcess(
                TASK, environment={"MPLBACKEND": "agg"}, stderr=stderr, has_group=True
            )
        with self._lock:
            self.running.add(worker)
        try:
            with suppress(OSError):  # its exit code shows why it died
                worker.send(asdict(order))
            yield worker
        finally:
            worker.close()
            with self._lock:
                self.running.discard(worker)


def _outcome_of(kind: str, content: bytes | bytearray, report: Report) -> Outcome | None:
    message: dict[str, Any] = from_json(content)
    if kind == DONE:
        return Outcome("done", message)
    if kind == ERROR:
        return Outcome("failed", message)
    report(message)
    return None


def _death(code: int, order: Order) -> Outcome:
    """Return the outcome of an attempt whose process ended without a message."""
    if code == -signal.SIGTERM:  # the system shuts down and ends all processes
        return STOPPED
    last_words = _tail(order.paths.job_stderr(order.job_id)).lower()
    if any(word in last_words for word in NO_MEMORY):
        return out_of_memory(order.memory_bytes)
    name = signal.Signals(-code).name if code < 0 else f"code {code}"
    hint = ", as a system does that runs out of memory" if code == -signal.SIGKILL else ""
    detail = (
        f"the process of the job ended by {name}{hint}; the operator finds more in "
        f"jobs/{order.job_id}/stderr.txt under the root"
    )
    return failed("Ended", 500, detail)


def _tail(path: Path) -> str:
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - TAIL_BYTES))
        return file.read().decode(errors="replace")
