"""Jobs on a Dask cluster: one task per job, which does on its worker the work of a slot here.

A worker takes a job if its own catalogs and its own starcat give the same key. It reports progress
as events of the cluster, and returns its result as one archive, which is checked before it is moved
to its place: the result is taken once, however often Dask runs a task. Stores are split further:
their process runs here, and the workers read the pieces.
"""

from __future__ import annotations

import logging
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path, PurePosixPath
from queue import Empty, SimpleQueue
from tarfile import TarError
from tarfile import open as open_tar
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from starcat.catalog.store import dask_cluster
from starcat.database import check_database
from starcat.errors import ProductError, SourceError
from starcat.pipeline.specs import spec_from_dict
from starcat.storage import READ_ONLY, sync_to_disk
from starcat_service.jobs.job import Attempt, Job, Outcome, failed, interrupt
from starcat_service.jobs.keys import build_key, ingest_key
from starcat_service.jobs.runner import (
    CANCELLED,
    STOPPED,
    TICK_S,
    Processes,
    limit_exceeded,
    time_exceeded,
)
from starcat_service.jobs.work import Order, order_of, place_database, threads_of
from starcat_service.paths import ServicePaths
from starcat_service.records import Records
from starcat_service.security.request_limits import disk_shortage

if TYPE_CHECKING:
    from distributed import Client, Future, Worker

    from starcat_service.service import Service

TOPIC = "starcat-jobs"
"""Topic of the workers' messages about all jobs; each message has the key of its task."""

HEARTBEAT_S = 1.0
"""Longest time between two messages of a worker about a job, seconds."""

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ClusterResult:
    """What a task gives back."""

    worker: str  # its address
    outcome: Outcome | None  # None if the worker cannot do the job
    refusal: str = ""  # reason why not
    archive: bytes = b""  # results: folders of a service, packed by `pack`
    stderr: bytes = b""  # error output of the process


class ClusterJobs:
    """The cluster as used by the slots of a service: connected when the first job waits."""

    def __init__(
        self,
        service: Service,
        run_here: Callable[[Attempt], Outcome],
        reason_to_end: Callable[[Attempt], Outcome | None],
    ) -> None:
        self._service = service
        self._run_here, self._reason_to_end = run_here, reason_to_end
        self.problem: str | None = None
        self._client: Client | None = None
        self._closing = ExitStack()
        self._lock = threading.Lock()
        self._inboxes: dict[str, SimpleQueue[dict[str, Any]]] = {}

    def is_ready(self) -> bool:
        """Connect if necessary; False if the cluster does not answer, and jobs have to wait."""
        scheduler = self._service.settings.scheduler
        with self._lock:
            try:
                if self._client is None or self._client.status != "running":
                    self._closing.close()
                    self._client = self._closing.enter_context(dask_cluster(scheduler=scheduler))
                    self._client.subscribe_topic(TOPIC, self._receive)
                self.problem = None if self._client.nthreads() else "it has no workers"
            except Exception as error:  # the workers and the library can raise anything
                self.problem = f"{type(error).__name__}: {error}"
            if self.problem is not None:
                _logger.warning("jobs wait for the cluster %s: %s", scheduler, self.problem)
            return self.problem is None

    def close(self) -> None:
        """Disconnect."""
        with self._lock, suppress(Exception):
            self._closing.close()

    def run(self, attempt: Attempt) -> Outcome:
        """Have the cluster do a job."""
        job = attempt.job
        if job.kind == "photographs" or job.request.get("to") == "hats":
            return self._run_here(attempt)
        short = disk_shortage(self._service.settings)
        if short is not None:
            return failed("Insufficient storage", 507, short)
        unfit: dict[str, str] = {}
        while True:
            result = self._result(attempt, unfit)
            if isinstance(result, Outcome):
                return result
            if result.outcome is not None:
                return self._taken(job, result, result.outcome)
            unfit[result.worker] = result.refusal
            attempt.log("warning", f"{result.worker}: {result.refusal}")

    def _result(self, attempt: Attempt, unfit: dict[str, str]) -> ClusterResult | Outcome:
        """Return the result of a job's task, or how the attempt ends without one."""
        from distributed import KilledWorker

        client, job = self._client, attempt.job
        if client is None:
            return STOPPED
        fit = sorted(set(client.nthreads()) - set(unfit)) if unfit else None
        if fit == []:
            detail = f"no worker of the cluster can do it: {'; '.join(unfit.values())}"
            return failed("No worker", 404, detail)
        key = f"starcat-{job.id}-{job.attempt}-{len(unfit)}"
        self._inboxes[key] = SimpleQueue()
        order = order_of(job, self._service.settings, root="")
        future = client.submit(
            do_task,
            order,
            self._service.settings.job_time_s,
            self._database(client, job),
            key=key,
            pure=False,
            workers=fit,
        )
        try:
            ended = self._follow(attempt, future)
            if ended is not None:
                return ended
            result: ClusterResult = future.result()
        except KilledWorker as error:
            detail = f"workers died again and again over it ({error}); give them more memory"
            return failed("Workers died", 500, detail)
        except Exception as error:
            _logger.exception("job %s: its task failed", job.id)
            detail = f"its task failed ({type(error).__name__}); see the log of the server"
            return failed("Task failed", 500, detail)
        finally:
            future.cancel(force=True)
            del self._inboxes[key]
        return result

    def _database(self, client: Client, job: Job) -> Any:
        """Send the database that a job evaluates, if there is one."""
        if job.kind != "evaluate":
            return None
        paths, database = self._service.paths, str(job.request["database"])
        archive = pack(paths.root, paths.database(database))
        return client.scatter(archive, hash=False)

    def _receive(self, event: tuple[float, dict[str, Any]]) -> None:
        _, message = event
        inbox = self._inboxes.get(message["task"])
        if inbox is not None:
            inbox.put(message)

    def _follow(self, attempt: Attempt, future: Future[ClusterResult]) -> Outcome | None:
        """Record the worker's messages until its task ends; return an outcome if it must end."""
        inbox, heard_s = self._inboxes[str(future.key)], None
        silence_s = self._service.settings.worker_silence_s
        while not (future.done() and inbox.empty()):
            with suppress(Empty):
                attempt.report(inbox.get(timeout=TICK_S))
                heard_s = time.monotonic()
            ended = self._reason_to_end(attempt)
            if ended is not None:
                return ended
            if heard_s is not None and time.monotonic() - heard_s > silence_s:
                return self._lost(attempt, f"its worker was silent for {silence_s:g} s")
        if future.status in ("cancelled", "lost"):
            return self._lost(attempt, "the cluster lost it")
        return None

    def _lost(self, attempt: Attempt, why: str) -> Outcome:
        """Queue a job again, unless that happened too often."""
        _logger.warning("job %s, attempt %d: %s", attempt.job.id, attempt.job.attempt, why)
        interrupt(self._service.records, attempt.job)
        return STOPPED  # this outcome is not recorded any more

    def _taken(self, job: Job, result: ClusterResult, outcome: Outcome) -> Outcome:
        """Move the results of a worker to their place."""
        paths = self._service.paths
        work = paths.job_work(job.id)
        work.mkdir(parents=True, exist_ok=True)
        try:
            paths.job_stderr(job.id).write_bytes(result.stderr)
            full = self._service.quota.database_excess(job.owner, len(result.archive))
            if full is not None and result.archive:
                return limit_exceeded(full)
            store_result(result.archive, job, ServicePaths(work), paths)
        except (ProductError, TarError, OSError) as error:
            detail = f"what {result.worker} has made cannot be taken: {error}"
            return failed("Damaged", 422, detail)
        finally:
            shutil.rmtree(work, ignore_errors=True)
        return outcome


def pack(root: Path, *folders: Path) -> bytes:
    """Return folders below another as a tar archive."""
    data = BytesIO()
    with open_tar(fileobj=data, mode="w") as tar:
        for folder in folders:
            tar.add(folder, folder.relative_to(root).as_posix())
    return data.getvalue()


def unpack(archive: bytes, root: Path) -> None:
    """Unpack an archive of folders and plain files, all of them below its root."""
    with open_tar(fileobj=BytesIO(archive)) as tar:
        for member in tar:
            path = PurePosixPath(member.name)
            data = tar.extractfile(member) if member.isfile() else None
            if path.is_absolute() or ".." in path.parts or not (data or member.isdir()):
                raise TarError(f"{member.name!r} is not a plain file below the archive's root")
            target = root / path
            (target.parent if data else target).mkdir(parents=True, exist_ok=True)
            if data:
                target.write_bytes(data.read())


def store_result(archive: bytes, job: Job, unpacked: ServicePaths, paths: ServicePaths) -> None:
    """Unpack and check the result of a worker for a job, and move it to its place."""
    if not archive:
        return
    unpack(archive, unpacked.root)
    if job.kind == "build":
        spec, folder = job.request["spec"], unpacked.database(job.key[:16])
        database = check_database(folder / f"{spec['name']}-{spec['version']}")
        if database.manifest["spec"] != spec:
            raise ProductError("the database was built by another spec")
        for path in database.folder.iterdir():
            path.chmod(READ_ONLY)
        place_database(folder, paths.database(job.key[:16]))
        return
    name = f"{job.request['source']}-{job.key[:16]}"  # after its rejected records
    for path in sorted(unpacked.catalogs.iterdir(), key=lambda path: path.stem == name):
        path.replace(paths.catalogs / path.name)
    sync_to_disk(paths.catalogs)


def do_task(order: Order, job_time_s: float, database: bytes | None) -> ClusterResult:
    """Do a job on a worker of the cluster."""
    from distributed import get_worker

    worker = get_worker()
    home = Path(worker.local_directory)
    try:
        refusal = _refusal(order, home)
    except SourceError as error:
        refusal = str(error)
    if refusal:
        return ClusterResult(worker.address, None, refusal)
    with TemporaryDirectory(prefix="starcat-", dir=home) as root:
        paths = ServicePaths(Path(root))
        paths.make()
        if database is not None:
            unpack(database, paths.root)
        order = replace(order, root=root, threads=threads_of(worker.state.nthreads))
        outcome = _followed(worker, order, job_time_s)
        folders = {"build": (paths.databases,), "ingest": (paths.catalogs,)}.get(order.kind, ())
        archive = pack(paths.root, *folders) if folders and outcome.state == "done" else b""
        stderr = paths.job_stderr(order.job_id).read_bytes()
    return ClusterResult(worker.address, outcome, "", archive, stderr)


def _refusal(order: Order, home: Path) -> str:
    """Return why a worker cannot do a job: its catalogs or its starcat give another key."""
    records = Records(home / "starcat-digests.sqlite")
    try:
        if order.kind == "build":
            key = build_key(records, spec_from_dict(dict(order.request["spec"]), "spec"))
        elif order.kind == "ingest":
            key = ingest_key(records, order.request)
        else:
            return ""
    finally:
        records.close()
    different = "the catalogs of this machine, or its starcat, are not the server's"
    return "" if key == order.key else different


def _followed(worker: Worker, order: Order, job_time_s: float) -> Outcome:
    task, began_s = worker.get_current_task(), time.monotonic()
    reported_s = -HEARTBEAT_S

    def report(message: dict[str, Any]) -> None:
        nonlocal reported_s
        worker.log_event(TOPIC, {**message, "task": task})
        reported_s = time.monotonic()

    def reason_to_end() -> Outcome | None:
        if time.monotonic() - reported_s >= HEARTBEAT_S:
            report({})
        state = worker.state.tasks.get(task)
        if state is None or state.state not in ("executing", "long-running"):
            return CANCELLED  # cancelled by the server, or together with the server
        return time_exceeded(began_s, job_time_s)

    report({"log": f"runs on {worker.address}", "level": "info"})
    return Processes().run(order, report, reason_to_end)
