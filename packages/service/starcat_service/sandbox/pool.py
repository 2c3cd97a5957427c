"""Processes that are kept for the next request, and query sessions in them."""

from __future__ import annotations

import threading
import time
import weakref
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Generic, ParamSpec, Protocol, TypeVar

from starcat.errors import QueryError, StarcatError, TargetMissing
from starcat.query import Allowance, Limits, Session, open_session
from starcat.storage import make_folder
from starcat_service.paths import ServicePaths
from starcat_service.sandbox.limiter import Limiter
from starcat_service.sandbox.query_engine import ConfinedEngine, warm_up
from starcat_service.security.request_limits import reserved, spare_gib
from starcat_service.settings import ServiceSettings

SHORT_SLOTS = 6
"""Short queries that run at the same time, in addition to `Settings.queries` long ones."""

SHORT_S = 0.25
"""Processor seconds after which a query has lower priority."""

IDLE = 2 * SHORT_SLOTS
"""Query sessions that are kept while idle; those unused for longest are closed first. SQL and TAP
use different sessions of a database, and each can need all slots for a moment."""

STARVED = 3.0
"""A query ends after this multiple of its time if a busy machine left it little processor time."""

SPARE = 2
"""Processes that are started before it is known what they will open, which saves time."""

BACK_S = 0.2
"""Seconds to wait for a process that others use before another is started."""

BEGINNING = 2
"""Processes with the same key that can start at the same time."""

DISK_GB = 4.0
"""Gigabytes of disk that a query can use for data that does not fit into its memory."""

MIN_DISK_GB = 0.001
"""The same if the disk is nearly full."""

ROW_BYTES = 64 << 20
"""Size of a row of a file at most."""

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


Lent = tuple[K, ProcessT, ExitStack]
"""A process with its key, and what closes it."""


class Pool(Generic[K, ProcessT]):
    """Processes that are kept for the next request with the same key.

    A process that raised an error is closed, unless the error is one of ``harmless``. If more than
    ``max_idle`` are idle, the processes that were unused for longest are closed.
    """

    def __init__(
        self,
        begin: Callable[[K], AbstractContextManager[ProcessT]],
        max_idle: int,
        harmless: tuple[type[Exception], ...] = (),
    ) -> None:
        self._begin, self._max_idle, self._harmless = begin, max_idle, harmless
        self._idle: list[Lent[K, ProcessT]] = []
        self._lent: list[Lent[K, ProcessT]] = []
        self._waiting: Counter[K] = Counter()  # requests that wait for a process
        self._beginning: Counter[K] = Counter()  # processes that are being started
        self._failed: dict[K, list[BaseException]] = {}  # why some could not be started
        self._changed = threading.Condition()
        self._is_closed = False
        weakref.finalize(self, _close, self._idle)

    @contextmanager
    def lend(self, key: K) -> Iterator[ProcessT]:
        """Lend a process for exclusive use."""
        lent = self._obtained(key)
        is_reusable = False
        try:
            yield lent[1]
            is_reusable = True
        except self._harmless:
            is_reusable = True
            raise
        finally:
            with self._changed:
                self._lent.remove(lent)
            self._keep(lent, is_reusable and lent[1].is_running)

    def forget(self, is_gone: Callable[[K], bool]) -> None:
        """Close the idle processes whose key fits."""
        with self._changed:
            gone = [lent for lent in self._idle if is_gone(lent[0])]
            self._idle[:] = [lent for lent in self._idle if lent not in gone]
        _close(gone)

    def close(self) -> None:
        """Close all processes; a user of a process notices that it has ended."""
        with self._changed:
            self._is_closed = True
            lent = list(self._lent)
        self.forget(lambda _: True)
        _close(lent)

    def _obtained(self, key: K) -> Lent[K, ProcessT]:
        """Return the first process that is free: one that is given back, or a new one."""
        with self._changed:
            is_used = self._beginning[key] or any(other[0] == key for other in self._lent)
            begins_s = time.monotonic() + (BACK_S if is_used else 0.0)
            self._waiting[key] += 1
            try:
                while (lent := self._idle_process(key)) is None:
                    if self._failed.get(key):
                        raise self._failed[key].pop()
                    wait_s = begins_s - time.monotonic()
                    if wait_s > 0.0:
                        self._changed.wait(wait_s)
                        continue
                    if self._beginning[key] < min(self._waiting[key], BEGINNING):
                        self._beginning[key] += 1
                        threading.Thread(
                            target=self._begin_process, args=(key,), daemon=True
                        ).start()
                    self._changed.wait()
            finally:
                self._waiting -= Counter((key,))
                if not self._waiting[key]:
                    self._failed.pop(key, None)
            self._lent.append(lent)
            return lent

    def _begin_process(self, key: K) -> None:
        started: Lent[K, ProcessT] | BaseException
        try:
            with ExitStack() as closing:
                started = key, closing.enter_context(self._begin(key)), closing.pop_all()
        except BaseException as error:
            started = error
        with self._changed:
            self._beginning -= Counter((key,))
            if isinstance(started, BaseException):
                if self._waiting[key]:
                    self._failed.setdefault(key, []).append(started)
                self._changed.notify_all()
                return
        self._keep(started, True)

    def _idle_process(self, key: K) -> Lent[K, ProcessT] | None:
        for number in range(len(self._idle) - 1, -1, -1):
            if self._idle[number][0] == key:
                lent = self._idle.pop(number)
                if lent[1].is_running:
                    return lent
                _close([lent])
        return None

    def _keep(self, lent: Lent[K, ProcessT], is_reusable: bool) -> None:
        """Keep a process for the next request with its key, or close it."""
        gone = [] if is_reusable else [lent]
        with self._changed:
            if is_reusable:
                self._idle.append(lent)
            most = self._waiting[lent[0]] + (0 if self._is_closed else self._max_idle)
            while len(self._idle) > most:
                gone.append(self._idle.pop(0))
            self._changed.notify_all()
        _close(gone)


def _close(idle: list[Lent[K, ProcessT]]) -> None:
    while idle:
        idle.pop()[-1].close()


Key = tuple[tuple[str, int, int], ...]  # path, inode and time of each target


class QueryPool:
    """Query sessions, which are kept for the next query about the same targets.

    Each is a process of its own (`ConfinedEngine`); `run` calls what uses `session` in a thread,
    when a slot is free for it.
    """

    def __init__(self, settings: ServiceSettings) -> None:
        memory_gb = settings.query_memory_gib * GIB_IN_GB
        rows_bytes = round(settings.rows_mib * 2**20)
        self._limits = Limits(settings.query_time_s, memory_gb, DISK_GB)
        self._new_engine = partial(
            ConfinedEngine, message_bytes=max(ROW_BYTES, rows_bytes), rows_bytes=rows_bytes
        )
        self._settings = settings
        # Below the root: its disk is monitored, and the folder is emptied at each start.
        self._scratch = ServicePaths(settings.root).scratch
        self._slots = SHORT_SLOTS + settings.queries
        self._limiter = Limiter(self._slots, self._slots // 4)
        self._open: Pool[Key, Session] = Pool(self._begin, IDLE, (QueryError,))
        self.close = self._open.close

    async def run(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function in a thread when a slot is free for it."""
        return await self._limiter.run(self._limits.time_s, partial(function, *args, **kwargs))

    @contextmanager
    def session(
        self, targets: Sequence[str | Path], time_s: float | None = None
    ) -> Iterator[Session]:
        """Lend a session about some targets, for exclusive use.

        All of its queries together have one time limit.
        """
        limits = replace(self._limits, time_s=time_s or self._limits.time_s)
        slot = self._limiter.slot.get()
        allowance = Allowance(limits.time_s, SHORT_S, STARVED)
        try:
            with (
                nullcontext() if slot is None else slot.used(),
                self._open.lend(tuple(map(_identity, targets))) as session,
                reserved(self._settings, round(1e9 * session.limits.disk_gb)),
            ):
                yield replace(session, limits=limits, allowance=allowance)
        except StarcatError as error:
            gone = [Path(target).name for target in targets if not Path(target).exists()]
            if not gone:
                raise
            raise TargetMissing(
                f"{', '.join(gone)}: removed while the query ran", hint="look at the list again"
            ) from error

    def forget(self, target: str | Path) -> None:
        """Close the unused sessions about a target that is to be removed."""
        name = str(target)
        self._open.forget(lambda key: name in [text for text, *_ in key])

    @contextmanager
    def _begin(self, key: Key) -> Iterator[Session]:
        make_folder(self._scratch)
        targets = [text for text, *_ in key]
        # All slots together take at most half of the space that may be used.
        spare_gb = spare_gib(self._settings) * GIB_IN_GB / (2 * self._slots)
        limits = replace(self._limits, disk_gb=min(DISK_GB, max(MIN_DISK_GB, spare_gb)))
        with open_session(
            targets, limits, within=self._scratch, new_engine=self._new_engine
        ) as session:
            warm_up(SPARE)
            yield session


def _identity(target: str | Path) -> tuple[str, int, int]:
    """Return an identity of a target that changes if the target is replaced."""
    try:
        stat = Path(target).stat()
    except OSError:
        return str(target), 0, 0
    return str(target), stat.st_ino, stat.st_mtime_ns
