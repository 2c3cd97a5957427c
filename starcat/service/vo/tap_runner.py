"""What answers asynchronous queries: a few threads, each with a process of a session at a time."""

from __future__ import annotations

import logging
import threading
import time
from concurrent.futures import ThreadPoolExecutor

from starcat.errors import StarcatError
from starcat.service.problems import Problem, problem_of
from starcat.service.vo.tap_queries import TapQueries
from starcat.service.vo.tap_store import RESULT, TapJobs
from starcat.storage.atomic import whole_file
from starcat.vo.parameters import Parameters, question
from starcat.vo.uws import JobFacts

RETRY_S = 0.5
"""How long to wait before asking again for a session while all are in use."""

_logger = logging.getLogger(__name__)


class _Unwanted(Exception):  # noqa: N818 - the name reads as the fact
    """The job was aborted, or the server stops."""


class TapRunner:
    """A bounded number of threads that answer jobs."""

    def __init__(self, jobs: TapJobs, queries: TapQueries, count: int) -> None:
        self._jobs = jobs
        self._queries = queries
        self._threads = ThreadPoolExecutor(count, thread_name_prefix="tap-job")
        self._ending: set[str] = set()
        self._stopping = threading.Event()

    def start(self) -> None:
        """Go on where the last server stopped."""
        self._jobs.recover()
        for job_id in self._jobs.queued():
            self._threads.submit(self._run, job_id)

    def run(self, job_id: str) -> None:
        """Let a job be answered, as soon as a thread is free."""
        if self._jobs.queue(job_id):
            self._threads.submit(self._run, job_id)

    def abort(self, job_id: str) -> None:
        """End a job; the process of its query is ended too."""
        if self._jobs.abort(job_id):
            self._ending.add(job_id)

    def close(self) -> None:
        """Stop: what runs is interrupted and waits for the next start."""
        self._stopping.set()
        self._threads.shutdown(wait=True, cancel_futures=True)

    def _run(self, job_id: str) -> None:
        if self._stopping.is_set() or not self._jobs.begin(job_id):
            self._ending.discard(job_id)
            return
        try:
            job = self._jobs.job(job_id)
            while not self._answered(job):
                self._check(job_id)
                time.sleep(RETRY_S)
        except _Unwanted:
            if self._stopping.is_set():
                self._jobs.requeue(job_id)
        except (StarcatError, Problem) as error:
            self._jobs.fail(job_id, problem_of(error).detail)
        except Exception as error:
            _logger.exception("a defect, at a job of TAP")
            self._jobs.fail(job_id, problem_of(error).detail)
        finally:
            self._ending.discard(job_id)
            self._jobs.tidy(job_id)

    def _answered(self, job: JobFacts) -> bool:
        """Answer a job; False where all sessions were in use for long."""
        asked = question(Parameters(job.parameters), self._queries.most_rows)
        files = self._jobs.files(job.job_id) | self._jobs.answers(asked.uploads, job.owner)

        def watch(*_: object) -> None:
            self._check(job.job_id)

        try:
            target = self._jobs.folder(job.job_id) / RESULT
            with whole_file(target) as path, path.open("wb") as stream:
                for part in self._queries.answer(asked, files, job.limit_s, watch):
                    self._check(job.job_id)
                    stream.write(part)
        except Problem as error:
            if error.status == 503:
                return False
            raise
        self._jobs.complete(job.job_id, asked.form.tap_type)
        return True

    def _check(self, job_id: str) -> None:
        if self._stopping.is_set() or job_id in self._ending:
            raise _Unwanted
