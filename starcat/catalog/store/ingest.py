"""Convert archive files of any size to a catalog store: split, plan, finish, describe.

Splitting reads each file once and writes its stars as runs. The counts of stars determine the
partitions, and the numbers of the stars identify repeated records. Finishing writes a partition
from its share of all runs. No step holds more than a run or a partition in memory. Each step
consists of many independent tasks, for any number of workers on this machine or on a cluster; the
output does not depend on the order of the tasks.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcat.catalog.ingest import ingest_options, unmoved_note
from starcat.catalog.parts import NAMED_PROBLEMS
from starcat.catalog.source import data_source, map_of
from starcat.catalog.source_files import FileFacts, SourceFiles
from starcat.catalog.store.cluster import cluster, run_tasks, versions
from starcat.catalog.store.finish import (
    border_path,
    finish,
    is_unchanged,
    split,
    split_name,
    write_margin,
)
from starcat.catalog.store.layout import MAX_ORDER, Pixel, border_of, store_files
from starcat.catalog.store.metadata import Written, describe_store, make_manifest
from starcat.catalog.store.plan import (
    StoreOptions,
    StorePlan,
    partition_pixels,
    rows_of_a_run,
    spill_order,
)
from starcat.catalog.store.runs import (
    BUCKETS,
    HISTOGRAM_ORDER,
    RESUME_ADVICE,
    Task,
    find_repeated,
    read_runs,
    write_index,
)
from starcat.errors import OutputError
from starcat.progress import Progress, no_progress
from starcat.results import entry, in_record
from starcat.storage.atomic import (
    Outcome,
    check_final,
    file_sha256,
    locked,
    move_into_place,
    remove_abandoned,
    remove_partial,
    writing,
)

if TYPE_CHECKING:
    from distributed import Client

Bordering = dict[Pixel, tuple[Pixel, ...]]
"""For each partition the partitions whose margins reach into it."""

_SMALL_BYTES = 50 << 20
"""Smaller inputs are read in this process: starting worker processes would take longer."""

_BYTES_A_RECORD = 40
"""Approximate smallest size of a compressed record; it gives an upper estimate of the rows."""


@dataclass(frozen=True)
class Stored:
    """The result of making a catalog store."""

    folder: Path = field(metadata=entry(key="store"))  # the store
    outcome: Outcome  # written, unchanged or replaced
    manifest: dict[str, Any] = field(repr=False)  # the content of its ``store.json``
    problems: tuple[str, ...]  # the first malformed records
    notes: tuple[str, ...]  # remarks on the inputs for the user

    @property
    @in_record()
    def partitions(self) -> int:
        """Number of its partitions."""
        return len(self.manifest["partitions"])

    @property
    @in_record(is_spread=True)
    def records(self) -> dict[str, Any]:
        """The catalog, its files, and its records: read, kept, and rejected by reason."""
        names = ("source", "band", "rows_read", "kept", "rejected", "files")
        return {name: self.manifest[name] for name in names}


@dataclass(frozen=True)
class _Ingest:
    """A run that makes a store."""

    plan: StorePlan
    files: SourceFiles
    client: Client
    progress: Progress

    def run(
        self, tasks: Sequence[Task], stage: str, sizes: Sequence[int], total: int | None = None
    ) -> list[dict[str, Any]]:
        """Run tasks and report their progress in rows.

        If the total number of rows is unknown, it is estimated from the finished tasks.
        """
        done, rows = 0, 0

        def report(number: int, result: dict[str, Any]) -> None:
            nonlocal done, rows
            done += sizes[number]
            rows += result["file"]["rows"] if "file" in result else result["rows"]
            self.progress(stage, rows, total if total is not None else rows * sum(sizes) // done)

        return run_tasks(self.client, Task.run, tasks, report)


def ingest_to_store(
    source_name: str,
    paths: Sequence[Path],
    output: Path,
    *,
    band: str | None = None,
    epoch_jyear: float | None = None,
    read_limit_mag: float | None = None,
    options: StoreOptions | None = None,
    progress: Progress = no_progress,
) -> Stored:
    """Read a star catalog of any size into a catalog store."""
    options = options or StoreOptions()
    reading = ingest_options(source_name, band, epoch_jyear, read_limit_mag)
    files = SourceFiles.find(data_source(source_name), paths)
    rows_of_a_run(options)
    parent = output.absolute().parent
    if parent.is_dir():
        with writing(parent, "choose another {output}"), locked(parent):
            remove_abandoned(output.absolute())
    if output.exists() and not (options.replace or options.resume):
        raise OutputError(
            f"{output} already exists",
            path=output,
            hint=("choose another {output}", "pass {replace:True}"),
        )
    listed = store_files if options.replace else None
    check_final(output, listed)
    plan = StorePlan.of(output, reading, options)
    plan.resume.begin(_all_options(plan, files), resume=options.resume)
    is_small = sum(files.sizes) < _SMALL_BYTES
    with (
        cluster(options.workers, options.scheduler, is_small=is_small) as client,
        writing(parent, RESUME_ADVICE),
    ):
        manifest, problems, notes = _make(_Ingest(plan, files, client, progress))
    progress("store", 0, None)
    remove_partial(plan.store)
    with writing(parent, RESUME_ADVICE):
        plan.resume.end()
        outcome = move_into_place(plan.store, output.absolute(), listed)
    shutil.rmtree(plan.resume.folder, ignore_errors=True)
    return Stored(output, outcome, manifest, problems, (*manifest["notes"], *notes))


def _all_options(plan: StorePlan, files: SourceFiles) -> dict[str, Any]:
    """Return all options on which the bytes of a store depend."""
    reading = plan.ingest
    return {
        "source": reading.source_name,
        "map": map_of(reading.source_name),
        "band": reading.band,
        "epoch_jyear": reading.epoch_jyear,
        "read_limit_mag": reading.read_limit_mag,
        "inputs": [str(file.path.absolute()) for file in files.files],
        "max_partition_rows": plan.options.max_partition_rows,
        "margin_arcsec": plan.options.margin_arcsec,
        "versions": versions(),
    }


def _make(run: _Ingest) -> tuple[dict[str, Any], tuple[str, ...], tuple[str, ...]]:
    """Return the manifest, the first malformed records, and remarks about the stars."""
    plan = run.plan
    for folder in (plan.rejected, plan.runs):
        folder.mkdir(parents=True, exist_ok=True)
    order = spill_order(sum(run.files.sizes) // _BYTES_A_RECORD)
    parts = _split_all(run, order)
    facts = [FileFacts(**part["file"]) for part in parts]
    run.files.check_contents(facts)
    content = _begin_partitions(plan, facts)
    indexes = [plan.runs / f"{split_name(number)}.npz" for number in range(len(parts))]
    counts = [part["runs"] for part in parts]
    runs = [run for each in map(read_runs, indexes, counts) for run in each]
    index = _kept(plan.resume / "index.npz", partial(write_index, order=order, runs=runs))
    by_bucket = run_tasks(run.client, find_repeated, [(index, bucket) for bucket in range(BUCKETS)])
    places = np.sort(np.concatenate(by_bucket))
    repeated = _kept(plan.resume / "repeated.npy", lambda path: np.save(path, places))
    pixels = _partitions(plan, indexes)
    rows_kept = sum(part["kept"] for part in parts) - len(places)
    beside = bordering(pixels, plan.margin_rad)
    finished = _finish_all(run, beside, index, repeated, rows_kept, content)
    margins = _margins_all(run, beside, finished, content)
    partitions = list(zip(pixels, finished, strict=True))
    written = Written(parts, len(places), partitions, margins)
    manifest = make_manifest(plan.name, plan.ingest, written, run.files.notes)
    describe_store(plan.store, plan.name, manifest, written, plan.options)
    problems = tuple(problem for part in parts for problem in part["problems"])
    unmoved = [facts.get("unmoved", []) for facts in finished]
    reading = plan.ingest
    notes = unmoved_note(reading.source_name, unmoved, manifest["kept"], reading.epoch_jyear)
    return manifest, problems[:NAMED_PROBLEMS], notes


def _split_all(run: _Ingest, order: int) -> list[dict[str, Any]]:
    plan = run.plan
    tasks = [
        Task(plan.resume, split_name(file.number), split, (plan, file, order), is_unchanged)
        for file in run.files.files
    ]
    return run.run(tasks, f"rows {plan.ingest.source_name}", run.files.sizes)


def _kept(path: Path, write: Callable[[Path], None]) -> Path:
    """Write a file and put its digest into its name: workers read each such file only once."""
    write(path)
    named = path.with_stem(f"{path.stem}-{file_sha256(path)[:16]}")
    path.replace(named)
    return named


def _begin_partitions(plan: StorePlan, facts: Sequence[FileFacts]) -> str:
    """Return a name for the content of the inputs, and remove files made from other content."""
    names = " ".join(fact.sha256 for fact in facts)
    content = hashlib.sha256(names.encode()).hexdigest()[:12]
    note = plan.resume / "content"
    if not note.is_file() or note.read_text() != content:
        for folder in (plan.catalog, plan.margin, plan.repeated, plan.borders):
            shutil.rmtree(folder, ignore_errors=True)
        note.write_text(content)
    for folder in (plan.catalog, plan.borders):
        folder.mkdir(exist_ok=True)
    return content


def _partitions(plan: StorePlan, indexes: Sequence[Path]) -> tuple[Pixel, ...]:
    counts = np.zeros(12 * 4**HISTOGRAM_ORDER, dtype=np.int64)
    for path in indexes:
        with np.load(path) as arrays:
            counts[arrays["pixels"]] += arrays["counts"]
    pixels = np.flatnonzero(counts)
    most = plan.options.max_partition_rows
    return partition_pixels(pixels, counts[pixels], HISTOGRAM_ORDER, most, plan.name)


def _finish_all(
    run: _Ingest, beside: Bordering, index: Path, repeated: Path, rows: int, content: str
) -> list[dict[str, Any]]:
    tasks = [
        _task_of(run, "finish", content, pixel, finish, (others, index, repeated, rows == 1))
        for pixel, others in beside.items()
    ]
    return run.run(tasks, "rows by partition", [1] * len(tasks), rows)


def _task_of(
    run: _Ingest,
    step: str,
    content: str,
    pixel: Pixel,
    function: Callable[..., tuple[dict[str, Any], list[Path]]],
    arguments: tuple[Any, ...],
) -> Task:
    name = f"{step}-{content}-{pixel.order}-{pixel.number}"
    return Task(run.plan.resume, name, function, (run.plan, pixel, *arguments))


def bordering(pixels: Sequence[Pixel], margin_rad: float) -> Bordering:
    """Return for each partition the partitions whose margins reach into it."""
    firsts = np.array([pixel.first for pixel in pixels])
    ends = np.array([pixel.end for pixel in pixels])
    reached_by: dict[Pixel, list[Pixel]] = {pixel: [] for pixel in pixels}
    for pixel in pixels:
        order, border = border_of(pixel, margin_rad)
        shift = 2 * (MAX_ORDER - order)
        first = np.searchsorted(ends, border << shift, side="right")
        last = np.searchsorted(firsts, (border + 1) << shift)
        reached = {
            k for a, b in zip(first.tolist(), last.tolist(), strict=True) for k in range(a, b)
        }
        for k in sorted(reached):
            if pixels[k] != pixel:
                reached_by[pixels[k]].append(pixel)
    return {pixel: tuple(others) for pixel, others in reached_by.items()}


def _margins_all(
    run: _Ingest, beside: Bordering, finished: Sequence[dict[str, Any]], content: str
) -> list[tuple[Pixel, dict[str, Any]]]:
    has_stars = {pixel for pixel, facts in zip(beside, finished, strict=True) if facts["rows"]}
    batches: dict[Pixel, list[tuple[Path, int]]] = {pixel: [] for pixel in beside}
    for pixel, others in beside.items():
        for number, other in enumerate(others if pixel in has_stars else ()):
            batches[other].append((border_path(run.plan, pixel), number))
    with_margin = [pixel for pixel in beside if batches[pixel] and pixel in has_stars]
    tasks = [
        _task_of(run, "margin", content, pixel, write_margin, (tuple(batches[pixel]),))
        for pixel in with_margin
    ]
    run.progress("margins", 0, None)
    results = run_tasks(run.client, Task.run, tasks)
    return [
        (pixel, facts) for pixel, facts in zip(with_margin, results, strict=True) if facts["rows"]
    ]
