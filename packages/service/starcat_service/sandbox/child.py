"""Child processes that are told, and tell, lines of JSON; the standard library only."""

from __future__ import annotations

import ctypes
import gc
import json
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import IO, Any

_PROGRAM = "import sys; sys.path[:] = sys.argv[1:]; from {module} import {name}; {name}()"


MAX_LINE_BYTES = 256 << 20
"""Size of a line that a child may send; one that sends more is ended."""


class Child:
    """A process of this Python that calls a function, which reads stdin and writes stdout.

    With ``has_group`` it is in a session of its own, and ends together with those it has started.
    """

    def __init__(
        self,
        function: str,  # "package.module:name"
        *,
        environment: Mapping[str, str] | None = None,
        stderr: int | IO[bytes] = subprocess.DEVNULL,
        has_group: bool = False,
    ) -> None:
        module, name = function.split(":")
        self._has_group = has_group
        self._received = bytearray()
        self._process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM.format(module=module, name=name), *sys.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            start_new_session=has_group,
            env={**os.environ, **(environment or {})},
        )

    @property
    def pid(self) -> int:
        """Its process id; that of its group too, where it has one."""
        return self._process.pid

    @property
    def is_running(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def wait(self) -> int:
        """Return its exit code when it has ended, negative for a signal."""
        return self._process.wait()

    def send(self, content: Mapping[str, Any]) -> None:
        """Send a line of JSON. What a dead process died of is told by how it ended."""
        if self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.write(json.dumps(content).encode() + b"\n")
                self._process.stdin.flush()

    def lines(self, tick_s: float) -> Iterator[bytes | None]:
        """Give the lines that arrive until it closes its output, and None after each tick."""
        pipe = self._process.stdout
        if pipe is None:
            return
        with selectors.DefaultSelector() as selector:
            selector.register(pipe, selectors.EVENT_READ)
            tick_at_s = time.monotonic() + tick_s
            while True:
                if selector.select(max(0.0, tick_at_s - time.monotonic())):
                    data = os.read(pipe.fileno(), 1 << 16)
                    if not data:
                        return
                    self._received += data
                    if len(self._received) > MAX_LINE_BYTES:
                        self.kill()
                        return
                    if b"\n" in data:
                        *lines, self._received = self._received.split(b"\n")
                        yield from map(bytes, lines)
                if time.monotonic() >= tick_at_s:
                    yield None
                    tick_at_s = time.monotonic() + tick_s

    def answer(self, time_s: float) -> bytes:
        """Return the one line that it answers a request with.

        Raises `TimeoutError` if none arrives in time, `EOFError` if the process ended instead.
        """
        for line in self.lines(time_s):
            if line is None:
                raise TimeoutError
            return line
        raise EOFError

    def kill(self) -> None:
        """End it at once; with those it has started, where it has a group."""
        if self._has_group:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self.pid, signal.SIGKILL)
        else:
            self._process.kill()

    def close(self) -> None:
        """End it and close its pipes."""
        self.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()


def own_output() -> IO[bytes]:
    """Return, within a child, the stream for its lines; what libraries print goes to stderr."""
    output = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return output


def return_free_memory() -> None:
    """Return, within a child, memory that is not used any more to the system.

    Figures of matplotlib and exceptions refer to themselves in circles, and keep large arrays
    until the garbage is collected.
    """
    gc.collect()
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):  # of another C library than that of GNU
            ctypes.CDLL(None).malloc_trim(0)
