"""A job as it is remembered: what was asked for, how far it is, what became of it."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import dataclass
from typing import Any, Literal

from starcat.errors import TargetMissing
from starcat.service.paths import JOB_ID, checked
from starcat.service.records import Records

Kind = Literal["build", "ingest", "evaluate"]
State = Literal["queued", "running", "done", "failed", "cancelled"]

ENDED: tuple[State, ...] = ("done", "failed", "cancelled")

QUERY = "query"
"""Kind of the rows that are asynchronous queries of TAP, which only `starcat.service.vo` shows."""


@dataclass(frozen=True)
class Job:
    """A job; times are seconds since 1970."""

    id: str  # 32 hexadecimal digits
    kind: Kind
    key: str  # SHA-256 of all that the result depends on
    owner: str
    title: str  # for people, such as "gaia-12deg 1.0.0"
    state: State
    request: dict[str, Any]
    created_s: float
    started_s: float | None
    ended_s: float | None
    attempt: int  # how often it was begun
    stage: str | None
    done: int | None  # of the stage
    total: int | None
    error: dict[str, Any] | None  # problem details
    result: dict[str, Any] | None  # such as {"database": "0123456789abcdef"}

    @property
    def has_ended(self) -> bool:
        """Whether nothing will change any more, unless it is tried again."""
        return self.state in ENDED


@dataclass(frozen=True)
class Event:
    """Something that happened to a job: ``data`` is a state, a stage, or a line of the log."""

    number: int  # 1, 2, 3 ... of its job
    at_s: float
    kind: str  # "state", "stage" or "log"
    data: dict[str, Any]


class JobStore:
    """The builds, ingests and evaluations of a service."""

    def __init__(self, records: Records) -> None:
        self._records = records

    def get(self, job_id: str) -> Job:
        """Return a job."""
        with self._records.reading() as connection:
            return job_in(connection, job_id)

    def all(
        self,
        *,
        state: State | None = None,
        kind: Kind | None = None,
        owner: str | None = None,
        most: int = 100,
        skip: int = 0,
    ) -> list[Job]:
        """Return the jobs, the newest first."""
        where, values = _where(state=state, kind=kind, owner=owner)
        with self._records.reading() as connection:
            rows = connection.execute(
                f"SELECT * FROM jobs {where} ORDER BY created_s DESC, id LIMIT ? OFFSET ?",
                (*values, most, skip),
            ).fetchall()
        return [job_of(row) for row in rows]

    def count(
        self, *, state: State | None = None, kind: Kind | None = None, owner: str | None = None
    ) -> int:
        """Return how many jobs there are."""
        where, values = _where(state=state, kind=kind, owner=owner)
        with self._records.reading() as connection:
            [found] = connection.execute(f"SELECT count(*) FROM jobs {where}", values).fetchone()
        return int(found)

    def events(self, job_id: str, after: int = 0) -> list[Event]:
        """Return what happened to a job."""
        with self._records.reading() as connection:
            rows = connection.execute(
                "SELECT * FROM job_events WHERE job = ? AND number > ? ORDER BY number",
                (job_id, after),
            ).fetchall()
        return [
            Event(row["number"], row["at_s"], row["kind"], json.loads(row["data"])) for row in rows
        ]


def _where(**wanted: str | None) -> tuple[str, list[str]]:
    given = {name: value for name, value in wanted.items() if value is not None}
    conditions = " AND ".join(["kind != ?", *(f"{name} = ?" for name in given)])
    return f"WHERE {conditions}", [QUERY, *given.values()]


def job_in(connection: sqlite3.Connection, job_id: str) -> Job:
    """Return a job within a transaction."""
    checked(job_id, JOB_ID, "job")
    row = connection.execute(
        "SELECT * FROM jobs WHERE id = ? AND kind != ?", (job_id, QUERY)
    ).fetchone()
    if row is None:
        raise TargetMissing(f"no job has the id {job_id!r}; the list of them tells theirs")
    return job_of(row)


def job_of(row: sqlite3.Row) -> Job:
    """Return the job of a row of the records."""
    content = {name: row[name] for name in Job.__dataclass_fields__}
    for name in ("request", "error", "result"):
        content[name] = None if content[name] is None else json.loads(content[name])
    return Job(**content)


def job_problem(title: str, status: int, detail: str) -> dict[str, Any]:
    """Return problem details of a job that failed."""
    return {"type": "about:blank", "title": title, "status": status, "detail": detail}
