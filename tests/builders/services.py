"""Services in the process of a test, and the databases that they have."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from database_copies import copied
from fastapi.routing import APIRoute
from fastapi.testclient import TestClient

from starcat.frames.images.render import write_simulated
from starcat.geometry.camera import Camera
from starcat.matcher.database import open_database
from starcat.pipeline.blind import blind_database
from starcat.pipeline.simulation.simulate import Noise, simulate_frames
from starcat_service.app import API, OTHERS, RESOURCES, make_app
from starcat_service.jobs.submission import submit
from starcat_service.records import Records
from starcat_service.security.tokens import TokenStore
from starcat_service.settings import Role, ServiceSettings

if TYPE_CHECKING:
    import pytest

    from starcat_service.jobs.job import Job
    from starcat_service.service import Service

DATABASE, OTHER = "0123456789abcdef", "fedcba9876543210"
"""The ids of the databases of a service."""

CATALOG = "sao-00112233445566aa"
"""The name of a catalog that a service has as a table."""

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


def add_database(root: Path, folder: Path, database: str = DATABASE) -> Path:
    """Copy a database into the folder of a service; return its path."""
    return copied(folder, root / "databases" / database)


def service_photographs(root: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Take two pictures of the sky with a field of 31.7 deg, 1024 x 768 px.

    The database that a service finds cameras with is built on the way.
    """
    sky = open_database(blind_database(cache=root / "blind"))
    camera, noise = Camera(1024, 768, fov_x_deg=31.7), Noise(0.2, noise_mag=0.1, limit_mag=4.8)
    folder, paths = tmp_path_factory.mktemp("photographs"), []
    frames = simulate_frames(sky.directions, camera, 2, noise, 11, mag=sky.mag)
    for number, frame in enumerate(frames):
        paths.append(folder / f"photo{number}.png")
        write_simulated(paths[-1], frame, camera, number)
    return paths


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


def every_route() -> Iterator[tuple[str, str]]:
    """Give method and path of every route of the application; parameters are in braces."""
    for prefix, routers in ((API, RESOURCES), ("", OTHERS)):
        for route in chain.from_iterable(router.routes for router in routers):
            assert isinstance(route, APIRoute)
            yield from ((method, prefix + route.path) for method in sorted(route.methods))


def with_name(path: str, name: str) -> str:
    """Return a path with a name in place of each parameter."""
    return re.sub(r"\{[^}]*\}", name, path)


def posted(client: TestClient, address: str, form: dict[str, Any], **more: Any) -> Any:
    """Send a form, again while the catalog is being read: a busy machine takes long for it."""
    answer = client.post(address, data=form, **more)
    while "being read, which takes longer" in answer.text:
        answer = client.post(address, data=form, **more)
    return answer


def until(is_so: Callable[[], object], seconds: float = 90.0) -> None:
    """Wait until something is so; fail if it takes too long."""
    until_s = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < until_s
        time.sleep(0.05)
