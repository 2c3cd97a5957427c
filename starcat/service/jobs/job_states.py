"""What may become of a job: each step is one transaction, and only one can take it.

A job is begun by whoever turns it from queued to running. From then on the number of the attempt
says whose job it is: what an earlier attempt still has to say is not heard.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Callable, Mapping
from typing import Any

from starcat.errors import TargetMissing
from starcat.service.jobs.job import Job, Kind, State, add_event, insert_job, job_of
from starcat.service.problems import Problem
from starcat.service.records import Records

MAX_INTERRUPTED = 8
"""So often a job may lose its server before it is taken for the cause."""

MAX_LOG_LINES = 2000
"""Lines of the log of a job that are kept, all attempts together."""


def add_once(
    records: Records,
    kind: Kind,
    request: Mapping[str, Any],
    *,
    key: str,
    title: str,
    owner: str,
    most_waiting: int,
    has_result: Callable[[Job], bool],
    check: Callable[[], None],
) -> tuple[str, bool]:
    """Remember a job, unless one is there that does the same."""
    with records.writing() as connection:
        there = _same(connection, key, has_result)
        if there is not None:
            return there.id, False
        check()
        _check_waiting(connection, owner, most_waiting)
        return insert_job(connection, kind, request, key=key, title=title, owner=owner), True


def _same(
    connection: sqlite3.Connection, key: str, has_result: Callable[[Job], bool]
) -> Job | None:
    """Return the newest job that gives or will give what has this key."""
    rows = connection.execute(
        "SELECT * FROM jobs WHERE key = ? AND state IN ('queued', 'running', 'done') "
        "ORDER BY created_s DESC, id",
        (key,),
    ).fetchall()
    jobs = map(job_of, rows)
    return next((job for job in jobs if job.state != "done" or has_result(job)), None)


def _check_waiting(connection: sqlite3.Connection, owner: str, most: int) -> None:
    [waiting] = connection.execute(
        "SELECT count(*) FROM jobs WHERE owner = ? AND state = 'queued'", (owner,)
    ).fetchone()
    if waiting >= most:
        raise Problem(
            429,
            f"{waiting} jobs of {owner} are waiting, and {most} may; wait until one has begun, "
            "or cancel one",
            headers={"Retry-After": "30"},
        )


def claim(records: Records, job_id: str, *, is_away: bool = False) -> Job | None:
    """Begin a job."""
    with records.writing() as connection:
        row = connection.execute(
            "UPDATE jobs SET state = 'running', started_s = ?, heard_s = ?, "
            "attempt = attempt + 1, wants_end = 0, stage = NULL, done = NULL, total = NULL, "
            "error = NULL WHERE id = ? AND state = 'queued' RETURNING *",
            (time.time(), time.time() if is_away else None, job_id),
        ).fetchone()
        if row is None:
            return None
        job = job_of(row)
        add_event(connection, job_id, "state", {"state": "running", "attempt": job.attempt})
    return job


def running_here(records: Records) -> list[tuple[str, int]]:
    """Return the jobs that run on this machine."""
    with records.reading() as connection:
        rows = connection.execute(
            "SELECT id, attempt FROM jobs WHERE state = 'running' AND heard_s IS NULL "
            "ORDER BY created_s"
        ).fetchall()
    return [(row["id"], row["attempt"]) for row in rows]


def silent_since(records: Records, then_s: float) -> list[tuple[str, int]]:
    """Return the jobs on other machines that nobody has heard of."""
    with records.reading() as connection:
        rows = connection.execute(
            "SELECT id, attempt FROM jobs WHERE state = 'running' AND heard_s < ?", (then_s,)
        ).fetchall()
    return [(row["id"], row["attempt"]) for row in rows]


def cancel(records: Records, job_id: str) -> None:
    """End a job that waits, and ask for the end of one that runs."""
    with records.writing() as connection:
        job = _job(connection, job_id)
        if job.state == "queued":
            _end(connection, job_id, "cancelled")
        elif job.state == "running":
            connection.execute("UPDATE jobs SET wants_end = 1 WHERE id = ?", (job_id,))
        elif job.state != "cancelled":
            raise Problem(409, f"job {job_id} has ended already; it is {job.state}")


def retry(
    records: Records, job_id: str, *, most_waiting: int, has_result: Callable[[Job], bool]
) -> None:
    """Have a job wait once more."""
    with records.writing() as connection:
        job = _job(connection, job_id)
        there = _same(connection, job.key, has_result)
        if there is not None:
            what = "it" if there.id == job_id else f"job {there.id} does the same and"
            raise Problem(409, f"job {job_id} need not be tried again: {what} is {there.state}")
        _check_waiting(connection, job.owner, most_waiting)
        connection.execute(
            "UPDATE jobs SET state = 'queued', interrupted = 0, wants_end = 0, ended_s = NULL, "
            "stage = NULL, done = NULL, total = NULL, error = NULL, result = NULL WHERE id = ?",
            (job_id,),
        )
        add_event(connection, job_id, "state", {"state": "queued"})


def interrupt(records: Records, job_id: str, attempt: int) -> None:
    """Say that whoever ran a job is gone: it waits again, unless that was too often."""
    with records.writing() as connection:
        row = connection.execute(
            "UPDATE jobs SET interrupted = interrupted + 1 "
            "WHERE id = ? AND attempt = ? AND state = 'running' RETURNING interrupted, wants_end",
            (job_id, attempt),
        ).fetchone()
        if row is None:
            return
        if row["wants_end"]:
            _end(connection, job_id, "cancelled")
        elif row["interrupted"] >= MAX_INTERRUPTED:
            detail = (
                f"the service ended {row['interrupted']} times while this job ran, which may be "
                "because of it; ask for less, or try it again"
            )
            error = {"type": "about:blank", "title": "Interrupted", "status": 500, "detail": detail}
            _end(connection, job_id, "failed", error=error)
        else:
            _wait_again(connection, job_id)


class Attempt:
    """An attempt at a job: what it has to say is remembered while the job is its own."""

    def __init__(self, records: Records, job: Job) -> None:
        self._records = records
        self.job = job

    def wants_end(self) -> bool:
        """Return whether the job is to end: it was cancelled, or is another attempt's."""
        with self._records.reading() as connection:
            row = connection.execute(
                "SELECT wants_end FROM jobs WHERE id = ? AND attempt = ? AND state = 'running'",
                (self.job.id, self.job.attempt),
            ).fetchone()
        return row is None or bool(row["wants_end"])

    def be_heard(self) -> bool:
        """Say that its worker, on another machine, is there; return whether the job is its own."""
        with self._records.writing() as connection:
            return self._update(connection, "heard_s = ?", time.time())

    def tell_stage(self, stage: str, done: int, total: int | None) -> None:
        """Say how far it is; of each stage the last event is kept."""
        with self._records.writing() as connection:
            changed = self._update(connection, "stage = ?, done = ?, total = ?", stage, done, total)
            if not changed:
                return
            before = connection.execute(
                "SELECT max(number) FROM job_events WHERE job = ? AND kind = 'stage' "
                "AND json_extract(data, '$.stage') = ?",
                (self.job.id, stage),
            ).fetchone()[0]
            add_event(
                connection, self.job.id, "stage", {"stage": stage, "done": done, "total": total}
            )
            connection.execute(
                "DELETE FROM job_events WHERE job = ? AND number = ?", (self.job.id, before)
            )

    def tell(self, level: str, text: str) -> None:
        """Say a line of the log."""
        with self._records.writing() as connection:
            if not self._is_mine(connection):
                return
            [lines] = connection.execute(
                "SELECT count(*) FROM job_events WHERE job = ? AND kind = 'log'", (self.job.id,)
            ).fetchone()
            if lines < MAX_LOG_LINES:
                add_event(connection, self.job.id, "log", {"level": level, "text": text})
            elif lines == MAX_LOG_LINES:
                text = f"the log ends here, after {lines:,} lines"
                add_event(connection, self.job.id, "log", {"level": "warning", "text": text})

    def succeed(self, result: Mapping[str, Any]) -> None:
        """Say that it is done."""
        self._close("done", result=result)

    def fail(self, error: Mapping[str, Any]) -> None:
        """Say that it has failed."""
        self._close("failed", error=error)

    def be_cancelled(self) -> None:
        """Say that it was ended because somebody asked for that."""
        self._close("cancelled")

    def wait_again(self) -> None:
        """Say that it was ended because the service stops, and is to be begun again."""
        with self._records.writing() as connection:
            if self._is_mine(connection):
                _wait_again(connection, self.job.id)

    def _close(self, state: State, **content: Mapping[str, Any]) -> None:
        with self._records.writing() as connection:
            if self._is_mine(connection):
                _end(connection, self.job.id, state, **content)

    def _is_mine(self, connection: sqlite3.Connection) -> bool:
        return self._update(connection, "attempt = ?", self.job.attempt)

    def _update(self, connection: sqlite3.Connection, change: str, *values: object) -> bool:
        done = connection.execute(
            f"UPDATE jobs SET {change} WHERE id = ? AND attempt = ? AND state = 'running'",
            (*values, self.job.id, self.job.attempt),
        )
        return bool(done.rowcount)


def _job(connection: sqlite3.Connection, job_id: str) -> Job:
    row = connection.execute("SELECT * FROM jobs WHERE id = ?", (job_id,)).fetchone()
    if row is None:
        raise TargetMissing(f"no job has the id {job_id[:80]!r}; the list of them tells theirs")
    return job_of(row)


def _wait_again(connection: sqlite3.Connection, job_id: str) -> None:
    connection.execute(
        "UPDATE jobs SET state = 'queued', stage = NULL, done = NULL, total = NULL WHERE id = ?",
        (job_id,),
    )
    add_event(connection, job_id, "state", {"state": "queued"})


def _end(
    connection: sqlite3.Connection,
    job_id: str,
    state: State,
    *,
    result: Mapping[str, Any] | None = None,
    error: Mapping[str, Any] | None = None,
) -> None:
    told: dict[str, Any] = {"state": state}
    if result is not None:
        told["result"] = dict(result)
    if error is not None:
        told["error"] = dict(error)
    connection.execute(
        "UPDATE jobs SET state = ?, ended_s = ?, wants_end = 0, result = ?, error = ? WHERE id = ?",
        (
            state,
            time.time(),
            None if result is None else json.dumps(result),
            None if error is None else json.dumps(error),
            job_id,
        ),
    )
    add_event(connection, job_id, "state", told)
