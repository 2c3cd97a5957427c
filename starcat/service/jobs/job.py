"""A job as it is remembered: what was asked for, how far it is, what became of it."""

from __future__ import annotations

import json
import secrets
import sqlite3
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from starcat.errors import TargetMissing
from starcat.service.paths import JOB_ID, checked
from starcat.service.records import Records

Kind = Literal["build", "ingest", "evaluate"]
State = Literal["queued", "running", "done", "failed", "cancelled"]

ENDED: tuple[State, ...] = ("done", "failed", "cancelled")


@dataclass(frozen=True)
class Job:
    """A job.

    Attributes
    ----------
    id : str
        Thirty-two hexadecimal digits.
    kind : {"build", "ingest", "evaluate"}
        What is to be done.
    key : str
        SHA-256 of all that the result depends on.
    owner : str
        Name of who asked for it.
    title : str
        For people, such as ``gaia-12deg 1.0.0``.
    state : {"queued", "running", "done", "failed", "cancelled"}
        How far it is.
    request : dict
        What was asked for, as JSON has it.
    created_s, started_s, ended_s : float
        Seconds since 1970; the last two None before.
    attempt : int
        How often it was begun.
    stage, done, total
        The stage that it is in, and how much of that is done of how much, where that is known.
    error : dict, optional
        Problem details, where it failed.
    result : dict, optional
        What it made, such as ``{"database": "0123456789abcdef"}``.
    """

    id: str
    kind: Kind
    key: str
    owner: str
    title: str
    state: State
    request: dict[str, Any]
    created_s: float
    started_s: float | None
    ended_s: float | None
    attempt: int
    stage: str | None
    done: int | None
    total: int | None
    error: dict[str, Any] | None
    result: dict[str, Any] | None

    @property
    def has_ended(self) -> bool:
        """Whether nothing will change any more, unless it is tried again."""
        return self.state in ENDED


@dataclass(frozen=True)
class Event:
    """Something that happened to a job.

    Attributes
    ----------
    number : int
        1, 2, 3 ... of its job.
    at_s : float
        Seconds since 1970.
    kind : {"state", "stage", "log"}
        What changed.
    data : dict
        The state; the stage with ``done`` and ``total``; or a line of the log.
    """

    number: int
    at_s: float
    kind: str
    data: dict[str, Any]


class JobStore:
    """The jobs of a service."""

    def __init__(self, records: Records) -> None:
        self._records = records

    def add(
        self, kind: Kind, request: Mapping[str, Any], *, key: str, title: str, owner: str
    ) -> Job:
        """Remember a new job."""
        with self._records.writing() as connection:
            job_id = insert_job(connection, kind, request, key=key, title=title, owner=owner)
        return self.get(job_id)

    def get(self, job_id: str) -> Job:
        """Return a job."""
        checked(job_id, JOB_ID, "job")
        with self._records.reading() as connection:
            row = connection.execute("SELECT * FROM jobs WHERE id = ?", (job_id,)).fetchone()
        if row is None:
            raise TargetMissing(f"no job has the id {job_id!r}; the list of them tells theirs")
        return job_of(row)

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
    conditions = " AND ".join(f"{name} = ?" for name in given)
    return (f"WHERE {conditions}" if given else ""), list(given.values())


def insert_job(
    connection: sqlite3.Connection,
    kind: Kind,
    request: Mapping[str, Any],
    *,
    key: str,
    title: str,
    owner: str,
) -> str:
    """Remember a new job within a transaction."""
    job_id = secrets.token_hex(16)
    connection.execute(
        "INSERT INTO jobs (id, kind, key, owner, title, state, request, created_s) "
        "VALUES (?, ?, ?, ?, ?, 'queued', ?, ?)",
        (job_id, kind, key, owner, title, json.dumps(request), time.time()),
    )
    add_event(connection, job_id, "state", {"state": "queued"})
    return job_id


def add_event(
    connection: sqlite3.Connection, job_id: str, kind: str, data: Mapping[str, Any]
) -> None:
    """Remember that something happened to a job."""
    connection.execute(
        "INSERT INTO job_events (job, number, at_s, kind, data) SELECT ?, "
        "1 + coalesce(max(number), 0), ?, ?, ? FROM job_events WHERE job = ?",
        (job_id, time.time(), kind, json.dumps(data), job_id),
    )


def job_of(row: sqlite3.Row) -> Job:
    """Return the job of a row of the records."""
    content = {name: row[name] for name in Job.__dataclass_fields__}
    for name in ("request", "error", "result"):
        content[name] = None if content[name] is None else json.loads(content[name])
    return Job(**content)
