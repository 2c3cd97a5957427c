"""Cross-identification of two catalogs of any size, partition by partition.

Three passes on the workers of a cluster: counts of both catalogs, the sure pairs from which
errors are measured, and the verdicts. The results are those of `match_files` on the same stars
in order of ``star_id``, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial, reduce
from operator import add
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from starcat.errors import OutputError, ProductError
from starcat.pipeline.counterparts import model_from_spec, read_star_table, schema_with_own_names
from starcat.pipeline.match_pieces import (
    PIECE_LOAD,
    Extent,
    Job,
    extent_of_partition,
    hop_of,
    judge_piece,
    measure_piece,
    numbers_path,
    pieces_of,
    rows_path,
)
from starcat.pipeline.match_summary import Summary, Tally, median_of, summary_of
from starcat.pipeline.star_rows import opened, store_of_file
from starcat.products.match_figures import ARCSEC, Measured, figures_of
from starcat.progress import Progress, no_progress
from starcat.specs.product_sections import Crossmatch
from starcat.storage.atomic import whole_file, whole_folder
from starcat.storage.parquet import write_parts
from starcat.store.cluster import cluster, run_tasks
from starcat.store.layout import is_store, open_store
from starcat.store.pixels import Pixel

_SMALL_BYTES = 32 << 20
"""Catalogs that are done before processes would have started."""


RunTasks = Callable[..., list[Any]]
"""Calls a function with each of some items, as `starcat.store.cluster.run_tasks` does."""


def run_here(
    function: Callable[[Any], Any],
    items: Sequence[Any],
    report: Callable[[int, Any], None] | None = None,
) -> list[Any]:
    """Call a function with each of some items, in this process."""
    results = []
    for number, item in enumerate(items):
        results.append(function(item))
        if report is not None:
            report(number, results[-1])
    return results


def match_on_cluster(
    a: Path,
    b: Path,
    output: Path,
    wanted: Crossmatch,
    workers: int = 2,
    scheduler: str | None = None,
    progress: Progress = no_progress,
) -> Summary:
    """Find the counterparts of the stars of one catalog in another, on a Dask cluster."""
    is_small = _bytes_of(a) + _bytes_of(b) < _SMALL_BYTES
    with cluster(workers, scheduler, is_small=is_small) as client:
        return match_stores(a, b, output, wanted, partial(run_tasks, client), progress)


def _bytes_of(path: Path) -> int:
    if not is_store(path):
        return path.stat().st_size if path.is_file() else 0
    partitions = open_store(path).catalog.partitions
    return sum(each.stat().st_size for partition in partitions for each in partition.paths)


def match_stores(
    a: Path,
    b: Path,
    output: Path,
    wanted: Crossmatch,
    run: RunTasks = run_here,
    progress: Progress = no_progress,
    piece_load: int = PIECE_LOAD,
) -> Summary:
    """Find the counterparts of the stars of one catalog in another; neither need fit in memory."""
    if output.is_dir():
        raise OutputError(
            f"{output}: cannot be written (Is a directory); choose another output",
            path=output,
            fields=("output",),
        )
    with whole_folder(output.absolute()) as scratch:
        stores = [_as_store(path, scratch / name) for path, name in ((a, "a"), (b, "b"))]
        radius_rad = wanted.radius_arcsec * ARCSEC
        job = Job(stores[0], stores[1], scratch, radius_rad, model_from_spec(wanted))
        tasks = _Tasks(run, progress)
        (of_a, parts_a), (of_b, parts_b) = (tasks.extent(job, store) for store in stores)
        hop_rad = hop_of(of_a, of_b, radius_rad)
        job = replace(job, hop_rad=hop_rad)
        pieces = pieces_of(parts_a, parts_b, job, piece_load)
        measured = tasks.measured(job, pieces, of_a.census.stars)
        figures = figures_of(of_a.census, of_b.census, measured, radius_rad, job.model)
        job = replace(job, figures=figures)
        results = tasks("crossmatch verdicts", judge_piece, job, pieces)
        with whole_file(output) as unfinished:
            write_parts(
                _rows(job, pieces), _example([longest for _, longest in results]), unfinished
            )
        return summary_of(
            reduce(add, (tally for tally, _ in results), Tally.of_none()),
            (of_a.census.stars, of_b.census.stars),
            wanted.radius_arcsec,
            figures,
            median_of([numbers_path(job, "matched", piece) for piece in pieces])[1],
            median_of([numbers_path(job, "matched-delta", piece) for piece in pieces])[1],
        )


def _as_store(path: Path, folder: Path) -> Path:
    """Return a store; a Parquet file becomes one."""
    if is_store(path):
        return path.absolute()
    store_of_file(read_star_table(path), path, folder)
    return folder


class _Tasks:
    """Runs the passes, and tells how far they are."""

    def __init__(self, run: RunTasks, progress: Progress) -> None:
        self._run = run
        self._progress = progress

    def __call__(
        self, stage: str, function: Callable[[Job, Any], Any], job: Job, items: Sequence[Any]
    ) -> list[Any]:
        done = [0]

        def report(_: int, __: Any) -> None:
            done[0] += 1
            self._progress(stage, done[0], len(items))

        self._progress(stage, 0, len(items))
        return self._run(partial(function, job), items, report)

    def extent(self, job: Job, folder: Path) -> tuple[Extent, list[tuple[Any, int]]]:
        """Count the stars of a store, and of each partition."""
        partitions = opened(folder, job.scratch).catalog.partitions
        items = [(folder, number) for number in range(len(partitions))]
        extents: list[Extent] = self("crossmatch counts", extent_of_partition, job, items)
        parts = [
            (partition.pixel, extent.census.stars)
            for partition, extent in zip(partitions, extents, strict=True)
        ]
        return reduce(add, extents, Extent.of_none()), parts

    def measured(self, job: Job, pieces: Sequence[Pixel], stars: int) -> Measured:
        """Return what all pairs say of the two catalogs."""
        counted = self("crossmatch pairs", measure_piece, job, pieces)
        found = sum(stars for stars, _ in counted)
        if found != stars:
            raise ProductError(
                f"{job.a}: had {stars:,} stars when they were counted and {found:,} when they were "
                "matched; the store has changed meanwhile, run it again",
                path=job.a,
            )
        sure, angle = median_of([numbers_path(job, "sure", piece) for piece in pieces])
        known, delta = median_of([numbers_path(job, "sure-delta", piece) for piece in pieces])
        with_candidates = sum(count for _, count in counted)
        return Measured(
            with_candidates,
            sure,
            known,
            float("nan") if angle is None else angle,
            float("nan") if delta is None else delta,
        )


def _rows(job: Job, pieces: Sequence[Pixel]) -> Iterator[pa.Table]:
    for piece in pieces:
        path = rows_path(job, piece)
        with pq.ParquetFile(path) as file:
            yield file.read()
        path.unlink()


def _example(results: Sequence[Mapping[str, int]]) -> pa.Table:
    """Return a row with texts as long as the longest of each column."""
    schema = schema_with_own_names()
    schema = schema.remove(schema.get_field_index("star"))
    longest = {
        field.name: max((result[field.name] for result in results), default=0)
        for field in schema
        if pa.types.is_string(field.type)
    }
    blank = {name: "x" * length for name, length in longest.items()}
    fields = [(field, blank.get(field.name, 0)) for field in schema]
    return pa.Table.from_arrays(
        [pa.array([value], field.type) for field, value in fields], schema=schema
    )
