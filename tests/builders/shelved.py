"""An artifact put onto the shelf of a service, as a job does that built it."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from starcat.service.jobs.job_states import add_once

if TYPE_CHECKING:
    from starcat.service.jobs.job import Job
    from starcat.service.service import Service

DATABASE = "0123456789abcdef"


def shelve(root: Path, artifact: Path, database: str = DATABASE) -> Path:
    """Copy an artifact onto the shelf.

    Parameters
    ----------
    root : Path
        Folder of the service.
    artifact : Path
        Folder of the artifact.
    database : str
        Sixteen hexadecimal digits.

    Returns
    -------
    Path
        Its folder on the shelf.
    """
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
