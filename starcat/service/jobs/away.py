"""Jobs on another machine: messages come from Redis, everything else goes over the REST interface.

A worker there takes a build if its own catalogs give the job's key, begins it only where the
server says that nobody else has, tells how far it is, and sends the database as a tar archive,
which the server checks before it has its place. One that is silent for long is given up.
"""

from __future__ import annotations

import dataclasses
import logging
import shutil
import tarfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import requests

from starcat.errors import SourceMissing
from starcat.service.jobs.ground import open_ground
from starcat.service.jobs.job import Job
from starcat.service.jobs.keys import build_key
from starcat.service.jobs.runner import Run, Slots
from starcat.service.jobs.worker import serve_queue
from starcat.service.settings import Settings
from starcat.specs.reading import spec_from_dict

TELL_S = 1.0
"""How often the server hears of a job."""

PAUSE_S = 2.0
"""Seconds after which a message that is for others goes back, or the server is asked again."""

ANSWER_S = 30.0
"""Seconds that the server has to answer."""

_logger = logging.getLogger(__name__)


class Server:
    """The server as its workers see it."""

    def __init__(self, address: str, token: str) -> None:
        self._address = f"{address.rstrip('/')}/api/v1"
        self._headers = {"Authorization": f"Bearer {token}"}

    def ask(self, method: str, path: str, **how: Any) -> requests.Response:
        """Send a request."""
        how = {"timeout": ANSWER_S, "headers": self._headers, **how}
        return requests.request(method, f"{self._address}{path}", allow_redirects=False, **how)


class AwaySlots(Slots):
    """What the jobs that run on this machine for a server elsewhere have in common."""

    def __init__(self, settings: Settings, server: Server) -> None:
        super().__init__(open_ground(settings))
        self._server = server

    def run_job(self, job_id: str) -> None:
        """Begin a job and see it to its end, if this worker can and nobody else does."""
        try:
            job = self._begun(job_id)
        except (requests.RequestException, SourceMissing) as error:
            _logger.warning("job %s goes back to the queue: %s", job_id, error)
            self._give_back(job_id)
            return
        if job is None:
            return
        paths = self.service.paths
        try:
            Run(self, AwayAttempt(self, self._server, job)).run()
        finally:
            for folder in (paths.job(job.id), paths.database(job.key[:16])):
                shutil.rmtree(folder, ignore_errors=True)

    def _begun(self, job_id: str) -> Job | None:
        answer = self._server.ask("GET", f"/jobs/{job_id}")
        if answer.status_code == 404 or (answer.ok and answer.json()["state"] != "queued"):
            return None
        answer.raise_for_status()
        found = answer.json()
        if found["kind"] != "build" or self.stop_at_s is not None:
            self._give_back(job_id)
            return None
        key = build_key(self.service.records, spec_from_dict(found["request"]["spec"], "spec"))
        if key != found["key"]:
            raise SourceMissing(
                "the catalogs of this machine, or its starcat, are not the server's"
            )
        answer = self._server.ask("POST", f"/work/{job_id}/claim")
        if answer.status_code == 409:
            return None
        answer.raise_for_status()
        names = [field.name for field in dataclasses.fields(Job)]
        return Job(**{name: answer.json().get(name) for name in names})

    def _give_back(self, job_id: str) -> None:
        time.sleep(PAUSE_S)
        self.service.queue.send(job_id)


class AwayAttempt:
    """An attempt here, of which the server is told."""

    def __init__(self, slots: AwaySlots, server: Server, job: Job) -> None:
        self.job = job
        self._slots, self._server = slots, server
        self._path = f"/work/{job.id}/{job.attempt}"
        self._lines: list[dict[str, Any]] = []
        self._told_at_s = self._heard_at_s = time.monotonic()
        self._wants_end = False

    def wants_end(self) -> bool:
        """Return whether the job is to end; the server is told of it meanwhile."""
        if time.monotonic() - self._told_at_s >= TELL_S:
            self._told_at_s = time.monotonic()
            self._tell_all()
        return self._wants_end

    def tell_stage(self, stage: str, done: int, total: int | None) -> None:
        """Say how far it is."""
        if self._lines and self._lines[-1].get("stage") == stage:
            self._lines.pop()
        self._lines.append({"stage": stage, "done": done, "total": total})

    def tell(self, level: str, text: str) -> None:
        """Say a line of the log."""
        self._lines.append({"level": level, "text": text})

    def succeed(self, result: Mapping[str, Any]) -> None:
        """Send the database."""
        self._tell_all()
        paths = self._slots.service.paths
        archive = paths.job(self.job.id) / "database.tar"
        pack(paths.database(str(result["database"])), archive)

        def send() -> requests.Response:
            headers = {**self._server._headers, "Content-Type": "application/x-tar"}
            with archive.open("rb") as file:
                return self._server.ask(
                    "PUT", f"{self._path}/database", data=file, headers=headers, timeout=600.0
                )

        answer = self._until_heard(send)
        if answer is not None and not answer.ok and answer.status_code != 409:
            detail = f"the server does not take the database: {_words(answer)}"
            self.fail({"title": "Refused", "status": answer.status_code, "detail": detail})

    def fail(self, error: Mapping[str, Any]) -> None:
        """Say that it has failed."""
        self._end(state="failed", error=dict(error))

    def be_cancelled(self) -> None:
        """Say that it was cancelled."""
        self._end(state="cancelled")

    def wait_again(self) -> None:
        """Say that it is to be begun again."""
        self._end(state="queued")

    def _end(self, **content: Any) -> None:
        self._tell_all()
        self._until_heard(lambda: self._server.ask("POST", f"{self._path}/end", json=content))

    def _tell_all(self) -> None:
        lines, self._lines = self._lines[:500], self._lines[500:]
        try:
            answer = self._server.ask("POST", f"{self._path}/tell", json={"lines": lines})
        except requests.RequestException as error:
            _logger.warning("job %s: the server does not answer: %s", self.job.id, error)
            self._lines = lines + self._lines
            silent_s = time.monotonic() - self._heard_at_s
            self._wants_end = silent_s > self._slots.service.settings.worker_silence_s
            return
        self._heard_at_s = time.monotonic()
        if answer.status_code < 500:
            self._wants_end = not answer.ok or bool(answer.json()["wants_end"])

    def _until_heard(self, send: Any) -> requests.Response | None:
        """Send something until it is answered, as long as the job may still be this worker's."""
        until_s = time.monotonic() + self._slots.service.settings.worker_silence_s
        while True:
            try:
                answer: requests.Response = send()
                if answer.status_code < 500:
                    return answer
                _logger.warning("job %s: %s", self.job.id, _words(answer))
            except requests.RequestException as error:
                _logger.warning("job %s: the server does not answer: %s", self.job.id, error)
            if time.monotonic() >= until_s:
                return None
            time.sleep(PAUSE_S)


def _words(answer: requests.Response) -> str:
    try:
        return str(answer.json()["detail"])
    except (ValueError, KeyError, TypeError):
        return f"status {answer.status_code}"


def pack(folder: Path, archive: Path) -> None:
    """Write the files of a folder into a tar archive."""
    with tarfile.open(archive, "w", format=tarfile.PAX_FORMAT) as tar:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                tar.add(path, path.relative_to(folder).as_posix(), recursive=False)


def work_away(settings: Settings, address: str, token: str) -> None:
    """Do the builds of a server elsewhere until a signal ends it."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    slots = AwaySlots(settings, Server(address, token))
    try:
        serve_queue(slots)
    finally:
        slots.end_all()
