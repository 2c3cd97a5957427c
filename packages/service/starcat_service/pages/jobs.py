"""The pages of jobs: the list, and one job with its steps, its log and its result."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import Query, Request
from fastapi.responses import RedirectResponse, Response

from starcat.pipeline.simulation import rates_of
from starcat.progress import BYTE_STAGES
from starcat.results import to_dict
from starcat_service.access import Builder, Reader
from starcat_service.jobs.job import Event, Job, State
from starcat_service.jobs.submission import cancel_job, may_change, retry_job
from starcat_service.pages.draft import draft_of_content, without_defaults
from starcat_service.pages.rendering import count_text, page_router, render, size_text
from starcat_service.service import TheService

JOBS_A_PAGE = 50
LINES = 500  # most lines of the log on a page; the address of the log has all
STATES: tuple[State, ...] = ("queued", "running", "done", "failed", "cancelled")

_BUILD_STEPS = (
    ("Read the catalogs", ("read", "rows", "check", "motions")),
    ("Make the products", ("product",)),
    ("Identify simulated frames", ("self-test",)),
    ("Write the report", ("report",)),
    ("Check every file", ("verify",)),
)

STEPS = {
    "build": _BUILD_STEPS,
    "photographs": _BUILD_STEPS,
    "ingest": (
        ("Read the catalog", ("read", "rows")),
        ("Write the stars", ("store", "margins", "write")),
    ),
    "evaluate": (
        ("Identify simulated frames", ("self-test", "build")),
        ("Curves against noise, false and missing stars", ("curves",)),
    ),
}
"""The steps that pages show of each kind of job: a name, and first words of stages."""

router = page_router()


@router.get("/jobs")
def jobs_page(
    request: Request,
    service: TheService,
    _: Reader,
    state: State | None = None,
    page: Annotated[int, Query(ge=1, le=10**6)] = 1,
    q: Annotated[str, Query(max_length=100)] = "",
) -> Response:
    """List the jobs, the newest first."""
    total = service.jobs.count(state=state, text=q)
    jobs = service.jobs.all(state=state, text=q, most=JOBS_A_PAGE, skip=(page - 1) * JOBS_A_PAGE)
    return render(
        request,
        "jobs.html",
        jobs=jobs,
        counts={name: service.jobs.count(state=name, text=q) for name in STATES},
        q=q,
        total=total,
        state=state,
        page=page,
        pages=max(1, math.ceil(total / JOBS_A_PAGE)),
        took=took_s,
        progress=progress_text,
    )


@router.get("/jobs/{job_id}")
def job_page(request: Request, service: TheService, who: Reader, job_id: str) -> Response:
    """Show a job."""
    job = service.jobs.get(job_id)
    events = service.jobs.events(job_id)
    spec = job.request.get("spec") if job.kind == "build" else None
    return render(
        request,
        "job.html",
        job=job,
        steps=steps_of(job, events),
        log=[event for event in events if event.kind == "log"][-LINES:],
        last=events[-1].number if events else 0,
        spec=None if spec is None else draft_of_content(without_defaults(spec)).text,
        facts=job_facts(job),
        took=took_s(job),
        progress=progress_text(job),
        may_change=may_change(job, who),
        **evaluation_of(job),
    )


def evaluation_of(job: Job | None) -> dict[str, Any]:
    """Return the rates of an evaluation that pages show, and its curves if they are drawn."""
    result = (job and job.result) or {}
    return {
        # A job of an older version has recorded no share of all pointings.
        "rates": [to_dict(rates_of(rates)) for rates in result.get("rates", ())],
        "charts": charts_of(result),
        "chart": (CHART_WIDTH, CHART_HEIGHT),
    }


@router.post("/jobs/{job_id}/cancel")
def cancel(service: TheService, who: Builder, job_id: str) -> Response:
    """End a job, and show it."""
    cancel_job(service, job_id, who)
    return RedirectResponse(f"/jobs/{job_id}", 303)


@router.post("/jobs/{job_id}/retry")
def retry(service: TheService, who: Builder, job_id: str) -> Response:
    """Run a job again, and show it."""
    retry_job(service, job_id, who)
    return RedirectResponse(f"/jobs/{job_id}", 303)


def took_s(job: Job) -> float | None:
    """Return for how long a job has been running, seconds; None before it began."""
    if job.started_s is None:
        return None
    return max(0.0, (job.ended_s or time.time()) - job.started_s)


def progress_text(job: Job) -> str:
    """Return the progress of a job within its stage, such as ``self-test: 120 of 400``."""
    if job.stage is None:
        return ""
    if job.total is None or job.done is None:
        return job.stage
    is_bytes = job.stage.split()[0] in BYTE_STAGES
    shown = size_text if is_bytes else count_text
    return f"{job.stage}: {shown(job.done)} of {shown(job.total)}"


def job_facts(job: Job) -> list[tuple[str, str]]:
    """Return further facts of a job, besides the spec of a build."""
    facts = {**job.request, **(job.result or {})}
    return [
        (name.replace("_", " "), str(value))
        for name, value in facts.items()
        if value is not None and name not in ("spec", "rates", "curves")
    ]


CHART_WIDTH, CHART_HEIGHT = 300.0, 150.0
"""Of the area of a curve; its labels are outside of it."""


@dataclass(frozen=True)
class Mark:
    """A point of a drawn curve and its position."""

    x: float
    y: float
    low_y: float  # ends of the interval
    high_y: float
    value: float  # value of the quantity
    point: Mapping[str, Any]  # the share


@dataclass(frozen=True)
class Chart:
    """A drawn curve, up to 100 %."""

    label: str
    conditions: str  # values of the other quantities; empty if they are the usual ones
    marks: list[Mark]
    ticks: list[tuple[float, float]]  # percent, and its position

    @property
    def line(self) -> str:
        """Points of the line."""
        return " ".join(f"{mark.x:.1f},{mark.y:.1f}" for mark in self.marks)


def charts_of(result: Mapping[str, Any]) -> list[Chart]:
    """Return the curves of an evaluation, with one axis for all."""
    curves = result.get("curves", ())
    lows = [point["low_percent"] or 0.0 for curve in curves for point in curve["points"]]
    least = min(lows, default=0.0)
    base = 10.0 * (least // 10.0) if least >= 50.0 else 0.0
    return [_chart(curve, min(base, 90.0)) for curve in curves]


def _chart(curve: Mapping[str, Any], base: float) -> Chart:
    points = curve["points"]
    most = max(point["x"] for point in points) or 1.0

    def y(percent: float | None) -> float:
        return CHART_HEIGHT * (100.0 - (percent or 0.0)) / (100.0 - base)

    marks = [
        Mark(
            CHART_WIDTH * point["x"] / most,
            y(point["percent"]),
            y(point["low_percent"]),
            y(point["high_percent"]),
            point["x"],
            point,
        )
        for point in points
    ]
    ticks = [(percent, y(percent)) for percent in (base, (base + 100.0) / 2.0, 100.0)]
    return Chart(curve["label"], curve["held"], marks, ticks)


def steps_of(job: Job, events: Sequence[Event]) -> list[dict[str, str]]:
    """Return the steps of a job: name, first words of its stages, and progress."""
    begun = max(
        (event.number for event in events if event.data.get("state") == "running"), default=0
    )
    seen = {
        str(event.data["stage"]).split()[0]
        for event in events
        if event.kind == "stage" and event.number > begun
    }
    steps = STEPS[job.kind]
    reached = max((k for k, (_, words) in enumerate(steps) if seen & set(words)), default=-1)
    if job.state == "running":
        reached = max(reached, 0)
    shown_steps = []
    for k, (name, words) in enumerate(steps):
        state = "done" if job.state == "done" or k < reached else "open"
        if k == reached and job.state != "done":
            state = "current" if job.state == "running" else "failed"
        state = "open" if job.state == "queued" else state
        shown_steps.append({"name": name, "words": " ".join(words), "state": state})
    return shown_steps
