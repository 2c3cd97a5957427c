"""What is kept in memory while there is room: the least used goes first."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Hashable
from typing import Generic, TypeVar

T = TypeVar("T")


class Kept(Generic[T]):
    """Results by what they depend on, of which all together take so much memory at the most."""

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self._bytes = 0
        self._found: OrderedDict[Hashable, tuple[T, int]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Hashable) -> T | None:
        """Return a result."""
        with self._lock:
            if key not in self._found:
                return None
            self._found.move_to_end(key)
            return self._found[key][0]

    def put(self, key: Hashable, result: T, nbytes: int) -> None:
        """Keep a result."""
        with self._lock:
            if key in self._found:
                self._bytes -= self._found.pop(key)[1]
            if nbytes > self._most_bytes:
                return
            self._found[key] = (result, nbytes)
            self._bytes += nbytes
            while self._bytes > self._most_bytes:
                self._bytes -= self._found.popitem(last=False)[1][1]
