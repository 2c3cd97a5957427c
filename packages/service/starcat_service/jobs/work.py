"""The process of one job: it reads an order, reports its progress, and leaves a result or an error.

It sends messages of `starcat_service.sandbox`: a stage, a line of the log, and at the end the
result or the error. It ends when its input does, which happens when the server that started it is
gone.

There is one function per kind of job, from a request to a result. A job works in a folder of its
own and moves the complete result to its place in one step; results that exist already are not made
again.
"""

from __future__ import annotations

import ctypes
import logging
import os
import shutil
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from starcat.errors import StarcatError, TargetMissing
from starcat.progress import Progress
from starcat.results import to_dict
from starcat.storage import locked, replace_folder, sync_to_disk
from starcat_service.jobs.job import Job, Kind, Outcome, failed
from starcat_service.library import Library
from starcat_service.paths import ServicePaths
from starcat_service.sandbox.channel import Channel
from starcat_service.sandbox.confinement import limit_memory
from starcat_service.sandbox.messages import DONE, ERROR, PROGRESS
from starcat_service.settings import ServiceSettings

NICENESS = 10
"""Requests come before jobs."""

STAGES_A_SECOND = 4.0

MAX_LINE = 2000
"""Characters of a line of the log that are kept."""

MAX_CURVE_FRAMES = 200
"""Frames per point of the curves that an evaluation draws."""

NO_THREAD = "can't start new thread"
"""Message of Python if there is no memory for the stack of a thread."""

_SET_PARENT_DEATH_SIGNAL = 1

Log = Callable[[str, str], None]
"""Called with a level and a line of the log."""


@dataclass(frozen=True)
class Order:
    """The order that the process of a job receives."""

    root: str  # root of the service
    job_id: str
    kind: Kind
    key: str
    request: Mapping[str, Any]
    memory_bytes: int
    scheduler: str | None  # address of a Dask cluster, for stores
    threads: int

    @property
    def paths(self) -> ServicePaths:
        """Files and folders of the service."""
        return ServicePaths(Path(self.root))

    @property
    def work(self) -> Path:
        """The folder in which it works."""
        return self.paths.job_work(self.job_id)


def prepare_worker(kind: Kind) -> None:
    """Load the modules of a kind of job: programs do not count as memory that a job takes."""
    for name in _NEEDS[kind]:
        import_module(name)


def _do_job(order: Order, progress: Progress, log: Log) -> dict[str, Any]:
    shutil.rmtree(order.work, ignore_errors=True)
    order.work.mkdir(parents=True)
    return _DOES[order.kind](order, progress, log)


def _build(order: Order, progress: Progress, log: Log) -> dict[str, Any]:
    database_id = order.key[:16]
    library = Library(order.paths)
    result = {"database": database_id}
    try:
        library.database(database_id)
    except TargetMissing:
        pass
    else:
        log("info", f"database {database_id} is there already")
        return result
    from starcat import build
    from starcat.pipeline.specs import spec_from_dict

    spec = spec_from_dict(dict(order.request["spec"]), "spec")
    folder = order.work / database_id
    built = build(
        spec,
        folder,
        workers=order.threads,
        progress=progress,
        announce=lambda cost: log("info", cost.in_words),
        max_memory_bytes=order.memory_bytes,
    )
    for problem in built.problems:
        log("warning", problem)
    for warning in built.warnings:
        log("warning", warning)
    clean = built.rates[0]
    log(
        "info",
        f"{clean.identified} of {clean.frames} clean frames were identified, {clean.wrong} wrongly",
    )
    place_database(folder, order.paths.database(database_id))
    return result


def place_database(folder: Path, final: Path) -> None:
    """Give the folder of a database its name, in one step."""
    sync_to_disk(folder)
    if final.is_dir():
        replace_folder(folder, final)
        return
    folder.rename(final)
    sync_to_disk(final.parent)


def _ingest(order: Order, progress: Progress, log: Log) -> dict[str, Any]:
    from starcat.catalog import locate

    asked = order.request
    source, to = str(asked["source"]), asked["to"]
    how = {name: asked[name] for name in ("band", "epoch_jyear", "read_limit_mag")}
    paths = locate(source, {})
    name = f"{source}-{order.key[:16]}" + (".parquet" if to == "parquet" else "")
    result: dict[str, Any] = {"catalog": name, "source": source}
    final = order.paths.catalogs / name
    output = order.work / name
    if to == "hats":
        from starcat.catalog.store import StoreOptions, ingest_to_store

        options = StoreOptions(
            memory_bytes=order.memory_bytes, workers=order.threads, scheduler=order.scheduler
        )
        stored = ingest_to_store(source, paths, output, **how, options=options, progress=progress)
        problems, notes, rows = stored.problems, stored.notes, int(stored.manifest["kept"])
    else:
        from starcat.catalog import write_star_tables
        from starcat.catalog.stars import rejected_path
        from starcat.catalog.store import read_catalog

        read = read_catalog(source, paths, **how, workers=order.threads, progress=progress)
        write_star_tables(read, output)
        problems, notes, rows = read.problems, read.notes, len(read.stars)
        if rejected_path(output).exists():
            rejected_path(output).replace(rejected_path(final))
    for line in (*problems, *notes):
        log("warning", line)
    if output.is_dir() and final.is_dir():  # the same content: it has the same key
        shutil.rmtree(output)
    else:
        output.replace(final)
    sync_to_disk(final.parent)
    return {**result, "rows": rows}


def _evaluate(order: Order, progress: Progress, log: Log) -> dict[str, Any]:
    from starcat.matcher import Matcher
    from starcat.pipeline.simulation import part_of_database, self_test
    from starcat_lab.curves import measure_curves

    asked = order.request
    database = Library(order.paths).database(str(asked["database"]))
    noise_px = float(asked["noise_px"])
    matcher = Matcher.open(database.folder, None, tolerance_px=max(0.5, 4.0 * noise_px))
    log("info", f"{asked['frames']} frames of each kind, of {database.title}")
    rates = self_test(
        matcher,
        int(asked["frames"]),
        noise_px,
        int(asked["seed"]),
        progress,
        noise_mag=float(asked["noise_mag"]),
        part=part_of_database(database.folder),
    )
    clean = rates[0]
    log(
        "info",
        f"{clean.identified} of {clean.frames} clean pointings were identified, "
        f"{clean.wrong} wrongly",
    )
    few = max(1, min(MAX_CURVE_FRAMES, int(asked["frames"])))
    log("info", f"{few} frames for each point of the curves")
    curves = measure_curves(database.folder, order.work, few, int(asked["seed"]), progress)
    return {
        "database": database.id, "rates": [to_dict(each) for each in rates], "curves": curves
    }  # fmt: skip


def _photographs(order: Order, progress: Progress, log: Log) -> dict[str, Any]:
    from starcat.pipeline import blind_database, blind_folder

    final = blind_folder(order.paths.blind).parent
    if final.is_dir():
        log("info", "the database for photographs is there already")
    else:
        folder = blind_database(progress, order.work).parent
        shutil.rmtree(order.paths.blind, ignore_errors=True)  # of an older version
        order.paths.blind.mkdir(parents=True)
        place_database(folder, final)
    return {"folder": str(final.relative_to(order.paths.root))}


_DOES: Mapping[Kind, Callable[[Order, Progress, Log], dict[str, Any]]] = {
    "build": _build,
    "ingest": _ingest,
    "evaluate": _evaluate,
    "photographs": _photographs,
}


_NEEDS: Mapping[Kind, tuple[str, ...]] = {
    "build": ("starcat.pipeline.build", "matplotlib.backends.backend_agg"),
    "ingest": ("starcat.catalog.ingest", "starcat.catalog.store.ingest"),
    "evaluate": ("starcat.pipeline.simulation.selftest", "starcat_lab.curves"),
    "photographs": ("starcat.pipeline.blind", "matplotlib.backends.backend_agg"),
}


def order_of(job: Job, settings: ServiceSettings, root: str) -> Order:
    """Return the order of a job in a service, or in a folder of another machine."""
    return Order(
        root=root,
        job_id=job.id,
        kind=job.kind,
        key=job.key,
        request=job.request,
        memory_bytes=int(settings.job_memory_gib * 2**30),
        scheduler=settings.scheduler,
        threads=threads_of(settings.workers),
    )


def threads_of(workers: int) -> int:
    """Return how many threads a job may use if several jobs run at the same time."""
    return max(1, (os.cpu_count() or 1) // max(1, workers))


class Messages:
    """Messages of a job to the server."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._lock = threading.Lock()
        self._stage, self._at_s = "", 0.0

    def stage(self, stage: str, done: int, total: int | None) -> None:
        """Send the progress of a stage, unless it was sent a moment ago."""
        now = time.monotonic()
        is_last = total is not None and done >= total
        with self._lock:
            is_new = stage != self._stage
            if not (is_new or is_last or now - self._at_s >= 1.0 / STAGES_A_SECOND):
                return
            if is_last and not is_new and now - self._at_s < 0.05:
                return
            self._stage, self._at_s = stage, now
        content = {
            "stage": stage,
            "done": int(done),
            "total": None if total is None else int(total),
        }
        self._channel.send(PROGRESS, content)

    def log(self, level: str, text: str) -> None:
        """Write a line of the log."""
        self._channel.send(PROGRESS, {"log": text[:MAX_LINE], "level": level})


class _Lines(logging.Handler):
    """Log messages of starcat, as lines of the job's log."""

    def __init__(self, messages: Messages) -> None:
        super().__init__(logging.INFO)
        self._messages = messages

    def emit(self, record: logging.LogRecord) -> None:
        level = "info" if record.levelno < logging.WARNING else "warning"
        self._messages.log(level, record.getMessage())


def work_main() -> None:
    """Read the order, and do it."""
    _end_with_parent()
    channel = Channel()
    messages = Messages(channel)
    order = Order(**channel.receive())
    threading.Thread(target=_end_with_input, args=(channel,), daemon=True).start()
    with suppress(OSError, AttributeError):
        os.nice(NICENESS)
        # Processes that answer waiting users get a processor at once, if Linux can do that.
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    lines = _Lines(messages)
    for package in ("starcat", "starcat_lab", "starcat_service"):
        logger = logging.getLogger(package)
        logger.setLevel(logging.INFO)
        logger.addHandler(lines)
    with locked(order.paths.job_lock(order.job_id)):
        prepare_worker(order.kind)
        limit_memory(order.memory_bytes)
        try:
            channel.send(DONE, _do_job(order, messages.stage, messages.log))
        except Exception as error:
            channel.send(ERROR, _problem_of(error, order))
    sys.stderr.flush()
    os._exit(0)  # also if threads of libraries still run


def _end_with_parent() -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL, 0, 0, 0)


def _end_with_input(channel: Channel) -> None:
    """End this process, and the processes that it has started, when its input ends."""
    channel.wait_for_end()
    if hasattr(os, "killpg") and os.getpgid(0) == os.getpid():
        os.killpg(os.getpid(), signal.SIGKILL)
    os._exit(1)


def _problem_of(error: Exception, order: Order) -> dict[str, Any]:
    """Return problem details of an exception; the traceback is only for the operator."""
    from starcat.failures import failure_of
    from starcat_service.problems import ProblemDetails, parameter_of, problem_of, without_folders

    if isinstance(error, MemoryError) or NO_THREAD in str(error):
        return dict(out_of_memory(order.memory_bytes).content)
    if isinstance(error, OSError) and not isinstance(error, StarcatError):
        failure = failure_of(error, "the job", parameter_of)
        detail = without_folders(failure.message)
        problem = ProblemDetails(
            title="The system refused", status=500, detail=detail, kind=failure.kind
        )
    else:
        problem = problem_of(error)
    if problem.status == 500:
        traceback.print_exception(error)
    return problem.model_dump(exclude_none=True)


def out_of_memory(memory_bytes: int) -> Outcome:
    """Return the outcome of a job that needed more memory than it may use."""
    detail = (
        f"the job took more than the {memory_bytes / 2**30:.3g} GiB of memory that it may "
        "(job_memory_gib); ask for less, or ask the operator for more"
    )
    return failed("Out of memory", 422, detail)
