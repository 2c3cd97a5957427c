"""Asynchronous queries of TAP: jobs of the kind ``query``, with one folder each for their files.

Slots of the server answer them (`starcat_service.jobs.slots`).
"""

from __future__ import annotations

import json
import secrets
import shutil
import sqlite3
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from starcat.errors import ConfigError, StarcatError, TargetMissing
from starcat.storage import make_folder, whole_file
from starcat_service.access import ANONYMOUS
from starcat_service.jobs.job import ASKER, QUERY, Attempt, Outcome
from starcat_service.paths import JOB_ID, ServicePaths, checked
from starcat_service.problems import Problem, problem_of
from starcat_service.protocols.parameters import Parameters, Upload, question
from starcat_service.protocols.uws import JobFacts
from starcat_service.quota import Quota, folder_bytes
from starcat_service.records import Records
from starcat_service.sandbox.limiter import asker
from starcat_service.security.request_limits import NoRoom, disk_shortage, reserved_bytes, room_for
from starcat_service.settings import ServiceSettings
from starcat_service.vo.tap_queries import Tap

RESULT = "result"
"""Name of the file with the answer, in the folder of a job."""

MAX_WAITING = 100
"""Most jobs of one user, or of one address, that are pending, queued or executing."""

CHECKED_BYTES = 1 << 20
"""Bytes of an answer after which the results of its user are counted again."""

RETRY_S = 0.5
"""Pause before the next attempt to get a session while all are in use."""

PHASES = {
    "pending": "PENDING",
    "queued": "QUEUED",
    "running": "EXECUTING",
    "done": "COMPLETED",
    "failed": "ERROR",
    "cancelled": "ABORTED",
}
"""The phase of UWS of each state of a job."""

ACTIVE = ("pending", "queued", "running")


class _Unwanted(Exception):  # noqa: N818 - the name reads as the fact
    """The job was aborted, or the server stops."""


class QueryJobs:
    """The asynchronous queries of a service."""

    def __init__(
        self,
        settings: ServiceSettings,
        records: Records,
        paths: ServicePaths,
        tap: Tap,
        quota: Quota,
        wake_slots: Callable[[], None],
    ) -> None:
        self._settings = settings
        self._quota = quota
        self._records = records
        self._paths = paths
        self._tap = tap
        self._wake_slots = wake_slots

    def create(self, owner: str) -> JobFacts:
        """Create a job without parameters, which is not run yet."""
        self.sweep()
        job_id, now_s = secrets.token_hex(16), time.time()
        request = {
            "parameters": [],
            "files": {},
            "run_id": "",
            "limit_s": self._tap.limits.run_s,
            ASKER: asker.get(),
        }
        with self._records.writing() as connection:
            [waiting] = connection.execute(
                "SELECT count(*) FROM jobs WHERE kind = ? AND owner = ? AND state IN (?, ?, ?) "
                f"AND json_extract(request, '$.{ASKER}') = ?",
                (QUERY, owner, *ACTIVE, asker.get()),
            ).fetchone()
            if waiting >= MAX_WAITING:
                raise ConfigError(
                    f"{waiting} of your jobs have not ended, which is the most allowed",
                    hint="run, abort or delete some",
                )
            make_folder(self.folder(job_id))
            connection.execute(
                "INSERT INTO jobs (id, kind, key, owner, title, state, request, created_s, "
                "destroyed_s) VALUES (?, ?, '', ?, '', 'pending', ?, ?, ?)",
                (job_id, QUERY, owner, json.dumps(request), now_s, now_s + self._tap.limits.keep_s),
            )
        return self.job(job_id)

    def job(self, job_id: str, owner: str | None = None, client: str = "") -> JobFacts:
        """Return a job; with an owner only if it belongs to that owner at that client."""
        row = self._row(job_id)
        is_gone = row["destroyed_s"] < time.time()
        if is_gone or (owner is not None and not _is_of(row, owner, client)):
            raise _no_job(job_id)
        return _facts(row)

    def jobs(self, owner: str, client: str) -> list[JobFacts]:
        """Return all jobs of a user, the newest first."""
        rows = self._records.rows(
            "SELECT * FROM jobs WHERE kind = ? AND owner = ? AND destroyed_s >= ? "
            "ORDER BY created_s DESC, id",
            QUERY,
            owner,
            time.time(),
        )
        return [_facts(row) for row in rows if _is_of(row, owner, client)]

    def folder(self, job_id: str) -> Path:
        """Return the folder with the uploads and the answer of a job."""
        return self._paths.results / checked(job_id, JOB_ID, "job")

    def answers(self, uploads: Sequence[Upload], owner: str, client: str) -> dict[str, Path]:
        """Return the answers of other jobs that a question uploads, by job id."""
        paths = {}
        for upload in uploads:
            if upload.job_id:
                phase = self.job(upload.job_id, owner, client).phase
                paths[upload.job_id] = self.folder(upload.job_id) / RESULT
                if phase != "COMPLETED":
                    raise TargetMissing(
                        f"UPLOAD of {upload.table}: the job is {phase}, no answer yet"
                    )
        return paths

    def set_parameters(
        self, job_id: str, parameters: Sequence[tuple[str, str]], files: Mapping[str, Path]
    ) -> None:
        """Set parameters of a job that has not been run; others keep their values."""
        names = {name for name, _ in parameters}
        request = _request(self._row(job_id))
        kept = [(name, value) for name, value in request["parameters"] if name not in names]
        request["parameters"] = [*kept, *parameters]
        request["files"] |= {part: path.name for part, path in files.items()}
        request["run_id"] = dict(request["parameters"]).get("RUNID", "")
        self._change(job_id, ("pending",), request=json.dumps(request))

    def set_limit(self, job_id: str, seconds: float) -> None:
        """Set the time limit of a job that has not been run, at most the limit of the service."""
        most = float(self._tap.limits.run_s)
        limit_s = min(seconds, most) if seconds > 0 else most
        request = {**_request(self._row(job_id)), "limit_s": limit_s}
        self._change(job_id, ("pending",), request=json.dumps(request))

    def set_destruction(self, job_id: str, at_s: float) -> None:
        """Set the time of deletion of a job, at most as late as the service allows."""
        latest = self.job(job_id).created_s + self._tap.limits.keep_s
        self._change(job_id, tuple(PHASES), destroyed_s=min(at_s, latest))

    def run(self, job_id: str) -> None:
        """Queue a job; it is answered as soon as a slot is free."""
        self._change(job_id, ("pending",), state="queued", queued_s=time.time())
        self._wake_slots()

    def abort(self, job_id: str) -> None:
        """End a job that has not ended; the thread that answers it notices this."""
        self._change(job_id, ACTIVE, state="cancelled", ended_s=time.time())

    def delete(self, job_id: str) -> None:
        """Delete a job and its answer."""
        with self._records.writing() as connection:
            connection.execute("DELETE FROM jobs WHERE id = ? AND kind = ?", (job_id, QUERY))
        shutil.rmtree(self.folder(job_id), ignore_errors=True)

    def sweep(self) -> None:
        """Remove the jobs whose time of deletion has passed."""
        over = "SELECT id FROM jobs WHERE kind = ? AND destroyed_s < ?"
        for row in self._records.rows(over, QUERY, time.time()):
            self.delete(row["id"])

    def answer(self, attempt: Attempt, is_stopping: Callable[[], bool]) -> Outcome:
        """Answer a job that a slot has begun."""

        def check(*_: object) -> None:
            if is_stopping() or attempt.cancel_requested():
                raise _Unwanted

        job_id = attempt.job.id
        asker.set(attempt.job.request.get(ASKER, attempt.job.owner))
        try:
            while True:
                try:
                    return self._written(job_id, check)
                except Problem as error:
                    if error.status != 503:  # all sessions are in use
                        raise
                check()
                time.sleep(RETRY_S)
        except _Unwanted:
            return Outcome("queued" if is_stopping() else "cancelled")
        except (StarcatError, Problem) as error:
            return Outcome("failed", {"detail": problem_of(error).detail})
        finally:
            if attempt.cancel_requested() and not self._rows(job_id):
                shutil.rmtree(self.folder(job_id), ignore_errors=True)

    def _written(self, job_id: str, check: Callable[..., None]) -> Outcome:
        row = self._row(job_id)
        job, folder = _facts(row), self.folder(job_id)
        asked = question(Parameters(job.parameters), self._tap.limits.rows)
        files = {part: folder / name for part, name in _request(row)["files"].items()}
        files |= self.answers(asked.uploads, job.owner, _request(row).get(ASKER, ""))
        written = checked_bytes = 0
        with whole_file(folder / RESULT) as path, path.open("wb") as stream:
            for part in self._tap.answer(asked, files, job.limit_s, check):
                check()
                written += len(part)
                if written >= checked_bytes:
                    self.make_room(job_id, written, len(part))
                    checked_bytes = written + CHECKED_BYTES
                with self._room(job_id, written, len(part)):
                    stream.write(part)
            self.make_room(job_id, written, 0)
        return Outcome("done", {"media_type": asked.form.tap_type})

    @contextmanager
    def _room(self, job_id: str, written: int, more: int) -> Iterator[None]:
        """Keep space for a part of an answer; old results of its user are removed for it."""
        with ExitStack() as kept:
            try:
                kept.enter_context(room_for(self._settings, more))
            except NoRoom:
                self.make_room(job_id, written, more)
                kept.enter_context(room_for(self._settings, more))
            yield

    def make_room(self, job_id: str, written: int, more: int) -> None:
        """Remove the oldest results of a user until a job may write more bytes.

        Raises a `Problem` if that cannot help; then nothing is removed.
        """
        row = self._row(job_id)
        owner, client = row["owner"], _request(row).get(ASKER, "")
        rows = self._records.rows(
            "SELECT * FROM jobs WHERE kind = ? AND owner = ? ORDER BY created_s, id", QUERY, owner
        )
        jobs_of_user = [job for job in rows if _is_of(job, owner, client) and job["id"] != job_id]
        sizes = {job["id"]: folder_bytes(self.folder(job["id"])) for job in jobs_of_user}
        others = written + more + (0 if owner == ANONYMOUS else self._quota.database_bytes(owner))
        ended = [job["id"] for job in jobs_of_user if job["state"] not in ACTIVE]

        def lack(freed: int) -> str | None:
            taken = others + sum(sizes.values()) - freed
            return self._quota.excess(
                taken, "your databases and results of TAP", "ask for less, delete jobs or databases"
            ) or disk_shortage(self._settings, reserved_bytes(self._settings) + more - freed)

        freed = 0
        for count in range(len(ended) + 1):
            freed = sum(sizes[ended_id] for ended_id in ended[:count])
            if (short := lack(freed)) is None:
                break
        else:
            raise Problem(507, short or "")
        for job_id in ended[:count]:
            self.delete(job_id)

    def _row(self, job_id: str) -> sqlite3.Row:
        for row in self._rows(checked(job_id, JOB_ID, "job")):
            return row
        raise _no_job(job_id)

    def _rows(self, job_id: str) -> list[sqlite3.Row]:
        return self._records.rows("SELECT * FROM jobs WHERE id = ? AND kind = ?", job_id, QUERY)

    def _change(self, job_id: str, states: tuple[str, ...], **values: object) -> None:
        setting = ", ".join(f"{name} = ?" for name in values)
        within = ", ".join("?" * len(states))
        with self._records.writing() as connection:
            connection.execute(
                f"UPDATE jobs SET {setting} WHERE id = ? AND kind = ? AND state IN ({within})",
                (*values.values(), job_id, QUERY, *states),
            )


def _no_job(job_id: str) -> TargetMissing:
    return TargetMissing(f"no job has the id {job_id}; the list of jobs shows the valid ids")


def _is_of(row: sqlite3.Row, owner: str, client: str) -> bool:
    """Return whether a user owns a job; users without a token are identified by their address."""
    is_same = owner != ANONYMOUS or _request(row).get(ASKER, client) == client
    return bool(row["owner"] == owner) and is_same


def _request(row: sqlite3.Row) -> dict[str, Any]:
    return dict(json.loads(row["request"]))


def _facts(row: sqlite3.Row) -> JobFacts:
    request = _request(row)
    error, result = (json.loads(row[name] or "{}") for name in ("error", "result"))
    return JobFacts(
        job_id=row["id"],
        owner=row["owner"],
        phase=PHASES[row["state"]],
        run_id=request["run_id"],
        parameters=tuple((name, value) for name, value in request["parameters"]),
        created_s=row["created_s"],
        started_s=row["started_s"],
        ended_s=row["ended_s"],
        destroyed_s=row["destroyed_s"],
        limit_s=request["limit_s"],
        error=error.get("detail", ""),
        media_type=result.get("media_type", ""),
    )
