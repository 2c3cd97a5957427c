"""Paths of all files under the root of the service; no other module builds such paths."""

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
        self.root = root  # absolute path of its folder
        self.records = root / "records.sqlite"  # jobs, tokens and everything else that is recorded
        self.lock = root / "server.lock"  # locked by the only server of this root while it runs
        self.databases = root / "databases"  # one folder per database, by id
        self.registry = root / "registry"  # registry of published releases
        self.catalogs = root / "catalogs"  # star tables of catalogs that jobs have read
        self.jobs = root / "jobs"  # one folder per job: its log and unfinished files
        self.blind = root / "blind"  # the database that finds the cameras of photographs
        self.results = root / "results"  # answers to asynchronous queries
        self.scratch = root / "scratch"  # temporary files; emptied at each start

    def database(self, database_id: str) -> Path:
        """Return the folder that contains the folder of a database."""
        return self.databases / checked(database_id, DATABASE_ID, "database")

    def job(self, job_id: str) -> Path:
        """Return the folder of a job."""
        return self.jobs / checked(job_id, JOB_ID, "job")

    def job_lock(self, job_id: str) -> Path:
        """Return the file that the process of a job keeps locked while it lives."""
        return self.job(job_id) / "lock"

    def job_work(self, job_id: str) -> Path:
        """Return the folder of unfinished results of a job."""
        return self.job(job_id) / "work"

    def job_stderr(self, job_id: str) -> Path:
        """Return the file with the error output of the processes of a job."""
        return self.job(job_id) / "stderr.txt"

    def make(self) -> None:
        """Make the missing folders, readable only by their owner."""
        for folder in (self.databases, self.catalogs, self.jobs, self.results, self.scratch):
            make_folder(folder)
        self.root.chmod(0o700)


def checked(text: str, pattern: re.Pattern[str], kind: str) -> str:
    """Return an id after checking its form."""
    if not pattern.fullmatch(text):
        raise TargetMissing(f"no {kind} has the id {text[:80]!r}; their list shows the valid ids")
    return text
