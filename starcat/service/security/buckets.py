"""Token buckets: how often each of many may do something, with bounded memory."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable

MOST = 10_000
"""Keys that are remembered; of more, those that were quiet for longest are forgotten."""


class Buckets:
    """A bucket for each key: full at first, emptied by one each time, filled again steadily."""

    def __init__(
        self,
        per_minute: float,
        most_at_once: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._per_s = per_minute / 60.0
        self._size = per_minute if most_at_once is None else most_at_once
        self._clock = clock
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, key: str) -> float:
        """Take one out of the bucket of a key."""
        now_s = self._clock()
        left, then_s = self._left.pop(key, (self._size, now_s))
        left = min(self._size, left + (now_s - then_s) * self._per_s)
        wait_s = 0.0 if left >= 1.0 else (1.0 - left) / self._per_s
        self._left[key] = (left if wait_s else left - 1.0), now_s
        if len(self._left) > MOST:
            self._left.popitem(last=False)
        return wait_s
