"""Processes for reading uploads and making files: a limited number, each with hard limits.

A picture of some kilobytes can claim to have a billion pixels, and a library can fail in any way on
a damaged picture. Both happen in a process (`starcat_service.sandbox.worker`) whose memory and time
the operating system limits, and which can write only into the scratch folder.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Mapping
from contextlib import closing, nullcontext, suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from starcat.errors import QueryLimitError
from starcat.ship.exchange import FILE_FORMATS, FORMATS, WHOLE_FORMATS, Label
from starcat_service.problems import Problem
from starcat_service.sandbox.limiter import WAIT_S, Limiter, asker
from starcat_service.sandbox.messages import DONE, MalformedMessage, error_of, from_json
from starcat_service.sandbox.pool import Pool
from starcat_service.sandbox.process import WorkerProcess
from starcat_service.security.request_limits import check_disk
from starcat_service.settings import ServiceSettings

GIB = 2**30

TICK_S = 0.1
"""Seconds between two checks whether a task must end."""

MIN_USED, STARVED = 0.75, 3.0
"""A task ends after ``query_time_s`` if it had this fraction of it as processor time, and in any
case after this multiple of it: a busy machine can leave a task little processor time."""

WRITING = ("convert", "flight_image", "upload")
"""Tasks that write large files."""

P = ParamSpec("P")
T = TypeVar("T")


class _OutOfMemory(Problem):
    """A task needed more memory than allowed."""


class Sandbox:
    """Processes that do one task at a time; `run` calls functions that use `call` in a thread."""

    def __init__(self, settings: ServiceSettings, scratch: Path) -> None:
        self._settings = settings
        self._time_s = settings.query_time_s
        self._scratch = scratch
        self._memory_bytes = int(settings.query_memory_gib * GIB)
        self._limiter = Limiter(settings.queries, settings.queries // 2)
        self._children: Pool[None, WorkerProcess] = Pool(self._begin, settings.queries)
        self.close = self._children.close

    async def run(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function that uses tasks in a thread, when a slot is free for it."""
        return await self._limiter.run(WAIT_S, partial(function, *args, **kwargs))

    def call(self, task: str, arguments: Mapping[str, Any]) -> Any:
        """Do a task of `starcat_service.sandbox.worker.TASKS`; its error is raised here."""
        if task in WRITING:
            check_disk(self._settings)
        has_slot = self._limiter.slot.get() is not None
        slot = nullcontext() if has_slot else self._limiter.hold(asker.get(), WAIT_S)
        try:
            with slot, self._children.lend(None) as worker:
                kind, content = self._answer(worker, [task, dict(arguments), self._time_s])
                answer = from_json(content)
                error = None if kind == DONE else error_of(answer)
                # A process that ran out of memory or stack is not used again.
                if isinstance(error, (MemoryError, RecursionError)):
                    raise error
        except MemoryError:
            raise _OutOfMemory(
                413,
                "the request takes more memory than it may "
                f"({self._memory_bytes / GIB:g} GiB); send less or a smaller picture, or ask the "
                "operator to raise query_memory_gib",
            ) from None
        except RecursionError:
            raise Problem(
                422, "the file is nested too deep to be read; send it with fewer levels"
            ) from None
        if error is not None:
            raise error
        return answer

    def convert(self, source: Path, target: Path, form: str, label: Label | None = None) -> None:
        """Convert an Arrow stream into a file of some format; some need the table in memory."""
        arguments = {"source": str(source), "target": str(target), "form": form}
        try:
            self.call("convert", {**arguments, "label": None if label is None else asdict(label)})
        except _OutOfMemory:
            others = [name for name in FILE_FORMATS if name not in WHOLE_FORMATS]
            raise Problem(
                413,
                f"the table takes more memory as {FORMATS[form].title} than a request may "
                f"({self._memory_bytes / GIB:g} GiB); choose {', '.join(others)}, which are "
                "written row by row, or ask for fewer rows",
            ) from None

    def _begin(self, _: None) -> closing[WorkerProcess]:
        worker = WorkerProcess(
            "starcat_service.sandbox.worker:serve",
            # astropy tests a temporary file when it writes FITS.
            environment={
                "MPLCONFIGDIR": str(self._scratch / "matplotlib"),
                "TMPDIR": str(self._scratch),
                "MALLOC_ARENA_MAX": "2",  # each arena keeps memory that the others cannot use
                "OMP_NUM_THREADS": "2",  # of Arrow; the stack of each thread counts as memory
            },
        )
        with suppress(OSError):  # the next request notices that it ended
            worker.send([str(self._scratch), self._memory_bytes])
        return closing(worker)

    def _answer(self, worker: WorkerProcess, request: Any) -> tuple[str, bytes | bytearray]:
        began_s, used_s = time.monotonic(), worker.used_s()
        try:
            worker.send(request, began_s + self._time_s)
            while (reply := worker.receive(TICK_S)) is None:
                self._check(time.monotonic() - began_s, worker.used_s() - used_s, request[0])
        except TimeoutError:
            raise self._late() from None
        except (EOFError, OSError, MalformedMessage):
            worker.kill()
            if worker.wait() == -signal.SIGXCPU:
                raise self._late() from None
            raise Problem(
                422,
                "the process that read the file crashed, as it does on damaged files; send another",
            ) from None
        return reply

    def _check(self, taken_s: float, used_s: float, task: str) -> None:
        """Raise an error if a task must end: it took its time, or would fill the disk."""
        if task in WRITING:
            check_disk(self._settings)
        if taken_s < self._time_s:
            return
        if used_s >= MIN_USED * self._time_s:
            raise self._late()
        if taken_s >= STARVED * self._time_s:
            raise Problem(
                503,
                f"the service is too busy: your request had {used_s:.1f} s of processor time in "
                f"{taken_s:.0f} s; ask again later",
                headers={"Retry-After": "60"},
            )

    def _late(self) -> QueryLimitError:
        return QueryLimitError(f"stopped after {self._time_s:g} s", hint="send less")
