"""Asking for jobs: what is checked before one waits, and who may end one.

The same request gives the same job, while it waits, runs, or what it has made is there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from starcat.catalog.ingest import check_band, star_catalog
from starcat.errors import TargetMissing
from starcat.service.access import Principal, Role
from starcat.service.jobs.job import Job, Kind
from starcat.service.jobs.keys import build_key, key_of, source_digests
from starcat.service.jobs.limits import check_room
from starcat.service.jobs.transitions import add_once, cancel, retry
from starcat.service.problems import Problem
from starcat.service.service import Service
from starcat.specs.build_spec import BuildSpec
from starcat.specs.reading import spec_from_dict

Format = Literal["parquet", "hats"]


@dataclass(frozen=True)
class Submitted:
    """What became of a request for a job.

    Attributes
    ----------
    job : Job
        The job that does it.
    is_new : bool
        Whether it was not there before.
    """

    job: Job
    is_new: bool


def submit_build(service: Service, spec: BuildSpec, owner: str) -> Submitted:
    """Have a database built.

    Parameters
    ----------
    service : Service
        Whose workers do it.
    spec : BuildSpec
        Checked.
    owner : str
        Who asks.

    Returns
    -------
    Submitted
        The job; its result names the database.

    Raises
    ------
    SourceMissing
        If the files of a source are not here.
    Problem
        If there is no room for it, or too many jobs of the owner wait.
    """
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
    """Have a catalog read.

    Parameters
    ----------
    service : Service
        Whose workers do it.
    source : str
        A star catalog of ``data_sources``.
    owner : str
        Who asks.
    band : str, optional
        Band of the magnitudes; the catalog's first by default.
    epoch_jyear : float, optional
        Julian year to move positions to; by default every star stays at its own epoch.
    read_limit_mag : float, optional
        Fainter records are counted and left out.
    to : {"parquet", "hats"}
        A star table in one file, or a store of any size.

    Returns
    -------
    Submitted
        The job; its result names what lies among the catalogs.

    Raises
    ------
    ConfigError
        If there is no such catalog or band.
    SourceMissing
        If the files of the source are not here.
    Problem
        If there is no room for it, or too many jobs of the owner wait.
    """
    request = {
        "source": source,
        "band": check_band(star_catalog(source), band),
        "epoch_jyear": epoch_jyear,
        "read_limit_mag": read_limit_mag,
        "to": to,
    }
    inputs = {source: source_digests(service.records, source)}
    key = key_of("ingest", {**request, "inputs": inputs})
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
    """Have it measured how often frames are identified with a database.

    Parameters
    ----------
    service : Service
        Whose workers do it.
    database_id : str
        The database.
    owner : str
        Who asks.
    frames : int, default 500
        Frames of each kind.
    noise_px, noise_mag : float, optional
        Standard deviation of a centroid and of a magnitude; by default those of its spec.
    seed : int, optional
        Same seed, same frames; by default that of its spec.

    Returns
    -------
    Submitted
        The job; its result has the rates.

    Raises
    ------
    TargetMissing
        If there is no such database.
    Problem
        If there is no room for it, or too many jobs of the owner wait.
    """
    database = service.shelf.database(database_id)
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
    job_id, is_new = add_once(
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
    if is_new:
        service.queue.send(job_id)
    return Submitted(service.jobs.get(job_id), is_new)


def has_result(service: Service, job: Job) -> bool:
    """Return whether what a job has made is still there.

    Parameters
    ----------
    service : Service
        Where it would be.
    job : Job
        One that is done.

    Returns
    -------
    bool
        Whether it is.
    """
    result = job.result or {}
    if job.kind == "evaluate":
        return "rates" in result
    if job.kind == "ingest":
        name = str(result.get("catalog", ""))
        return bool(name) and (service.places.catalogs / Path(name).name).exists()
    try:
        service.shelf.database(str(result.get("database", "")))
    except TargetMissing:
        return False
    return True


def cancel_job(service: Service, job_id: str, principal: Principal) -> Job:
    """End a job.

    Parameters
    ----------
    service : Service
        Whose workers do it.
    job_id : str
        Its id.
    principal : Principal
        Who asks: its owner, or a publisher.

    Returns
    -------
    Job
        Cancelled; one that ran a moment ago may still do so.

    Raises
    ------
    TargetMissing
        If there is none.
    Problem
        With status 403, if it is another's; with 409, if it has ended otherwise.
    """
    _check_may(service.jobs.get(job_id), principal)
    cancel(service.records, job_id)
    return service.jobs.get(job_id)


def retry_job(service: Service, job_id: str, principal: Principal) -> Job:
    """Have a job that failed or was cancelled done once more.

    Parameters
    ----------
    service : Service
        Whose workers do it.
    job_id : str
        Its id.
    principal : Principal
        Who asks: its owner, or a publisher.

    Returns
    -------
    Job
        Queued.

    Raises
    ------
    TargetMissing
        If there is none.
    Problem
        With status 403, if it is another's; with 409, if it need not be done; with 429 or 507, if
        there is no room for it.
    """
    job = service.jobs.get(job_id)
    _check_may(job, principal)
    check_room(service, job.owner)
    retry(
        service.records,
        job_id,
        most_waiting=service.settings.jobs_waiting,
        has_result=lambda one: has_result(service, one),
    )
    service.queue.send(job_id)
    return service.jobs.get(job_id)


def _check_may(job: Job, principal: Principal) -> None:
    if principal.name != job.owner and principal.role < Role.PUBLISHER:
        raise Problem(
            403,
            f"job {job.id} is of {job.owner}, and {principal.name} may not change it; ask them, or "
            "somebody whose token has the role publisher",
        )
