"""Submitting, cancelling and retrying jobs, and limits of their disk space.

The same request gives the same job while it waits, runs, or its result exists.
"""

from __future__ import annotations

import json
import secrets
import sqlite3
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from starcat.catalog import ingest_options
from starcat.errors import TargetMissing
from starcat.pipeline import blind_folder
from starcat.pipeline.specs import BuildSpec, spec_from_dict
from starcat.sections import version_numbers
from starcat_service.access import Principal
from starcat_service.jobs.job import NO_STAGE, Job, Kind, add_event, finish_job, job_in, job_of
from starcat_service.jobs.keys import build_key, ingest_key, key_of
from starcat_service.problems import Problem
from starcat_service.sandbox.limiter import RETRY_S
from starcat_service.security.request_limits import check_disk
from starcat_service.service import Service
from starcat_service.settings import Role

Format = Literal["parquet", "hats"]

SERVICE_ITSELF = "the service"
"""Owner of jobs that every user needs. No token has a name with a space."""


def check_room(service: Service, owner: str) -> None:
    """Check that the disk and the user's share of it allow another job."""
    check_disk(service.settings)
    full = service.quota.database_excess(owner)
    if full is not None:
        raise Problem(409, full)


@dataclass(frozen=True)
class Submitted:
    """The result of a request for a job: the job that does it, new or existing."""

    job: Job
    is_new: bool


def submit_build(service: Service, spec: BuildSpec, owner: str) -> Submitted:
    """Have a database built."""
    key = check_title(service, spec)
    title = f"{spec.name} {spec.version}"
    return submit(service, "build", {"spec": spec.recorded()}, key, title, owner)


def check_title(service: Service, spec: BuildSpec) -> str:
    """Return the key of a build, unless another database has its name and version.

    The same database may be asked for again; a job that waits or runs has its name already.
    """
    key = build_key(service.records, spec)
    check_free(service, spec, key)
    return key


def check_free(service: Service, spec: BuildSpec, key: str | None = None) -> None:
    """Check that no other database has the name and version of a spec.

    ``key`` is the key of its build; it is computed only if it is needed.
    """
    taken = {
        (database.version, database.id)
        for database in service.library.databases()
        if database.name == spec.name
    }
    for row in service.records.rows(
        "SELECT title, key FROM jobs WHERE kind = 'build' AND state IN ('queued', 'running')"
    ):
        name, _, version = str(row["title"]).rpartition(" ")
        if name == spec.name:
            taken.add((version, str(row["key"])[:16]))
    versions = {version for version, _ in taken}
    if spec.version not in versions:
        return
    if (spec.version, (key or build_key(service.records, spec))[:16]) in taken:
        return
    *first, last = version_numbers(spec.version)
    while (free := ".".join(map(str, (*first, last)))) in versions:
        last += 1
    raise Problem(
        409,
        f"{spec.name} {spec.version} is there already, made from another spec or other files; "
        f"choose another version, such as {free}, or another name",
        key="version",
    )


def submit_ingest(
    service: Service,
    source: str,
    owner: str,
    *,
    band: str | None = None,
    epoch_jyear: float | None = None,
    read_limit_mag: float | None = None,
    to: Format = "parquet",
) -> Submitted:
    """Have a catalog read."""
    request = {
        "source": source,
        "band": ingest_options(source, band).band,
        "epoch_jyear": epoch_jyear,
        "read_limit_mag": read_limit_mag,
        "to": to,
    }
    key = ingest_key(service.records, request)
    return submit(service, "ingest", request, key, f"{source} ({to})", owner)


def submit_evaluation(
    service: Service,
    database_id: str,
    owner: str,
    *,
    frames: int = 500,
    noise_px: float | None = None,
    noise_mag: float | None = None,
    seed: int | None = None,
) -> Submitted:
    """Request a measurement of how often frames are identified with a database."""
    database = service.library.database(database_id)
    test = spec_from_dict(database.manifest["spec"], database.title).self_test
    request = {
        "database": database_id,
        "frames": frames,
        "noise_px": test.noise_px if noise_px is None else noise_px,
        "noise_mag": test.noise_mag if noise_mag is None else noise_mag,
        "seed": test.seed if seed is None else seed,
    }
    key = key_of("evaluate", request)
    return submit(service, "evaluate", request, key, f"{database.title} evaluated", owner)


def photographs_database(service: Service) -> Path:
    """Return the database that finds the cameras of photographs.

    If it is not there, its job is queued, and a `BeingBuilt` is raised. A job that failed is not
    repeated by requests: a publisher can retry it.
    """
    folder = blind_folder(service.paths.blind)
    if folder.is_dir():
        return folder
    key = key_of("photographs", {"folder": folder.parent.name})
    newest = "SELECT id FROM jobs WHERE key = ? ORDER BY created_s DESC, id LIMIT 1"
    for row in service.records.rows(newest, key):
        job = service.jobs.get(row["id"])
        if job.state in ("failed", "cancelled"):
            why = (job.error or {}).get("detail", f"it was {job.state}")
            raise Problem(
                503,
                f"the database for photographs could not be built: {why}. A publisher can retry "
                f"the job {job.id}",
            )
    title = "database for photographs"
    job = submit(service, "photographs", {}, key, title, SERVICE_ITSELF).job
    if folder.is_dir():
        return folder
    raise BeingBuilt(job.id)


class BeingBuilt(Problem):
    """The database that a request needs is being built by a job."""

    def __init__(self, job_id: str) -> None:
        super().__init__(
            503,
            "the database for photographs is being built, once for all users; ask again in "
            f"{RETRY_S} s",
            headers={"Retry-After": str(RETRY_S)},
        )
        self.job_id = job_id


def submit(
    service: Service, kind: Kind, request: Mapping[str, Any], key: str, title: str, owner: str
) -> Submitted:
    """Queue a job, or return the job that does the same."""
    job_id, now_s = secrets.token_hex(16), time.time()
    with service.records.writing() as connection:
        same = _same(service, connection, key)
        if same is not None:
            return Submitted(same, is_new=False)
        check_room(service, owner)
        _check_waiting(service, connection, owner)
        connection.execute(
            "INSERT INTO jobs (id, kind, key, owner, title, state, request, created_s, queued_s) "
            "VALUES (?, ?, ?, ?, ?, 'queued', ?, ?, ?)",
            (job_id, kind, key, owner, title, json.dumps(request), now_s, now_s),
        )
        add_event(connection, job_id, "state", {"state": "queued"})
    service.wake_slots()
    return Submitted(service.jobs.get(job_id), is_new=True)


def _same(service: Service, connection: sqlite3.Connection, key: str) -> Job | None:
    """Return the newest job whose result has or will have this key."""
    rows = connection.execute(
        "SELECT * FROM jobs WHERE key = ? AND state IN ('queued', 'running', 'done') "
        "ORDER BY created_s DESC, id",
        (key,),
    ).fetchall()
    jobs = map(job_of, rows)
    return next((job for job in jobs if job.state != "done" or _has_result(service, job)), None)


def _check_waiting(service: Service, connection: sqlite3.Connection, owner: str) -> None:
    [waiting] = connection.execute(
        "SELECT count(*) FROM jobs WHERE owner = ? AND state = 'queued' AND kind != 'query'",
        (owner,),
    ).fetchone()
    most = service.settings.jobs_waiting
    if waiting >= most:
        raise Problem(
            429,
            f"{waiting} jobs of {owner} are waiting, and {most} may; wait until one has begun, "
            "or cancel one",
            headers={"Retry-After": "30"},
        )


def _has_result(service: Service, job: Job) -> bool:
    result = job.result or {}
    if job.kind == "evaluate":
        return "curves" in result
    if job.kind == "photographs":
        return blind_folder(service.paths.blind).is_dir()
    if job.kind == "ingest":
        name = str(result.get("catalog", ""))
        return bool(name) and (service.paths.catalogs / Path(name).name).exists()
    try:
        service.library.database(str(result.get("database", "")))
    except TargetMissing:
        return False
    return True


def cancel_job(service: Service, job_id: str, principal: Principal) -> Job:
    """End a job that waits, or request the end of a job that runs."""
    _check_may(service.jobs.get(job_id), principal)
    with service.records.writing() as connection:
        job = job_in(connection, job_id)
        if job.state == "queued":
            finish_job(connection, job_id, "cancelled")
        elif job.state == "running":
            connection.execute("UPDATE jobs SET cancel_requested = 1 WHERE id = ?", (job_id,))
        elif job.state != "cancelled":
            raise Problem(409, f"job {job_id} has ended already; it is {job.state}")
    return service.jobs.get(job_id)


def retry_job(service: Service, job_id: str, principal: Principal) -> Job:
    """Run a job again that failed or was cancelled."""
    job = service.jobs.get(job_id)
    _check_may(job, principal)
    check_room(service, job.owner)
    with service.records.writing() as connection:
        same = _same(service, connection, job.key)
        if same is not None:
            what = "it" if same.id == job_id else f"job {same.id} does the same and"
            raise Problem(409, f"job {job_id} need not be tried again: {what} is {same.state}")
        _check_waiting(service, connection, job.owner)
        connection.execute(
            "UPDATE jobs SET state = 'queued', queued_s = ?, interrupted = 0, ended_s = NULL, "
            f"cancel_requested = 0, {NO_STAGE}, error = NULL, result = NULL WHERE id = ?",
            (time.time(), job_id),
        )
        add_event(connection, job_id, "state", {"state": "queued"})
    service.wake_slots()
    return service.jobs.get(job_id)


def may_change(job: Job, principal: Principal) -> bool:
    """Return whether a user may end a job or have it done again."""
    needed = Role.BUILDER if principal.name == job.owner else Role.PUBLISHER
    return principal.role >= needed


def _check_may(job: Job, principal: Principal) -> None:
    if not may_change(job, principal):
        raise Problem(
            403,
            f"job {job.id} belongs to {job.owner}, and {principal.name} may not change it; ask the "
            "owner, or a user whose token has the role publisher",
        )
