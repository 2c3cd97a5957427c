"""Asynchronous queries as they are remembered: a row of the records and a folder each."""

from __future__ import annotations

import json
import secrets
import shutil
import sqlite3
import time
from collections.abc import Sequence
from pathlib import Path

from starcat.errors import ConfigError, TargetMissing
from starcat.service.paths import JOB_ID, ServicePaths, checked
from starcat.service.records import Records
from starcat.storage.atomic import make_folder
from starcat.vo.documents import ServiceLimits
from starcat.vo.parameters import Upload
from starcat.vo.uws import ACTIVE, JobFacts

RESULT = "result"
"""Name of the file with the answer, in the folder of a job."""

MAX_WAITING = 100
"""Jobs of one user that may be pending, queued or executing."""

ENDED_WITH_SERVER = (
    "the server ended while the query ran; run it again, the job keeps its parameters"
)


class TapJobs:
    """The asynchronous queries there are."""

    def __init__(self, records: Records, paths: ServicePaths, limits: ServiceLimits) -> None:
        self._records = records
        self._paths = paths
        self._limits = limits

    def create(self, owner: str, parameters: Sequence[tuple[str, str]]) -> JobFacts:
        """Make a job that waits to be run."""
        self.sweep()
        job_id, now = secrets.token_hex(16), time.time()
        make_folder(self.folder(job_id))
        with self._records.writing() as connection:
            paths = ", ".join("?" * len(ACTIVE))
            [waiting] = connection.execute(
                f"SELECT count(*) FROM tap_jobs WHERE owner = ? AND phase IN ({paths})",
                (owner, *ACTIVE),
            ).fetchone()
            if waiting >= MAX_WAITING:
                raise ConfigError(
                    f"{waiting} jobs of {owner} are not at their end, and so many are allowed; "
                    "run, abort or delete some"
                )
            connection.execute(
                "INSERT INTO tap_jobs (id, owner, phase, parameters, files, created_s, limit_s, "
                "destroyed_s) VALUES (?, ?, 'PENDING', ?, '{}', ?, ?, ?)",
                (job_id, owner, json.dumps(list(parameters)), now, self._limits.run_s,
                 now + self._limits.keep_s),
            )  # fmt: skip
        return self.job(job_id)

    def job(self, job_id: str, owner: str | None = None) -> JobFacts:
        """Return a job."""
        checked(job_id, JOB_ID, "job")
        with self._records.reading() as connection:
            row = connection.execute("SELECT * FROM tap_jobs WHERE id = ?", (job_id,)).fetchone()
        if row is None or owner not in (None, row["owner"]) or row["destroyed_s"] < time.time():
            raise TargetMissing(f"no job has the id {job_id}; the list of jobs tells theirs")
        return _facts(row)

    def jobs(self, owner: str) -> list[JobFacts]:
        """Return all jobs of somebody, the newest first."""
        with self._records.reading() as connection:
            rows = connection.execute(
                "SELECT * FROM tap_jobs WHERE owner = ? AND destroyed_s >= ? "
                "ORDER BY created_s DESC, id",
                (owner, time.time()),
            ).fetchall()
        return [_facts(row) for row in rows]

    def queued(self) -> list[str]:
        """Return the ids of jobs that wait to be run, in their order."""
        with self._records.reading() as connection:
            rows = connection.execute(
                "SELECT id FROM tap_jobs WHERE phase = 'QUEUED' ORDER BY queued_s, id"
            ).fetchall()
        return [row["id"] for row in rows]

    def folder(self, job_id: str) -> Path:
        """Return the folder with the uploads and the answer of a job."""
        return self._paths.results / checked(job_id, JOB_ID, "job")

    def files(self, job_id: str) -> dict[str, Path]:
        """Return the uploads of a job by the names of their parts."""
        with self._records.reading() as connection:
            row = connection.execute(
                "SELECT files FROM tap_jobs WHERE id = ?", (job_id,)
            ).fetchone()
        folder = self.folder(job_id)
        return {part: folder / name for part, name in json.loads(row["files"]).items()}

    def answers(self, uploads: Sequence[Upload], owner: str) -> dict[str, Path]:
        """Return the answers of other jobs that a question is about, by the ids of these."""
        found = {}
        for one in uploads:
            if one.job_id:
                phase = self.job(one.job_id, owner).phase
                found[one.job_id] = self.folder(one.job_id) / RESULT
                if phase != "COMPLETED":
                    raise TargetMissing(f"UPLOAD of {one.table}: the job is {phase}, no answer yet")
        return found

    def set_parameters(
        self, job_id: str, given: Sequence[tuple[str, str]], files: dict[str, Path]
    ) -> None:
        """Set parameters of a job that has not been run; others keep their values."""
        names = {name for name, _ in given}
        before = self.job(job_id)
        kept = [(name, value) for name, value in before.parameters if name not in names]
        known = {part: path.name for part, path in (self.files(job_id) | files).items()}
        self._change(
            job_id, ("PENDING",),
            parameters=json.dumps([*kept, *given]), files=json.dumps(known),
            run_id=dict([*kept, *given]).get("RUNID", ""),
        )  # fmt: skip

    def set_limit(self, job_id: str, seconds: float) -> None:
        """Set how long a job that has not been run may run, at most what is granted."""
        most = float(self._limits.run_s)
        self._change(job_id, ("PENDING",), limit_s=min(seconds, most) if seconds > 0 else most)

    def set_destruction(self, job_id: str, at_s: float) -> None:
        """Set when a job goes, at most as late as is granted."""
        job = self.job(job_id)
        latest = job.created_s + self._limits.keep_s
        self._change(job_id, None, destroyed_s=min(at_s, latest))

    def queue(self, job_id: str) -> bool:
        """Let a job wait to be run; False where it did so before."""
        return self._change(job_id, ("PENDING",), phase="QUEUED", queued_s=time.time())

    def begin(self, job_id: str) -> bool:
        """Note that a job runs; False where it is not one that waits."""
        return self._change(job_id, ("QUEUED",), phase="EXECUTING", started_s=time.time())

    def complete(self, job_id: str, media_type: str) -> bool:
        """Note that the answer of a job is there."""
        return self._change(
            job_id, ("EXECUTING",), phase="COMPLETED", ended_s=time.time(), media_type=media_type
        )

    def fail(self, job_id: str, message: str) -> bool:
        """Note that a job has no answer, and why."""
        return self._change(
            job_id, ("QUEUED", "EXECUTING"), phase="ERROR", ended_s=time.time(), error=message
        )

    def abort(self, job_id: str) -> bool:
        """Note that a job is not wanted; False where it was at its end."""
        return self._change(job_id, ACTIVE, phase="ABORTED", ended_s=time.time())

    def requeue(self, job_id: str) -> bool:
        """Let a job that was interrupted on purpose wait again."""
        return self._change(job_id, ("EXECUTING",), phase="QUEUED", started_s=None)

    def delete(self, job_id: str) -> None:
        """Forget a job and its answer."""
        with self._records.writing() as connection:
            connection.execute("DELETE FROM tap_jobs WHERE id = ?", (job_id,))
        shutil.rmtree(self.folder(job_id), ignore_errors=True)

    def tidy(self, job_id: str) -> None:
        """Remove what was written for a job that was deleted meanwhile."""
        with self._records.reading() as connection:
            row = connection.execute("SELECT 1 FROM tap_jobs WHERE id = ?", (job_id,)).fetchone()
        if row is None:
            shutil.rmtree(self.folder(job_id), ignore_errors=True)

    def recover(self) -> None:
        """Tell of jobs that a server left halfway that they failed, and remove what is over."""
        with self._records.writing() as connection:
            connection.execute(
                "UPDATE tap_jobs SET phase = 'ERROR', ended_s = ?, error = ? "
                "WHERE phase = 'EXECUTING'",
                (time.time(), ENDED_WITH_SERVER),
            )
        self.sweep()

    def sweep(self) -> None:
        """Remove the jobs whose time is over."""
        with self._records.reading() as connection:
            rows = connection.execute(
                "SELECT id FROM tap_jobs WHERE destroyed_s < ?", (time.time(),)
            ).fetchall()
        for row in rows:
            self.delete(row["id"])

    def _change(self, job_id: str, phases: tuple[str, ...] | None, **values: object) -> bool:
        """Set columns of a job that is in one of some phases; return whether it was."""
        setting = ", ".join(f"{name} = ?" for name in values)
        within = f" AND phase IN ({', '.join('?' * len(phases))})" if phases else ""
        with self._records.writing() as connection:
            done = connection.execute(
                f"UPDATE tap_jobs SET {setting} WHERE id = ?{within}",
                (*values.values(), job_id, *(phases or ())),
            )
        return done.rowcount > 0


def _facts(row: sqlite3.Row) -> JobFacts:
    return JobFacts(
        job_id=row["id"],
        owner=row["owner"],
        phase=row["phase"],
        run_id=row["run_id"],
        parameters=tuple((name, value) for name, value in json.loads(row["parameters"])),
        created_s=row["created_s"],
        started_s=row["started_s"],
        ended_s=row["ended_s"],
        destroyed_s=row["destroyed_s"],
        limit_s=row["limit_s"],
        error=row["error"],
        media_type=row["media_type"],
    )
