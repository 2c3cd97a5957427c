"""Removal: of databases by users, and of old jobs, results, uploads and sessions.

The signatures of the registry expire too and are renewed at the same times.

Databases and releases stay until a user removes them. Files that no rule in this module covers
stay too.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import shutil
import time
from pathlib import Path

from starcat.errors import TargetMissing
from starcat.query import SCRATCH_PREFIX
from starcat_service.access import ANONYMOUS, Principal
from starcat_service.jobs.job import ENDED, QUERY, State
from starcat_service.paths import DATABASE_ID, checked
from starcat_service.problems import Problem
from starcat_service.security.tokens import DAY_S, SessionStore
from starcat_service.service import Service
from starcat_service.settings import Role

ACTIVE: tuple[State, ...] = ("queued", "running")
ALL_JOBS = 1 << 31

EVERY_S = 3600.0
SCRATCH_DAYS = 1.0

_logger = logging.getLogger(__name__)


def may_remove(service: Service, database_id: str, principal: Principal) -> bool:
    """Return whether a user may remove a database: users without a token have none of their own."""
    is_own = principal.name != ANONYMOUS and service.quota.owns(principal.name, database_id)
    return principal.role >= (Role.BUILDER if is_own else Role.PUBLISHER)


def remove_database(service: Service, database_id: str, principal: Principal) -> None:
    """Remove a database; releases of it stay in the registry."""
    database = service.library.database(checked(database_id, DATABASE_ID, "database"))
    if not may_remove(service, database_id, principal):
        raise Problem(
            403,
            f"{database.title} was not built for {principal.name}; ask its owner, or a user whose "
            "token has the role publisher",
        )
    for state in ACTIVE:
        for job in service.jobs.all(state=state, most=ALL_JOBS):
            if job.key.startswith(database_id) or database_id in str(job.request):
                raise Problem(
                    409,
                    f"the job {job.id} ({job.title}), which is {job.state}, uses {database.title}; "
                    "cancel it, or wait until it has ended",
                )
    _remove(service, service.paths.database(database_id), database.folder)


def remove_catalog(service: Service, name: str) -> None:
    """Remove a star table that a job has read."""
    if name not in service.library.catalogs():
        raise TargetMissing(
            f"no catalog {name[:80]!r} is stored", hint="/api/v1/catalogs lists them"
        )
    path = service.paths.catalogs / name
    _remove(service, path, path)


def _remove(service: Service, path: Path, target: Path) -> None:
    """Remove a file or folder in one step; then close its queries, and delete it."""
    gone = service.paths.scratch / f"removed-{secrets.token_hex(8)}"
    path.rename(gone)
    service.query_pool.forget(target)
    if gone.is_dir():
        shutil.rmtree(gone, ignore_errors=True)
    else:
        gone.unlink(missing_ok=True)


def remove_old(service: Service, now_s: float) -> dict[str, int]:
    """Remove everything older than the settings allow; return the number removed of each kind."""
    settings, paths = service.settings, service.paths
    removed = {
        "jobs": _remove_jobs(service, now_s - settings.keep_jobs_days * DAY_S),
        "results": _remove_entries(paths.results, now_s - settings.keep_results_days * DAY_S),
        "scratch": _remove_entries(paths.scratch, now_s - SCRATCH_DAYS * DAY_S),
        "sessions": SessionStore(service.records, settings.session_hours).forget_expired(),
    }
    if any(removed.values()):
        _logger.info("removed what is old", extra={"facts": {"removed": removed}})
    return removed


async def keep_removing(service: Service) -> None:
    """Remove old files now and every hour, until it is cancelled."""
    while True:
        try:
            await asyncio.to_thread(remove_old, service, time.time())
        except Exception:
            _logger.exception("old files could not be removed")
        try:
            await asyncio.to_thread(_renew_signatures, service)
        except Exception:
            _logger.exception("the signatures of the registry could not be renewed")
        await asyncio.sleep(EVERY_S)


def _renew_signatures(service: Service) -> None:
    """Renew the signatures of the registry before they expire."""
    key = service.settings.signing_key
    if key is not None:
        from starcat.ship.releases import renew_if_old, signing_with

        if renew_if_old(service.paths.registry, signing_with([key])):
            _logger.info("renewed the signatures of the registry")


def _remove_jobs(service: Service, before_s: float) -> int:
    marks = ", ".join("?" for _ in ENDED)
    # An evaluation is kept as long as its database.
    kept = [database.id for database in service.library.databases()]
    with service.records.writing() as connection:
        rows = connection.execute(
            f"DELETE FROM jobs WHERE state IN ({marks}) AND ended_s < ? AND kind != ? AND NOT ("
            "kind = 'evaluate' AND state = 'done' AND json_extract(request, '$.database') IN "
            f"({', '.join('?' for _ in kept)})) RETURNING id",
            (*ENDED, before_s, QUERY, *kept),
        ).fetchall()
    for row in rows:
        shutil.rmtree(service.paths.job(row["id"]), ignore_errors=True)
    return len(rows)


def _remove_entries(folder: Path, before_s: float) -> int:
    removed = 0
    for path in folder.iterdir():
        # An open query session needs its folder as long as it lives.
        if path.lstat().st_mtime >= before_s or path.name.startswith(SCRATCH_PREFIX):
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
        removed += 1
    return removed
