"""Submitting and cancelling jobs: what is checked first, and what they may take of the disk.

The same request gives the same job while it waits, runs, or its result exists.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from starcat.catalog.ingest import ingest_options
from starcat.errors import ProductError, TargetMissing
from starcat.service.access import Principal, Role
from starcat.service.jobs.job import Job, Kind
from starcat.service.jobs.job_states import add_once, cancel, retry
from starcat.service.jobs.keys import build_key, ingest_key, key_of
from starcat.service.problems import Problem
from starcat.service.service import Service
from starcat.specs.build_spec import BuildSpec
from starcat.specs.reading import spec_from_dict

if TYPE_CHECKING:
    from starcat.service.service import Service

GIB = 2**30


def check_room(service: Service, owner: str) -> None:
    """Check that there is room for what a user wants to have made."""
    short = disk_shortage(service)
    if short is not None:
        raise Problem(507, short)
    full = owner_excess(service, owner)
    if full is not None:
        raise Problem(409, full)


def disk_shortage(service: Service) -> str | None:
    """Return what to say where the disk is nearly full."""
    free_gib = shutil.disk_usage(service.paths.root).free / GIB
    if free_gib >= service.settings.free_gib:
        return None
    return (
        f"the disk of the service has {free_gib:.2f} GiB free, and {service.settings.free_gib:g} "
        "have to be left (free_gib); remove unused databases, or ask the operator"
    )


def owner_excess(service: Service, owner: str, more_bytes: int = 0) -> str | None:
    """Return what to say where a user's databases take more of the disk than they may."""
    taken_gib = (owned_bytes(service, owner) + more_bytes) / GIB
    if taken_gib < service.settings.disk_gib:
        return None
    return (
        f"the databases of {owner} take {taken_gib:.2f} GiB, and {service.settings.disk_gib:g} "
        "are allowed (disk_gib); remove unused ones, or ask the operator"
    )


def owned_bytes(service: Service, owner: str) -> int:
    """Return how much of the disk the databases of a user take."""
    with service.records.reading() as connection:
        rows = connection.execute(
            "SELECT DISTINCT json_extract(result, '$.database') FROM jobs "
            "WHERE owner = ? AND kind = 'build' AND state = 'done'",
            (owner,),
        ).fetchall()
    taken = 0
    for [database_id] in rows:
        try:
            files = service.library.database(str(database_id)).manifest["files"]
        except (TargetMissing, ProductError, OSError):
            continue
        taken += sum(int(facts["bytes"]) for facts in files.values())
    return taken


def folder_bytes(folder: Path) -> int:
    """Return how much of the disk a folder takes, with all below it."""
    taken = 0
    for path in folder.rglob("*"):
        try:
            taken += 512 * path.lstat().st_blocks
        except OSError:  # removed meanwhile
            continue
    return taken


Format = Literal["parquet", "hats"]


@dataclass(frozen=True)
class Submitted:
    """What became of a request for a job: the job that does it, perhaps one that there was."""

    job: Job
    is_new: bool


def submit_build(service: Service, spec: BuildSpec, owner: str) -> Submitted:
    """Have a database built."""
    key = build_key(service.records, spec)
    title = f"{spec.name} {spec.version}"
    return _submit(service, "build", {"spec": spec.recorded()}, key, title, owner)


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
    return _submit(service, "ingest", request, key, f"{source} ({to})", owner)


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
    """Have it measured how often frames are identified with a database."""
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
    return _submit(service, "evaluate", request, key, f"{database.title} self-test", owner)


def _submit(
    service: Service, kind: Kind, request: Mapping[str, Any], key: str, title: str, owner: str
) -> Submitted:
    job, is_new = add_once(
        service.records,
        kind,
        request,
        key=key,
        title=title,
        owner=owner,
        most_waiting=service.settings.jobs_waiting,
        has_result=lambda job: has_result(service, job),
        check=lambda: check_room(service, owner),
    )
    service.wake_slots()
    return Submitted(job, is_new)


def has_result(service: Service, job: Job) -> bool:
    """Return whether what a job has made is still there."""
    result = job.result or {}
    if job.kind == "evaluate":
        return "rates" in result
    if job.kind == "ingest":
        name = str(result.get("catalog", ""))
        return bool(name) and (service.paths.catalogs / Path(name).name).exists()
    try:
        service.library.database(str(result.get("database", "")))
    except TargetMissing:
        return False
    return True


def cancel_job(service: Service, job_id: str, principal: Principal) -> Job:
    """End a job."""
    _check_may(service.jobs.get(job_id), principal)
    cancel(service.records, job_id)
    return service.jobs.get(job_id)


def retry_job(service: Service, job_id: str, principal: Principal) -> Job:
    """Have a job that failed or was cancelled done once more."""
    job = service.jobs.get(job_id)
    _check_may(job, principal)
    check_room(service, job.owner)
    retry(
        service.records,
        job_id,
        most_waiting=service.settings.jobs_waiting,
        has_result=lambda one: has_result(service, one),
    )
    service.wake_slots()
    return service.jobs.get(job_id)


def may_change(job: Job, principal: Principal) -> bool:
    """Return whether somebody may end a job, or have it done again."""
    needed = Role.BUILDER if principal.name == job.owner else Role.PUBLISHER
    return principal.role >= needed


def _check_may(job: Job, principal: Principal) -> None:
    if not may_change(job, principal):
        raise Problem(
            403,
            f"job {job.id} is of {job.owner}, and {principal.name} may not change it; ask them, or "
            "somebody whose token has the role publisher",
        )
