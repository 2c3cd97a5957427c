"""What lies where under the root of the service; no other module puts such paths together."""

from __future__ import annotations

import re
from pathlib import Path

from starcat.errors import TargetMissing
from starcat.storage import make_folder

DATABASE_ID = re.compile(r"[0-9a-f]{16}")
JOB_ID = re.compile(r"[0-9a-f]{32}")


class ServicePaths:
    """Files and folders of a service."""

    def __init__(self, root: Path) -> None:
        self.root = root  # its folder, in full
        self.records = root / "records.sqlite"  # jobs, tokens and what else is remembered
        self.lock = root / "server.lock"  # what the one server of this root holds while it runs
        self.databases = root / "databases"  # a folder each, by id
        self.registry = root / "registry"  # what releases are published into
        self.catalogs = root / "catalogs"  # star tables of catalogs that were read
        self.jobs = root / "jobs"  # a folder each: its log, and what is not whole yet
        self.blind = root / "blind"  # the database that finds the cameras of photographs
        self.results = root / "results"  # answers to asynchronous queries
        self.scratch = root / "scratch"  # what is on its way; emptied at each start

    def database(self, database_id: str) -> Path:
        """Return the folder that the folder of a database lies in."""
        return self.databases / checked(database_id, DATABASE_ID, "database")

    def job(self, job_id: str) -> Path:
        """Return the folder of a job."""
        return self.jobs / checked(job_id, JOB_ID, "job")

    def job_lock(self, job_id: str) -> Path:
        """Return what the process of a job holds while it lives."""
        return self.job(job_id) / "lock"

    def job_work(self, job_id: str) -> Path:
        """Return the folder of what a job makes before it is whole."""
        return self.job(job_id) / "work"

    def job_stderr(self, job_id: str) -> Path:
        """Return the file of what the processes of a job said of their troubles."""
        return self.job(job_id) / "stderr.txt"

    def make(self) -> None:
        """Make the folders that are not there, readable by their owner only."""
        for folder in (self.databases, self.catalogs, self.jobs, self.results, self.scratch):
            make_folder(folder)
        self.root.chmod(0o700)


def checked(text: str, pattern: re.Pattern[str], kind: str) -> str:
    """Return an id that is of the form that it must have."""
    if not pattern.fullmatch(text):
        raise TargetMissing(f"no {kind} has the id {text[:80]!r}; the list of them tells theirs")
    return text
