"""Places for what runs at the same time, shared by who asks.

A user gets another place only where more are free than he holds, and no more than half of all, so
nobody can take them all; a place that becomes free is for the user who holds fewest, and of
those for the one who was served longest ago. A request begins in a short lane. What is not at its
end in `SHORT_S` moves to the long lane, where it goes on if a place is free there; else it is
ended, and begun again as soon as one is. Who is in the long lane has one place of the short lane.
"""

from __future__ import annotations

import asyncio
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from concurrent.futures import TimeoutError as OutOfTime
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from typing import ParamSpec, TypeVar

from anyio import CapacityLimiter, to_thread

from starcat.query.engine import Allowance
from starcat_service.problems import Problem

SHORT_PLACES = 6
"""Places of queries that are short, beside those that `Settings.queries` gives to long ones."""

SHORT_S = 0.25
"""Seconds of a processor that a query may take in a place of the short lane."""

WAIT_S = 30.0
"""Seconds that a request waits while others are answered."""

MOST_WAITING = 20
"""Long queries of one user that may wait."""

asker: ContextVar[str] = ContextVar("asker", default="")
"""Who is counted as one user: the name of a token, or the address of somebody without one."""

P = ParamSpec("P")
T = TypeVar("T")


class Overdue(Exception):  # noqa: N818 - the name reads as the fact
    """What was asked is not short, and no place of the long lane was free for it."""


class Places:
    """Some places, and those who wait for one."""

    def __init__(self, count: int, elsewhere: Places | None = None) -> None:
        self._free = count
        self._share = max(1, count // 2)
        self._elsewhere = elsewhere  # who has a place there is content with one here
        self._held: Counter[str] = Counter()
        self._served: dict[str, int] = {}  # when each user was last given a place, as a number
        self._waiting: list[tuple[str, Future[None]]] = []
        self._lock = threading.Lock()

    def waiting(self, who: str) -> int:
        """Return how often somebody waits."""
        with self._lock:
            return sum(one == who for one, _ in self._waiting)

    def is_used_by(self, who: str) -> bool:
        """Return whether somebody holds a place, or waits for one."""
        return self._held[who] > 0 or self.waiting(who) > 0

    def try_take(self, who: str) -> bool:
        """Take a place if nobody has to be waited for."""
        place = self._asked(who)
        return place.done() or not self._given_up(who, place)

    def take(self, who: str, patience_s: float) -> None:
        """Take a place; a `Problem` where none was free in time."""
        place = self._asked(who)
        try:
            place.result(patience_s)
        except OutOfTime:
            if self._given_up(who, place):
                raise self._too_late(who, patience_s) from None

    async def take_later(self, who: str, patience_s: float) -> None:
        """Take a place as `take` does, holding no thread meanwhile."""
        place = self._asked(who)
        if place.done():
            return
        try:
            async with asyncio.timeout(patience_s):
                await asyncio.shield(asyncio.wrap_future(place))
        except TimeoutError:
            if self._given_up(who, place):
                raise self._too_late(who, patience_s) from None
        except BaseException:
            if not self._given_up(who, place):
                self.release(who)
            raise

    def release(self, who: str) -> None:
        """Give a place back."""
        with self._lock:
            self._free += 1
            self._held[who] -= 1
            self._give()

    def _too_late(self, who: str, waited_s: float) -> Problem:
        """Return what is said where no place was free in time, by whose doing that was."""
        own = self._held[who]
        after = "ask again later"
        why = f"the service was busy for {waited_s:g} s: too many requests at once; {after}"
        if own:
            why = f"{own} of your requests took more than {waited_s:g} s; {after}, one at a time"
        return Problem(429 if own else 503, why, headers={"Retry-After": "10"})

    def _asked(self, who: str) -> Future[None]:
        place: Future[None] = Future()
        with self._lock:
            self._waiting.append((who, place))
            self._give()
        return place

    def _given_up(self, who: str, place: Future[None]) -> bool:
        """Wait no longer; False where the place was given meanwhile."""
        with self._lock:
            if place.done():
                return False
            self._waiting.remove((who, place))
            return True

    def _give(self) -> None:
        while self._free:
            able = [one for one in self._waiting if self._may_have_another(one[0])]
            if not able:
                break
            chosen = min(able, key=lambda one: (self._held[one[0]], self._served.get(one[0], 0)))
            who, place = chosen
            self._waiting.remove(chosen)
            self._free -= 1
            self._held[who] += 1
            self._served[who] = max(self._served.values(), default=0) + 1
            place.set_result(None)
        known = {one for one, _ in self._waiting} | set(+self._held)
        self._served = {one: when for one, when in self._served.items() if one in known}

    def _may_have_another(self, who: str) -> bool:
        held = self._held[who]
        is_content = held > 0 and self._elsewhere is not None and self._elsewhere.is_used_by(who)
        return held < min(1 if is_content else self._share, self._free)


class Lease:
    """A place that is held while something of a request uses it, in the short lane or the long."""

    def __init__(self, who: str, long: Places, held: Places) -> None:
        self._who, self._long, self._held = who, long, held
        self._users = 1
        self._lock = threading.Lock()
        self.is_overdue = False

    @property
    def is_long(self) -> bool:
        """Whether it is a place of the long lane."""
        return self._held is self._long

    def prolong(self) -> bool:
        """Move to the long lane, if a place is free there."""
        with self._lock:
            if not self.is_long:
                if self._long.try_take(self._who):
                    self._held.release(self._who)
                    self._held = self._long
                else:
                    self.is_overdue = True
            return self.is_long

    def allowance(self, total_s: float) -> Allowance:
        """Return the time of a query in this place."""
        if self.is_long or total_s <= SHORT_S:
            return Allowance(total_s, is_patient=self.is_long)
        return Allowance(total_s, SHORT_S, self.prolong)

    @contextmanager
    def used(self) -> Iterator[None]:
        """Keep the place while something goes on that may last longer than the request's call."""
        with self._lock:
            self._users += 1
        try:
            yield
        finally:
            self.end()

    def end(self) -> None:
        """Give the place back, when nothing uses it any more."""
        with self._lock:
            self._users -= 1
            if not self._users:
                self._held.release(self._who)


lease: ContextVar[Lease | None] = ContextVar("lease", default=None)
"""The place of the request that is answered."""


class Lanes:
    """The short lane and the long lane."""

    def __init__(self, short: int, long: int) -> None:
        self.long = Places(long)
        self.short = Places(short, self.long)

    async def run(
        self, patience_s: float, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """Call a function in a thread when a place is free; again where it was overdue."""
        who = asker.get()
        call = partial(function, *args, **kwargs)
        await self.short.take_later(who, WAIT_S)
        try:
            return await self._called(Lease(who, self.long, self.short), call)
        except Overdue:
            waiting = self.long.waiting(who)
            if waiting >= MOST_WAITING:
                raise Problem(
                    429,
                    f"{waiting} of your queries wait for one that takes long; ask again when they "
                    "are answered, or make jobs of them with TAP",
                    headers={"Retry-After": f"{patience_s:.0f}"},
                ) from None
        await self.long.take_later(who, patience_s)
        return await self._called(Lease(who, self.long, self.long), call)

    async def _called(self, place: Lease, call: Callable[[], T]) -> T:
        token = lease.set(place)
        try:
            return await in_thread(call)
        finally:
            lease.reset(token)
            place.end()


async def in_thread(call: Callable[[], T]) -> T:
    """Call a function in a thread; that one is free is seen to by whoever has a place."""
    return await to_thread.run_sync(call, limiter=CapacityLimiter(1))


@contextmanager
def held(places: Places, who: str) -> Iterator[None]:
    """Hold a place in this thread."""
    places.take(who, WAIT_S)
    try:
        yield
    finally:
        places.release(who)
