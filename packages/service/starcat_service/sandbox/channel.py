"""The counterpart of `starcat_service.sandbox.process`: functions that a worker calls."""

from __future__ import annotations

import ctypes
import gc
import os
import signal
import sys
import threading
from contextlib import suppress
from typing import Any

from starcat_service.sandbox.messages import HEAD, from_json, json_content


class Channel:
    """Requests that a worker reads and replies that it writes; several threads may write.

    The output of libraries is redirected to the standard error of the process.
    """

    def __init__(self) -> None:
        # Ctrl-C reaches every process of a terminal; the parent process decides whether the
        # worker ends.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        self._replies = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        self.sending = threading.RLock()

    def receive(self) -> Any:
        """Return the next request; EOFError if there are no more requests."""
        _, size = HEAD.unpack(self._exactly(HEAD.size))
        return from_json(self._exactly(size))

    def send(self, kind: str, content: Any, *, more: bool = False) -> None:
        """Send a reply (plain values or raw bytes); with ``more`` it may wait for the next one.

        OSError if the parent process is gone.
        """
        payload = content if isinstance(content, bytes) else json_content(content)
        with self.sending:
            self._replies.write(HEAD.pack(kind.encode(), len(payload)))
            self._replies.write(payload)
            if not more:
                self._replies.flush()

    def wait_for_end(self) -> None:
        """Wait until the parent process closes its end; further requests are dropped."""
        while sys.stdin.buffer.read(1):
            pass

    def _exactly(self, size: int) -> bytes:
        data = sys.stdin.buffer.read(size)
        if len(data) < size:
            raise EOFError
        return data


_ARENA_MAX, _ARENAS = -8, 2


def limit_arenas() -> None:
    """Let the threads of this process share their heaps: each heap keeps memory that it frees."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):  # another C library than GNU's
            ctypes.CDLL(None).mallopt(_ARENA_MAX, _ARENAS)


def return_free_memory() -> None:
    """Return unused memory of this process to the system.

    Figures of matplotlib and exceptions have reference cycles, and keep large arrays until a
    garbage collection.
    """
    gc.collect()
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):  # another C library than GNU's
            ctypes.CDLL(None).malloc_trim(0)
