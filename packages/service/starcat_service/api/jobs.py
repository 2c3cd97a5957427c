"""Jobs in the REST interface: requesting, watching and ending them."""

from __future__ import annotations

import re
from collections.abc import AsyncIterator
from datetime import UTC, datetime
from functools import partial
from typing import Annotated, Any, Literal

import anyio
from anyio import to_thread
from fastapi import APIRouter, Body, Depends, Header, Query, Response
from fastapi import Path as InPath
from fastapi.responses import PlainTextResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import BaseModel, ConfigDict, Field

from starcat.errors import ConfigError
from starcat.pipeline.specs import BuildSpec
from starcat.sections import SOURCE_NAME
from starcat_service.access import Builder, Reader
from starcat_service.api.specs import GivenSpec
from starcat_service.jobs.job import Event, Job, Kind, State
from starcat_service.jobs.submission import (
    Submitted,
    cancel_job,
    retry_job,
    submit_build,
    submit_evaluation,
    submit_ingest,
)
from starcat_service.sandbox.limiter import WAIT_S
from starcat_service.service import Service, TheService

router = APIRouter(prefix="/jobs", tags=["jobs"])

LOOK_S = 0.25
"""Seconds between checks for news of a job that a client watches."""

NUMBER = re.compile("[0-9]{1,15}")

JobId = Annotated[
    str,
    InPath(
        description="Id of a job: thirty-two hexadecimal digits.",
        examples=["0123456789abcdef0123456789abcdef"],
    ),
]
Text = Annotated[str, Field(max_length=2000)]


class Wish(BaseModel):
    """Fields that all requests for jobs share."""

    model_config = ConfigDict(extra="forbid")


class BuildWish(Wish):
    """A database to build: a spec or a preset, and changes to it."""

    kind: Literal["build"]
    spec: Annotated[str, Field(max_length=200_000)] | dict[str, Any] | None = Field(
        None, description="A build spec: the text of its TOML file, or the same keys as JSON."
    )
    preset: Annotated[str, Field(max_length=100)] | None = Field(
        None, description="Name of a spec that ships with starcat, instead."
    )
    changes: dict[Text, Text] = Field(
        default_factory=dict,
        max_length=200,
        description="With a preset: values that replace its own, by dotted key, in TOML; an empty "
        "text removes the key.",
    )


class IngestWish(Wish):
    """A catalog to be read."""

    kind: Literal["ingest"]
    source: str = Field(
        pattern=SOURCE_NAME, description="A star catalog, as 'starcat sources' lists."
    )
    band: str | None = Field(None, max_length=20, description="Band of the magnitudes.")
    epoch_jyear: float | None = Field(
        None, ge=1800, le=2200, description="Julian year to move positions to; else its own."
    )
    read_limit_mag: float | None = Field(
        None, ge=-30, le=40, description="Fainter records are counted and left out."
    )
    to: Literal["parquet", "hats"] = Field(
        "parquet", description="One file, or a store of any size, written by Dask."
    )


class EvaluateWish(Wish):
    """A request to measure the rates of a database with simulated frames."""

    kind: Literal["evaluate"]
    database: str = Field(max_length=100, description="Id of the database.")
    frames: int = Field(500, ge=1, le=20_000, description="Frames of each kind.")
    noise_px: float | None = Field(
        None, ge=0, le=50, description="Noise of a centroid, each axis; by default as in its spec."
    )
    noise_mag: float | None = Field(
        None, ge=0, le=10, description="Noise of a magnitude; by default as in its spec."
    )
    seed: int | None = Field(
        None, ge=0, le=2**63 - 1, description="Same seed, same frames; by default as in its spec."
    )


AnyWish = Annotated[BuildWish | IngestWish | EvaluateWish, Field(discriminator="kind")]

EXAMPLES: dict[str, Any] = {
    "preset": {
        "summary": "A preset with another camera",
        "value": {
            "kind": "build",
            "preset": "gaia-12deg",
            "changes": {"name": '"wide"', "camera.fov_x_deg": "16"},
        },
    },
    "toml": {
        "summary": "A spec as TOML",
        "value": {
            "kind": "build",
            "spec": 'name = "small"\nversion = "1.0.0"\nepoch_jyear = 2026.0\n'
            'catalog.source = "gaia"\nselection.faint_limit_mag = 5.0\n'
            "camera = { width_px = 512, height_px = 512, fov_x_deg = 30.0 }\n",
        },
    },
    "ingest": {
        "summary": "A catalog as one file",
        "value": {"kind": "ingest", "source": "gaia", "epoch_jyear": 2026.0},
    },
    "evaluate": {
        "summary": "Rates of a database",
        "value": {"kind": "evaluate", "database": "0123456789abcdef", "frames": 200},
    },
}


class JobPage(BaseModel):
    """A part of the list of jobs, the newest first."""

    jobs: list[Job] = Field(description="The jobs.")
    total: int = Field(description="Total number of jobs that match.")


@router.post(
    "",
    status_code=201,
    responses={
        200: {"model": Job, "description": "A job was there that does the same."},
        507: {"description": "The disk of the service is nearly full."},
    },
    summary="Request a job",
)
async def submit_job(
    wish: Annotated[AnyWish, Body(openapi_examples=EXAMPLES)],
    response: Response,
    service: TheService,
    principal: Builder,
) -> Job:
    """Request a build, a catalog to be read, or rates to be measured.

    The same request returns the same job while it waits or runs, or while its result exists.
    """
    # The first request for a catalog reads its files for the key.
    submitted = await service.designs.run(
        WAIT_S, partial(_submitted, service, wish, principal.name)
    )
    response.status_code = 201 if submitted.is_new else 200
    response.headers["Location"] = f"/api/v1/jobs/{submitted.job.id}"
    return submitted.job


def _submitted(service: Service, wish: AnyWish, owner: str) -> Submitted:
    if isinstance(wish, BuildWish):
        return submit_build(service, _spec_of(wish), owner)
    if isinstance(wish, IngestWish):
        how = wish.model_dump(exclude={"kind", "source"})
        return submit_ingest(service, wish.source, owner, **how)
    how = wish.model_dump(exclude={"kind", "database"})
    return submit_evaluation(service, wish.database, owner, **how)


def _spec_of(wish: BuildWish) -> BuildSpec:
    if (wish.spec is None) == (wish.preset is None):
        raise ConfigError("say what to build: give either spec or preset", key="spec")
    if wish.preset is None and wish.changes:
        raise ConfigError("changes go with a preset", key="changes", hint="change the spec itself")
    toml, keys = (wish.spec, None) if isinstance(wish.spec, str) else (None, wish.spec)
    unchecked = GivenSpec.model_construct(
        toml=toml, spec=keys, preset=wish.preset, changes=wish.changes
    )
    return unchecked.checked()


@router.get("", summary="List jobs")
def list_jobs(
    service: TheService,
    principal: Reader,
    state: Annotated[State | None, Query(description="Only those in it.")] = None,
    kind: Annotated[Kind | None, Query(description="Only those of it.")] = None,
    owner: Annotated[str | None, Query(max_length=200, description="Only theirs.")] = None,
    database: Annotated[
        str | None, Query(max_length=64, description="Only evaluations of this database.")
    ] = None,
    text: Annotated[
        str | None, Query(max_length=100, description="Words of the title, kind, owner or id.")
    ] = None,
    limit: Annotated[int, Query(ge=1, le=1000, description="So many at most.")] = 100,
    offset: Annotated[int, Query(ge=0, le=10**9, description="Leave out so many.")] = 0,
) -> JobPage:
    """Return jobs, the newest first."""
    conditions: dict[str, Any] = {"state": state, "kind": kind, "owner": owner}
    conditions |= {"database": database, "text": text}
    jobs = service.jobs.all(**conditions, most=limit, skip=offset)
    return JobPage(jobs=jobs, total=service.jobs.count(**conditions))


@router.get("/{job_id}", summary="Look at a job")
async def show_job(job_id: JobId, service: TheService, principal: Reader) -> Job:
    """Return the current state of a job."""  # frequent, and faster than a thread
    return service.jobs.get(job_id)


After = Annotated[
    int, Query(ge=0, le=2**53, description="Only events after the event of this number.")
]


@router.get("/{job_id}/events.json", summary="What happened to a job")
def list_events(
    job_id: JobId, service: TheService, principal: Reader, after: After = 0
) -> list[Event]:
    """Return the events of a job so far."""
    service.jobs.get(job_id)
    return service.jobs.events(job_id, after)


def _known_job(job_id: JobId, service: TheService, principal: Reader) -> Job:
    """Return the job to watch, or refuse before anything is sent."""
    return service.jobs.get(job_id)


@router.get("/{job_id}/events", response_class=EventSourceResponse, summary="Watch a job")
async def watch_job(
    job: Annotated[Job, Depends(_known_job)],
    service: TheService,
    after: After = 0,
    last_event_id: Annotated[
        str | None,
        Header(description="Number of the last event that was seen, as browsers send it."),
    ] = None,
) -> AsyncIterator[ServerSentEvent]:
    """Return the events of a job as server-sent events, until the job has ended.

    The kind of an event is ``state``, ``stage`` or ``log``; its data are as in events.json, with
    ``at_s``. A client that reconnects continues after the last event that it received.
    """
    last_seen = NUMBER.fullmatch(last_event_id or "")
    seen = int(last_seen[0]) if last_seen else after
    while not service.stopping.is_set():
        has_ended, events = await to_thread.run_sync(_news, service, job.id, seen)
        for event in events:
            seen = event.number
            data = {"at_s": event.at_s, **event.data}
            yield ServerSentEvent(data=data, event=event.kind, id=str(event.number))
        if has_ended:
            return
        await anyio.sleep(LOOK_S)


def _news(service: Service, job_id: str, seen: int) -> tuple[bool, list[Event]]:
    """Return whether a job has ended, and its events after the number ``seen``."""
    has_ended = service.jobs.get(job_id).has_ended
    return has_ended, service.jobs.events(job_id, seen)


@router.get("/{job_id}/log", response_class=PlainTextResponse, summary="Log of a job")
def show_log(job_id: JobId, service: TheService, principal: Reader) -> PlainTextResponse:
    """Return the log of a job as text: one line per entry, with its time (UTC)."""
    service.jobs.get(job_id)
    lines = map(_log_line, service.jobs.events(job_id))
    return PlainTextResponse("".join(f"{line}\n" for line in lines))


def _log_line(event: Event) -> str:
    at = datetime.fromtimestamp(event.at_s, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    data = event.data
    if event.kind == "log":
        text = f"{data['level']}: {data['text']}"
    elif event.kind == "stage":
        much = "" if data["total"] is None else f" {data['done']:,} of {data['total']:,}"
        text = f"{data['stage']}{much}"
    else:
        error = data.get("error") or {}
        text = f"{data['state']}" + (f": {error['detail']}" if "detail" in error else "")
    return f"{at} {' '.join(text.splitlines())}"


@router.post("/{job_id}/cancel", summary="End a job")
def end_job(job_id: JobId, service: TheService, principal: Builder) -> Job:
    """End a job that waits or runs; its partial results are removed."""
    return cancel_job(service, job_id, principal)


@router.post(
    "/{job_id}/retry",
    responses={507: {"description": "The disk of the service is nearly full."}},
    summary="Try a job again",
)
def try_again(job_id: JobId, service: TheService, principal: Builder) -> Job:
    """Run a job again that failed or was cancelled."""
    return retry_job(service, job_id, principal)
