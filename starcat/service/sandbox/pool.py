"""A bounded number at the same time: of threads that work, and of processes that are lent."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Generic, ParamSpec, Protocol, TypeVar

import anyio
from anyio import CapacityLimiter, to_thread

from starcat.service.problems import Problem

WAIT_S = 10.0
"""Seconds that a request waits while others are answered."""

P = ParamSpec("P")
T = TypeVar("T")
K = TypeVar("K")


class Limiter:
    """So many at the same time; `run` lets requests wait without holding a thread."""

    def __init__(self, count: int) -> None:
        self._threads = CapacityLimiter(count)
        self._slots = threading.BoundedSemaphore(count)

    async def run(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function in a thread when one of the threads is free."""
        borrower = object()
        with anyio.move_on_after(WAIT_S) as waiting:
            await self._threads.acquire_on_behalf_of(borrower)
        if waiting.cancelled_caught:
            raise _busy()
        try:
            # A thread is free already: the limiter of this call keeps nobody waiting.
            return await to_thread.run_sync(
                partial(function, *args, **kwargs), limiter=CapacityLimiter(1)
            )
        finally:
            self._threads.release_on_behalf_of(borrower)

    @contextmanager
    def slot(self) -> Iterator[None]:
        """Hold one of the slots, which whoever streams an answer does for longer than `run`."""
        if not self._slots.acquire(timeout=WAIT_S):
            raise _busy()
        try:
            yield
        finally:
            self._slots.release()


class Process(Protocol):
    """What a `Pool` lends."""

    @property
    def is_running(self) -> bool:
        """Whether it can be lent again."""

    def close(self) -> None:
        """End it."""


ProcessT = TypeVar("ProcessT", bound=Process)


class Pool(Generic[K, ProcessT]):
    """Processes that are kept for the next request with the same key.

    One that an error was raised with is closed, unless the error is one of ``harmless``; the
    processes that were used longest ago are closed where more than ``most_idle`` are idle.
    """

    def __init__(
        self,
        begin: Callable[[K], ProcessT],
        most: int,
        most_idle: int,
        harmless: tuple[type[Exception], ...] = (),
    ) -> None:
        self._begin, self._most_idle, self._harmless = begin, most_idle, harmless
        self._limiter = Limiter(most)
        self.run = self._limiter.run  # for handlers that are ``async def``
        self._idle: list[tuple[K, ProcessT]] = []
        self._lock = threading.Lock()
        self._is_closed = False
        weakref.finalize(self, _close, self._idle)

    @contextmanager
    def lend(self, key: K) -> Iterator[ProcessT]:
        """Give a process that nobody else uses meanwhile."""
        with self._limiter.slot():
            process = self._idle_one(key) or self._begin(key)
            is_reusable = False
            try:
                yield process
                is_reusable = True
            except self._harmless:
                is_reusable = True
                raise
            finally:
                self._give_back(key, process, is_reusable and process.is_running)

    def forget(self, is_gone: Callable[[K], bool]) -> None:
        """Close the idle processes whose key fits."""
        with self._lock:
            gone = [one for one in self._idle if is_gone(one[0])]
            self._idle[:] = [one for one in self._idle if one not in gone]
        _close(gone)

    def close(self) -> None:
        """Close all processes; one that is in use is closed as soon as it is given back."""
        with self._lock:
            self._is_closed = True
        self.forget(lambda _: True)

    def _idle_one(self, key: K) -> ProcessT | None:
        with self._lock:
            found = next((one for one in reversed(self._idle) if one[0] == key), None)
            if found is not None:
                self._idle.remove(found)
        if found is not None and not found[1].is_running:
            _close([found])
            return self._idle_one(key)
        return None if found is None else found[1]

    def _give_back(self, key: K, process: ProcessT, is_reusable: bool) -> None:
        gone = [] if is_reusable else [(key, process)]
        with self._lock:
            if is_reusable:
                self._idle.append((key, process))
            while len(self._idle) > (0 if self._is_closed else self._most_idle):
                gone.append(self._idle.pop(0))
        _close(gone)


def _close(idle: list[tuple[K, ProcessT]]) -> None:
    while idle:
        idle.pop()[1].close()


def _busy() -> Problem:
    return Problem(
        503,
        f"the service was busy for {WAIT_S:g} s: too many requests at once; ask again later",
        headers={"Retry-After": f"{WAIT_S:.0f}"},
    )
