"""Health and readiness of the service, and its figures for Prometheus."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from tempfile import TemporaryFile
from typing import get_args

from fastapi import APIRouter, Request
from fastapi.responses import JSONResponse, Response
from prometheus_client import (
    CONTENT_TYPE_PLAIN_0_0_4,
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    generate_latest,
)
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from pydantic import BaseModel, Field
from starlette.types import Scope

from starcat.errors import reason
from starcat.version import __version__
from starcat_service.access import Reader
from starcat_service.jobs.job import State
from starcat_service.jobs.slots import JobSlots
from starcat_service.problems import damaged_records, outage_of
from starcat_service.security.request_limits import GIB, disk_shortage, free_gib
from starcat_service.security.tokens import SessionStore
from starcat_service.service import Service, TheService

router = APIRouter(tags=["operations"])

BUCKETS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0)

PROBE_BYTES = 1 << 16
"""Bytes that are written to test whether the disk accepts them."""

UNMATCHED = "unmatched"
"""Route of a request to an unknown address: arbitrary addresses must not become labels."""


class Metrics:
    """The counters of the service."""

    def __init__(self, service: Service) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "starcat_requests_total",
            "Requests that were answered.",
            ("method", "route", "status"),
            registry=self.registry,
        )
        self.seconds = Histogram(
            "starcat_request_seconds",
            "Time until a request was answered in full, streams of events left out.",
            ("route",),
            buckets=BUCKETS_S,
            registry=self.registry,
        )
        self.running = Gauge(
            "starcat_requests_running", "Requests that are being answered.", registry=self.registry
        )
        self.registry.register(_State(service))

    def count(self, scope: Scope, status: int, taken_s: float | None) -> None:
        """Count a request; streams of events, None, have no time."""
        route = route_of(scope)
        method = scope["method"] if scope["method"].isalpha() else "OTHER"
        self.requests.labels(method[:10], route, str(status)).inc()
        if taken_s is not None:
            self.seconds.labels(route).observe(taken_s)

    def text(self) -> bytes:
        """Return all figures in the text format of Prometheus."""
        return generate_latest(self.registry)


class _State(Collector):
    """Figures of the records and the disk at the time of the request."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._sessions = SessionStore(service.records, service.settings.session_hours)

    def describe(self) -> Iterator[Metric]:
        """Return nothing: the figures are computed only when they are collected."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        """Return the figures."""
        service = self._service
        jobs = GaugeMetricFamily("starcat_jobs", "Jobs that are remembered.", labels=["state"])
        by_state = "SELECT state, count(*) FROM jobs WHERE kind != 'query' GROUP BY state"
        counts = {state: count for state, count in service.records.rows(by_state)}  # noqa: C416
        for state in get_args(State):
            jobs.add_metric([state], counts.get(state, 0))
        yield jobs
        yield GaugeMetricFamily(
            "starcat_sessions", "Sign-ins that have not expired.", self._sessions.count()
        )
        yield GaugeMetricFamily(
            "starcat_databases", "Databases there are.", len(service.library.databases())
        )
        free = free_gib(service.settings.root) * GIB
        yield GaugeMetricFamily("starcat_disk_free_bytes", "Room that is left on the disk.", free)
        build = GaugeMetricFamily("starcat_build_info", "The version.", labels=["version"])
        build.add_metric([__version__], 1)
        yield build


def route_of(scope: Scope) -> str:
    """Return the template of the address that answered, such as ``/api/v1/jobs/{job_id}``."""
    route = scope.get("route")
    template = getattr(route, "path", None)
    if template is None:
        return UNMATCHED
    # A route has its template within its router; the prefix of the router is only in the path.
    try:
        within = str(getattr(route, "path_format", template)).format(**scope["path_params"])
    except (KeyError, IndexError):
        return str(template)
    path: str = scope["path"]
    return f"{path.removesuffix(within)}{template}" if path.endswith(within) else str(template)


class Alive(BaseModel):
    """The service answers."""

    status: str = Field("alive", description="Always this.")


class Readiness(BaseModel):
    """Return whether the service can do all of its work."""

    ready: bool = Field(description="Whether nothing is wrong.")
    reasons: list[str] = Field(description="What is wrong.")


@router.get("/healthz", summary="Whether the service lives")
async def alive() -> Alive:
    """Answer from the event loop: no thread has to be free, and nothing here waits."""
    return Alive(status="alive")


@router.get(
    "/readyz",
    summary="Whether the service can work",
    responses={503: {"model": Readiness, "description": "Something is wrong."}},
)
def ready(request: Request, service: TheService, who: Reader) -> Response:
    """Check the records, the disk and the slots of jobs."""
    reasons = []
    try:
        service.records.check()
    except sqlite3.OperationalError as error:
        reasons.append(f"the records cannot be written: {error}")
    except sqlite3.DatabaseError as error:
        reasons.append(damaged_records("records.sqlite", error))
    try:
        short = disk_shortage(service.settings)
        with TemporaryFile(dir=service.paths.scratch) as probe:
            probe.write(bytes(PROBE_BYTES))
    except OSError as error:
        outage = outage_of(error, service.settings.root)
        short = outage.detail if outage else f"the disk cannot be written: {reason(error)}"
    if short is not None:
        reasons.append(short)
    slots: JobSlots = request.app.state.slots
    if not slots.is_alive:
        reasons.append("a slot of jobs has ended; start the service again")
    if slots.cluster is not None and slots.cluster.problem is not None:
        reasons.append(f"jobs wait for the cluster: {slots.cluster.problem}")
    content = Readiness(ready=not reasons, reasons=reasons)
    return JSONResponse(content.model_dump(), 503 if reasons else 200)


@router.get("/metrics", summary="Figures for Prometheus", response_class=Response)
def figures(request: Request, who: Reader) -> Response:
    """Return all figures as text."""
    return Response(request.app.state.metrics.text(), media_type=CONTENT_TYPE_PLAIN_0_0_4)
