"""The worker as the server sees it: started, started again when it dies, and stopped in the end."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
import time
from contextlib import suppress

from starcat.service.jobs.ground import Ground
from starcat.service.jobs.recovery import give_up_silent, recover, send_waiting
from starcat.service.jobs.worker import PROGRAM

LOOK_S = 5.0
"""How often it is looked whether jobs wait that nobody was told of."""

PAUSE_S = (0.5, 30.0)
"""Seconds until a worker that died is started again: the first time, and at the most."""

GRACE_S = 10.0
"""Seconds that a worker has beyond the time of its jobs to end by itself."""

_logger = logging.getLogger(__name__)


class WorkerPool:
    """The worker of a service, with all of its slots."""

    def __init__(self, service: Ground) -> None:
        self._service = service
        self._stopping = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._thread: threading.Thread | None = None

    @property
    def is_alive(self) -> bool:
        """Whether jobs are taken; true too where no worker was to be started."""
        if self._thread is None or self._process is None:
            return True
        return self._process.poll() is None

    def start(self) -> None:
        """Take up the jobs that an earlier server has left, and have them done."""
        recover(self._service)
        if self._service.settings.queue_url is not None:
            self._service.queue.is_used.set()  # by workers on other machines, for all we know
        if self._service.settings.workers or self._service.settings.queue_url is not None:
            # The system ends the worker with the thread that started it, which lasts as long.
            self._thread = threading.Thread(target=self._watch, name="worker", daemon=True)
            self._thread.start()

    def begin_stop(self) -> None:
        """Have the worker take no further job, and end when those that run have had their time."""
        self._stopping.set()
        self._service.queue.is_used.set()
        process = self._process
        if process is not None and process.stdin is not None:
            with suppress(OSError, ValueError):
                os.write(process.stdin.fileno(), b"stop\n")

    def stop(self) -> None:
        """Stop the worker, and wait until it has ended."""
        self.begin_stop()
        if self._thread is not None:
            self._thread.join(self._service.settings.shutdown_s + GRACE_S)
            if self._thread.is_alive() and self._process is not None:
                self._process.kill()
                self._thread.join()

    def _watch(self) -> None:
        first_s, most_s = PAUSE_S
        pause_s = first_s
        try:
            self._service.queue.is_used.wait()  # until then no memory is taken
            while not self._service.settings.workers and not self._stopping.wait(LOOK_S):
                self._look()
            while not self._stopping.is_set():
                began_s = time.monotonic()
                self._run()
                if self._stopping.is_set():
                    break
                lasted_s = time.monotonic() - began_s
                pause_s = first_s if lasted_s > most_s else min(2.0 * pause_s, most_s)
                self._stopping.wait(pause_s)
                self._recover()
        finally:
            self._service.records.close()

    def _recover(self) -> None:
        try:
            recover(self._service)
        except Exception:  # the disk is full, for one: the next worker's jobs are not to suffer
            _logger.exception("the jobs of a worker that ended cannot be taken up yet")

    def _run(self) -> None:
        """Start a worker, and look after it until it ends."""
        settings = self._service.settings
        with subprocess.Popen(
            [sys.executable, "-c", PROGRAM, *sys.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
        ) as process:
            if process.stdin is None:
                return
            process.stdin.write(settings.model_dump_json().encode() + b"\n")
            process.stdin.flush()
            self._process = process
            if self._stopping.is_set():  # since a moment ago
                self.begin_stop()
            while process.poll() is None:
                with suppress(subprocess.TimeoutExpired):
                    process.wait(LOOK_S)
                    break
                self._look()
        if not self._stopping.is_set():
            _logger.error("the worker ended with code %s; it is started again", process.returncode)

    def _look(self) -> None:
        """Give up workers that are lost, and send messages again that are."""
        service = self._service
        try:
            give_up_silent(service)
            if service.jobs.count(state="queued") and service.queue.is_empty():
                send_waiting(service)
        except Exception:  # the disk is full, for one: it is looked again later
            _logger.exception("the queue cannot be looked after")
