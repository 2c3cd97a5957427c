"""Limits of the work at the same time, for one client and for all together.

Waiting clients are served in turn: a slot is given to the client who holds the fewest; a client
that was served goes behind the others. A client gets another slot only if more slots are free
than it holds, so that one client cannot hold all slots when others come.
"""

from __future__ import annotations

import asyncio
import threading
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import Future
from concurrent.futures import TimeoutError as OutOfTime
from contextlib import asynccontextmanager, contextmanager
from contextvars import ContextVar
from functools import partial
from typing import TypeVar

from anyio import CapacityLimiter, to_thread

from starcat_service.problems import Problem

WAIT_S = 30.0
"""Seconds that a request waits while others are answered."""

RETRY_S = 5
"""Seconds after which to ask again."""

asker: ContextVar[str] = ContextVar("asker", default="")
"""Name of the client that is counted: the name of a token, or an address without a token."""

T = TypeVar("T")


class Slot:
    """A slot that is occupied while anything uses it, even beyond the end of a request."""

    def __init__(self, release: Callable[[], None]) -> None:
        self._release = release
        self._users = 0
        self._lock = threading.Lock()

    @contextmanager
    def used(self) -> Iterator[None]:
        """Keep the slot meanwhile; it is returned when nothing uses it any more."""
        with self._lock:
            self._users += 1
        try:
            yield
        finally:
            with self._lock:
                self._users -= 1
                is_over = not self._users
            if is_over:
                self._release()


class Limiter:
    """A number of slots for all clients together, of which one client can hold ``each``.

    With ``max_waiting``, a client that has so many requests waiting is refused at once.
    """

    def __init__(self, count: int, each: int, max_waiting: int | None = None) -> None:
        self._free, self._each, self._max_waiting = count, max(1, each), max_waiting
        self._used: Counter[str] = Counter()
        self._waiting: list[tuple[str, Future[Slot]]] = []
        self._lock = threading.Lock()
        self.slot: ContextVar[Slot | None] = ContextVar("slot", default=None)  # per request

    @contextmanager
    def hold(self, who: str, patience_s: float) -> Iterator[None]:
        """Hold a slot in this thread; raise a `Problem` if none is free in time."""
        future = self._enqueue(who)
        try:
            slot = future.result(patience_s)
        except OutOfTime:
            slot = self._stop_waiting(who, future, patience_s)
        with slot.used():
            yield

    @asynccontextmanager
    async def turn(self, patience_s: float) -> AsyncIterator[None]:
        """Hold a slot meanwhile; waiting for it takes no thread."""
        who = asker.get()
        future = self._enqueue(who)
        try:
            async with asyncio.timeout(None if future.done() else patience_s):
                slot = await asyncio.shield(asyncio.wrap_future(future))
        except TimeoutError:
            slot = self._stop_waiting(who, future, patience_s)
        except BaseException:
            if not future.cancel():
                self._release(who)
            raise
        with slot.used():
            token = self.slot.set(slot)
            try:
                yield
            finally:
                self.slot.reset(token)

    async def run(self, patience_s: float, call: Callable[[], T]) -> T:
        """Call a function in a thread when a slot is free."""
        async with self.turn(patience_s):
            return await in_thread(call)

    def _enqueue(self, who: str) -> Future[Slot]:
        future: Future[Slot] = Future()
        with self._lock:
            self._waiting.append((who, future))
            self._give()
            waiting = sum(waiter == who for waiter, _ in self._waiting)
            if future.done() or self._max_waiting is None or waiting <= self._max_waiting:
                return future
            future.cancel()
            self._give()
        raise Problem(
            503,
            f"{self._max_waiting} of your requests wait for others already; ask again in {RETRY_S} "
            "s, fewer at a time",
            headers={"Retry-After": str(RETRY_S)},
        )

    def _stop_waiting(self, who: str, future: Future[Slot], waited_s: float) -> Slot:
        """Stop waiting: return a slot that was given meanwhile, or raise an error."""
        if not future.cancel():
            return future.result()
        used = self._used[who]
        after = "ask again later"
        why = f"the service was busy for {waited_s:g} s: too many requests at once; {after}"
        if used:
            why = f"{used} of your requests took more than {waited_s:g} s; {after}, one at a time"
        raise Problem(429 if used else 503, why, headers={"Retry-After": "10"})

    def _release(self, who: str) -> None:
        with self._lock:
            self._free += 1
            self._used[who] -= 1
            self._give()

    def _give(self) -> None:
        waiting = [entry for entry in self._waiting if not entry[1].cancelled()]
        while able := [
            entry for entry in waiting if self._used[entry[0]] < min(self._each, self._free)
        ]:
            who, future = first = min(able, key=lambda entry: self._used[entry[0]])
            waiting.remove(first)
            waiting.sort(key=lambda entry: entry[0] == who)  # the others come first
            if future.set_running_or_notify_cancel():
                self._free -= 1
                self._used[who] += 1
                future.set_result(Slot(partial(self._release, who)))
        self._waiting, self._used = waiting, +self._used


async def in_thread(call: Callable[[], T]) -> T:
    """Call a function in a thread; the limit is the slot that the caller holds."""
    return await to_thread.run_sync(call, limiter=CapacityLimiter(1))
