"""What workers on other machines ask: to begin a job, to tell of it, and to bring what it made."""

from __future__ import annotations

import secrets
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from anyio import open_file, to_thread
from fastapi import APIRouter, Request
from fastapi import Path as InPath
from pydantic import BaseModel, ConfigDict, Field

from starcat.service.access import Publisher
from starcat.service.api.jobs import JobId, JobView, view_of
from starcat.service.jobs.job_states import Attempt, claim
from starcat.service.jobs.unpacking import unpack_database
from starcat.service.jobs.work import place_database
from starcat.service.problems import Problem
from starcat.service.service import Service, TheService

router = APIRouter(prefix="/work", tags=["workers on other machines"])

AttemptNumber = Annotated[int, InPath(ge=1, le=10**6, description="Number of the attempt.")]


class Line(BaseModel):
    """A stage, or a line of the log."""

    model_config = ConfigDict(extra="forbid")

    stage: str | None = Field(None, max_length=200, description="The stage that it is in.")
    done: int = Field(0, ge=0, le=2**53, description="How much of it is done.")
    total: int | None = Field(None, ge=0, le=2**53, description="Of how much.")
    level: Literal["info", "warning", "error"] = Field("info", description="Of a line of the log.")
    text: str | None = Field(None, max_length=2000, description="A line of the log.")


class Lines(BaseModel):
    """What has happened since the last time."""

    model_config = ConfigDict(extra="forbid")

    lines: list[Line] = Field(max_length=500, description="In order.")


class Answer(BaseModel):
    """What a worker is to do."""

    wants_end: bool = Field(description="Whether the job is to end.")


class End(BaseModel):
    """How an attempt ended that has made nothing."""

    model_config = ConfigDict(extra="forbid")

    state: Literal["queued", "failed", "cancelled"] = Field(description="What becomes of the job.")
    error: dict[str, Any] = Field(default_factory=dict, description="Problem details.")


@router.post("/{job_id}/claim", summary="Begin a job")
def begin(job_id: JobId, service: TheService, principal: Publisher) -> JobView:
    """Begin a build that waits; 409 where it does not, or is no build."""
    job = service.jobs.get(job_id)
    if job.kind != "build":
        raise Problem(409, f"job {job_id} is no build; it is done on the machine of the server")
    begun = claim(service.records, job_id, is_away=True)
    if begun is None:
        raise Problem(409, f"job {job_id} does not wait; it is {job.state}")
    return view_of(begun)


def _attempt(service: Service, job_id: str, number: int) -> Attempt:
    """Return an attempt that is still this worker's, and was heard of now."""
    attempt = Attempt(service.records, replace(service.jobs.get(job_id), attempt=number))
    if not attempt.be_heard():
        raise Problem(409, f"attempt {number} of job {job_id} is over; leave it")
    return attempt


@router.post("/{job_id}/{number}/tell", summary="Tell of a job")
def tell(
    job_id: JobId, number: AttemptNumber, told: Lines, service: TheService, principal: Publisher
) -> Answer:
    """Say what has happened, and hear whether the job is to end."""
    attempt = _attempt(service, job_id, number)
    for line in told.lines:
        if line.stage is not None:
            attempt.tell_stage(line.stage, line.done, line.total)
        if line.text is not None:
            attempt.tell(line.level, line.text)
    return Answer(wants_end=attempt.wants_end())


@router.post("/{job_id}/{number}/end", summary="End an attempt")
def end(
    job_id: JobId, number: AttemptNumber, how: End, service: TheService, principal: Publisher
) -> JobView:
    """Say that an attempt has ended without a database."""
    attempt = _attempt(service, job_id, number)
    if how.state == "failed":
        attempt.fail(how.error)
    elif how.state == "cancelled":
        attempt.be_cancelled()
    else:
        attempt.wait_again()
        service.queue.send(job_id)
    return view_of(service.jobs.get(job_id))


@router.put(
    "/{job_id}/{number}/database",
    summary="Bring a database",
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {"application/x-tar": {"schema": {"type": "string", "format": "binary"}}},
        }
    },
)
async def bring(
    request: Request,
    job_id: JobId,
    number: AttemptNumber,
    service: TheService,
    principal: Publisher,
) -> JobView:
    """Take the database that a job was to make: a tar archive, checked before it has its place."""
    await to_thread.run_sync(_attempt, service, job_id, number)
    folder = service.paths.scratch / f"brought-{secrets.token_hex(8)}"
    await to_thread.run_sync(folder.mkdir)
    try:
        async with await open_file(folder / "database.tar", "xb") as file:
            async for chunk in request.stream():
                await file.write(chunk)
        return await to_thread.run_sync(_take, service, job_id, number, folder)
    finally:
        await to_thread.run_sync(lambda: shutil.rmtree(folder, ignore_errors=True))


def _take(service: Service, job_id: str, number: int, folder: Path) -> JobView:
    job = service.jobs.get(job_id)
    database_id = job.key[:16]
    unpack_database(folder / "database.tar", job, folder / database_id)
    attempt = _attempt(service, job_id, number)  # it may be over by now
    place_database(folder / database_id, service.paths.database(database_id))
    attempt.succeed({"database": database_id})
    return view_of(service.jobs.get(job_id))
