"""The object that gives handlers access to everything else."""

from __future__ import annotations

import threading
from typing import Annotated

from fastapi import Depends, Request

from starcat_service.estimates import OWN_WAITING, ChildCatalogs
from starcat_service.jobs.job import JobStore
from starcat_service.library import Library
from starcat_service.paths import ServicePaths
from starcat_service.quota import Quota
from starcat_service.records import Records
from starcat_service.sandbox.limiter import Limiter
from starcat_service.sandbox.pool import QueryPool
from starcat_service.sandbox.sandbox import Sandbox
from starcat_service.settings import ServiceSettings
from starcat_service.vo.tap_jobs import QueryJobs
from starcat_service.vo.tap_queries import Tap

GIB = 2**30

DESIGNS = 4
"""Answers that show an estimate, as maps or tables, that are made at the same time."""


class Service:
    """A running service: its folders and records, and the objects that use them."""

    def __init__(self, settings: ServiceSettings) -> None:
        self.settings = settings
        self.paths = ServicePaths(settings.root)
        self.paths.make()
        self.records = Records(self.paths.records)
        self.library = Library(self.paths)
        self.jobs = JobStore(self.records)
        self.job_queued = threading.Condition()  # notified when a job waits
        self.query_pool = QueryPool(settings)
        self.sandbox = Sandbox(settings, self.paths.scratch)
        self.quota = Quota(settings, self.records, self.library)
        self.tap = Tap(settings, self.paths, self.library, self.query_pool, self.sandbox)
        self.query_jobs = QueryJobs(
            settings, self.records, self.paths, self.tap, self.quota, self.wake_slots
        )
        self.catalogs = ChildCatalogs(round(settings.job_memory_gib * GIB))
        self.designs = Limiter(DESIGNS, DESIGNS // 2)  # answers that show an estimate
        self.photographs = Limiter(settings.queries, settings.queries // 2, OWN_WAITING)
        self.publishing = Limiter(1, 1, OWN_WAITING)
        self.stopping = threading.Event()

    def wake_slots(self) -> None:
        """Wake an idle slot so that it looks for jobs now."""
        with self.job_queued:
            self.job_queued.notify_all()

    def close(self) -> None:
        """Close sessions, processes and records."""
        self.catalogs.close()
        self.query_pool.close()
        self.sandbox.close()
        self.records.close()


def service_of(request: Request) -> Service:
    """Return the service of a request."""
    service: Service = request.app.state.service
    return service


async def _service_of(request: Request) -> Service:
    return service_of(request)  # async, as FastAPI sends plain functions to a thread


TheService = Annotated[Service, Depends(_service_of)]
