"""Estimates of specs in a process of their own.

A catalog in memory takes hundreds of megabytes, and choosing stars from it takes processor time.
Both happen in a child process, so that the server process stays small and answers other requests
meanwhile. Several requests can be in progress. If the process ends, its requests are refused, and
the next request starts another process.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from starcat.errors import BuildError
from starcat.pipeline import Cost, Estimate, LimitRow, Starter, boresights_of
from starcat.products import CoverageSummary, FieldStars, Spread
from starcat.specs import BuildSpec, CameraSpec, spec_from_dict
from starcat.workers import (
    DONE,
    ERROR,
    Channel,
    MalformedMessage,
    WorkerProcess,
    error_content,
    error_of,
    from_json,
    return_free_memory,
)
from starcat_service.catalogs import RETRY_S, WAIT_S, CatalogRead, Catalogs
from starcat_service.problems import Problem
from starcat_service.sandbox.limiter import asker

T = TypeVar("T")

ANSWER_S = 4 * WAIT_S
"""Seconds that a request waits for its answer; the process itself refuses much earlier."""

THREADS = 40
"""Largest number of requests that the process works on or keeps waiting, as in the server."""

_SIMPLE = ("read_seconds", "enough_share", "full_share", "filters", "rejected")


class ChildCatalogs(Catalogs):
    """The catalogs of a service, and estimates from them, which a child process makes."""

    def __init__(self, max_memory_bytes: int | None = None, wait_s: float = WAIT_S) -> None:
        super().__init__(max_memory_bytes, wait_s)
        self._worker: WorkerProcess | None = None
        self._pending: dict[int, Future[Any]] = {}  # requests of this process, by their numbers
        self._read_ones: tuple[CatalogRead, ...] = ()  # catalogs that the process has read
        self._number = 0
        self._sending = threading.Lock()

    def known(self) -> list[CatalogRead]:
        """Return the figures of the catalogs that the process has read."""
        return list(self._read_ones)

    def estimate(self, spec: BuildSpec) -> Estimate:
        """Estimate the result of a spec, without the lists of stars of the fields."""
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
            fields=FieldStars(boresights_of(spec), offsets, np.empty(0, dtype=np.int32)),
            coverage=CoverageSummary(**coverage),
            read_seconds=found["read_seconds"],
            enough_share=found["enough_share"],
            full_share=found["full_share"],
            filters=tuple((name, stars) for name, stars in found["filters"]),
            rejected=found["rejected"],
            refusals=tuple(BuildError(words, key=key) for words, key in found["refusals"]),
            warnings=tuple(found["warnings"]),
        )

    def starter(
        self,
        name: str,
        camera: CameraSpec,
        faint_limit_mag: float | None = None,
        widest_fov_x_deg: float | None = None,
        reach_mag: float | None = None,
    ) -> Starter:
        """Return a first spec for a camera, from the embedded sky."""
        found = self._ask(
            "starter",
            name=name,
            camera=camera.model_dump(mode="json"),
            faint_limit_mag=faint_limit_mag,
            widest_fov_x_deg=widest_fov_x_deg,
            reach_mag=reach_mag,
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

    def blind(self, cache: Path) -> Path:
        """Return the database for photographs of unknown cameras; build it the first time."""
        return Path(self._ask("blind", cache=str(cache)))

    def close(self) -> None:
        """End the process; requests that wait for an answer are refused."""
        super().close()
        with self._sending:
            worker, self._worker = self._worker, None
        if worker is not None:
            worker.kill()
            self._hearing.join()

    def _ask(self, task: str, **arguments: Any) -> Any:
        answer: Future[Any] = Future()
        with self._sending:
            if self._worker is None or not self._worker.is_running:
                self._worker = self._started()
            self._number += 1
            self._pending[self._number] = answer
            with suppress(OSError):  # the reader notices that the process ended
                self._worker.send([self._number, asker.get(), task, arguments])
        try:
            kind, content = answer.result(ANSWER_S)
        except TimeoutError:
            raise _ended() from None
        if kind == DONE:
            return content
        if content["status"] is not None:
            status, message, key = content["status"], content["message"], content["key"]
            raise Problem(status, message, headers=content["headers"], key=key)
        raise error_of(content)

    def _started(self) -> WorkerProcess:
        # With more arenas, memory of catalogs that are not needed any more would be kept.
        worker = WorkerProcess(
            "starcat_service.estimates:serve_estimates", environment={"MALLOC_ARENA_MAX": "2"}
        )
        worker.send([self._max_memory_bytes, self._wait_s])
        self._pending = {}
        given = worker, self._pending
        self._hearing = threading.Thread(target=self._hear, args=given, daemon=True)
        self._hearing.start()
        return worker

    def _hear(self, worker: WorkerProcess, pending: dict[int, Future[Any]]) -> None:
        """Deliver each answer of a process to its request, until the process ends."""
        try:
            while True:
                reply = worker.receive()
                if reply is not None:
                    number, read, content = from_json(reply[1])
                    self._read_ones = tuple(CatalogRead(**one) for one in read)
                    waiting = pending.pop(number, None)
                    if waiting is not None:
                        waiting.set_result((reply[0], content))
        except (EOFError, OSError, MalformedMessage):
            pass
        finally:
            worker.close()
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


def serve_estimates() -> None:
    """Answer requests until there are no more: the main function of the worker."""
    channel = Channel()
    with suppress(EOFError), ThreadPoolExecutor(THREADS, "estimate") as threads:
        catalogs = Catalogs(*channel.receive())
        while True:
            threads.submit(_answer, channel, catalogs, *channel.receive())


def _answer(
    channel: Channel, catalogs: Catalogs, number: int, who: str, task: str, arguments: Any
) -> None:
    asker.set(who)
    before = catalogs.known()
    try:
        kind, content = DONE, _TASKS[task](catalogs, **arguments)
    except Exception as error:
        problem = error if isinstance(error, Problem) else None
        status, headers = (problem.status, problem.headers) if problem else (None, {})
        kind, content = ERROR, {**error_content(error), "status": status, "headers": headers}
    known = catalogs.known()
    if known != before:
        return_free_memory()
    channel.send(kind, [number, [asdict(one) for one in known], content])


def _estimate(catalogs: Catalogs, spec: dict[str, Any]) -> dict[str, Any]:
    found = catalogs.estimate(spec_from_dict(spec, "spec"))
    return {
        **{name: getattr(found, name) for name in (*_SIMPLE, "warnings")},
        "refusals": [(str(error), error.key) for error in found.refusals],
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
    "blind": lambda catalogs, cache: str(catalogs.blind(Path(cache))),
}
