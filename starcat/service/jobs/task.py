"""The process of one job: it reads an order, says how far it is, and leaves a result or an error.

The order is the first line of its input. What it has to say are lines of JSON on its output: a
stage, a line of the log, and at last the result or the error. It ends when its input does, which
is when the worker that started it is gone.
"""

from __future__ import annotations

import ctypes
import json
import logging
import os
import signal
import sys
import threading
import time
import traceback
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from starcat.errors import StarcatError
from starcat.query.confinement import limit_memory
from starcat.service.jobs.work import Order, do_job, prepare
from starcat.service.paths import ServicePaths
from starcat.storage.locks import locked

NICENESS = 10
"""Requests come before jobs."""

STAGES_A_SECOND = 4.0

MAX_LINE = 2000
"""Characters of a line of the log that are kept."""

NO_THREAD = "can't start new thread"
"""What Python says where there is no memory for the stack of a thread."""

_SET_PARENT_DEATH_SIGNAL = 1

PROGRAM = (
    "import sys; sys.path[:] = sys.argv[1:]; from starcat.service.jobs.task import main; main()"
)


class Teller:
    """Says what happens, as lines of JSON."""

    def __init__(self, output: IO[str]) -> None:
        self._output = output
        self._lock = threading.Lock()
        self._stage, self._at_s = "", 0.0

    def tell_stage(self, stage: str, done: int, total: int | None) -> None:
        """Say how far it is, unless that was said a moment ago."""
        now = time.monotonic()
        is_last = total is not None and done >= total
        with self._lock:
            is_new = stage != self._stage
            if not (is_new or is_last or now - self._at_s >= 1.0 / STAGES_A_SECOND):
                return
            if is_last and not is_new and now - self._at_s < 0.05:
                return
            self._stage, self._at_s = stage, now
        self.say(
            {"stage": stage, "done": int(done), "total": None if total is None else int(total)}
        )

    def tell(self, level: str, text: str) -> None:
        """Say a line of the log."""
        self.say({"log": text[:MAX_LINE], "level": level})

    def say(self, content: dict[str, Any]) -> None:
        """Say anything."""
        with self._lock:
            self._output.write(json.dumps(content) + "\n")
            self._output.flush()


class _Lines(logging.Handler):
    """What starcat logs, as lines of the job's log."""

    def __init__(self, teller: Teller) -> None:
        super().__init__(logging.INFO)
        self._teller = teller

    def emit(self, record: logging.LogRecord) -> None:
        level = "info" if record.levelno < logging.WARNING else "warning"
        self._teller.tell(level, record.getMessage())


def main() -> None:
    """Read the order, and do it."""
    end_with_parent()
    output = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a library prints is no message
    order = _order(json.loads(sys.stdin.buffer.readline()))
    threading.Thread(target=_end_with_input, daemon=True).start()
    with suppress(OSError, AttributeError):
        os.nice(NICENESS)
        # What answers somebody who waits gets a processor at once, where Linux can do that.
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    teller = Teller(output)
    logger = logging.getLogger("starcat")
    logger.setLevel(logging.INFO)
    logger.addHandler(_Lines(teller))
    with locked(order.paths.job_lock(order.job_id)):
        prepare(order.kind)
        limit_memory(order.memory_bytes)
        try:
            teller.say({"result": do_job(order, teller.tell_stage, teller.tell)})
        except Exception as error:
            teller.say({"error": _told(error, order)})
    sys.stderr.flush()
    os._exit(0)  # whatever threads of libraries do


def end_with_parent() -> None:
    """Have the system end this process when the one that started it is gone, where it can."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL, 0, 0, 0)


def _end_with_input() -> None:
    """End this process, and those that it has started, when its input ends."""
    while sys.stdin.buffer.read(1):
        pass
    if hasattr(os, "killpg") and os.getpgid(0) == os.getpid():
        os.killpg(os.getpid(), signal.SIGKILL)
    os._exit(1)


def _order(content: dict[str, Any]) -> Order:
    paths = ServicePaths(Path(content.pop("root")))
    return Order(paths=paths, **content)


def _told(error: Exception, order: Order) -> dict[str, Any]:
    """Return what to say of an exception: details for whoever asked, the rest for the operator."""
    from starcat.failures import failure_of
    from starcat.service.problems import ProblemDetails, problem_of, without_folders

    if isinstance(error, MemoryError) or NO_THREAD in str(error):
        return memory_problem(order.memory_bytes)
    if isinstance(error, OSError) and not isinstance(error, StarcatError):
        failure = failure_of(error, "the job")
        problem = ProblemDetails(
            title="The system refused",
            status=500,
            detail=without_folders(failure.message),
            kind=failure.kind,
        )
    else:
        problem = problem_of(error)
    if problem.status == 500:
        traceback.print_exception(error)
    return problem.model_dump(exclude_none=True)


def memory_problem(memory_bytes: int) -> dict[str, Any]:
    """Return what to say of a job that wanted more memory than it may take."""
    detail = (
        f"the job took more than the {memory_bytes / 2**30:.3g} GiB of memory that it may "
        "(job_memory_gib); ask for less, or ask the operator for more"
    )
    return {"type": "about:blank", "title": "Out of memory", "status": 422, "detail": detail}
