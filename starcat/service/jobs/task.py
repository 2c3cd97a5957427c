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
from typing import IO, Any

from starcat.errors import StarcatError
from starcat.query.confinement import limit_memory
from starcat.service.jobs.job import job_problem
from starcat.service.jobs.work import Order, do_job, prepare
from starcat.service.sandbox.child import own_output
from starcat.storage.locks import locked

NICENESS = 10
"""Requests come before jobs."""

STAGES_A_SECOND = 4.0

MAX_LINE = 2000
"""Characters of a line of the log that are kept."""

NO_THREAD = "can't start new thread"
"""What Python says where there is no memory for the stack of a thread."""

_SET_PARENT_DEATH_SIGNAL = 1


class Messages:
    """What happens, written as lines of JSON."""

    def __init__(self, output: IO[bytes]) -> None:
        self._output = output
        self._lock = threading.Lock()
        self._stage, self._at_s = "", 0.0

    def stage(self, stage: str, done: int, total: int | None) -> None:
        """Write how much of a stage is done, unless that was written a moment ago."""
        now = time.monotonic()
        is_last = total is not None and done >= total
        with self._lock:
            is_new = stage != self._stage
            if not (is_new or is_last or now - self._at_s >= 1.0 / STAGES_A_SECOND):
                return
            if is_last and not is_new and now - self._at_s < 0.05:
                return
            self._stage, self._at_s = stage, now
        self.write(
            {"stage": stage, "done": int(done), "total": None if total is None else int(total)}
        )

    def log(self, level: str, text: str) -> None:
        """Write a line of the log."""
        self.write({"log": text[:MAX_LINE], "level": level})

    def write(self, content: dict[str, Any]) -> None:
        """Write any message."""
        with self._lock:
            self._output.write(json.dumps(content).encode() + b"\n")
            self._output.flush()


class _Lines(logging.Handler):
    """What starcat logs, as lines of the job's log."""

    def __init__(self, messages: Messages) -> None:
        super().__init__(logging.INFO)
        self._messages = messages

    def emit(self, record: logging.LogRecord) -> None:
        level = "info" if record.levelno < logging.WARNING else "warning"
        self._messages.log(level, record.getMessage())


def main() -> None:
    """Read the order, and do it."""
    end_with_parent()
    messages = Messages(own_output())
    order = Order(**json.loads(sys.stdin.buffer.readline()))
    threading.Thread(target=_end_with_input, daemon=True).start()
    with suppress(OSError, AttributeError):
        os.nice(NICENESS)
        # What answers somebody who waits gets a processor at once, where Linux can do that.
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    logger = logging.getLogger("starcat")
    logger.setLevel(logging.INFO)
    logger.addHandler(_Lines(messages))
    with locked(order.paths.job_lock(order.job_id)):
        prepare(order.kind)
        limit_memory(order.memory_bytes)
        try:
            messages.write({"result": do_job(order, messages.stage, messages.log)})
        except Exception as error:
            messages.write({"error": _problem_of(error, order)})
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


def _problem_of(error: Exception, order: Order) -> dict[str, Any]:
    """Return problem details of an exception; a traceback is the operator's."""
    from starcat.failures import failure_of
    from starcat.service.problems import ProblemDetails, problem_of, without_folders

    if isinstance(error, MemoryError) or NO_THREAD in str(error):
        return memory_problem(order.memory_bytes)
    if isinstance(error, OSError) and not isinstance(error, StarcatError):
        failure = failure_of(error, "the job")
        detail = without_folders(failure.message)
        problem = ProblemDetails(
            title="The system refused", status=500, detail=detail, kind=failure.kind
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
    return job_problem("Out of memory", 422, detail)
