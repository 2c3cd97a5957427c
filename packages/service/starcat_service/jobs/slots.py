"""Slots of the server: threads that take jobs from the table and run each to its end.

A job that an earlier server began is begun again; a half-done query of TAP has failed.
"""

from __future__ import annotations

import logging
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from starcat.storage import locked
from starcat_service.jobs.cluster import ClusterJobs
from starcat_service.jobs.job import (
    QUERY,
    Attempt,
    Outcome,
    begin_next,
    failed,
    interrupt,
    is_waiting,
    running_jobs,
)
from starcat_service.jobs.runner import CANCELLED, STOPPED, Processes, limit_exceeded, time_exceeded
from starcat_service.jobs.work import order_of
from starcat_service.paths import JOB_ID, ServicePaths
from starcat_service.quota import folder_bytes
from starcat_service.security.request_limits import disk_shortage

if TYPE_CHECKING:
    from starcat_service.service import Service

MADE_BY_PROCESSES = ("build", "ingest", "evaluate", "photographs")

POLL_S = 1.0
"""Seconds between two looks of an idle slot into the table, if it is not woken."""

PAUSE_S = 5.0
"""Pause of a slot after a failure that no job has caused, such as a full disk."""

DISK_TICK_S = 2.0
"""Seconds between two measurements of the files of a job; free space is looked at more often."""

GRACE_S = 1.0
"""Seconds that slots have after the time limit of their jobs to end."""

WAIT_S = 10.0
"""Seconds that the process of a job has to end after its server has ended."""

ENDED_WITH_SERVER = (
    "the server ended while the query ran; run it again, the job keeps its parameters"
)

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Lane:
    """Slots of some kinds of jobs."""

    name: str
    kinds: tuple[str, ...]
    count: int
    run: Callable[[Attempt], Outcome]
    is_ready: Callable[[], bool] = lambda: True


class JobSlots:
    """The slots of a service. A job on another machine also takes a slot, which waits for it."""

    def __init__(self, service: Service) -> None:
        self.service = service
        self.processes = Processes()
        self.stop_at_s: float | None = None  # when running jobs are ended, `time.monotonic`
        self.cluster: ClusterJobs | None = None
        if service.settings.scheduler is not None:
            self.cluster = ClusterJobs(service, self.run_process, self.reason_to_end)
        self._threads: list[threading.Thread] = []

    @property
    def is_alive(self) -> bool:
        """Whether all slots take jobs."""
        return all(thread.is_alive() for thread in self._threads)

    def start(self) -> None:
        """Recover the jobs that an earlier server left, and begin the jobs that wait."""
        recover(self.service)
        for lane in self._lanes():
            for number in range(lane.count):
                thread = threading.Thread(
                    target=self._serve, args=(lane,), name=f"{lane.name}-{number}", daemon=True
                )
                thread.start()
                self._threads.append(thread)

    def begin_stop(self) -> None:
        """Take no further job; running jobs may finish within a time, and queries end at once."""
        if self.stop_at_s is None:
            self.stop_at_s = time.monotonic() + self.service.settings.shutdown_s
        self.service.wake_slots()

    def stop(self) -> None:
        """Stop, and wait until all slots have ended."""
        self.begin_stop()
        until_s = (self.stop_at_s or 0.0) + GRACE_S
        for thread in self._threads:
            thread.join(max(0.0, until_s - time.monotonic()))
        self.processes.end_all()
        if self.cluster is not None:
            self.cluster.close()

    def run_next(self, kinds: tuple[str, ...] = MADE_BY_PROCESSES) -> bool:
        """Run the job that has waited longest, if there is one."""
        [lane] = (lane for lane in self._lanes() if lane.kinds == kinds)
        return self._run_next(lane)

    def _lanes(self) -> tuple[_Lane, _Lane]:
        service, cluster = self.service, self.cluster
        lane = _Lane("job", MADE_BY_PROCESSES, service.settings.workers, self.run_process)
        if cluster is not None:
            lane = _Lane("job", lane.kinds, lane.count, cluster.run, cluster.is_ready)
        # One of the concurrent queries is reserved for clients who wait for the answer.
        queries = max(1, service.settings.queries - 1)
        return lane, _Lane("query", (QUERY,), queries, self._answer_query)

    def _serve(self, lane: _Lane) -> None:
        records, queued = self.service.records, self.service.job_queued
        while self.stop_at_s is None:
            try:
                with queued:
                    if not is_waiting(records, lane.kinds):
                        queued.wait(POLL_S)
                        continue
                if lane.is_ready():
                    self._run_next(lane)
                    continue
            except Exception:
                _logger.exception("a slot of jobs cannot go on yet")
            with queued:
                queued.wait(PAUSE_S)
        records.close()

    def _run_next(self, lane: _Lane) -> bool:
        if self.stop_at_s is not None:
            return False
        job = begin_next(self.service.records, lane.kinds)
        if job is None:
            return False
        attempt = Attempt(self.service.records, job)
        try:
            attempt.end(lane.run(attempt))
        except BaseException:
            interrupt(self.service.records, job)
            raise
        return True

    def _answer_query(self, attempt: Attempt) -> Outcome:
        return self.service.query_jobs.answer(attempt, lambda: self.stop_at_s is not None)

    def run_process(self, attempt: Attempt) -> Outcome:
        """Do a job in a process of this machine."""
        service, job = self.service, attempt.job
        short = disk_shortage(service.settings)
        if short is not None:
            return failed("Insufficient storage", 507, short)
        order = order_of(job, service.settings, str(service.paths.root))
        try:
            return self.processes.run(order, attempt.report, self._watch(attempt))
        finally:
            shutil.rmtree(service.paths.job_work(job.id), ignore_errors=True)

    def reason_to_end(self, attempt: Attempt) -> Outcome | None:
        """Return the outcome of an attempt that the server or its user ends, else None."""
        if self.stop_at_s is not None and time.monotonic() >= self.stop_at_s:
            return STOPPED
        return CANCELLED if attempt.cancel_requested() else None

    def _watch(self, attempt: Attempt) -> Callable[[], Outcome | None]:
        """Return a function that returns the outcome of an attempt that must end, else None."""
        service, job = self.service, attempt.job
        began_s = disk_at_s = time.monotonic()

        def watch() -> Outcome | None:
            nonlocal disk_at_s
            outcome = self.reason_to_end(attempt)
            outcome = outcome or time_exceeded(began_s, service.settings.job_time_s)
            if outcome is not None:
                return outcome
            full = disk_shortage(service.settings)
            if full is None and time.monotonic() - disk_at_s >= DISK_TICK_S:
                disk_at_s = time.monotonic()
                used_bytes = folder_bytes(service.paths.job(job.id))
                full = service.quota.database_excess(job.owner, used_bytes)
            return None if full is None else limit_exceeded(full)

        return watch


def recover(service: Service) -> None:
    """Recover running jobs after the server that ran them ended; remove their partial results."""
    for job in running_jobs(service.records):
        if str(job.kind) == QUERY:
            Attempt(service.records, job).end(Outcome("failed", {"detail": ENDED_WITH_SERVER}))
            continue
        _wait_for_end(service.paths, job.id)
        _logger.warning("job %s was interrupted in attempt %d", job.id, job.attempt)
        interrupt(service.records, job)
    for folder in service.paths.jobs.iterdir():
        if JOB_ID.fullmatch(folder.name):
            shutil.rmtree(service.paths.job_work(folder.name), ignore_errors=True)
    for folder in service.paths.databases.iterdir():
        with suppress(OSError):  # it is not empty
            folder.rmdir()
    service.query_jobs.sweep()


def _wait_for_end(paths: ServicePaths, job_id: str) -> None:
    """Wait until the process of a job is gone; the next attempt waits too, if it is not."""
    lock = paths.job_lock(job_id)
    if not lock.exists():
        return
    until_s = time.monotonic() + WAIT_S
    while time.monotonic() < until_s:
        with suppress(BlockingIOError), locked(lock, wait=False):
            return
        time.sleep(0.05)
    _logger.error("job %s: its process does not end", job_id)
