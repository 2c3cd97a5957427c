"""Figures for Prometheus: requests, jobs, sign-ins, disk; in a registry of this service alone."""

from __future__ import annotations

import time
from collections.abc import Iterator

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from starcat.service.security.bodies import GIB, free_gib
from starcat.service.security.guard import Guard
from starcat.service.security.login_sessions import SessionStore
from starcat.service.service import Service
from starcat.version import __version__

BUCKETS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0)

STATES = ("queued", "running", "done", "failed", "cancelled")

UNMATCHED = "unmatched"
"""Route of a request to no address that there is: what people make up is no label."""


class Metrics:
    """What is counted."""

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

    def text(self) -> bytes:
        """Return all figures in the text format of Prometheus."""
        return generate_latest(self.registry)


class _State(Collector):
    """What the records and the disk say at the time of the question."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._sessions = SessionStore(service.records, service.settings.session_hours)

    def describe(self) -> Iterator[Metric]:
        """Return nothing: the figures are looked up only when they are asked for."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        """Return the figures."""
        service = self._service
        jobs = GaugeMetricFamily("starcat_jobs", "Jobs that are remembered.", labels=["state"])
        with service.records.reading() as connection:
            counts = dict(
                connection.execute("SELECT state, count(*) FROM jobs GROUP BY state").fetchall()
            )
        for state in STATES:
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


class Counted(Guard):
    """Counts requests and their time, by the route that answered."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        super().__init__(app)
        self._metrics = metrics

    async def answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        begun_s, status, is_endless = time.perf_counter(), 0, False

        async def send_noted(message: Message) -> None:
            nonlocal status, is_endless
            if message["type"] == "http.response.start":
                status = message["status"]
                is_endless = any(
                    name == b"content-type" and value.startswith(b"text/event-stream")
                    for name, value in message.get("headers", [])
                )
            await send(message)

        self._metrics.running.inc()
        try:
            await self._app(scope, receive, send_noted)
        finally:
            self._metrics.running.dec()
            route = route_of(scope)
            method = scope["method"] if scope["method"].isalpha() else "OTHER"
            self._metrics.requests.labels(method[:10], route, str(status)).inc()
            if not is_endless:
                self._metrics.seconds.labels(route).observe(time.perf_counter() - begun_s)


def route_of(scope: Scope) -> str:
    """Return the template of the address that answered, such as ``/api/v1/jobs/{job_id}``."""
    route = scope.get("route")
    template = getattr(route, "path", None)
    if template is None:
        return UNMATCHED
    # A route knows its template within its router; what the router stands behind is in the path.
    try:
        within = str(getattr(route, "path_format", template)).format(**scope["path_params"])
    except (KeyError, IndexError):
        return str(template)
    path: str = scope["path"]
    return f"{path.removesuffix(within)}{template}" if path.endswith(within) else str(template)
