"""Processes for what reads uploads and makes files: a bounded number, each with hard limits.

A picture of some kilobytes may say that it has a billion pixels, and a library may fail in any way
upon a damaged one. Both happen in a process (`starcat.service.sandbox.worker`) whose memory and
time are limited by the operating system, and which may write into the scratch folder only.
"""

from __future__ import annotations

import json
import signal
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from starcat.errors import QueryLimitError, error_of_kind
from starcat.service.problems import Problem
from starcat.service.sandbox.child import Child
from starcat.service.sandbox.pool import Pool
from starcat.service.settings import Settings

GIB = 2**30


class Sandbox:
    """Processes that do one task after the other; `run` calls what uses `call` in a thread."""

    def __init__(self, settings: Settings, scratch: Path) -> None:
        self._time_s = settings.query_time_s
        self._scratch = scratch
        self._memory_bytes = int(settings.query_memory_gib * GIB)
        self._children: Pool[None, Child] = Pool(self._begin, settings.queries, settings.queries)
        self.run = self._children.run
        self.close = self._children.close

    def call(self, task: str, arguments: Mapping[str, Any]) -> Any:
        """Have a task of `starcat.service.sandbox.worker.TASKS` done; its error is raised here."""
        with self._children.lend(None) as child:
            answer = self._answer(child, {"task": task, "arguments": arguments})
            if answer.get("kind") == "MemoryError":
                raise Problem(
                    413, "it takes more memory than a request may; send less, or a smaller picture"
                )
        if "kind" not in answer:
            return answer["found"]
        error = error_of_kind(answer["kind"], answer["message"], key=answer["key"])
        raise error or RuntimeError(f"{answer['kind']}: {answer['message']}")

    def convert(self, source: Path, target: Path, form: str) -> None:
        """Have an Arrow stream made a file of some format: some need the table in memory."""
        self.call("convert", {"source": str(source), "target": str(target), "form": form})

    def _begin(self, _: None) -> closing[Child]:
        child = Child(
            "starcat.service.sandbox.worker:serve",
            # astropy tries out a temporary file where it writes FITS.
            environment={
                "MPLCONFIGDIR": str(self._scratch / "matplotlib"),
                "TMPDIR": str(self._scratch),
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
