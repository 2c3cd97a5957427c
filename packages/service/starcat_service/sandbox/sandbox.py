"""Processes for what reads uploads and makes files: a bounded number, each with hard limits.

A picture of some kilobytes may say that it has a billion pixels, and a library may fail in any way
upon a damaged one. Both happen in a process (`starcat_service.sandbox.worker`) whose memory and
time are limited by the operating system, and which may write into the scratch folder only.
"""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Mapping
from contextlib import closing, nullcontext
from contextvars import ContextVar
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from starcat.errors import QueryLimitError, error_of_kind
from starcat.exchange.columns import Label
from starcat.exchange.formats import FILE_FORMATS, FORMATS, WHOLE_FORMATS
from starcat_service.problems import Problem
from starcat_service.sandbox.child import Child
from starcat_service.sandbox.places import WAIT_S, Places, asker, held, in_thread
from starcat_service.sandbox.pool import Pool
from starcat_service.settings import Settings

GIB = 2**30

P = ParamSpec("P")
T = TypeVar("T")

_has_place: ContextVar[bool] = ContextVar("has_place", default=False)


class _OutOfMemory(Problem):
    """A task needed more memory than it may take."""


class Sandbox:
    """Processes that do one task after the other; `run` calls what uses `call` in a thread."""

    def __init__(self, settings: Settings, scratch: Path) -> None:
        self._time_s = settings.query_time_s
        self._scratch = scratch
        self._memory_bytes = int(settings.query_memory_gib * GIB)
        self._places = Places(settings.queries)
        self._children: Pool[None, Child] = Pool(self._begin, settings.queries)
        self.close = self._children.close

    async def run(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function that has tasks done in a thread, when there is a place for it."""
        who = asker.get()
        await self._places.take_later(who, WAIT_S)
        token = _has_place.set(True)
        try:
            return await in_thread(partial(function, *args, **kwargs))
        finally:
            _has_place.reset(token)
            self._places.release(who)

    def call(self, task: str, arguments: Mapping[str, Any]) -> Any:
        """Have a task of `starcat_service.sandbox.worker.TASKS` done; its error is raised here."""
        place = nullcontext() if _has_place.get() else held(self._places, asker.get())
        with place, self._children.lend(None) as child:
            answer = self._answer(child, {"task": task, "arguments": arguments})
            if answer.get("kind") == "MemoryError":
                raise _OutOfMemory(
                    413,
                    "the request takes more memory than it may "
                    f"({self._memory_bytes / GIB:g} GiB); send less or a smaller picture, or ask "
                    "the operator to raise query_memory_gib",
                )
            if answer.get("kind") == "RecursionError":
                raise Problem(
                    422, "the file is nested too deep to be read; send it with fewer levels"
                )
        if "kind" not in answer:
            return answer["found"]
        if answer["errno"] is not None:
            raise OSError(answer["errno"], answer["message"])
        error = error_of_kind(
            answer["kind"], answer["message"], key=answer["key"], fields=answer["fields"]
        )
        raise error or RuntimeError(f"{answer['kind']}: {answer['message']}")

    def convert(self, source: Path, target: Path, form: str, label: Label | None = None) -> None:
        """Have an Arrow stream made a file of some format: some need the table in memory."""
        given = {"source": str(source), "target": str(target), "form": form}
        try:
            self.call("convert", {**given, "label": None if label is None else asdict(label)})
        except _OutOfMemory:
            others = [name for name in FILE_FORMATS if name not in WHOLE_FORMATS]
            raise Problem(
                413,
                f"the table takes more memory as {FORMATS[form].title} than a request may "
                f"({self._memory_bytes / GIB:g} GiB); choose {', '.join(others)}, which are "
                "written row by row, or ask for fewer rows",
            ) from None

    def _begin(self, _: None) -> closing[Child]:
        child = Child(
            "starcat_service.sandbox.worker:serve",
            # astropy tries out a temporary file where it writes FITS.
            environment={
                "MPLCONFIGDIR": str(self._scratch / "matplotlib"),
                "TMPDIR": str(self._scratch),
                "MALLOC_ARENA_MAX": "2",  # each arena keeps memory that the others cannot use
            },
        )
        child.send({"scratch": str(self._scratch), "memory_bytes": self._memory_bytes})
        return closing(child)

    def _answer(self, child: Child, request: Mapping[str, Any]) -> dict[str, Any]:
        late = QueryLimitError(f"stopped after {self._time_s:g} s; send less")
        child.send({**request, "time_s": self._time_s})
        try:
            return dict(json.loads(child.answer(self._time_s)))
        except TimeoutError:
            raise late from None
        except EOFError:
            if child.wait() == -signal.SIGXCPU:
                raise late from None
            raise Problem(
                422,
                "the process that read the file crashed, as it does on damaged files; send another",
            ) from None
