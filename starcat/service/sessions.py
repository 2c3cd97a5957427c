"""Open query sessions, which are kept for the next question about the same targets.

Each is a process of its own with the guard of `starcat.query`. So many as the operator says answer
at the same time; a few more wait, for whoever asks about the same targets next.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from starcat.errors import QueryError
from starcat.query.session import Limits, Session, open_session
from starcat.service import turns
from starcat.service.settings import Settings
from starcat.service.turns import Turns, busy

IDLE = 4
"""Sessions that are kept while nobody asks; those that were asked longest ago are closed first."""

DISK_GB = 4.0
"""Gigabytes of disk that a query may take for what does not fit into its memory."""

GIB_IN_GB = 2**30 / 1e9

Key = tuple[tuple[str, int, int], ...]


@dataclass(frozen=True, eq=False)
class _Open:
    """A session that is open, and what closes it."""

    key: Key
    session: Session
    closing: ExitStack


class Sessions:
    """A bounded number of open sessions; any thread may ask for one.

    Attributes
    ----------
    run : coroutine function
        Calls a function that uses `session` in a thread, when it is its turn (`Turns.run`): for
        handlers that are ``async def``.
    """

    def __init__(self, settings: Settings) -> None:
        memory_gb = settings.query_memory_gib * GIB_IN_GB
        self._limits = Limits(settings.query_time_s, memory_gb, DISK_GB)
        self._slots = threading.BoundedSemaphore(settings.queries)
        self._lock = threading.Lock()
        self._idle: list[_Open] = []
        self.run = Turns(settings.queries).run
        self._is_closed = False
        weakref.finalize(self, _close, self._idle)

    @contextmanager
    def session(
        self, targets: Sequence[str | Path], time_s: float | None = None
    ) -> Iterator[Session]:
        """Give a session about some targets, which nobody else uses meanwhile."""
        if not self._slots.acquire(timeout=turns.WAIT_S):
            raise busy()
        try:
            key = tuple(map(_identity, targets))
            one = self._taken(key) or self._opened(key)
            limits = replace(self._limits, time_s=time_s or self._limits.time_s)
            is_kept = False
            try:
                yield replace(one.session, limits=limits)
                is_kept = True
            except QueryError:
                is_kept = True
                raise
            finally:
                self._give_back(one, is_kept and one.session.is_running)
        finally:
            self._slots.release()

    def forget(self, target: str | Path) -> None:
        """Close the sessions about a target that is to be removed and that nobody uses."""
        name = str(target)
        with self._lock:
            gone = [one for one in self._idle if name in [text for text, *_ in one.key]]
            self._idle[:] = [one for one in self._idle if one not in gone]
        _close(gone)

    def close(self) -> None:
        """Close all sessions; one that is in use is closed as soon as it is given back."""
        with self._lock:
            self._is_closed = True
            gone = self._idle[:]
            self._idle.clear()
        _close(gone)

    def _taken(self, key: Key) -> _Open | None:
        """Return the session about some targets that was used last, if one is idle."""
        with self._lock:
            found = next((one for one in reversed(self._idle) if one.key == key), None)
            if found is not None:
                self._idle.remove(found)
        return found

    def _opened(self, key: Key) -> _Open:
        with ExitStack() as stack:
            names = [text for text, *_ in key]
            session = stack.enter_context(open_session(names, self._limits))
            return _Open(key, session, stack.pop_all())

    def _give_back(self, one: _Open, is_kept: bool) -> None:
        gone = [] if is_kept else [one]
        with self._lock:
            if is_kept:
                self._idle.append(one)
            most = 0 if self._is_closed else IDLE
            while len(self._idle) > most:
                gone.append(self._idle.pop(0))
        _close(gone)


def _identity(target: str | Path) -> tuple[str, int, int]:
    """Return what tells a target from another that takes its place."""
    try:
        found = Path(target).stat()
    except OSError:
        return str(target), 0, 0
    return str(target), found.st_ino, found.st_mtime_ns


def _close(sessions: list[_Open]) -> None:
    for one in sessions:
        one.closing.close()
