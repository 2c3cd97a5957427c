"""One attempt at a job, seen from outside: its process is started, watched, and ended.

What the process says is remembered. It is ended when it was cancelled, takes too long or too much
of the disk, or when the service stops; nothing is left of an attempt but what it has finished.
"""

from __future__ import annotations

import json
import os
import selectors
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Protocol

from starcat.service.jobs.ground import Ground
from starcat.service.jobs.job import Job
from starcat.service.jobs.job_states import Attempt, claim
from starcat.service.jobs.limits import disk_shortage, folder_bytes, owner_excess
from starcat.service.jobs.task import PROGRAM, memory_problem
from starcat.service.jobs.work import threads_of
from starcat.storage.atomic import make_folder

TICK_S = 0.2
"""How often it is looked whether a process has to end."""

DISK_TICK_S = 2.0
"""How often the disk that it takes is counted."""

TAIL_BYTES = 4096

NO_MEMORY = ("bad_alloc", "out of memory", "memory allocation", "cannot allocate memory")
"""What libraries say, in small letters, that end a process which is refused memory."""

STOPPED = "the service stops"


class Told(Protocol):
    """Who remembers what becomes of an attempt; as `starcat.service.jobs.job_states.Attempt`."""

    job: Job

    def wants_end(self) -> bool:
        """Return whether the job is to end."""

    def tell_stage(self, stage: str, done: int, total: int | None) -> None:
        """Say how far it is."""

    def tell(self, level: str, text: str) -> None:
        """Say a line of the log."""

    def succeed(self, result: Mapping[str, Any]) -> None:
        """Say that it is done."""

    def fail(self, error: Mapping[str, Any]) -> None:
        """Say that it has failed."""

    def be_cancelled(self) -> None:
        """Say that it was cancelled."""

    def wait_again(self) -> None:
        """Say that it is to be begun again."""


@dataclass
class Slots:
    """What the jobs that run in a worker have in common.

    Attributes
    ----------
    service : Ground
        Whose jobs they are.
    stop_at_s : float, optional
        When jobs that still run are ended, `time.monotonic`; None while nobody wants to stop.
    """

    service: Ground
    stop_at_s: float | None = None
    _groups: set[int] = field(default_factory=set)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def run_job(self, job_id: str) -> None:
        """Begin a job and see it to its end, unless it does not wait any more."""
        if self.stop_at_s is not None:
            return  # it goes on waiting; its message is sent again at the next start
        job = claim(self.service.records, job_id)
        if job is None:
            return
        attempt = Attempt(self.service.records, job)
        short = disk_shortage(self.service)
        if short is not None:
            attempt.fail(_problem("Insufficient storage", 507, short))
            return
        try:
            Run(self, attempt).run()
        finally:
            shutil.rmtree(self.service.paths.job_work(job.id), ignore_errors=True)

    @contextmanager
    def process(self, job: Job) -> Iterator[subprocess.Popen[bytes]]:
        """Start the process of a job, in a group of its own, and see that it has ended."""
        paths = self.service.paths
        make_folder(paths.job(job.id))
        with paths.job_stderr(job.id).open("wb") as stderr:
            process = subprocess.Popen(
                [sys.executable, "-c", PROGRAM, *sys.path],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                start_new_session=True,
                # Arrow's own allocators reserve gigabytes, which count as memory that is used.
                env={**os.environ, "ARROW_DEFAULT_MEMORY_POOL": "system", "MPLBACKEND": "agg"},
            )
        with self._lock:
            self._groups.add(process.pid)
        try:
            _send(process.stdin, self._order(job))
            yield process
        finally:
            end_group(process.pid)
            process.wait()
            with self._lock:
                self._groups.discard(process.pid)
            for pipe in (process.stdin, process.stdout):
                with suppress(OSError):
                    pipe.close()  # type: ignore[union-attr]

    def _order(self, job: Job) -> dict[str, Any]:
        settings = self.service.settings
        return {
            "root": str(self.service.paths.root),
            "job_id": job.id,
            "kind": job.kind,
            "key": job.key,
            "request": job.request,
            "memory_bytes": int(settings.job_memory_gib * 2**30),
            "scheduler": settings.scheduler,
            "threads": threads_of(settings.workers),
        }

    def end_all(self) -> None:
        """End all processes at once: nobody is left to be told."""
        with self._lock:
            for group in self._groups:
                end_group(group)


def end_group(group: int) -> None:
    """End a process and those that it has started."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(group, signal.SIGKILL)


class Run:
    """An attempt that runs."""

    def __init__(self, slots: Slots, attempt: Told) -> None:
        self._slots, self._attempt = slots, attempt
        self._began_s = self._disk_at_s = time.monotonic()
        self._result: dict[str, Any] | None = None
        self._error: dict[str, Any] | None = None

    def run(self) -> None:
        """See it to its end."""
        with self._slots.process(self._attempt.job) as process:
            why = self._follow(process)
        if self._result is not None:  # it was faster than whoever wanted its end
            self._attempt.succeed(self._result)
        elif why == STOPPED:
            self._attempt.wait_again()
        elif why == "":
            self._attempt.be_cancelled()
        elif why is not None:
            self._attempt.fail(_problem("Limit exceeded", 422, why))
        elif self._error is not None:
            self._attempt.fail(self._error)
        else:
            self._tell_death(process.returncode)

    def _follow(self, process: subprocess.Popen[bytes]) -> str | None:
        """Listen to a process until it ends; return why it was ended, if it was."""
        why = None
        for line in lines_of(process.stdout, TICK_S) if process.stdout else ():
            if line is not None:
                self._hear(line)
            elif why is None and self._result is None:
                why = self._reason_to_end()
                if why is not None:
                    end_group(process.pid)
        return why

    def _hear(self, line: bytes) -> None:
        try:
            told = json.loads(line)
        except ValueError:  # cut off
            return
        if "stage" in told:
            self._attempt.tell_stage(told["stage"], told["done"], told["total"])
        elif "log" in told:
            self._attempt.tell(told["level"], told["log"])
        else:
            self._result = told.get("result", self._result)
            self._error = told.get("error", self._error)

    def _reason_to_end(self) -> str | None:
        """Return why the process has to end: a sentence, or nothing where it was cancelled."""
        now, settings = time.monotonic(), self._slots.service.settings
        if self._slots.stop_at_s is not None and now >= self._slots.stop_at_s:
            return STOPPED
        if self._attempt.wants_end():
            return ""
        if now - self._began_s > settings.job_time_s:
            return (
                f"the job took more than {settings.job_time_s:g} s (job_time_s); ask for less, "
                "or ask the operator for more"
            )
        if now - self._disk_at_s < DISK_TICK_S:
            return None
        self._disk_at_s = now
        service, job = self._slots.service, self._attempt.job
        made = folder_bytes(service.paths.job(job.id))
        return disk_shortage(service) or owner_excess(service, job.owner, made)

    def _tell_death(self, code: int) -> None:
        if code == -signal.SIGTERM:  # the system goes down, and has told all processes
            self._attempt.wait_again()
            return
        service, job = self._slots.service, self._attempt.job
        last_words = _tail(service.paths.job_stderr(job.id)).lower()
        if any(word in last_words for word in NO_MEMORY):
            problem = memory_problem(int(service.settings.job_memory_gib * 2**30))
            self._attempt.fail(problem)
            return
        name = signal.Signals(-code).name if code < 0 else f"code {code}"
        hint = ", as a system does that runs out of memory" if code == -signal.SIGKILL else ""
        detail = (
            f"the process of the job ended by {name}{hint}; the operator finds more in "
            f"jobs/{job.id}/stderr.txt under the root"
        )
        self._attempt.fail(_problem("Ended", 500, detail))


def _tail(path: Path) -> str:
    """Return the end of what a process said of its troubles."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - TAIL_BYTES))
        return file.read().decode(errors="replace")


def lines_of(pipe: IO[bytes], tick_s: float) -> Iterator[bytes | None]:
    """Return the lines that arrive in a pipe until its other end is closed."""
    with selectors.DefaultSelector() as selector:
        selector.register(pipe, selectors.EVENT_READ)
        held, tick_at_s = b"", time.monotonic() + tick_s
        while True:
            if selector.select(max(0.0, tick_at_s - time.monotonic())):
                data = os.read(pipe.fileno(), 1 << 16)
                if not data:
                    return
                *lines, held = (held + data).split(b"\n")
                yield from lines
            if time.monotonic() >= tick_at_s:
                yield None
                tick_at_s = time.monotonic() + tick_s


def _send(pipe: IO[bytes] | None, content: dict[str, Any]) -> None:
    if pipe is not None:
        with suppress(BrokenPipeError):  # what it died of is told by how it ended
            pipe.write(json.dumps(content).encode() + b"\n")
            pipe.flush()


def _problem(title: str, status: int, detail: str) -> dict[str, Any]:
    return {"type": "about:blank", "title": title, "status": status, "detail": detail}
