"""Archive files of any size to a catalog store: split, plan, finish, describe.

Splitting reads each file once and writes its stars as runs. The counts of stars decide on the
partitions, and the numbers of the stars on repeated records. Finishing writes a partition from its
share of all runs. None of the steps holds more than a run or a partition in memory, and each is
many tasks that depend on nothing but their input, for any number of workers, of this machine or
of a cluster; the order in which they are done leaves no trace in what they write.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from starcat.catalog.ingest import ingest_options
from starcat.catalog.parts import NAMED_PROBLEMS, IngestOptions
from starcat.catalog.source import data_source
from starcat.catalog.source_files import FileFacts, InputFile, SourceFiles
from starcat.errors import OutputError
from starcat.progress import Progress, no_progress
from starcat.storage.atomic import Outcome, move_into_place, remove_partial, writing
from starcat.storage.digests import file_sha256
from starcat.store.account import Written, describe_store, make_manifest
from starcat.store.cluster import cluster, run_tasks, versions
from starcat.store.finish import Finish, Margin, border_path, finish
from starcat.store.finish import write_margin as make_margin
from starcat.store.index import find_repeated, read_runs, write_index
from starcat.store.layout import REJECTED, REPEATED
from starcat.store.ledger import RESUME_ADVICE, Job, Work
from starcat.store.options import StoreOptions, rows_of_a_run
from starcat.store.pixels import MAX_ORDER, Pixel, border_of
from starcat.store.plan import partition_pixels, spill_order
from starcat.store.runs import BUCKETS, HISTOGRAM_ORDER
from starcat.store.split import Split, is_unchanged, split

if TYPE_CHECKING:
    from distributed import Client

Bordering = dict[Pixel, tuple[Pixel, ...]]
"""For each partition those whose margins reach into it."""

_SMALL_BYTES = 50 << 20
"""Inputs below this are read before worker processes would have started."""

_BYTES_A_RECORD = 40
"""A compressed record is no shorter than about this: it gives an upper guess of the rows."""


@dataclass(frozen=True)
class Stored:
    """A catalog store that was made.

    Attributes
    ----------
    folder : Path
        Where it is.
    outcome : {"written", "unchanged", "replaced"}
        What happened to the folder.
    manifest : dict
        The content of its ``store.json``.
    problems, notes : tuple of str
        The first malformed records, and what a user should know of the inputs.
    """

    folder: Path
    outcome: Outcome
    manifest: dict[str, Any]
    problems: tuple[str, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Ingest:
    """A run that makes a store."""

    work: Work
    name: str
    files: SourceFiles
    how: IngestOptions
    options: StoreOptions
    client: Client
    progress: Progress

    @property
    def store(self) -> Path:
        return self.work / "store"

    @property
    def catalog(self) -> Path:
        return self.store / self.name

    @property
    def margin(self) -> Path:
        return self.store / f"{self.name}_margin"

    @property
    def margin_rad(self) -> float:
        return float(np.radians(self.options.margin_arcsec / 3600.0))

    def run(
        self, jobs: Sequence[Job], stage: str, sizes: Sequence[int], total: int | None = None
    ) -> list[dict[str, Any]]:
        """Do tasks and say how far they are, in rows.

        Where the rows in all are not known, they are guessed from those of the tasks that are done.
        """
        done, rows = 0, 0

        def report(number: int, result: dict[str, Any]) -> None:
            nonlocal done, rows
            done += sizes[number]
            rows += result["file"]["rows"] if "file" in result else result["rows"]
            self.progress(stage, rows, total if total is not None else rows * sum(sizes) // done)

        return run_tasks(self.client, Job.run, jobs, report)


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
    how = ingest_options(source_name, band, epoch_jyear, read_limit_mag)
    files = SourceFiles.find(data_source(source_name), paths)
    rows_of_a_run(options)
    _check_output(output, options)
    work = Work.of(output)
    work.begin(_all_options(files.files, how, options), resume=options.resume)
    is_small = sum(files.sizes) < _SMALL_BYTES
    with cluster(options.workers, options.scheduler, is_small=is_small) as client:
        run = _Ingest(work, output.name, files, how, options, client, progress)
        with writing(output.absolute().parent, RESUME_ADVICE):
            manifest, problems = _make(run)
    progress("store", 0, None)
    remove_partial(run.store)
    with writing(output.absolute().parent, RESUME_ADVICE):
        outcome = move_into_place(run.store, output.absolute(), replace=options.replace)
    shutil.rmtree(work.folder, ignore_errors=True)
    return Stored(output, outcome, manifest, problems, tuple(manifest["notes"]))


def _check_output(output: Path, options: StoreOptions) -> None:
    if output.exists() and not (options.replace or options.resume):
        raise OutputError(
            f"{output} already exists; choose another --output, or pass --replace", path=output
        )


def _all_options(
    files: Sequence[InputFile], how: IngestOptions, options: StoreOptions
) -> dict[str, Any]:
    """Return all that the bytes of a store depend on."""
    return {
        "source": how.source_name,
        "band": how.band,
        "epoch_jyear": how.epoch_jyear,
        "read_limit_mag": how.read_limit_mag,
        "inputs": [str(file.path.absolute()) for file in files],
        "max_partition_rows": options.max_partition_rows,
        "margin_arcsec": options.margin_arcsec,
        "versions": versions(),
    }


def _make(run: _Ingest) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Go through all steps, in the hidden folder."""
    for folder in (run.store / REJECTED, run.work / "runs"):
        folder.mkdir(parents=True, exist_ok=True)
    order = _order(run.files.files)
    parts = _split_all(run, order)
    facts = [FileFacts(**part["file"]) for part in parts]
    run.files.check_contents(facts)
    content = _begin_partitions(run, facts)
    indexes = [run.work / f"runs/file-{number:05}.npz" for number in range(len(run.files.files))]
    runs = [
        one
        for path, part in zip(indexes, parts, strict=True)
        for one in read_runs(path, part["runs"])
    ]
    index = _kept(run.work / "index.npz", partial(write_index, order=order, runs=runs))
    places = _repeated(run, index)
    repeated = _kept(run.work / "repeated.npy", lambda path: np.save(path, places))
    pixels = _plan(run, indexes)
    left = int(sum(run.rows.sum() for run in runs)) - len(places)
    beside = bordering(pixels, run.margin_rad)
    finished = _finish_all(run, beside, index, repeated, left, content)
    margins = _margins_all(run, beside, finished, content)
    partitions = list(zip(pixels, finished, strict=True))
    written = Written(parts, len(places), partitions, margins)
    manifest = make_manifest(run.name, run.how, written, run.files.notes)
    describe_store(run.store, run.name, manifest, written, run.options)
    problems = tuple(problem for part in parts for problem in part["problems"])
    return manifest, problems[:NAMED_PROBLEMS]


def _order(files: Sequence[InputFile]) -> int:
    """Return the order of the coarse pixels, by the size of the inputs."""
    return spill_order(sum(file.path.stat().st_size for file in files) // _BYTES_A_RECORD)


def _split_all(run: _Ingest, order: int) -> list[dict[str, Any]]:
    rows = rows_of_a_run(run.options)
    jobs = []
    for number, file in enumerate(run.files.files):
        asked = Split(number, file, run.how, order, rows, run.work / "runs", run.store / REJECTED)
        jobs.append(Job(run.work, asked.name, split, asked, is_unchanged))
    sizes = [file.path.stat().st_size for file in run.files.files]
    return run.run(jobs, f"rows {run.how.source_name}", sizes)


def _kept(path: Path, write: Callable[[Path], None]) -> Path:
    """Write a file and give it a name with its digest: workers read each such file but once."""
    write(path)
    named = path.with_stem(f"{path.stem}-{file_sha256(path)[:16]}")
    path.replace(named)
    return named


def _begin_partitions(run: _Ingest, facts: Sequence[FileFacts]) -> str:
    """Return a name for the content of the inputs, and remove what was made of another."""
    names = " ".join(fact.sha256 for fact in facts)
    content = hashlib.sha256(names.encode()).hexdigest()[:12]
    note = run.work / "content"
    if not note.is_file() or note.read_text() != content:
        for folder in (run.catalog, run.margin, run.store / REPEATED, run.work / "borders"):
            shutil.rmtree(folder, ignore_errors=True)
        note.write_text(content)
    for folder in (run.catalog, run.work / "borders"):
        folder.mkdir(exist_ok=True)
    return content


def _repeated(run: _Ingest, index: Path) -> NDArray[np.int64]:
    """Return the records of stars that were read before."""
    found = run_tasks(run.client, find_repeated, [(index, bucket) for bucket in range(BUCKETS)])
    return np.sort(np.concatenate(found))


def _plan(run: _Ingest, indexes: Sequence[Path]) -> tuple[Pixel, ...]:
    counts = np.zeros(12 * 4**HISTOGRAM_ORDER, dtype=np.int64)
    for path in indexes:
        with np.load(path) as held:
            counts[held["pixels"]] += held["counts"]
    pixels = np.flatnonzero(counts)
    most = run.options.max_partition_rows
    return partition_pixels(pixels, counts[pixels], HISTOGRAM_ORDER, most, run.name)


def _finish_all(
    run: _Ingest, beside: Bordering, index: Path, repeated: Path, rows: int, content: str
) -> list[dict[str, Any]]:
    jobs = []
    for pixel, others in beside.items():
        asked = Finish(
            pixel,
            others,
            run.margin_rad,
            index,
            repeated,
            run.catalog,
            run.work / "borders",
            run.store,
            is_alone=rows == 1,
        )
        name = f"finish-{content}-{pixel.order}-{pixel.number}"
        jobs.append(Job(run.work, name, finish, asked))
    return run.run(jobs, "rows by partition", [1] * len(jobs), rows)


def bordering(pixels: Sequence[Pixel], margin_rad: float) -> Bordering:
    """Return for each partition those whose margins reach into it."""
    firsts = np.array([pixel.first for pixel in pixels])
    ends = np.array([pixel.end for pixel in pixels])
    found: dict[Pixel, list[Pixel]] = {pixel: [] for pixel in pixels}
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
                found[pixels[k]].append(pixel)
    return {pixel: tuple(others) for pixel, others in found.items()}


def _margins_all(
    run: _Ingest, beside: Bordering, finished: Sequence[dict[str, Any]], content: str
) -> list[tuple[Pixel, dict[str, Any]]]:
    """Write the margins, and return those that have stars."""
    has_stars = {pixel for pixel, facts in zip(beside, finished, strict=True) if facts["rows"]}
    batches: dict[Pixel, list[tuple[Path, int]]] = {pixel: [] for pixel in beside}
    for pixel, others in beside.items():
        for number, other in enumerate(others if pixel in has_stars else ()):
            batches[other].append((border_path(run.work / "borders", pixel), number))
    jobs = []
    asked_of = [pixel for pixel in beside if batches[pixel] and pixel in has_stars]
    for pixel in asked_of:
        asked = Margin(pixel, tuple(batches[pixel]), run.margin)
        name = f"margin-{content}-{pixel.order}-{pixel.number}"
        jobs.append(Job(run.work, name, make_margin, asked))
    run.progress("margins", 0, None)
    results = run_tasks(run.client, Job.run, jobs)
    made = zip(asked_of, results, strict=True)
    return [(pixel, facts) for pixel, facts in made if facts["rows"]]
