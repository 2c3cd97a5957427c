"""What lies where under the root of the service; no other module puts such paths together."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from starcat.errors import TargetMissing
from starcat.storage.atomic import make_folder

DATABASE_ID = re.compile(r"[0-9a-f]{16}")
JOB_ID = re.compile(r"[0-9a-f]{32}")


@dataclass(frozen=True)
class ServicePaths:
    """Files and folders of a service."""

    root: Path  # its folder, in full

    @property
    def records(self) -> Path:
        """The SQLite file with jobs, tokens and what else is remembered."""
        return self.root / "records.sqlite"

    @property
    def lock(self) -> Path:
        """What the one server of this root holds while it runs."""
        return self.root / "server.lock"

    @property
    def databases(self) -> Path:
        """Built databases, a folder each, by id."""
        return self.root / "databases"

    @property
    def registry(self) -> Path:
        """The registry that releases are published into."""
        return self.root / "registry"

    @property
    def catalogs(self) -> Path:
        """Star tables of catalogs that were read."""
        return self.root / "catalogs"

    @property
    def jobs(self) -> Path:
        """A folder for each job: its log, and what it makes before it is whole."""
        return self.root / "jobs"

    @property
    def results(self) -> Path:
        """Answers to asynchronous queries."""
        return self.root / "results"

    @property
    def scratch(self) -> Path:
        """Uploads and files that are on their way; emptied at each start."""
        return self.root / "scratch"

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
