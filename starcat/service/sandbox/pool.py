"""Processes that are kept for the next request, and query sessions in them."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Generic, ParamSpec, Protocol, TypeVar

from starcat.errors import QueryError, QueryLimitError
from starcat.query.engine import Allowance
from starcat.query.session import Limits, Session, open_session
from starcat.service.sandbox.places import SHORT_PLACES, Lanes, Overdue, lease
from starcat.service.settings import Settings

IDLE = 6
"""Query sessions that are kept while nobody asks; those used longest ago are closed first."""

DISK_GB = 4.0
"""Gigabytes of disk that a query may take for what does not fit into its memory."""

GIB_IN_GB = 2**30 / 1e9

P = ParamSpec("P")
T = TypeVar("T")
K = TypeVar("K")


class Process(Protocol):
    """What a `Pool` lends."""

    @property
    def is_running(self) -> bool:
        """Whether it can be lent again."""


ProcessT = TypeVar("ProcessT", bound=Process)


class Pool(Generic[K, ProcessT]):
    """Processes that are kept for the next request with the same key.

    One that an error was raised with is closed, unless the error is one of ``harmless``; the
    processes that were used longest ago are closed where more than ``most_idle`` are idle.
    """

    def __init__(
        self,
        begin: Callable[[K], AbstractContextManager[ProcessT]],
        most_idle: int,
        harmless: tuple[type[Exception], ...] = (),
    ) -> None:
        self._begin, self._most_idle, self._harmless = begin, most_idle, harmless
        self._idle: list[tuple[K, ProcessT, ExitStack]] = []
        self._lock = threading.Lock()
        self._is_closed = False
        weakref.finalize(self, _close, self._idle)

    @contextmanager
    def lend(self, key: K) -> Iterator[ProcessT]:
        """Give a process that nobody else uses meanwhile."""
        process, closing = self._idle_one(key) or self._begun(key)
        is_reusable = False
        try:
            yield process
            is_reusable = True
        except self._harmless:
            is_reusable = True
            raise
        finally:
            self._give_back((key, process, closing), is_reusable and process.is_running)

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

    def _begun(self, key: K) -> tuple[ProcessT, ExitStack]:
        with ExitStack() as closing:
            return closing.enter_context(self._begin(key)), closing.pop_all()

    def _idle_one(self, key: K) -> tuple[ProcessT, ExitStack] | None:
        with self._lock:
            found = next((one for one in reversed(self._idle) if one[0] == key), None)
            if found is None:
                return None
            self._idle.remove(found)
        if found[1].is_running:
            return found[1:]
        _close([found])
        return self._idle_one(key)

    def _give_back(self, lent: tuple[K, ProcessT, ExitStack], is_reusable: bool) -> None:
        gone = [] if is_reusable else [lent]
        with self._lock:
            if is_reusable:
                self._idle.append(lent)
            while len(self._idle) > (0 if self._is_closed else self._most_idle):
                gone.append(self._idle.pop(0))
        _close(gone)


def _close(idle: list[tuple[K, ProcessT, ExitStack]]) -> None:
    while idle:
        idle.pop()[-1].close()


Key = tuple[tuple[str, int, int], ...]  # path, inode and time of each target


class QueryPool:
    """Query sessions, which are kept for the next query about the same targets.

    Each is a process of its own with the guard of `starcat.query`; `run` calls what uses `session`
    in a thread, when there is a place for it.
    """

    def __init__(self, settings: Settings) -> None:
        memory_gb = settings.query_memory_gib * GIB_IN_GB
        self._limits = Limits(settings.query_time_s, memory_gb, DISK_GB)
        self._lanes = Lanes(SHORT_PLACES, settings.queries)
        self._open: Pool[Key, Session] = Pool(self._begin, IDLE, (QueryError,))
        self.close = self._open.close

    async def run(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function that only reads: where it takes long, it may be called again."""
        return await self._lanes.run(self._limits.time_s, function, *args, **kwargs)

    @contextmanager
    def session(
        self, targets: Sequence[str | Path], time_s: float | None = None
    ) -> Iterator[Session]:
        """Give a session about some targets, which nobody else uses meanwhile.

        All that it is asked has one time together.
        """
        limits = replace(self._limits, time_s=time_s or self._limits.time_s)
        place = lease.get()
        with (
            nullcontext() if place is None else place.used(),
            self._open.lend(tuple(map(_identity, targets))) as one,
        ):
            time_of = Allowance if place is None else place.allowance
            try:
                yield replace(one, limits=limits, allowance=time_of(limits.time_s))
            except QueryLimitError as error:
                if place is not None and place.is_overdue:
                    raise Overdue from error
                raise

    def forget(self, target: str | Path) -> None:
        """Close the sessions about a target that is to be removed and that nobody uses."""
        name = str(target)
        self._open.forget(lambda key: name in [text for text, *_ in key])

    def _begin(self, key: Key) -> AbstractContextManager[Session]:
        return open_session([text for text, *_ in key], self._limits)


def _identity(target: str | Path) -> tuple[str, int, int]:
    """Return what tells a target from another that takes its place."""
    try:
        found = Path(target).stat()
    except OSError:
        return str(target), 0, 0
    return str(target), found.st_ino, found.st_mtime_ns
