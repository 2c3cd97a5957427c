"""Services in the process of a test, and the databases that they have."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from artifact_copies import copied
from fastapi.testclient import TestClient

from starcat_service.app import make_app
from starcat_service.jobs.submission import submit
from starcat_service.records import Records
from starcat_service.security.tokens import TokenStore
from starcat_service.settings import Role, ServiceSettings

if TYPE_CHECKING:
    from starcat_service.jobs.job import Job
    from starcat_service.service import Service

DATABASE = "0123456789abcdef"
LOCAL = "http://127.0.0.1:8000"

SPEC = """\
name = "small"
version = "1.0.0"
epoch_jyear = 2016.0

[catalog]
source = "gaia"

[selection]
faint_limit_mag = 4.5

[camera]
width_px = 512
height_px = 512
fov_x_deg = 30.0

[boresights]
count = 300
"""


@contextmanager
def client_of(
    root: Path, address: str = LOCAL, workers: int = 0, **settings: Any
) -> Iterator[TestClient]:
    """Run a service, by default without workers, and yield a client of it."""
    app = make_app(ServiceSettings(root=root, workers=workers, **settings))
    with TestClient(app, base_url=address) as client:
        yield client


def add_database(root: Path, artifact: Path, database: str = DATABASE) -> Path:
    """Copy a database into the folder of a service; return its path."""
    return copied(artifact, root / "databases" / database)


def token_of(root: Path, name: str) -> str:
    """Give a user the role of publisher in a service that does not run yet."""
    records = Records(root / "records.sqlite")
    _, token = TokenStore(records).create(name, Role.PUBLISHER)
    records.close()
    return token


def states(service: Service, job: Job) -> list[str]:
    """Return the states that a job has been in."""
    events = service.jobs.events(job.id)
    return [event.data["state"] for event in events if event.kind == "state"]


def waiting_build(service: Service, key: str) -> Job:
    """Add a build that waits, of nothing."""
    return submit(service, "build", {}, key.ljust(64, "0"), "small 1.0.0", "me").job
