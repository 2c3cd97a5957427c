"""Processes for what reads uploads and makes files: a bounded number, each with hard limits.

A picture of some kilobytes may say that it has a billion pixels, and a library may fail in any way
upon a damaged one. Both happen in a process (`starcat.service.confined_worker`) whose memory and
time are limited by the operating system, and which may write into the scratch folder only.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import weakref
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from starcat.errors import QueryLimitError, error_of_kind
from starcat.service import turns
from starcat.service.problems import Problem
from starcat.service.settings import Settings
from starcat.service.turns import Turns, busy

GIB = 2**30

_PROGRAM = (
    "import sys; sys.path[:] = sys.argv[1:]; "
    "from starcat.service.confined_worker import serve; serve()"
)


class Confined:
    """Processes that are asked one thing after the other.

    Attributes
    ----------
    run : coroutine function
        Calls a function that uses `call` in a thread, when it is its turn (`Turns.run`).
    """

    def __init__(self, settings: Settings, scratch: Path) -> None:
        self.run = Turns(settings.queries).run
        self._time_s = settings.query_time_s
        self._scratch = scratch
        self._memory_bytes = int(settings.query_memory_gib * GIB)
        self._slots = threading.BoundedSemaphore(settings.queries)
        self._lock = threading.Lock()
        self._idle: list[subprocess.Popen[bytes]] = []
        self._is_closed = False
        weakref.finalize(self, _end_all, self._idle)

    def call(self, task: str, arguments: Mapping[str, Any]) -> Any:
        """Have something done."""
        if not self._slots.acquire(timeout=turns.WAIT_S):
            raise busy()
        try:
            process = self._taken()
            try:
                answer = self._answer(process, {"task": task, "arguments": arguments})
            except BaseException:
                _end(process)
                raise
            if answer.get("kind") == "MemoryError":
                _end(process)
                raise Problem(
                    413, "it takes more memory than a request may; send less, or a smaller picture"
                )
            self._give_back(process)
        finally:
            self._slots.release()
        if "kind" in answer:
            raise _error_of(answer)
        return answer["found"]

    def close(self) -> None:
        """End the processes; one that is in use ends as soon as it has answered."""
        with self._lock:
            self._is_closed = True
        _end_all(self._idle)

    def _taken(self) -> subprocess.Popen[bytes]:
        with self._lock:
            while self._idle:
                process = self._idle.pop()
                if process.poll() is None:
                    return process
                _end(process)
        process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, *sys.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            # astropy tries out a temporary file where it writes FITS.
            env={
                **os.environ,
                "MPLCONFIGDIR": str(self._scratch / "matplotlib"),
                "TMPDIR": str(self._scratch),
            },
        )
        with suppress(OSError):
            opening = {"scratch": str(self._scratch), "memory_bytes": self._memory_bytes}
            _write(process, opening)
        return process

    def _answer(self, process: subprocess.Popen[bytes], request: dict[str, Any]) -> dict[str, Any]:
        is_late = threading.Event()

        def stop() -> None:
            is_late.set()
            process.kill()

        timer = threading.Timer(self._time_s, stop)
        timer.daemon = True
        timer.start()
        line = b""
        try:
            with suppress(OSError):
                _write(process, {**request, "time_s": self._time_s})
                line = process.stdout.readline() if process.stdout else b""
        finally:
            timer.cancel()
        if line.endswith(b"\n"):
            return dict(json.loads(line))
        code = process.wait()
        if is_late.is_set() or code == -24:  # SIGXCPU
            raise QueryLimitError(f"stopped after {self._time_s:g} s; send less")
        raise Problem(
            422,
            "the process that read it ended by itself, as it does upon damaged files; send another",
        )

    def _give_back(self, process: subprocess.Popen[bytes]) -> None:
        with self._lock:
            if not self._is_closed:
                self._idle.append(process)
                return
        _end(process)


def _write(process: subprocess.Popen[bytes], content: Mapping[str, Any]) -> None:
    if process.stdin is not None:
        process.stdin.write(json.dumps(content).encode() + b"\n")
        process.stdin.flush()


def _error_of(answer: Mapping[str, Any]) -> Exception:
    """Return the error that a process told of."""
    told = error_of_kind(str(answer["kind"]), str(answer["words"]), key=answer.get("key"))
    if told is not None:
        return told
    return RuntimeError(f"{answer['kind']}: {answer['words']}")


def _end_all(processes: list[subprocess.Popen[bytes]]) -> None:
    while processes:
        _end(processes.pop())


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()
