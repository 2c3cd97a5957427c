"""Estimates of specs in a process of their own.

A catalog in memory takes hundreds of megabytes, and choosing stars from it takes processor time.
Both happen in a child process, so that the server process stays small and answers other requests
meanwhile. If the process ends, its requests are refused, and the next request starts another one.

Waiting takes no thread. Equal requests wait for one answer. A user can have few requests in the
process and few that wait; more are refused at once. A request that waits too long is refused too,
but the process goes on, and the same request finds the answer later.
"""

from __future__ import annotations

import asyncio
import hashlib
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from typing import Any, TypeVar

import numpy as np

from starcat.database.products import FieldStars, Spread
from starcat.errors import BuildError
from starcat.pipeline import Cost, Estimate, LimitRow, Starter, boresights_of
from starcat.pipeline.specs import BuildSpec, CameraSpec, preset, preset_names, spec_from_dict
from starcat.storage import json_bytes
from starcat_service.catalogs import CatalogRead, Catalogs, Offered, offered_catalogs, sources_read
from starcat_service.problems import Problem
from starcat_service.sandbox.channel import Channel, return_free_memory
from starcat_service.sandbox.limiter import RETRY_S, Limiter, asker, in_thread
from starcat_service.sandbox.messages import (
    DONE,
    ERROR,
    MalformedMessage,
    error_content,
    error_of,
    from_json,
)
from starcat_service.sandbox.process import WorkerProcess

K = TypeVar("K")
T = TypeVar("T")

WAIT_S = 25.0
"""Seconds that a request waits for its answer."""

MAX_ANSWER_S = 1800.0
"""Seconds after which a process that does not answer is ended."""

AT_ONCE, OWN_AT_ONCE, OWN_WAITING = 6, 2, 4
"""Requests in the process at the same time, and those of one user; more of the user wait."""


class ChildCatalogs:
    """The catalogs of a service, and estimates from them, which a child process makes."""

    def __init__(self, max_memory_bytes: int | None = None, wait_s: float = WAIT_S) -> None:
        self._max_memory_bytes, self._wait_s = max_memory_bytes, wait_s
        self._worker: WorkerProcess | None = None
        self._pending: dict[int, Future[Any]] = {}  # requests of this process, by their numbers
        self._catalogs_read: tuple[CatalogRead, ...] = ()  # catalogs that the process has read
        self._number = 0
        self._sending = threading.Lock()
        self._limiter = Limiter(AT_ONCE, OWN_AT_ONCE, OWN_WAITING)
        # By a digest of the request: of each user what waits for a place; what is in the process.
        self._waiting: dict[tuple[str, str], asyncio.Task[Any]] = {}
        self._running: dict[str, asyncio.Task[Any]] = {}

    def catalogs_read(self) -> list[CatalogRead]:
        """Return the figures of the catalogs that the process has read."""
        return list(self._catalogs_read)

    def offered(self) -> list[Offered]:
        """Return the catalogs that a spec can name."""
        return offered_catalogs(self._catalogs_read)

    async def estimate(self, spec: BuildSpec) -> Estimate:
        """Estimate the result of a spec, without the lists of stars of the fields."""
        arguments = {"spec": spec.model_dump(mode="json")}
        return await self._ask("estimate", arguments, spec, partial(_estimate_of, spec))

    async def starter(
        self,
        name: str,
        camera: CameraSpec,
        faint_limit_mag: float | None = None,
        widest_fov_x_deg: float | None = None,
        reach_mag: float | None = None,
    ) -> Starter:
        """Return a first spec for a camera, from the embedded sky."""
        arguments = {
            "name": name,
            "camera": camera.model_dump(mode="json"),
            "faint_limit_mag": faint_limit_mag,
            "widest_fov_x_deg": widest_fov_x_deg,
            "reach_mag": reach_mag,
        }
        return await self._ask("starter", arguments, preset(preset_names()[0]), _starter_of)

    async def enough_limit(self, spec: BuildSpec) -> tuple[float, float]:
        """Return the faint limit that a camera needs, and the magnitude where the catalog ends."""
        arguments = {"spec": spec.model_dump(mode="json")}
        return await self._ask("enough_limit", arguments, spec, _limits_of)

    def close(self) -> None:
        """End the process; requests that wait for an answer are refused."""
        with self._sending:
            worker, self._worker = self._worker, None
        if worker is not None:
            worker.kill()
            self._hearing.join()

    async def _ask(
        self,
        task: str,
        arguments: Mapping[str, Any],
        read: BuildSpec,  # its catalogs are read for the answer
        convert: Callable[[Any], T],
    ) -> T:
        """Return an answer of the process; equal requests at the same time have the same answer."""
        key, who = hashlib.sha256(json_bytes([task, arguments])).hexdigest(), asker.get()
        running = self._running.get(key) or self._waiting.get((who, key))
        if running is None:
            running = asyncio.create_task(self._in_turn(key, task, arguments, convert))
            self._waiting[who, key] = running
            running.add_done_callback(partial(_forget, self._waiting, (who, key)))
        try:
            async with asyncio.timeout(self._wait_s):
                answer: T = await asyncio.shield(running)
        except TimeoutError:
            if running.done():
                raise
            sources = {catalog.source for catalog in self._catalogs_read}
            names = ", ".join(name for name in sources_read(read) if name not in sources)
            what = f"{names}: being read, which" if names else "the estimate"
            raise _busy(f"{what} takes longer than a request waits") from None
        return answer

    async def _in_turn(
        self, key: str, task: str, arguments: Mapping[str, Any], convert: Callable[[Any], T]
    ) -> T:
        """Return an answer of the process as soon as its user has a slot."""
        async with self._limiter.turn(MAX_ANSWER_S):
            running = self._running.get(key)
            if running is None:
                running = asyncio.create_task(self._answer(task, arguments, convert))
                self._running[key] = running
                running.add_done_callback(partial(_forget, self._running, key))
            answer: T = await asyncio.shield(running)
        return answer

    async def _answer(
        self, task: str, arguments: Mapping[str, Any], convert: Callable[[Any], T]
    ) -> T:
        answer = await in_thread(partial(self._sent, task, arguments))
        try:
            async with asyncio.timeout(MAX_ANSWER_S):
                kind, content = await asyncio.wrap_future(answer)
        except TimeoutError:
            with self._sending:
                if self._worker is not None:
                    self._worker.kill()
            raise _ended() from None
        if kind == DONE:
            return await in_thread(partial(convert, content))
        if content["status"] is not None:
            status, message, key = content["status"], content["message"], content["key"]
            raise Problem(status, message, headers=content["headers"], key=key)
        raise error_of(content)

    def _sent(self, task: str, arguments: Mapping[str, Any]) -> Future[Any]:
        """Send a request to the process; return the future answer."""
        answer: Future[Any] = Future()
        with self._sending:
            if self._worker is None or not self._worker.is_running:
                self._worker = self._started()
            self._number += 1
            self._pending[self._number] = answer
            with suppress(OSError):  # the reader notices that the process ended
                self._worker.send([self._number, task, dict(arguments)])
        return answer

    def _started(self) -> WorkerProcess:
        # With more arenas, memory of catalogs that are not needed any more would be kept.
        worker = WorkerProcess(
            "starcat_service.estimates:serve_estimates", environment={"MALLOC_ARENA_MAX": "2"}
        )
        worker.send([self._max_memory_bytes])
        self._pending = {}
        arguments = worker, self._pending
        self._hearing = threading.Thread(target=self._hear, args=arguments, daemon=True)
        self._hearing.start()
        return worker

    def _hear(self, worker: WorkerProcess, pending: dict[int, Future[Any]]) -> None:
        """Deliver each answer of a process to its request, until the process ends."""
        try:
            while True:
                reply = worker.receive()
                if reply is not None:
                    number, read, content = from_json(reply[1])
                    self._catalogs_read = tuple(CatalogRead(**figures) for figures in read)
                    waiting = pending.pop(number, None)
                    if waiting is not None and waiting.set_running_or_notify_cancel():
                        waiting.set_result((reply[0], content))
        except (EOFError, OSError, MalformedMessage):
            pass
        finally:
            worker.close()
            with self._sending:
                lost = list(pending.values())
                pending.clear()
            for waiting in lost:
                if waiting.set_running_or_notify_cancel():
                    waiting.set_exception(_ended())


def _forget(tasks: dict[K, asyncio.Task[Any]], key: K, task: asyncio.Task[Any]) -> None:
    del tasks[key]
    if not task.cancelled():
        task.exception()  # nobody may be waiting for it any more


def _busy(what: str) -> Problem:
    headers = {"Retry-After": str(RETRY_S)}
    return Problem(503, f"{what}; ask again in {RETRY_S} s", headers=headers)


def _ended() -> Problem:
    return _busy("the process of the estimates ended, as it does without memory")


def _estimate_of(spec: BuildSpec, content: Mapping[str, Any]) -> Estimate:
    """Return the estimate that the process has sent."""
    offsets = np.concatenate([[0], np.cumsum(np.array(content["counts"], dtype=np.int64))])
    return Estimate(
        spec=spec,
        cost=Cost(**content["cost"]),
        fields=FieldStars(boresights_of(spec), offsets, np.empty(0, dtype=np.int32)),
        filters=tuple((name, stars) for name, stars in content["filters"]),
        rejected=content["rejected"],
        refusals=tuple(BuildError(words, key=key) for words, key in content["refusals"]),
        warnings=tuple(content["warnings"]),
    )


def _limits_of(content: Sequence[float]) -> tuple[float, float]:
    limit, deepest = content
    return limit, deepest


def _starter_of(content: Mapping[str, Any]) -> Starter:
    """Return the first spec that the process has sent."""
    return Starter(
        spec_from_dict(content["spec"], "spec"),
        tuple(map(_limit_row, content["limits"])),
        content["deepest_mag"],
        _limit_row(content["thinned"]),
        Cost(**content["cost"]),
    )


def _limit_row(content: Mapping[str, Any]) -> LimitRow:
    return LimitRow(**{**content, "stars": Spread(**content["stars"])})


def serve_estimates() -> None:
    """Answer requests until there are no more: the main function of the worker."""
    channel = Channel()
    with suppress(EOFError), ThreadPoolExecutor(AT_ONCE, "estimate") as threads:
        catalogs = Catalogs(*channel.receive())
        while True:
            threads.submit(_answer, channel, catalogs, *channel.receive())


def _answer(channel: Channel, catalogs: Catalogs, number: int, task: str, arguments: Any) -> None:
    before = catalogs.catalogs_read()
    try:
        kind, content = DONE, _TASKS[task](catalogs, **arguments)
    except Exception as error:
        problem = error if isinstance(error, Problem) else None
        status, headers = (problem.status, problem.headers) if problem else (None, {})
        kind, content = ERROR, {**error_content(error), "status": status, "headers": headers}
    after = catalogs.catalogs_read()
    if after != before:
        return_free_memory()
    channel.send(kind, [number, [asdict(catalog) for catalog in after], content])


def _estimate(catalogs: Catalogs, spec: dict[str, Any]) -> dict[str, Any]:
    estimate = catalogs.estimate(spec_from_dict(spec, "spec"))
    return {
        **{name: getattr(estimate, name) for name in ("filters", "rejected", "warnings")},
        "refusals": [(str(error), error.key) for error in estimate.refusals],
        "cost": asdict(estimate.cost),
        "counts": estimate.fields.count,
    }


def _starter(catalogs: Catalogs, *, camera: dict[str, Any], **arguments: Any) -> dict[str, Any]:
    starter = catalogs.starter(camera=CameraSpec.model_validate(camera), **arguments)
    return {
        "spec": starter.spec.model_dump(mode="json"),
        "limits": [asdict(row) for row in starter.limits],
        "deepest_mag": starter.deepest_mag,
        "thinned": asdict(starter.thinned),
        "cost": asdict(starter.cost),
    }


def _enough_limit(catalogs: Catalogs, spec: dict[str, Any]) -> Sequence[float]:
    return catalogs.enough_limit(spec_from_dict(spec, "spec"))


_TASKS: dict[str, Callable[..., Any]] = {
    "estimate": _estimate,
    "starter": _starter,
    "enough_limit": _enough_limit,
}
