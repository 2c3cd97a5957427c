"""What may become of a job: each step is one transaction, and only one can take it.

The table is the queue: a job is begun by whoever turns its row from queued to running. From then
on the number of the attempt says whose job it is: what an earlier attempt reports is not taken.
"""

from __future__ import annotations

import json
import secrets
import sqlite3
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from starcat.service.jobs.job import Job, Kind, State, job_in, job_of, job_problem
from starcat.service.problems import Problem
from starcat.service.records import Records

MAX_INTERRUPTED = 8
"""So often a job may lose its server before it is taken for the cause."""

MAX_LOG_LINES = 2000
"""Lines of the log of a job that are kept, all attempts together."""

_NO_STAGE = "stage = NULL, done = NULL, total = NULL"


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
) -> tuple[Job, bool]:
    """Return the job that does what is asked for, and whether it is new.

    ``has_result`` tells whether the result of a job that is done still exists; ``check`` raises
    where there is no room for a new one.
    """
    with records.writing() as connection:
        same = _same(connection, key, has_result)
        if same is not None:
            return same, False
        check()
        _check_waiting(connection, owner, most_waiting)
        job_id, now_s = secrets.token_hex(16), time.time()
        connection.execute(
            "INSERT INTO jobs (id, kind, key, owner, title, state, request, created_s, queued_s) "
            "VALUES (?, ?, ?, ?, ?, 'queued', ?, ?, ?)",
            (job_id, kind, key, owner, title, json.dumps(request), now_s, now_s),
        )
        _add_event(connection, job_id, "state", {"state": "queued"})
        return job_in(connection, job_id), True


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
        "SELECT count(*) FROM jobs WHERE owner = ? AND state = 'queued' AND kind != 'query'",
        (owner,),
    ).fetchone()
    if waiting >= most:
        raise Problem(
            429,
            f"{waiting} jobs of {owner} are waiting, and {most} may; wait until one has begun, "
            "or cancel one",
            headers={"Retry-After": "30"},
        )


def is_waiting(records: Records, kinds: Sequence[str]) -> bool:
    """Return whether a job of some kinds waits."""
    with records.reading() as connection:
        return connection.execute(_first(kinds), kinds).fetchone() is not None


def begin_next(records: Records, kinds: Sequence[str]) -> Job | None:
    """Begin the job of some kinds that has waited for longest; None where none waits."""
    with records.writing() as connection:
        row = connection.execute(
            "UPDATE jobs SET state = 'running', started_s = ?, attempt = attempt + 1, "
            f"cancel_requested = 0, {_NO_STAGE}, error = NULL WHERE id = ({_first(kinds)}) "
            "RETURNING *",
            (time.time(), *kinds),
        ).fetchone()
        if row is None:
            return None
        job = job_of(row)
        _add_event(connection, job.id, "state", {"state": "running", "attempt": job.attempt})
    return job


def _first(kinds: Sequence[str]) -> str:
    marks = ", ".join("?" * len(kinds))
    return (
        f"SELECT id FROM jobs WHERE state = 'queued' AND kind IN ({marks}) "
        "ORDER BY queued_s, id LIMIT 1"
    )


def running_jobs(records: Records) -> list[Job]:
    """Return the jobs that run, of all kinds."""
    with records.reading() as connection:
        rows = connection.execute(
            "SELECT * FROM jobs WHERE state = 'running' ORDER BY created_s"
        ).fetchall()
    return [job_of(row) for row in rows]


def cancel(records: Records, job_id: str) -> None:
    """End a job that waits, and ask for the end of one that runs."""
    with records.writing() as connection:
        job = job_in(connection, job_id)
        if job.state == "queued":
            _end(connection, job_id, "cancelled")
        elif job.state == "running":
            connection.execute("UPDATE jobs SET cancel_requested = 1 WHERE id = ?", (job_id,))
        elif job.state != "cancelled":
            raise Problem(409, f"job {job_id} has ended already; it is {job.state}")


def retry(
    records: Records, job_id: str, *, most_waiting: int, has_result: Callable[[Job], bool]
) -> None:
    """Have a job wait once more."""
    with records.writing() as connection:
        job = job_in(connection, job_id)
        same = _same(connection, job.key, has_result)
        if same is not None:
            what = "it" if same.id == job_id else f"job {same.id} does the same and"
            raise Problem(409, f"job {job_id} need not be tried again: {what} is {same.state}")
        _check_waiting(connection, job.owner, most_waiting)
        connection.execute(
            "UPDATE jobs SET state = 'queued', queued_s = ?, interrupted = 0, ended_s = NULL, "
            f"cancel_requested = 0, {_NO_STAGE}, error = NULL, result = NULL WHERE id = ?",
            (time.time(), job_id),
        )
        _add_event(connection, job_id, "state", {"state": "queued"})


def interrupt(records: Records, job: Job) -> None:
    """Have a job wait again whose attempt is lost, unless that was too often."""
    with records.writing() as connection:
        row = connection.execute(
            "UPDATE jobs SET interrupted = interrupted + 1 WHERE id = ? AND attempt = ? "
            "AND state = 'running' RETURNING interrupted, cancel_requested",
            (job.id, job.attempt),
        ).fetchone()
        if row is None:
            return
        if row["cancel_requested"]:
            _end(connection, job.id, "cancelled")
        elif row["interrupted"] >= MAX_INTERRUPTED:
            detail = (
                f"the service ended {row['interrupted']} times while this job ran, which may be "
                "because of it; ask for less, or try it again"
            )
            _end(connection, job.id, "failed", job_problem("Interrupted", 500, detail))
        else:
            _requeue(connection, job.id)


@dataclass(frozen=True)
class Outcome:
    """How an attempt ended; ``queued`` where the service stops, and the job is to run again."""

    state: Literal["done", "failed", "cancelled", "queued"]
    content: Mapping[str, Any] = field(default_factory=dict)  # the result, or problem details


class Attempt:
    """An attempt at a job: what it reports is taken while the job is its own."""

    def __init__(self, records: Records, job: Job) -> None:
        self._records = records
        self.job = job

    def cancel_requested(self) -> bool:
        """Return whether it has to end: the job was cancelled, or is another attempt's."""
        with self._records.reading() as connection:
            row = connection.execute(
                "SELECT cancel_requested FROM jobs WHERE id = ? AND attempt = ? "
                "AND state = 'running'",
                (self.job.id, self.job.attempt),
            ).fetchone()
        return row is None or bool(row["cancel_requested"])

    def report(self, message: Mapping[str, Any]) -> None:
        """Take a message of the process: ``stage``, ``done``, ``total``; or ``log``, ``level``."""
        if "stage" in message:
            self.report_stage(message["stage"], message["done"], message["total"])
        elif "log" in message:
            self.log(message["level"], message["log"])

    def report_stage(self, stage: str, done: int, total: int | None) -> None:
        """Record how much of a stage is done; of the events of a stage only the last is kept."""
        with self._records.writing() as connection:
            changed = self._update(connection, "stage = ?, done = ?, total = ?", stage, done, total)
            if not changed:
                return
            before = connection.execute(
                "SELECT max(number) FROM job_events WHERE job = ? AND kind = 'stage' "
                "AND json_extract(data, '$.stage') = ?",
                (self.job.id, stage),
            ).fetchone()[0]
            _add_event(
                connection, self.job.id, "stage", {"stage": stage, "done": done, "total": total}
            )
            connection.execute(
                "DELETE FROM job_events WHERE job = ? AND number = ?", (self.job.id, before)
            )

    def log(self, level: str, text: str) -> None:
        """Add a line to the log; the level is info, warning or error."""
        with self._records.writing() as connection:
            if not self._is_mine(connection):
                return
            [lines] = connection.execute(
                "SELECT count(*) FROM job_events WHERE job = ? AND kind = 'log'", (self.job.id,)
            ).fetchone()
            if lines < MAX_LOG_LINES:
                _add_event(connection, self.job.id, "log", {"level": level, "text": text})
            elif lines == MAX_LOG_LINES:
                text = f"the log ends here, after {lines:,} lines"
                _add_event(connection, self.job.id, "log", {"level": "warning", "text": text})

    def end(self, outcome: Outcome) -> None:
        """Record how it ended."""
        with self._records.writing() as connection:
            if not self._is_mine(connection):
                return
            if outcome.state == "queued":
                _requeue(connection, self.job.id)
            else:
                _end(connection, self.job.id, outcome.state, outcome.content)

    def _is_mine(self, connection: sqlite3.Connection) -> bool:
        return self._update(connection, "attempt = ?", self.job.attempt)

    def _update(self, connection: sqlite3.Connection, change: str, *values: object) -> bool:
        done = connection.execute(
            f"UPDATE jobs SET {change} WHERE id = ? AND attempt = ? AND state = 'running'",
            (*values, self.job.id, self.job.attempt),
        )
        return bool(done.rowcount)


def _requeue(connection: sqlite3.Connection, job_id: str) -> None:
    connection.execute(f"UPDATE jobs SET state = 'queued', {_NO_STAGE} WHERE id = ?", (job_id,))
    _add_event(connection, job_id, "state", {"state": "queued"})


def _end(
    connection: sqlite3.Connection, job_id: str, state: State, content: Mapping[str, Any] = {}
) -> None:
    column = {"done": "result", "failed": "error"}.get(state)
    told = {} if column is None else {column: dict(content)}
    result, error = (json.dumps(told[one]) if one in told else None for one in ("result", "error"))
    connection.execute(
        "UPDATE jobs SET state = ?, ended_s = ?, cancel_requested = 0, result = ?, error = ? "
        "WHERE id = ?",
        (state, time.time(), result, error, job_id),
    )
    _add_event(connection, job_id, "state", {"state": state, **told})


def _add_event(
    connection: sqlite3.Connection, job_id: str, kind: str, data: Mapping[str, Any]
) -> None:
    connection.execute(
        "INSERT INTO job_events (job, number, at_s, kind, data) SELECT ?, "
        "1 + coalesce(max(number), 0), ?, ?, ? FROM job_events WHERE job = ?",
        (job_id, time.time(), kind, json.dumps(data), job_id),
    )
