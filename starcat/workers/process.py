"""A worker as the process that started it sees it: asked, listened to, and ended.

A worker is confined, or works on what strangers sent. Nothing that it sends is trusted: memory is
taken only for bytes that arrived, and nobody waits longer for it than wanted.
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

from starcat.workers.messages import HEAD, REQUEST, MalformedMessage, json_content

PROGRAM = "import sys; sys.path[:] = sys.argv[1:]; from {module} import {name}; {name}()"
READ_BYTES = 1 << 16
LOOK_S = 0.5
"""Seconds after which one that waits looks whether the worker is still running."""

MAX_BYTES = 256 << 20
"""Size of a message of a worker, if nothing else is said."""

MAX_WORDS_BYTES = 1 << 16
PATIENT = 19
"""The priority of a process that leaves the processors to others."""

_TICKS = os.sysconf("SC_CLK_TCK") if os.name == "posix" else 1


class WorkerProcess:
    """A process of this Python that calls a function, which answers requests.

    The function makes a `starcat.workers.channel.Channel`. With ``has_group`` the process is in a
    session of its own, and ends together with those that it has started.
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
        self._head: tuple[str, int] | None = None  # of the message that arrives
        self._process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM.format(module=module, name=name), *sys.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            start_new_session=has_group,
            # Arrow's own allocators reserve gigabytes, which count as memory that is used.
            env={**os.environ, "ARROW_DEFAULT_MEMORY_POOL": "system", **(environment or {})},
        )
        self._requests, self._replies = _pipe(self._process.stdin), _pipe(self._process.stdout)
        if os.name == "posix":
            os.set_blocking(self._requests.fileno(), False)
            self._poll = select.poll()
            self._poll.register(self._replies.fileno(), select.POLLIN)
        else:  # pipes cannot be waited for there
            self._parts: queue.Queue[bytes] = queue.Queue(1)
            threading.Thread(target=self._read_parts, daemon=True).start()

    @property
    def pid(self) -> int:
        """Its process id; that of its group too, where it has one."""
        return self._process.pid

    @property
    def is_running(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def wait(self, wait_s: float | None = None) -> int | None:
        """Return its exit code when it has ended, negative for a signal; None if not in time."""
        with suppress(subprocess.TimeoutExpired):
            return self._process.wait(wait_s)
        return None

    def send(self, request: Any, until_s: float = math.inf) -> None:
        """Send a request, plain values as JSON has them.

        OSError if the process ended, TimeoutError if it takes longer (`time.monotonic`).
        """
        content = json_content(request)
        left = memoryview(HEAD.pack(REQUEST.encode(), len(content)) + content)
        if os.name != "posix":
            self._requests.write(left)
            self._requests.flush()
            return
        while left:
            try:
                descriptor = self._requests.fileno()
                left = left[os.write(descriptor, left) :]
            except BlockingIOError:
                waiting = select.poll()
                waiting.register(descriptor, select.POLLOUT)
                wait_s = min(LOOK_S, until_s - time.monotonic())
                if not waiting.poll(1e3 * max(0.0, wait_s)):
                    if not self.is_running:  # others may keep its pipe open
                        raise BrokenPipeError from None
                    if wait_s <= 0.0:
                        raise TimeoutError from None
            except ValueError:  # it was closed
                raise BrokenPipeError from None

    def receive(self, wait_s: float = math.inf) -> tuple[str, bytes | bytearray] | None:
        """Return kind and content of the next message; None if there is none in time.

        EOFError if the process ended, `MalformedMessage` if its message is too long.
        """
        until_s = time.monotonic() + wait_s
        while (found := self._next()) is None:
            wait_s = max(0.0, min(LOOK_S, until_s - time.monotonic()))
            # What it wrote is in the pipe before it ends; others may keep the pipe open.
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
        return found

    def _next(self) -> tuple[str, bytes | bytearray] | None:
        """Take the next message out of what has arrived, if it is whole."""
        if self._head is None and len(self._received) >= HEAD.size:
            kind, size = HEAD.unpack_from(self._received)
            if size > self.max_bytes:
                raise MalformedMessage(
                    f"the process sent a message of {size:,} bytes, and at most "
                    f"{self.max_bytes:,} are read; it was ended. Ask again"
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
        """Return some bytes that arrived, none at the end; None if there are none in time."""
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
        """Return the lines in the pipe of its standard error, which its children may keep open."""
        if self._process.stderr is None:
            return []
        try:
            if os.name == "posix":
                os.set_blocking(self._process.stderr.fileno(), False)
            found = os.read(self._process.stderr.fileno(), MAX_WORDS_BYTES)
        except (OSError, ValueError):
            return []
        return found.decode(errors="replace").strip().splitlines()

    def used_s(self) -> float:
        """Return the time of processors that it has taken, where that can be read, or any time."""
        try:
            # Twice for each query, so without what `Path` and decoding take.
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
        """Let it run where nobody else wants to; that cannot be taken back."""
        with suppress(OSError):
            for thread in Path(f"/proc/{self.pid}/task").iterdir():
                os.setpriority(os.PRIO_PROCESS, int(thread.name), PATIENT)

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
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()


def _pipe(pipe: IO[bytes] | None) -> IO[bytes]:
    if pipe is None:
        raise EOFError
    return pipe
