"""What jobs need of a service: a worker opens this much, and nothing that answers requests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from starcat.service.jobs.job import JobStore
from starcat.service.jobs.queue import JobQueue, open_queue
from starcat.service.library import Library
from starcat.service.paths import ServicePaths
from starcat.service.records import Records
from starcat.service.settings import Settings


class Ground(Protocol):
    """A service, or the part of one that jobs need; attributes as those of `Service`."""

    @property
    def settings(self) -> Settings:
        """What the operator set."""

    @property
    def paths(self) -> ServicePaths:
        """What lies where."""

    @property
    def records(self) -> Records:
        """What is remembered."""

    @property
    def library(self) -> Library:
        """The databases there are."""

    @property
    def jobs(self) -> JobStore:
        """The jobs there are."""

    @property
    def queue(self) -> JobQueue:
        """What tells the workers that a job waits."""


@dataclass(frozen=True)
class WorkerGround:
    """The part of a service that a worker has; attributes as those of `Ground`."""

    settings: Settings
    paths: ServicePaths
    records: Records
    library: Library
    jobs: JobStore
    queue: JobQueue


def open_ground(settings: Settings) -> WorkerGround:
    """Open what a worker needs."""
    paths = ServicePaths(settings.root)
    paths.make()
    records = Records(paths.records)
    queue = open_queue(settings, paths)
    return WorkerGround(settings, paths, records, Library(paths), JobStore(records), queue)
