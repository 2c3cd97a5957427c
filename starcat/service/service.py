"""The one object that handlers reach everything through."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends, Request

from starcat.service.catalogs import Catalogs
from starcat.service.jobs.job import JobStore
from starcat.service.jobs.queue import JobQueue, open_queue
from starcat.service.library import Library
from starcat.service.paths import ServicePaths
from starcat.service.query_pool import QueryPool
from starcat.service.records import Records
from starcat.service.sandbox.sandbox import Sandbox
from starcat.service.settings import Settings
from starcat.service.vo.tap_service import Tap

GIB = 2**30


@dataclass(frozen=True)
class Service:
    """What a running service is made of.

    Attributes
    ----------
    settings : Settings
        What the operator set.
    paths : ServicePaths
        What lies where.
    records : Records
        What is remembered.
    library : Library
        The databases there are.
    jobs : JobStore
        The jobs there are.
    query_pool : QueryPool
        Open query sessions.
    queue : JobQueue
        What waits for workers.
    sandbox : Sandbox
        Processes that read uploads and make files.
    tap : Tap
        What TAP needs.
    catalogs : Catalogs
        The catalogs there are, and estimates from them.
    stopping : threading.Event
        Set when the service stops.
    """

    settings: Settings
    paths: ServicePaths
    records: Records
    library: Library
    jobs: JobStore
    query_pool: QueryPool
    sandbox: Sandbox
    tap: Tap
    queue: JobQueue
    catalogs: Catalogs
    stopping: threading.Event = field(default_factory=threading.Event)


def open_service(settings: Settings) -> Service:
    """Open a service: its folders and its records."""
    paths = ServicePaths(settings.root)
    paths.make()
    records = Records(paths.records)
    library, query_pool = Library(paths), QueryPool(settings)
    most = round(settings.job_memory_gib * GIB)
    sandbox = Sandbox(settings, paths.scratch)
    return Service(
        settings=settings,
        paths=paths,
        records=records,
        library=library,
        jobs=JobStore(records),
        query_pool=query_pool,
        sandbox=sandbox,
        tap=Tap(settings, paths, records, library, query_pool, sandbox),
        queue=open_queue(settings, paths),
        catalogs=Catalogs(most),
    )


def service_of(request: Request) -> Service:
    """Return the service that a request came to."""
    service: Service = request.app.state.service
    return service


async def _service_of(request: Request) -> Service:
    return service_of(request)  # in the event loop: FastAPI sends plain functions to a thread


TheService = Annotated[Service, Depends(_service_of)]
