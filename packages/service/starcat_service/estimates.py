"""Estimates of specs in a process of their own.

A catalog that was read takes hundreds of megabytes, and choosing stars from it takes processor
time. Both are the child process's, so the server process stays small and answers other requests
meanwhile. Requests and answers are lines of JSON; several requests can be underway. If the process
ends, its requests are refused and the next one starts another process.
"""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from typing import Any, TypeVar

import numpy as np

from starcat.errors import error_of_kind
from starcat.geometry.sphere import saff_kuijlaars
from starcat.pipeline.cost import Cost
from starcat.pipeline.estimate import Estimate
from starcat.pipeline.starter import LimitRow, Starter
from starcat.products.coverage import CoverageSummary, Spread
from starcat.products.tiling import FieldStars
from starcat.specs.build_spec import BuildSpec, CameraSpec
from starcat.specs.reading import spec_from_dict
from starcat_service.catalogs import RETRY_S, WAIT_S, CatalogRead, Catalogs
from starcat_service.problems import Problem
from starcat_service.sandbox.child import Child, own_output, return_free_memory

T = TypeVar("T")

ANSWER_S = 4 * WAIT_S
"""Seconds that a request waits for its answer; the process refuses it long before."""

TICK_S = 3600.0
THREADS = 40
"""Requests that the process works on or keeps waiting at the same time, as the server does."""

_SIMPLE = ("read_seconds", "enough_share", "full_share", "filters", "rejected", "refusals")


class ChildCatalogs(Catalogs):
    """The catalogs of a service, and estimates from them, which a child process makes."""

    def __init__(self, max_memory_bytes: int | None = None, wait_s: float = WAIT_S) -> None:
        super().__init__(max_memory_bytes, wait_s)
        self._child: Child | None = None
        self._pending: dict[int, Future[Any]] = {}  # requests of this process, by their numbers
        self._read_ones: tuple[CatalogRead, ...] = ()  # catalogs that the process has read
        self._number = 0
        self._sending = threading.Lock()

    def known(self) -> list[CatalogRead]:
        """Return what is known of the catalogs that the process has read."""
        return list(self._read_ones)

    def estimate(self, spec: BuildSpec) -> Estimate:
        """Estimate what a spec will give; the lists of stars of the fields are left out."""
        found = self._ask("estimate", spec=spec.model_dump(mode="json"))
        coverage: dict[str, Any] = {
            name: Spread(**value) if isinstance(value, dict) else value
            for name, value in found["coverage"].items()
        }
        coverage["histogram"] = np.array(coverage["histogram"], dtype=np.int64)
        offsets = np.concatenate([[0], np.cumsum(np.array(found["counts"], dtype=np.int64))])
        return Estimate(
            spec=spec,
            cost=Cost(**found["cost"]),
            fields=FieldStars(
                saff_kuijlaars(len(found["counts"])), offsets, np.empty(0, dtype=np.int32)
            ),
            coverage=CoverageSummary(**coverage),
            read_seconds=found["read_seconds"],
            enough_share=found["enough_share"],
            full_share=found["full_share"],
            filters=tuple((name, stars) for name, stars in found["filters"]),
            rejected=found["rejected"],
            refusals=tuple(found["refusals"]),
            warnings=tuple(found["warnings"]),
        )

    def starter(
        self,
        name: str,
        camera: CameraSpec,
        faint_limit_mag: float | None = None,
        widest_fov_x_deg: float | None = None,
    ) -> Starter:
        """Return a first spec for a camera, from the embedded sky."""
        found = self._ask(
            "starter",
            name=name,
            camera=camera.model_dump(mode="json"),
            faint_limit_mag=faint_limit_mag,
            widest_fov_x_deg=widest_fov_x_deg,
        )
        return Starter(
            spec_from_dict(found["spec"], "spec"),
            tuple(map(_limit_row, found["limits"])),
            found["deepest_mag"],
            _limit_row(found["thinned"]),
            Cost(**found["cost"]),
        )

    def enough_limit(self, spec: BuildSpec) -> tuple[float, float]:
        """Return the faint limit that a camera needs, and the magnitude where the catalog ends."""
        limit, deepest = self._ask("enough_limit", spec=spec.model_dump(mode="json"))
        return limit, deepest

    def close(self) -> None:
        """End the process; whoever waits for an answer is refused."""
        super().close()
        with self._sending:
            child, self._child = self._child, None
        if child is not None:
            child.kill()
            self._hearing.join()

    def _ask(self, task: str, **arguments: Any) -> Any:
        answer: Future[Any] = Future()
        with self._sending:
            if self._child is None or not self._child.is_running:
                self._child = self._started()
            self._number += 1
            self._pending[self._number] = answer
            self._child.send({"number": self._number, "task": task, "arguments": arguments})
        try:
            content = answer.result(ANSWER_S)
        except TimeoutError:
            raise _ended() from None
        if "kind" not in content:
            return content["found"]
        status, message, key = content["status"], content["message"], content["key"]
        if status is not None:
            raise Problem(status, message, headers=content["headers"], key=key)
        error = error_of_kind(content["kind"], message, key=key, fields=content["fields"])
        raise error or RuntimeError(f"{content['kind']}: {message}")

    def _started(self) -> Child:
        # Arrow's own allocators keep the memory of a catalog that is not needed any more.
        memory = {"ARROW_DEFAULT_MEMORY_POOL": "system", "MALLOC_ARENA_MAX": "2"}
        child = Child("starcat_service.estimates:serve", environment=memory)
        child.send({"max_memory_bytes": self._max_memory_bytes, "wait_s": self._wait_s})
        self._pending = {}
        given = child, self._pending
        self._hearing = threading.Thread(target=self._hear, args=given, daemon=True)
        self._hearing.start()
        return child

    def _hear(self, child: Child, pending: dict[int, Future[Any]]) -> None:
        """Give each answer of a process to whom it is for, until the process ends."""
        try:
            for line in child.lines(TICK_S):
                if line is not None:
                    content = json.loads(line)
                    self._read_ones = tuple(CatalogRead(**one) for one in content["read"])
                    waiting = pending.pop(content["number"], None)
                    if waiting is not None:
                        waiting.set_result(content)
        except (OSError, ValueError):  # the pipe was closed
            pass
        finally:
            child.close()
            with self._sending:
                lost = list(pending.values())
                pending.clear()
            for waiting in lost:
                waiting.set_exception(_ended())


def _ended() -> Problem:
    return Problem(
        503,
        f"the process of the estimates ended, as it does without memory; ask again in {RETRY_S} s",
        headers={"Retry-After": str(RETRY_S)},
    )


def _limit_row(content: Mapping[str, Any]) -> LimitRow:
    return LimitRow(**{**content, "stars": Spread(**content["stars"])})


def serve() -> None:
    """Answer requests until there are no more: what the child process runs."""
    output = own_output()
    opening = json.loads(sys.stdin.buffer.readline() or b"{}")
    if not opening:
        return
    catalogs = Catalogs(opening["max_memory_bytes"], opening["wait_s"])
    writing = threading.Lock()

    def answer(request: Mapping[str, Any]) -> None:
        before = catalogs.known()
        content = {"number": request["number"], **_answer(catalogs, request)}
        content["read"] = [asdict(one) for one in catalogs.known()]
        if catalogs.known() != before:
            return_free_memory()
        line = json.dumps(content, default=_plain).encode() + b"\n"
        with writing:
            output.write(line)
            output.flush()

    with ThreadPoolExecutor(THREADS, "estimate") as threads:
        for line in sys.stdin.buffer:
            threads.submit(answer, json.loads(line))


def _answer(catalogs: Catalogs, request: Mapping[str, Any]) -> dict[str, Any]:
    try:
        return {"found": _TASKS[request["task"]](catalogs, **request["arguments"])}
    except Exception as error:
        problem = error if isinstance(error, Problem) else None
        key = getattr(error, "key", None)
        return {
            "kind": type(error).__name__,
            "message": str(error)[:4000],
            "key": None if key is None else str(key),
            "fields": list(getattr(error, "fields", ())),
            "status": problem.status if problem else None,
            "headers": problem.headers if problem else {},
        }


def _estimate(catalogs: Catalogs, spec: dict[str, Any]) -> dict[str, Any]:
    found = catalogs.estimate(spec_from_dict(spec, "spec"))
    return {
        **{name: getattr(found, name) for name in (*_SIMPLE, "warnings")},
        "cost": asdict(found.cost),
        "coverage": asdict(found.coverage),
        "counts": found.fields.count,
    }


def _starter(catalogs: Catalogs, *, camera: dict[str, Any], **arguments: Any) -> dict[str, Any]:
    found = catalogs.starter(camera=CameraSpec.model_validate(camera), **arguments)
    return {
        "spec": found.spec.model_dump(mode="json"),
        "limits": [asdict(row) for row in found.limits],
        "deepest_mag": found.deepest_mag,
        "thinned": asdict(found.thinned),
        "cost": asdict(found.cost),
    }


def _enough_limit(catalogs: Catalogs, spec: dict[str, Any]) -> Sequence[float]:
    return catalogs.enough_limit(spec_from_dict(spec, "spec"))


_TASKS: dict[str, Callable[..., Any]] = {
    "estimate": _estimate,
    "starter": _starter,
    "enough_limit": _enough_limit,
}


def _plain(value: Any) -> Any:
    """Return an array or a number of numpy as JSON has it."""
    return value.tolist()
