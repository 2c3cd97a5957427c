"""The one object that handlers reach everything through."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends, Request

from starcat.service.catalogs import Catalogs
from starcat.service.confined import Confined
from starcat.service.jobs.job import JobStore
from starcat.service.jobs.queue import JobQueue, open_queue
from starcat.service.paths import ServicePaths
from starcat.service.records import Records
from starcat.service.sessions import Sessions
from starcat.service.settings import Settings
from starcat.service.shelf import Shelf
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
    shelf : Shelf
        The databases there are.
    jobs : JobStore
        The jobs there are.
    sessions : Sessions
        Open query sessions.
    queue : JobQueue
        What waits for workers.
    confined : Confined
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
    shelf: Shelf
    jobs: JobStore
    sessions: Sessions
    confined: Confined
    tap: Tap
    queue: JobQueue
    catalogs: Catalogs
    stopping: threading.Event = field(default_factory=threading.Event)


def open_service(settings: Settings) -> Service:
    """Open a service: its folders and its records."""
    paths = ServicePaths(settings.root)
    paths.make()
    records = Records(paths.records)
    shelf, sessions = Shelf(paths), Sessions(settings)
    most = round(settings.job_memory_gib * GIB)
    confined = Confined(settings, paths.scratch)
    return Service(
        settings=settings,
        paths=paths,
        records=records,
        shelf=shelf,
        jobs=JobStore(records),
        sessions=sessions,
        confined=confined,
        tap=Tap(settings, paths, records, shelf, sessions, confined),
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
