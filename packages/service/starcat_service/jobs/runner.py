"""The process of a job, seen from outside: started, listened to, and ended.

It is ended when the job was cancelled, takes too long or too much of the disk, or when the service
stops; nothing is left of an attempt but what it has finished.
"""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from starcat.storage.atomic import make_folder
from starcat_service.jobs.job import Outcome, failed
from starcat_service.jobs.work import Order, out_of_memory
from starcat_service.sandbox.child import Child

TASK = "starcat_service.jobs.work:main"

TICK_S = 0.2
"""How often it is looked whether a process has to end."""

TAIL_BYTES = 4096

NO_MEMORY = ("bad_alloc", "out of memory", "memory allocation", "cannot allocate memory")
"""What libraries say, in small letters, that end a process which is refused memory."""

STOPPED, CANCELLED = Outcome("queued"), Outcome("cancelled")

Report = Callable[[dict[str, Any]], None]
"""Called with each message of a process: a stage, or a line of the log."""

ReasonToEnd = Callable[[], Outcome | None]
"""Asked each tick; what it returns, if anything, is how the attempt ends."""


def limit_exceeded(detail: str) -> Outcome:
    """Return the end of an attempt that took more than it may."""
    return failed("Limit exceeded", 422, detail)


def time_exceeded(began_s: float, job_time_s: float) -> Outcome | None:
    """Return the end of an attempt that takes too long; ``began_s`` is of `time.monotonic`."""
    if time.monotonic() - began_s <= job_time_s:
        return None
    return limit_exceeded(
        f"the job took more than {job_time_s:g} s (job_time_s); ask for less, or ask the operator "
        "for more"
    )


class Processes:
    """The processes of jobs that run."""

    def __init__(self) -> None:
        self.children: set[Child] = set()
        self._lock = threading.Lock()

    def run(self, order: Order, report: Report, reason_to_end: ReasonToEnd) -> Outcome:
        """Run the process of a job until it ends, or has to."""
        ended: Outcome | None = None
        told: Outcome | None = None
        with self._started(order) as child:
            for line in child.lines(TICK_S):
                if line is not None:
                    told = _outcome_in(line, report) or told
                elif ended is None and told is None:
                    ended = reason_to_end()
                    if ended is not None:
                        child.kill()
        if told is not None and (told.state == "done" or ended is None):
            return told  # it was faster than whoever wanted its end
        return ended or _death(child.wait(), order)

    def end_all(self) -> None:
        """End all processes at once."""
        with self._lock:
            for child in self.children:
                child.kill()

    @contextmanager
    def _started(self, order: Order) -> Iterator[Child]:
        """Start the process of a job, in a group of its own, and see that it has ended."""
        make_folder(order.paths.job(order.job_id))
        with order.paths.job_stderr(order.job_id).open("wb") as stderr:
            # Arrow's own allocators reserve gigabytes, which count as memory that is used.
            environment = {"ARROW_DEFAULT_MEMORY_POOL": "system", "MPLBACKEND": "agg"}
            child = Child(TASK, environment=environment, stderr=stderr, has_group=True)
        with self._lock:
            self.children.add(child)
        try:
            child.send(asdict(order))
            yield child
        finally:
            child.close()
            with self._lock:
                self.children.discard(child)


def _outcome_in(line: bytes, report: Report) -> Outcome | None:
    try:
        message: dict[str, Any] = json.loads(line)
    except ValueError:  # cut off
        return None
    if "result" in message:
        return Outcome("done", message["result"])
    if "error" in message:
        return Outcome("failed", message["error"])
    report(message)
    return None


def _death(code: int, order: Order) -> Outcome:
    """Return the end of an attempt whose process ended without a word."""
    if code == -signal.SIGTERM:  # the system goes down, and has told all processes
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
