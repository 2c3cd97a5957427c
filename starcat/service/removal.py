"""Removing a database."""

from __future__ import annotations

import secrets
import shutil

from starcat.service.jobs.job import State
from starcat.service.paths import DATABASE_ID, checked
from starcat.service.problems import Problem
from starcat.service.service import Service

ACTIVE: tuple[State, ...] = ("queued", "running")
ALL_JOBS = 1 << 31


def remove_database(service: Service, database_id: str) -> None:
    """Remove a database; what was published of it stays in the registry."""
    database = service.library.database(checked(database_id, DATABASE_ID, "database"))
    for state in ACTIVE:
        for job in service.jobs.all(state=state, most=ALL_JOBS):
            if job.key.startswith(database_id) or database_id in str(job.request):
                raise Problem(
                    409,
                    f"the job {job.id} ({job.title}), which is {job.state}, uses {database.title}; "
                    "cancel it, or wait until it has ended",
                )
    # It is gone in one step; then its files are.
    gone = service.paths.scratch / f"removed-{secrets.token_hex(8)}"
    service.paths.database(database_id).rename(gone)
    service.query_pool.forget(database.folder)
    shutil.rmtree(gone, ignore_errors=True)
