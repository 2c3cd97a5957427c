"""The service from Python: build, ask, identify, download and publish over HTTP."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import quote

import requests

from starcat.database.manifest import MANIFEST_NAME, parse_manifest
from starcat.database.verify import check_database
from starcat.errors import DownloadError, ServiceError, error_from_fields
from starcat.progress import Progress, no_progress
from starcat.ship.releases.tree import Release, tree_files
from starcat.storage.atomic import move_into_place, whole_folder

Content = dict[str, Any]

CHUNK_BYTES = 1 << 18
AGAIN_S = 0.2  # wait before reading the events of a job again, if they ended before the job did


class Client:
    """A service at an address such as ``http://127.0.0.1:8000``.

    An error that the service reports is raised as the class of `starcat.errors` it names.
    `ServiceError` is raised if no byte arrives for ``timeout_s``.
    """

    def __init__(self, url: str, token: str | None = None, timeout_s: float = 120.0) -> None:
        self.url = url.rstrip("/")
        self._timeout_s = timeout_s
        self._session = requests.Session()
        if token:
            self._session.headers["Authorization"] = f"Bearer {token}"

    def build(self, spec: str | Mapping[str, Any], progress: Progress = no_progress) -> Content:
        """Build a spec (TOML or its keys) and wait; the job's ``result`` names the database."""
        return self.wait(self.submit(spec), progress)

    def submit(self, spec: str | Mapping[str, Any]) -> str:
        """Start building a database, and return the id of the job for `wait`."""
        return str(self._json("POST", "jobs", json={"kind": "build", "spec": spec})["id"])

    def wait(self, job_id: str, progress: Progress = no_progress) -> Content:
        """Wait for a job, and return it; raise its error if it failed or was cancelled."""
        seen = "0"
        while True:
            for number, kind, data in self._events(job_id, seen):
                seen = number or seen
                if kind == "stage":
                    progress(data["stage"], data.get("done") or 0, data.get("total"))
            job = self._json("GET", f"jobs/{job_id}")
            if job["state"] == "done":
                return job
            if job["state"] in ("failed", "cancelled"):
                problem = job.get("error") or {"detail": f"the job {job_id} was {job['state']}"}
                raise _error_of(problem, None)
            time.sleep(AGAIN_S)

    def sql(
        self,
        targets: Sequence[str],
        query: str | None = None,
        values: Mapping[str, Any] | None = None,
        *,
        named: str | None = None,
        max_rows: int | None = None,
        time_limit_s: float | None = None,
    ) -> Content:
        """Run a query on databases (ids or titles) and catalogs.

        The answer has ``columns`` (name, type, unit, description), ``rows`` and ``is_cut``.
        """
        asked: Content = {"targets": list(targets), "query": query, "named": named}
        asked |= {"values": dict(values or {}), "max_rows": max_rows, "time_limit_s": time_limit_s}
        return self._json("POST", "sql", json=asked)

    def sql_file(
        self,
        path: Path,
        form: str,
        targets: Sequence[str],
        query: str | None = None,
        values: Mapping[str, Any] | None = None,
        *,
        named: str | None = None,
        time_limit_s: float | None = None,
    ) -> int:
        """Write the answer to a query to a file, and return its number of rows."""
        asked: Content = {"targets": list(targets), "query": query, "named": named}
        asked |= {"values": dict(values or {}), "format": form, "time_limit_s": time_limit_s}
        with closing(self._answer("POST", "sql", json=asked, stream=True)) as answer:
            _receive(answer, path)
        return int(answer.headers["X-Starcat-Rows"])

    def identify(
        self,
        database: str,
        frames: Path | Mapping[str, Any],
        options: Mapping[str, Any] | None = None,
    ) -> Content:
        """Identify a file of frames, or ``centroids_px`` with or without ``mag``.

        ``/api/v1/identify/options`` describes the options. The answer's ``frames`` have the form
        that 'starcat identify --json' prints.
        """
        return dict(self._of_frames(f"identify/{quote(database, safe='')}", frames, options).json())

    def picture(
        self,
        database: str,
        frames: Path | Mapping[str, Any],
        options: Mapping[str, Any] | None = None,
        form: str = "png",
    ) -> bytes:
        """Return a picture (PNG or SVG) of the first frame, labelled with the stars' names."""
        path = f"identify/{quote(database, safe='')}/picture?format={form}"
        return self._of_frames(path, frames, options).content

    def download(
        self, database: str, folder: Path, progress: Progress = no_progress
    ) -> tuple[Path, str]:
        """Download and check a database; return its folder, and "written" or "unchanged"."""
        where = f"databases/{quote(database, safe='')}"
        data = self._answer("GET", f"{where}/manifest").content
        manifest = parse_manifest(data, f"{self.url}/api/v1/{where}/manifest", "try again")
        # The names of the database and of its files are checked before they become paths.
        files = tree_files(manifest, where)
        release = Release.model_validate(
            {name: manifest[name] for name in ("name", "version")}
            | {"manifest": {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}}
        )
        total, done = sum(blob.bytes for blob in files.values()), 0
        final = folder / release.title
        with whole_folder(final) as partial:
            (partial / MANIFEST_NAME).write_bytes(data)
            for name, blob in files.items():
                progress("download", done, total)
                (partial / name).parent.mkdir(parents=True, exist_ok=True)
                with closing(self._answer("GET", f"{where}/files/{name}", stream=True)) as answer:
                    digest = _receive(answer, partial / name)
                if digest != blob.sha256:
                    raise DownloadError(
                        f"its sha256 begins with {digest[:12]}; expected {blob.sha256[:12]}",
                        where=answer.url,
                        hint="Try again",
                    )
                done += blob.bytes
            progress("download", done, total)
            check_database(partial)
            outcome = move_into_place(partial, final)
        return final, outcome

    def files(self, database: str) -> list[Content]:
        """Return ``path``, ``bytes``, ``sha256``, ``content_type`` of the files of a database."""
        return list(self._answer("GET", f"databases/{database}/files").json())

    def report(self, database: str) -> Content:
        """Return the report of a build, ``report/report.json`` of the database."""
        return self._json("GET", f"databases/{database}/report")

    def difference(self, database: str, other: str) -> Content:
        """Return the differences of two databases: spec, products, and stars with the reason."""
        return self._json("GET", f"databases/{database}/diff/{other}")

    def publish(self, database: str, note: str = "") -> Content:
        """Publish a database; ``outcome`` is ``published``, or ``unchanged``."""
        return self._json("POST", "releases", json={"database": database, "note": note})

    def estimate(self, spec: str | Mapping[str, Any]) -> Content:
        """Estimate a build's result: stars, sizes and time."""
        key = "toml" if isinstance(spec, str) else "spec"
        return self._json("POST", "specs/estimate", json={key: spec})

    def _events(self, job_id: str, after: str) -> Iterator[tuple[str, str, Content]]:
        """Yield the events of a job: number, kind, data."""
        path = f"jobs/{job_id}/events?after={after}"
        with closing(self._answer("GET", path, stream=True)) as answer:
            event: dict[str, str] = {}
            try:
                for line in answer.iter_lines(decode_unicode=True):
                    name, _, value = line.partition(":")
                    if line:
                        event[name] = value.removeprefix(" ")
                    elif "data" in event:
                        data = json.loads(event["data"])
                        yield event.get("id", ""), event.get("event", ""), data
                        event = {}
            except requests.RequestException:
                return  # the connection ended; the caller reads the job's state and events again

    def _of_frames(
        self, path: str, frames: Path | Mapping[str, Any], options: Mapping[str, Any] | None
    ) -> requests.Response:
        if not isinstance(frames, Path):
            return self._answer("POST", path, json={**frames, "options": dict(options or {})})
        files = {"file": (frames.name, frames.read_bytes())}
        return self._answer("POST", path, files=files, data={"options": json.dumps(options or {})})

    def _json(self, method: str, path: str, **asked: Any) -> Content:
        return dict(self._answer(method, path, **asked).json())

    def _answer(self, method: str, path: str, **asked: Any) -> requests.Response:
        url = f"{self.url}/api/v1/{path}"
        try:
            answer = self._session.request(method, url, timeout=self._timeout_s, **asked)
        except (requests.RequestException, ValueError) as error:
            raise ServiceError(
                f"no answer ({str(error)[:200]})",
                where=self.url,
                hint="is 'starcat serve' running there?",
            ) from error
        if answer.ok:
            return answer
        with closing(answer):
            try:
                problem = dict(answer.json())
            except ValueError:
                problem = {"detail": f"{url}: answered {answer.status_code} {answer.reason}"}
            raise _error_of(problem, answer.status_code)


def _receive(answer: requests.Response, path: Path) -> str:
    """Write an answer to a file, and return its digest."""
    digest = hashlib.sha256()
    try:
        with path.open("wb") as file:
            for chunk in answer.iter_content(CHUNK_BYTES):
                digest.update(chunk)
                file.write(chunk)
    except requests.RequestException as error:
        path.unlink(missing_ok=True)
        raise ServiceError(
            f"broke off ({str(error)[:200]})", where=answer.url, hint="try again"
        ) from error
    return digest.hexdigest()


def _error_of(problem: Mapping[str, Any], status: int | None) -> Exception:
    words = str(problem.get("detail", "no words"))
    error = error_from_fields({"kind": "", "problem": words, **problem})
    return error or ServiceError(words, exit_code=int(problem.get("code", 1)), status=status)
