"""Open query sessions, which are kept for the next query about the same targets.

Each is a process of its own with the guard of `starcat.query`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from starcat.errors import QueryError
from starcat.query.session import Limits, Session, open_session
from starcat.service.sandbox.pool import Pool
from starcat.service.settings import Settings

IDLE = 4
"""QueryPool that are kept while nobody asks; those that were used longest ago are closed first."""

DISK_GB = 4.0
"""Gigabytes of disk that a query may take for what does not fit into its memory."""

GIB_IN_GB = 2**30 / 1e9

Key = tuple[tuple[str, int, int], ...]  # path, inode and time of each target


@dataclass(frozen=True, eq=False)
class _Open:
    session: Session
    closing: ExitStack

    @property
    def is_running(self) -> bool:
        return self.session.is_running

    def close(self) -> None:
        self.closing.close()


class QueryPool:
    """A bounded number of sessions; `run` calls what uses `session` in a thread."""

    def __init__(self, settings: Settings) -> None:
        memory_gb = settings.query_memory_gib * GIB_IN_GB
        self._limits = Limits(settings.query_time_s, memory_gb, DISK_GB)
        self._open: Pool[Key, _Open] = Pool(self._begin, settings.queries, IDLE, (QueryError,))
        self.run = self._open.run
        self.close = self._open.close

    @contextmanager
    def session(
        self, targets: Sequence[str | Path], time_s: float | None = None
    ) -> Iterator[Session]:
        """Give a session about some targets, which nobody else uses meanwhile."""
        limits = replace(self._limits, time_s=time_s or self._limits.time_s)
        with self._open.lend(tuple(map(_identity, targets))) as one:
            yield replace(one.session, limits=limits)

    def forget(self, target: str | Path) -> None:
        """Close the sessions about a target that is to be removed and that nobody uses."""
        name = str(target)
        self._open.forget(lambda key: name in [text for text, *_ in key])

    def _begin(self, key: Key) -> _Open:
        with ExitStack() as stack:
            names = [text for text, *_ in key]
            session = stack.enter_context(open_session(names, self._limits))
            return _Open(session, stack.pop_all())


def _identity(target: str | Path) -> tuple[str, int, int]:
    """Return what tells a target from another that takes its place."""
    try:
        found = Path(target).stat()
    except OSError:
        return str(target), 0, 0
    return str(target), found.st_ino, found.st_mtime_ns
