"""Services in the process of a test, and the databases that they have."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fastapi.testclient import TestClient

from starcat.service.app import make_app
from starcat.service.jobs.job_states import add_once
from starcat.service.settings import Settings

if TYPE_CHECKING:
    from starcat.service.jobs.job import Job
    from starcat.service.service import Service

DATABASE = "0123456789abcdef"
LOCAL = "http://127.0.0.1:8000"


@contextmanager
def client_of(
    root: Path, address: str = LOCAL, workers: int = 0, **settings: Any
) -> Iterator[TestClient]:
    """Run a service, without workers if nothing else is said, and give a client of it."""
    app = make_app(Settings(root=root, workers=workers, **settings))
    with TestClient(app, base_url=address) as client:
        yield client


def shelve(root: Path, artifact: Path, database: str = DATABASE) -> Path:
    """Copy an artifact into the folder of a service; return where it is."""
    folder = root / "databases" / database / artifact.name
    shutil.copytree(artifact, folder, copy_function=shutil.copyfile)
    return folder


def waiting_build(service: Service, key: str) -> Job:
    """Add a build that waits, of nothing."""
    job, _ = add_once(
        service.records,
        "build",
        {},
        key=key.ljust(64, "0"),
        title="small 1.0.0",
        owner="me",
        most_waiting=100,
        has_result=bool,
        check=lambda: None,
    )
    return job
