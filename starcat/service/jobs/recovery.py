"""What a killed server has left: jobs that ran, messages that are lost, halves of things."""

from __future__ import annotations

import logging
import shutil
import time
from contextlib import suppress

from starcat.service.jobs.ground import Ground
from starcat.service.jobs.job import Job
from starcat.service.jobs.job_states import interrupt, running_here, silent_since
from starcat.service.paths import JOB_ID, ServicePaths
from starcat.storage.locks import locked

WAIT_S = 10.0
"""Seconds that a process of a job has to die, after its worker has."""

_logger = logging.getLogger(__name__)


def recover(service: Ground) -> None:
    """Take up the jobs of a service where nobody runs any on this machine."""
    for job_id, attempt in running_here(service.records):
        _wait_for_end(service.paths, job_id)
        _logger.warning("job %s was interrupted in attempt %d", job_id, attempt)
        interrupt(service.records, job_id, attempt)
    _remove_halves(service)
    send_waiting(service)


def give_up_silent(service: Ground) -> None:
    """Have jobs wait again whose workers, on other machines, have been silent for long."""
    then_s = time.time() - service.settings.worker_silence_s
    for job_id, attempt in silent_since(service.records, then_s):
        _logger.warning("job %s: nobody hears of its worker; attempt %d is over", job_id, attempt)
        interrupt(service.records, job_id, attempt)


def send_waiting(service: Ground) -> None:
    """Send a message for each job that waits, and forget all others."""
    waiting = _all(service, "queued")
    service.queue.send_again(job.id for job in reversed(waiting))


def _all(service: Ground, state: str) -> list[Job]:
    return service.jobs.all(state=state, most=1_000_000)  # type: ignore[arg-type]


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


def _remove_halves(service: Ground) -> None:
    paths = service.paths
    running = {job.id for job in _all(service, "running")}
    for folder in paths.jobs.iterdir():
        if JOB_ID.fullmatch(folder.name) and folder.name not in running:
            shutil.rmtree(paths.job_work(folder.name), ignore_errors=True)
    for folder in paths.databases.iterdir():
        with suppress(OSError):  # it is not empty
            folder.rmdir()
