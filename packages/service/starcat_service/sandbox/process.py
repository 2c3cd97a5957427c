"""A worker from the view of the parent process: send requests, receive replies, end it.

A worker is confined, or processes data from untrusted users. So its replies are not trusted: memory
is allocated only for bytes that arrived, and every wait has a time limit.
"""

from __future__ import annotations

import math
import os
import queue
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from starcat_service.sandbox.messages import HEAD, REQUEST, MalformedMessage, json_content

PROGRAM = "import sys; sys.path[:] = sys.argv[1:]; from {module} import {name}; {name}()"
READ_BYTES = 1 << 16
LOOK_S = 0.5
"""Seconds between checks whether the worker is still running, during a wait."""

MAX_BYTES = 256 << 20
"""Default for the largest message of a worker."""

MAX_WORDS_BYTES = 1 << 16
PATIENT = 19
"""Priority of a process that yields the processors to all others."""

_TICKS = os.sysconf("SC_CLK_TCK") if os.name == "posix" else 1


_LEAN = {
    # Arrow's own allocators reserve gigabytes, and each thread of OpenBLAS 40 MB. All of it counts
    # as used memory, and by default there are as many threads as processors.
    "ARROW_DEFAULT_MEMORY_POOL": "system",
    "OPENBLAS_NUM_THREADS": "1",
}


class WorkerProcess:
    """A process with the same Python that calls a function, which answers requests.

    The function makes a `starcat_service.sandbox.channel.Channel`. With ``has_group`` the process
    has its own session, and ends together with the processes that it has started.
    """

    def __init__(
        self,
        function: str,  # "package.module:name"
        *,
        environment: Mapping[str, str] | None = None,
        stderr: int | IO[bytes] = subprocess.DEVNULL,
        has_group: bool = False,
        max_bytes: int = MAX_BYTES,
    ) -> None:
        module, name = function.split(":")
        self.max_bytes = max_bytes
        self._has_group = has_group
        self._received = bytearray()
        self._head: tuple[str, int] | None = None  # head of the message being received
        self._process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM.format(module=module, name=name), *sys.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            start_new_session=has_group,
            env={**os.environ, **_LEAN, **(environment or {})},
        )
        self._requests, self._replies = _pipe(self._process.stdin), _pipe(self._process.stdout)
        if os.name == "posix":
            os.set_blocking(self._requests.fileno(), False)
            self._poll = select.poll()
            self._poll.register(self._replies.fileno(), select.POLLIN)
        else:  # Windows cannot wait for pipes
            self._parts: queue.Queue[bytes] = queue.Queue(1)
            threading.Thread(target=self._read_parts, daemon=True).start()

    @property
    def pid(self) -> int:
        """Its process id, which is also the id of its group if it has one."""
        return self._process.pid

    @property
    def is_running(self) -> bool:
        """Whether the process is still running."""
        return self._process.poll() is None

    def wait(self, wait_s: float | None = None) -> int | None:
        """Wait for its end; return the exit code (negative for a signal), or None if too late."""
        with suppress(subprocess.TimeoutExpired):
            return self._process.wait(wait_s)
        return None

    def send(self, request: Any, until_s: float = math.inf) -> None:
        """Send a request (plain values for JSON).

        OSError if the process ended, TimeoutError if it takes longer (`time.monotonic`).
        """
        content = json_content(request)
        unsent = memoryview(HEAD.pack(REQUEST.encode(), len(content)) + content)
        if os.name != "posix":
            self._requests.write(unsent)
            self._requests.flush()
            return
        while unsent:
            try:
                descriptor = self._requests.fileno()
                unsent = unsent[os.write(descriptor, unsent) :]
            except BlockingIOError:
                waiting = select.poll()
                waiting.register(descriptor, select.POLLOUT)
                wait_s = min(LOOK_S, until_s - time.monotonic())
                if not waiting.poll(1e3 * max(0.0, wait_s)):
                    if not self.is_running:  # other processes may keep its pipe open
                        raise BrokenPipeError from None
                    if wait_s <= 0.0:
                        raise TimeoutError from None
            except ValueError:  # it was closed
                raise BrokenPipeError from None

    def receive(self, wait_s: float = math.inf) -> tuple[str, bytes | bytearray] | None:
        """Return kind and content of the next message; None if none arrives in time.

        EOFError if the process ended, `MalformedMessage` if its message is too long.
        """
        until_s = time.monotonic() + wait_s
        while (message := self._next()) is None:
            wait_s = max(0.0, min(LOOK_S, until_s - time.monotonic()))
            # Its output is in the pipe before it ends; other processes may keep the pipe open.
            is_over = not self.is_running
            size = READ_BYTES if self._head is None else self._head[1] - len(self._received)
            part = self._part(min(READ_BYTES, size), wait_s)
            if part is None:
                if is_over:
                    raise EOFError
                if time.monotonic() >= until_s:
                    return None
            elif not part:
                raise EOFError
            else:
                self._received += part
        return message

    def _next(self) -> tuple[str, bytes | bytearray] | None:
        """Return the next message from the received bytes, if it is complete."""
        if self._head is None and len(self._received) >= HEAD.size:
            kind, size = HEAD.unpack_from(self._received)
            if size > self.max_bytes:
                raise MalformedMessage(
                    f"the process sent a message of {size:,} bytes, but at most "
                    f"{self.max_bytes:,} are read; it was ended",
                    hint="Ask again",
                )
            del self._received[: HEAD.size]
            self._head = kind.decode("latin-1"), size
        if self._head is None or len(self._received) < self._head[1]:
            return None
        (name, size), self._head = self._head, None
        content = self._received
        self._received = content[size:]
        del content[size:]
        return name, content

    def _part(self, size: int, wait_s: float) -> bytes | None:
        """Return received bytes, empty at the end; None if none arrive in time."""
        if os.name != "posix":
            with suppress(queue.Empty):
                return self._parts.get(timeout=wait_s)
            return None
        if not self._poll.poll(math.ceil(1e3 * wait_s)):
            return None
        try:
            return os.read(self._replies.fileno(), size)
        except ValueError:  # it was closed
            return b""

    def _read_parts(self) -> None:
        part = b"-"
        while part:
            try:
                part = os.read(self._replies.fileno(), READ_BYTES)
            except (OSError, ValueError):  # it was closed
                part = b""
            self._parts.put(part)

    def last_words(self) -> list[str]:
        """Return the lines of its standard error; its children may keep the pipe open."""
        if self._process.stderr is None:
            return []
        try:
            if os.name == "posix":
                os.set_blocking(self._process.stderr.fileno(), False)
            output = os.read(self._process.stderr.fileno(), MAX_WORDS_BYTES)
        except (OSError, ValueError):
            return []
        return output.decode(errors="replace").strip().splitlines()

    def used_s(self) -> float:
        """Return its processor time, or the time of the clock if that cannot be read."""
        try:
            # Called twice per query, so without the overhead of `Path` and decoding.
            descriptor = os.open(f"/proc/{self.pid}/stat", os.O_RDONLY)
        except OSError:
            return time.monotonic()
        try:
            text = os.read(descriptor, READ_BYTES)
        finally:
            os.close(descriptor)
        user, system = text.rpartition(b")")[2].split()[11:13]
        return (int(user) + int(system)) / _TICKS

    def yield_processors(self) -> None:
        """Give it the lowest priority; this cannot be undone."""
        with suppress(OSError):
            for thread in Path(f"/proc/{self.pid}/task").iterdir():
                os.setpriority(os.PRIO_PROCESS, int(thread.name), PATIENT)

    def kill(self) -> None:
        """End it at once; with a group, also the processes that it has started."""
        if self._has_group:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self.pid, signal.SIGKILL)
        else:
            self._process.kill()

    def close(self) -> None:
        """End the process and close its pipes."""
        self.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()


def _pipe(pipe: IO[bytes] | None) -> IO[bytes]:
    if pipe is None:
        raise EOFError
    return pipe
