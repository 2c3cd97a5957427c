"""The one object that handlers reach everything through."""

from __future__ import annotations

import threading
from typing import Annotated

from fastapi import Depends, Request

from starcat.service.catalogs import Catalogs
from starcat.service.jobs.job import JobStore
from starcat.service.library import Library
from starcat.service.paths import ServicePaths
from starcat.service.query_pool import QueryPool
from starcat.service.records import Records
from starcat.service.sandbox.sandbox import Sandbox
from starcat.service.settings import Settings
from starcat.service.vo.tap_jobs import QueryJobs
from starcat.service.vo.tap_queries import TapQueries, TapTables
from starcat.vo.documents import ServiceLimits

GIB = 2**30
DAY_S = 86_400


class Tap:
    """The parts of TAP: what is granted, what there is to be asked, and what answers."""

    def __init__(self, service: Service) -> None:
        settings, paths, query_pool = service.settings, service.paths, service.query_pool
        self.limits = ServiceLimits(
            run_s=int(settings.job_time_s),
            keep_s=int(settings.keep_results_days * DAY_S),
            rows=settings.max_rows,
            upload_bytes=int(settings.upload_mib * 2**20),
        )
        self.tables = TapTables(paths, service.library, query_pool)
        self.queries = TapQueries(
            paths, self.tables, query_pool, service.sandbox, settings.max_rows
        )
        self.jobs = QueryJobs(service.records, paths, self.limits, self.queries, service.wake_slots)


class Service:
    """A running service: its folders and records, and what works with them."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.paths = ServicePaths(settings.root)
        self.paths.make()
        self.records = Records(self.paths.records)
        self.library = Library(self.paths)
        self.jobs = JobStore(self.records)
        self.job_queued = threading.Condition()  # notified when a job waits
        self.query_pool = QueryPool(settings)
        self.sandbox = Sandbox(settings, self.paths.scratch)
        self.tap = Tap(self)
        self.catalogs = Catalogs(round(settings.job_memory_gib * GIB))
        self.stopping = threading.Event()

    def wake_slots(self) -> None:
        """Have an idle slot look for jobs now."""
        with self.job_queued:
            self.job_queued.notify_all()

    def close(self) -> None:
        """Close sessions, processes and records."""
        self.catalogs.close()
        self.query_pool.close()
        self.sandbox.close()
        self.records.close()


def service_of(request: Request) -> Service:
    """Return the service that a request came to."""
    service: Service = request.app.state.service
    return service


async def _service_of(request: Request) -> Service:
    return service_of(request)  # in the event loop: FastAPI sends plain functions to a thread


TheService = Annotated[Service, Depends(_service_of)]
