"""What the kinds of jobs do: a function each, from a request to a result.

What a job makes is made in a folder of its own, and moved to its place in one step when it is
whole; what is there already is not made again.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from starcat.errors import TargetMissing
from starcat.progress import Progress
from starcat.service.jobs.job import Job, Kind
from starcat.service.library import Library
from starcat.service.paths import ServicePaths
from starcat.service.settings import Settings
from starcat.storage.atomic import sync

Log = Callable[[str, str], None]
"""Called with a level and a line of the log."""


@dataclass(frozen=True)
class Order:
    """What the process of a job is told to do."""

    root: str  # of the service
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
        """The folder that it makes things in."""
        return self.paths.job_work(self.job_id)


def prepare(kind: Kind) -> None:
    """Load what a kind of job needs: programs do not count as memory that a job takes."""
    for name in _NEEDS[kind]:
        import_module(name)


def do_job(order: Order, progress: Progress, log: Log) -> dict[str, Any]:
    """Do a job."""
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
    from starcat.pipeline.build import build
    from starcat.specs.reading import spec_from_dict

    spec = spec_from_dict(dict(order.request["spec"]), "spec")
    made = order.work / database_id
    built = build(
        spec,
        {},
        made,
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
        f"{clean.identified} of {clean.identifiable} clean frames were identified, "
        f"{clean.wrong} wrongly",
    )
    place_database(made, order.paths.database(database_id))
    return result


def place_database(made: Path, final: Path) -> None:
    """Give the folder of a database its name, in one step."""
    if final.is_dir():
        aside = made.with_name("aside")
        final.rename(aside)
        shutil.rmtree(aside, ignore_errors=True)
    sync(made)
    made.rename(final)
    sync(final.parent)


def _ingest(order: Order, progress: Progress, log: Log) -> dict[str, Any]:
    from starcat.catalog.source_files import locate

    asked = order.request
    source, to = str(asked["source"]), asked["to"]
    how = {name: asked[name] for name in ("band", "epoch_jyear", "read_limit_mag")}
    paths = locate(source, {})
    name = f"{source}-{order.key[:16]}" + (".parquet" if to == "parquet" else "")
    result: dict[str, Any] = {"catalog": name, "source": source}
    final = order.paths.catalogs / name
    made = order.work / name
    if to == "hats":
        from starcat.store.ingest import ingest_to_store
        from starcat.store.plan import StoreOptions

        options = StoreOptions(
            memory_bytes=order.memory_bytes, workers=order.threads, scheduler=order.scheduler
        )
        stored = ingest_to_store(source, paths, made, **how, options=options, progress=progress)
        problems, notes, rows = stored.problems, stored.notes, int(stored.manifest["kept"])
    else:
        from starcat.catalog.ingest import write_star_tables
        from starcat.catalog.verdict import rejected_path
        from starcat.store.reading import read_catalog

        read = read_catalog(source, paths, **how, workers=order.threads, progress=progress)
        write_star_tables(read, made)
        problems, notes, rows = read.problems, read.notes, len(read.stars)
        if rejected_path(made).exists():
            rejected_path(made).replace(rejected_path(final))
    for line in (*problems, *notes):
        log("warning", line)
    if made.is_dir() and final.is_dir():  # the same content: it has the same key
        shutil.rmtree(made)
    else:
        made.replace(final)
    sync(final.parent)
    return {**result, "rows": rows}


def _evaluate(order: Order, progress: Progress, log: Log) -> dict[str, Any]:
    from starcat.matcher.matcher import Matcher
    from starcat.simulation.selftest import self_test

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
    )
    return {"database": database.id, "rates": [each.as_dict() for each in rates]}


_DOES: Mapping[Kind, Callable[[Order, Progress, Log], dict[str, Any]]] = {
    "build": _build,
    "ingest": _ingest,
    "evaluate": _evaluate,
}


_NEEDS: Mapping[Kind, tuple[str, ...]] = {
    "build": ("starcat.pipeline.build", "matplotlib.backends.backend_agg"),
    "ingest": ("starcat.catalog.ingest", "starcat.store.ingest"),
    "evaluate": ("starcat.simulation.selftest",),
}


def order_of(job: Job, settings: Settings, root: str) -> Order:
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
    """Return how many threads a job may use where several run at the same time."""
    return max(1, (os.cpu_count() or 1) // max(1, workers))
