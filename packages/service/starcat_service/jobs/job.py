"""A job in the records: its request, its progress, and its end.

The table is the queue: the slot that changes a row from queued to running has begun the job. From
then on the number of the attempt identifies its owner: reports of earlier attempts are ignored.
Each step is one transaction, and only one slot can take it.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import Field

from starcat.errors import TargetMissing
from starcat_service.paths import JOB_ID, checked
from starcat_service.records import Records

Kind = Literal["build", "ingest", "evaluate", "photographs"]
State = Literal["queued", "running", "done", "failed", "cancelled"]

ENDED: tuple[State, ...] = ("done", "failed", "cancelled")

QUERY = "query"
"""Kind of the rows that are asynchronous queries of TAP, which only `starcat_service.vo` shows."""

ASKER = "asker"
"""Key of a request: the client to count as one user if the owner has no name."""

MAX_INTERRUPTED = 8
"""A job that has lost its server this often is taken for the cause."""

MAX_LOG_LINES = 2000
"""Lines of the log of a job that are kept, all attempts together."""

NO_STAGE = "stage = NULL, done = NULL, total = NULL"


@dataclass(frozen=True)
class Job:
    """A job; times are seconds since 1970."""

    id: Annotated[str, Field(description="Thirty-two hexadecimal digits.")]
    kind: Annotated[Kind, Field(description="Kind of work.")]
    key: Annotated[str, Field(description="SHA-256 of all that the result depends on.")]
    owner: Annotated[str, Field(description="User who requested it.")]
    title: Annotated[str, Field(description="For people, such as ``gaia-12deg 1.0.0``.")]
    state: Annotated[State, Field(description="How far it is.")]
    request: Annotated[dict[str, Any], Field(description="The request.")]
    created_s: Annotated[float, Field(description="When it was requested.")]
    started_s: Annotated[float | None, Field(description="When the last attempt began.")]
    ended_s: Annotated[float | None, Field(description="When it ended.")]
    attempt: Annotated[int, Field(description="How often it was begun.")]
    stage: Annotated[str | None, Field(description="The stage that it is in.")]
    done: Annotated[int | None, Field(description="How much of the stage is done.")]
    total: Annotated[int | None, Field(description="The whole of the stage, if it is known.")]
    error: Annotated[dict[str, Any] | None, Field(description="Problem details of a failure.")]
    result: Annotated[
        dict[str, Any] | None, Field(description="The id of a database, a catalog, or rates.")
    ]

    @property
    def has_ended(self) -> bool:
        """Whether the job will not change any more, unless it is tried again."""
        return self.state in ENDED


@dataclass(frozen=True)
class Event:
    """An event of a job."""

    number: Annotated[
        int, Field(description="Number within its job, from 1; only the last stages are stored.")
    ]
    at_s: Annotated[float, Field(description="Seconds since 1970.")]
    kind: Annotated[Literal["state", "stage", "log"], Field(description="What changed.")]
    data: Annotated[
        dict[str, Any],
        Field(description="The state; the stage with 'done' and 'total'; or 'level' and 'text'."),
    ]


class JobStore:
    """The jobs of a service but for queries."""

    def __init__(self, records: Records) -> None:
        self._records = records

    def get(self, job_id: str) -> Job:
        """Return a job."""
        return job_in(self._records.connection(), job_id)

    def all(
        self,
        *,
        state: State | None = None,
        kind: Kind | None = None,
        owner: str | None = None,
        database: str | None = None,
        text: str | None = None,
        most: int = 100,
        skip: int = 0,
    ) -> list[Job]:
        """Return jobs, the newest first; ``database`` selects the evaluations of a database."""
        where, values = _where(text, state=state, kind=kind, owner=owner, database=database)
        newest = f"SELECT * FROM jobs {where} ORDER BY created_s DESC, id LIMIT ? OFFSET ?"
        return [job_of(row) for row in self._records.rows(newest, *values, most, skip)]

    def count(
        self,
        *,
        state: State | None = None,
        kind: Kind | None = None,
        owner: str | None = None,
        database: str | None = None,
        text: str | None = None,
    ) -> int:
        """Return how many jobs there are."""
        where, values = _where(text, state=state, kind=kind, owner=owner, database=database)
        [[count]] = self._records.rows(f"SELECT count(*) FROM jobs {where}", *values)
        return int(count)

    def events(self, job_id: str, after: int = 0) -> list[Event]:
        """Return the events of a job."""
        later = (
            "SELECT number, at_s, kind, data FROM job_events WHERE job = ? AND number > ? "
            "ORDER BY number"
        )
        rows = self._records.rows(later, job_id, after)
        return [Event(number, at_s, kind, json.loads(data)) for number, at_s, kind, data in rows]


_COLUMNS = {"database": "json_extract(request, '$.database')"}


def _where(text: str | None, **columns: str | None) -> tuple[str, list[str]]:
    filters = {name: value for name, value in columns.items() if value is not None}
    conditions = ["kind != ?", *(f"{_COLUMNS.get(name, name)} = ?" for name in filters)]
    values = [*filters.values()]
    for word in (text or "").split():
        conditions.append("instr(lower(title || ' ' || kind || ' ' || owner || ' ' || id), ?) > 0")
        values.append(word.lower())
    return f"WHERE {' AND '.join(conditions)}", [QUERY, *values]


def job_in(connection: sqlite3.Connection, job_id: str) -> Job:
    """Return a job within a transaction."""
    checked(job_id, JOB_ID, "job")
    row = connection.execute(
        "SELECT * FROM jobs WHERE id = ? AND kind != ?", (job_id, QUERY)
    ).fetchone()
    if row is None:
        raise TargetMissing(f"no job has the id {job_id!r}; the list of jobs shows the valid ids")
    return job_of(row)


def job_of(row: sqlite3.Row) -> Job:
    """Return the job of a row of the records."""
    content = {name: row[name] for name in Job.__dataclass_fields__}
    for name in ("request", "error", "result"):
        content[name] = None if content[name] is None else json.loads(content[name])
    return Job(**content)


def is_waiting(records: Records, kinds: Sequence[str]) -> bool:
    """Return whether a job of some kinds is waiting."""
    waiting = f"SELECT 1 FROM jobs WHERE state = 'queued' AND kind IN ({_marks(kinds)}) LIMIT 1"
    return bool(records.rows(waiting, *kinds))


def begin_next(records: Records, kinds: Sequence[str]) -> Job | None:
    """Begin a job of some kinds; None if no job waits.

    Users with the fewest running jobs come first, then the user whose job has waited longest.
    """
    marks = _marks(kinds)
    of = f"owner || ' ' || coalesce(json_extract(request, '$.{ASKER}'), '')"
    first = (
        f"SELECT id FROM jobs LEFT JOIN (SELECT {of} AS who, sum(state = 'running') AS running, "
        f"max(started_s) AS served_s FROM jobs WHERE kind IN ({marks}) GROUP BY who) "
        f"ON who = {of} WHERE state = 'queued' AND kind IN ({marks}) "
        "ORDER BY running, served_s NULLS FIRST, queued_s, id LIMIT 1"
    )
    with records.writing() as connection:
        row = connection.execute(
            "UPDATE jobs SET state = 'running', started_s = ?, attempt = attempt + 1, "
            f"cancel_requested = 0, {NO_STAGE}, error = NULL WHERE id = ({first}) RETURNING *",
            (time.time(), *kinds, *kinds),
        ).fetchone()
        if row is None:
            return None
        job = job_of(row)
        add_event(connection, job.id, "state", {"state": "running", "attempt": job.attempt})
    return job


def _marks(values: Sequence[str]) -> str:
    return ", ".join("?" * len(values))


def running_jobs(records: Records) -> list[Job]:
    """Return the running jobs of all kinds."""
    rows = records.rows("SELECT * FROM jobs WHERE state = 'running' ORDER BY created_s")
    return [job_of(row) for row in rows]


def interrupt(records: Records, job: Job) -> None:
    """Queue a job whose attempt is lost again, unless that happened too often."""
    with records.writing() as connection:
        row = connection.execute(
            "UPDATE jobs SET interrupted = interrupted + 1 WHERE id = ? AND attempt = ? "
            "AND state = 'running' RETURNING interrupted, cancel_requested",
            (job.id, job.attempt),
        ).fetchone()
        if row is None:
            return
        if row["cancel_requested"]:
            finish_job(connection, job.id, "cancelled")
        elif row["interrupted"] >= MAX_INTERRUPTED:
            detail = (
                f"the service ended {row['interrupted']} times while this job ran, which may be "
                "because of it; ask for less, or try it again"
            )
            finish_job(connection, job.id, "failed", failed("Interrupted", 500, detail).content)
        else:
            _requeue(connection, job.id)


@dataclass(frozen=True)
class Outcome:
    """How an attempt ended; ``queued`` if the service stops and the job must run again."""

    state: Literal["done", "failed", "cancelled", "queued"]
    content: Mapping[str, Any] = field(default_factory=dict)  # the result, or problem details


def failed(title: str, status: int, detail: str) -> Outcome:
    """Return the end of an attempt with problem details."""
    content = {"type": "about:blank", "title": title, "status": status, "detail": detail}
    return Outcome("failed", content)


class Attempt:
    """An attempt at a job: its reports are accepted while the job belongs to it."""

    def __init__(self, records: Records, job: Job) -> None:
        self._records = records
        self.job = job

    def cancel_requested(self) -> bool:
        """Return whether it must end: the job was cancelled, or belongs to another attempt."""
        rows = self._records.rows(
            "SELECT 1 FROM jobs WHERE id = ? AND attempt = ? AND state = 'running' "
            "AND NOT cancel_requested",
            self.job.id,
            self.job.attempt,
        )
        return not rows

    def report(self, message: Mapping[str, Any]) -> None:
        """Take a message of the process: ``stage``, ``done``, ``total``; or ``log``, ``level``."""
        if "stage" in message:
            self.report_stage(message["stage"], message["done"], message["total"])
        elif "log" in message:
            self.log(message["level"], message["log"])

    def report_stage(self, stage: str, done: int, total: int | None) -> None:
        """Record the progress of a stage; of the events of a stage only the last is kept."""
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

    def log(self, level: str, text: str) -> None:
        """Add a line to the log; the level is info, warning or error."""
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

    def end(self, outcome: Outcome) -> None:
        """Record how it ended."""
        with self._records.writing() as connection:
            if not self._is_mine(connection):
                return
            if outcome.state == "queued":
                _requeue(connection, self.job.id)
            else:
                finish_job(connection, self.job.id, outcome.state, outcome.content)

    def _is_mine(self, connection: sqlite3.Connection) -> bool:
        return self._update(connection, "attempt = ?", self.job.attempt)

    def _update(self, connection: sqlite3.Connection, change: str, *values: object) -> bool:
        done = connection.execute(
            f"UPDATE jobs SET {change} WHERE id = ? AND attempt = ? AND state = 'running'",
            (*values, self.job.id, self.job.attempt),
        )
        return bool(done.rowcount)


def _requeue(connection: sqlite3.Connection, job_id: str) -> None:
    connection.execute(f"UPDATE jobs SET state = 'queued', {NO_STAGE} WHERE id = ?", (job_id,))
    add_event(connection, job_id, "state", {"state": "queued"})


def finish_job(
    connection: sqlite3.Connection, job_id: str, state: State, content: Mapping[str, Any] = {}
) -> None:
    """Record the end of a job, within a transaction."""
    column = {"done": "result", "failed": "error"}.get(state)
    columns = {} if column is None else {column: dict(content)}
    result, error = (
        json.dumps(columns[name]) if name in columns else None for name in ("result", "error")
    )
    connection.execute(
        "UPDATE jobs SET state = ?, ended_s = ?, cancel_requested = 0, result = ?, error = ? "
        "WHERE id = ?",
        (state, time.time(), result, error, job_id),
    )
    add_event(connection, job_id, "state", {"state": state, **columns})


def add_event(
    connection: sqlite3.Connection, job_id: str, kind: str, data: Mapping[str, Any]
) -> None:
    """Record an event of a job, within a transaction."""
    connection.execute(
        "INSERT INTO job_events (job, number, at_s, kind, data) SELECT ?, "
        "1 + coalesce(max(number), 0), ?, ?, ? FROM job_events WHERE job = ?",
        (job_id, time.time(), kind, json.dumps(data), job_id),
    )
