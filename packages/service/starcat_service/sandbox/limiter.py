"""Limits of the work at the same time, for one client and for all together.

Waiting clients are served in turn: a place is given to the client who holds the fewest; a client
that was served goes behind the others. A client gets another place only if more places are free
than it holds, so that one client cannot hold all places when others come.
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


class Place:
    """A place that is held while anything uses it, even beyond the end of a request."""

    def __init__(self, release: Callable[[], None]) -> None:
        self._release = release
        self._users = 0
        self._lock = threading.Lock()

    @contextmanager
    def used(self) -> Iterator[None]:
        """Keep the place meanwhile; it is returned when nothing uses it any more."""
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
    """A number of places for all clients together, of which one client can hold ``each``.

    With ``max_waiting``, a client that has so many requests waiting is refused at once.
    """

    def __init__(self, count: int, each: int, max_waiting: int | None = None) -> None:
        self._free, self._each, self._max_waiting = count, max(1, each), max_waiting
        self._held: Counter[str] = Counter()
        self._waiting: list[tuple[str, Future[Place]]] = []
        self._lock = threading.Lock()
        self.place: ContextVar[Place | None] = ContextVar("place", default=None)  # per request

    @contextmanager
    def held(self, who: str, patience_s: float) -> Iterator[None]:
        """Hold a place in this thread; raise a `Problem` if none is free in time."""
        wanted = self._wanted(who)
        try:
            place = wanted.result(patience_s)
        except OutOfTime:
            place = self._given_up(who, wanted, patience_s)
        with place.used():
            yield

    @asynccontextmanager
    async def turn(self, patience_s: float) -> AsyncIterator[None]:
        """Hold a place meanwhile; waiting for it takes no thread."""
        who = asker.get()
        wanted = self._wanted(who)
        try:
            async with asyncio.timeout(None if wanted.done() else patience_s):
                place = await asyncio.shield(asyncio.wrap_future(wanted))
        except TimeoutError:
            place = self._given_up(who, wanted, patience_s)
        except BaseException:
            if not wanted.cancel():
                self._release(who)
            raise
        with place.used():
            token = self.place.set(place)
            try:
                yield
            finally:
                self.place.reset(token)

    async def run(self, patience_s: float, call: Callable[[], T]) -> T:
        """Call a function in a thread when a place is free."""
        async with self.turn(patience_s):
            return await in_thread(call)

    def _wanted(self, who: str) -> Future[Place]:
        wanted: Future[Place] = Future()
        with self._lock:
            self._waiting.append((who, wanted))
            self._give()
            waiting = sum(one == who for one, _ in self._waiting)
            if wanted.done() or self._max_waiting is None or waiting <= self._max_waiting:
                return wanted
            wanted.cancel()
            self._give()
        raise Problem(
            503,
            f"{self._max_waiting} of your requests wait for others already; ask again in {RETRY_S} "
            "s, fewer at a time",
            headers={"Retry-After": str(RETRY_S)},
        )

    def _given_up(self, who: str, wanted: Future[Place], waited_s: float) -> Place:
        """Stop waiting: return a place that was given meanwhile, or raise an error."""
        if not wanted.cancel():
            return wanted.result()
        own = self._held[who]
        after = "ask again later"
        why = f"the service was busy for {waited_s:g} s: too many requests at once; {after}"
        if own:
            why = f"{own} of your requests took more than {waited_s:g} s; {after}, one at a time"
        raise Problem(429 if own else 503, why, headers={"Retry-After": "10"})

    def _release(self, who: str) -> None:
        with self._lock:
            self._free += 1
            self._held[who] -= 1
            self._give()

    def _give(self) -> None:
        waiting = [one for one in self._waiting if not one[1].cancelled()]
        while able := [one for one in waiting if self._held[one[0]] < min(self._each, self._free)]:
            who, wanted = chosen = min(able, key=lambda one: self._held[one[0]])
            waiting.remove(chosen)
            waiting.sort(key=lambda one: one[0] == who)  # the others come first
            if wanted.set_running_or_notify_cancel():
                self._free -= 1
                self._held[who] += 1
                wanted.set_result(Place(partial(self._release, who)))
        self._waiting, self._held = waiting, +self._held


async def in_thread(call: Callable[[], T]) -> T:
    """Call a function in a thread; the limit is the place that the caller holds."""
    return await to_thread.run_sync(call, limiter=CapacityLimiter(1))
