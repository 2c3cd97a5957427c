"""Routes of TAP's asynchronous queries, with jobs as defined by UWS 1.1."""

from __future__ import annotations

import asyncio
import math
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import FileResponse, PlainTextResponse, RedirectResponse, Response

from starcat.errors import ConfigError, TargetMissing, quoted
from starcat.ship.exchange import TAP_FORMATS
from starcat_service.access import Reader
from starcat_service.problems import Problem
from starcat_service.protocols.documents import MEDIA_TYPE, VOTABLE_TYPE, error_votable
from starcat_service.protocols.uws import (
    ACTIVE,
    JobFacts,
    iso_time,
    job_document,
    jobs_document,
    parameters_document,
    results_document,
)
from starcat_service.sandbox.limiter import asker
from starcat_service.service import Service, TheService
from starcat_service.vo.tap import FORM, PREFIX, TapRequest, TheRequest, VOTableRoute, base_url
from starcat_service.vo.tap_jobs import RESULT

router = APIRouter(prefix=f"{PREFIX}/async", tags=["TAP"], route_class=VOTableRoute)

MAX_WAIT_S = 60.0
"""Longest time that a request can wait for a change of phase."""

LOOK_S = 0.1

PHASES = (*ACTIVE, "COMPLETED", "ERROR", "ABORTED", "UNKNOWN", "HELD", "SUSPENDED", "ARCHIVED")


def own_job(job_id: str, service: TheService, who: Reader) -> JobFacts:
    """Return the job of a request; it must belong to the sender of the request."""
    return service.query_jobs.job(job_id, who.name, asker.get())


TheJob = Annotated[JobFacts, Depends(own_job)]


@router.get("", summary="Own jobs (UWS)")
def list_tap_jobs(
    request: Request,
    service: TheService,
    who: Reader,
    phases: Annotated[list[str] | None, Query(alias="PHASE")] = None,
    after: Annotated[str | None, Query(alias="AFTER")] = None,
    last: Annotated[int | None, Query(alias="LAST", ge=1)] = None,
) -> Response:
    """Return jobs, the newest first; without a phase, all jobs that are not archived."""
    for phase in phases or ():
        if phase not in PHASES:
            raise ConfigError(
                f"PHASE is {quoted(phase)}; expected one of {', '.join(PHASES)}", key="PHASE"
            )
    since = None if after is None else _seconds("AFTER", after)
    jobs = [
        job
        for job in service.query_jobs.jobs(who.name, asker.get())
        if (not phases or job.phase in phases) and (since is None or job.created_s > since)
    ]
    return _xml(jobs_document(jobs[:last], f"{base_url(request)}/async"))


@router.post("", summary="Make a job (UWS)", openapi_extra=FORM)
def make_job(
    tap_request: TheRequest, request: Request, service: TheService, who: Reader
) -> Response:
    """Create a job from the parameters of TAP; with PHASE=RUN it is run."""
    phase = tap_request.parameters.value("PHASE")
    if phase not in (None, "RUN"):
        raise ConfigError(f"PHASE is {quoted(phase or '')}; a new job takes RUN only", key="PHASE")
    kept = [(name, value) for name, value in tap_request.parameters.items() if name != "PHASE"]
    job = service.query_jobs.create(who.name)
    try:
        files = _kept_files(tap_request, service, job)
    except Problem:
        service.query_jobs.delete(job.job_id)
        raise
    service.query_jobs.set_parameters(job.job_id, kept, files)
    if phase == "RUN":
        service.query_jobs.run(job.job_id)
    return _see(request, job)


@router.get("/{job_id}", summary="A job (UWS)")
async def get_job(
    job: TheJob,
    request: Request,
    service: TheService,
    wait: Annotated[int | None, Query(alias="WAIT", ge=-1)] = None,
    phase: Annotated[str | None, Query(alias="PHASE")] = None,
) -> Response:
    """Return all facts of a job; with WAIT after its phase has changed."""
    if wait is not None and phase in (None, job.phase):
        most_s = MAX_WAIT_S if wait < 0 else min(wait, MAX_WAIT_S)
        job = await _changed(service, job, most_s)
    return _xml(job_document(job, _address(request, job)))


@router.post("/{job_id}", summary="Delete a job, or set parameters (UWS)")
def change_job(
    tap_request: TheRequest, job: TheJob, request: Request, service: TheService
) -> Response:
    """Delete a job with ACTION=DELETE."""
    action = tap_request.parameters.value("ACTION")
    if action is not None:
        if action.upper() != "DELETE":
            raise ConfigError(f"ACTION is {quoted(action)}; it may be DELETE", key="ACTION")
        return _deleted(request, service, job)
    if tap_request.parameters.value("PHASE") is not None:
        return set_phase(tap_request, job, request, service)
    return set_parameters(tap_request, job, request, service)


@router.delete("/{job_id}", summary="Delete a job (UWS)")
def delete_job(job: TheJob, request: Request, service: TheService) -> Response:
    """Delete a job and its answer; a running query is ended."""
    return _deleted(request, service, job)


@router.get("/{job_id}/phase", summary="Phase of a job (UWS)")
def get_phase(job: TheJob) -> Response:
    """Return the phase."""
    return PlainTextResponse(job.phase)


@router.post("/{job_id}/phase", summary="Run or abort a job (UWS)")
def set_phase(
    tap_request: TheRequest, job: TheJob, request: Request, service: TheService
) -> Response:
    """Run a job that is pending, or abort one that has not ended."""
    phase = tap_request.parameters.value("PHASE")
    if phase == "RUN":
        service.query_jobs.run(job.job_id)
    elif phase == "ABORT":
        service.query_jobs.abort(job.job_id)
    else:
        raise ConfigError(f"PHASE is {quoted(phase or '')}; it may be RUN or ABORT", key="PHASE")
    return _see(request, job)


@router.get("/{job_id}/executionduration", summary="Seconds that a job may run (UWS)")
def get_limit(job: TheJob) -> Response:
    """Return seconds."""
    return PlainTextResponse(str(int(job.limit_s)))


@router.post("/{job_id}/executionduration", summary="Set how long a job may run (UWS)")
def set_limit(
    tap_request: TheRequest, job: TheJob, request: Request, service: TheService
) -> Response:
    """Set the time limit in seconds, at most the limit of the service; 0 for that limit."""
    text = tap_request.parameters.value("EXECUTIONDURATION") or ""
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0 <= seconds < math.inf:
        raise ConfigError(
            f"EXECUTIONDURATION is {quoted(text)}; it is seconds", key="EXECUTIONDURATION"
        )
    service.query_jobs.set_limit(job.job_id, seconds)
    return _see(request, job)


@router.get("/{job_id}/destruction", summary="When a job goes (UWS)")
def get_destruction(job: TheJob) -> Response:
    """Return a time, UTC."""
    return PlainTextResponse(iso_time(job.destroyed_s))


@router.post("/{job_id}/destruction", summary="Set when a job goes (UWS)")
def set_destruction(
    tap_request: TheRequest, job: TheJob, request: Request, service: TheService
) -> Response:
    """Set the time of deletion, at most as late as the service allows."""
    text = tap_request.parameters.value("DESTRUCTION") or ""
    service.query_jobs.set_destruction(job.job_id, _seconds("DESTRUCTION", text))
    return _see(request, job)


@router.get("/{job_id}/quote", summary="When a job will be at its end (UWS)")
def get_quote(job: TheJob) -> Response:
    """Return nothing: the expected time is unknown."""
    return PlainTextResponse("")


@router.get("/{job_id}/owner", summary="Owner of a job (UWS)")
def get_owner(job: TheJob) -> Response:
    """Return the name of the token, or anonymous."""
    return PlainTextResponse(job.owner)


@router.get("/{job_id}/parameters", summary="Parameters of a job (UWS)")
def get_parameters(job: TheJob) -> Response:
    """Return the parameters as the client sent them."""
    return _xml(parameters_document(job))


@router.post("/{job_id}/parameters", summary="Set parameters of a job (UWS)")
def set_parameters(
    tap_request: TheRequest, job: TheJob, request: Request, service: TheService
) -> Response:
    """Set parameters of a job that is pending."""
    if job.phase != "PENDING":
        raise ConfigError(f"the job is {job.phase}; parameters are set before it is run")
    files = _kept_files(tap_request, service, job)
    service.query_jobs.set_parameters(job.job_id, tap_request.parameters.items(), files)
    return _see(request, job)


@router.get("/{job_id}/results", summary="Addresses of the answer (UWS)")
def get_results(job: TheJob, request: Request) -> Response:
    """Return the addresses of results."""
    return _xml(results_document(job, _address(request, job)))


@router.get("/{job_id}/results/result", summary="The answer of a job (TAP)")
def get_result(job: TheJob, service: TheService) -> Response:
    """Return the answer in the requested format."""
    path = service.query_jobs.folder(job.job_id) / RESULT
    if job.phase == "ERROR":  # some clients look here for the reason, not at the error
        raise TargetMissing(f"the job has no answer: {job.error}")
    if job.phase != "COMPLETED" or not path.is_file():
        raise TargetMissing(
            f"the job is {job.phase} and has no answer until its phase is COMPLETED"
        )
    suffix = next(
        (tap_format.suffix for tap_format in TAP_FORMATS if tap_format.tap_type == job.media_type),
        ".vot",
    )
    return FileResponse(
        path,
        media_type=job.media_type,
        filename=f"result{suffix}",
        content_disposition_type="inline",
    )


@router.get("/{job_id}/error", summary="Why a job has no answer (TAP)")
def get_error(job: TheJob) -> Response:
    """Return the error as a VOTable."""
    if job.phase != "ERROR":
        raise TargetMissing(f"the job is {job.phase} and has no error")
    return Response(error_votable(job.error), media_type=VOTABLE_TYPE)


def _kept_files(tap_request: TapRequest, service: Service, job: JobFacts) -> dict[str, Path]:
    """Copy the files of a request into the folder of a job, within the quota of its user."""
    if tap_request.uploads:
        service.query_jobs.make_room(job.job_id, 0, tap_request.upload_bytes)
    return tap_request.keep(service.query_jobs.folder(job.job_id), service.settings)


async def _changed(service: Service, job: JobFacts, most_s: float) -> JobFacts:
    """Return a job when its phase has changed, or after some time."""
    ends = time.monotonic() + most_s
    current = job
    while current.phase == job.phase and job.phase in ACTIVE and time.monotonic() < ends:
        await asyncio.sleep(LOOK_S)
        current = service.query_jobs.job(job.job_id)
    return current


def _deleted(request: Request, service: Service, job: JobFacts) -> Response:
    service.query_jobs.abort(job.job_id)
    service.query_jobs.delete(job.job_id)
    return RedirectResponse(f"{base_url(request)}/async", 303)


def _see(request: Request, job: JobFacts) -> Response:
    return RedirectResponse(_address(request, job), 303)


def _address(request: Request, job: JobFacts) -> str:
    return f"{base_url(request)}/async/{job.job_id}"


def _xml(content: bytes) -> Response:
    return Response(content, media_type=MEDIA_TYPE)


def _seconds(name: str, text: str) -> float:
    """Return the time of a request's parameter, in seconds since 1970."""
    try:
        moment = datetime.fromisoformat(text.strip())
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        raise ConfigError(
            f"{name} is {quoted(text)}; it is a time such as 2026-01-31T12:00:00Z", key=name
        ) from None
