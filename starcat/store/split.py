"""Splitting: one archive file in, its stars out as runs and its rejected records as a table."""

from __future__ import annotations

from collections import Counter
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from starcat.catalog.ingest import count_by_reason
from starcat.catalog.parts import merged, parse_block, read_files
from starcat.catalog.source_files import InputFile
from starcat.stars.verdict import Reason
from starcat.storage.atomic import placed
from starcat.storage.digests import file_sha256
from starcat.storage.schema import product_schema
from starcat.store.pixels import runs_of
from starcat.store.plan import StorePlan, rows_of_a_run
from starcat.store.runs import HISTOGRAM_ORDER, Run, write_run


@dataclass
class _Written:
    """What has been written of a file so far."""

    plan: StorePlan
    name: str  # of its files
    order: int  # of the coarse pixels of runs
    kept: int = 0  # stars
    runs: list[Run] = field(default_factory=list)
    pixels: list[Any] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    writer: pq.ParquetWriter | None = None
    closing: ExitStack = field(default_factory=ExitStack)

    def stars(self, stars: pa.Table) -> None:
        """Write a run, and count its stars by pixel."""
        name = f"{self.name}-{len(self.runs):04}"
        run, pixels = write_run(stars, self.order, self.plan.runs, name)
        self.runs.append(run)
        self.kept += len(stars)
        fine, _, counts = runs_of(pixels, HISTOGRAM_ORDER)
        self.pixels.append((fine, counts))
        self.files += [run.stars, run.places]

    def rejected(self, rejected: pa.Table) -> None:
        """Append to the file's rejected records, in the order of their lines."""
        path = self.plan.rejected / f"{self.name}.parquet"
        if self.writer is None:
            schema = product_schema("rejected").arrow_schema
            partial = self.closing.enter_context(placed(path))
            writer = pq.ParquetWriter(partial, schema, compression="zstd", compression_level=1)
            self.writer = self.closing.enter_context(writer)
            self.files.append(path)
        self.writer.write_table(rejected.sort_by("source_line"))

    def index(self) -> None:
        """Write what the runs hold: batches, buckets and counts by pixel."""
        path = self.plan.runs / f"{self.name}.npz"
        pixels = np.concatenate([found for found, _ in self.pixels] or [np.empty(0, np.int64)])
        counts = np.concatenate([count for _, count in self.pixels] or [np.empty(0, np.int64)])
        fine, place = np.unique(pixels, return_inverse=True)
        arrays = {"pixels": fine, "counts": np.bincount(place, counts, len(fine)).astype(np.int64)}
        for k, run in enumerate(self.runs):
            arrays |= {f"batches{k}": run.pixels, f"buckets{k}": run.buckets}
        with placed(path) as partial, partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        self.files.append(path)


def split(plan: StorePlan, file: InputFile, order: int) -> tuple[dict[str, Any], list[Path]]:
    """Split an input into runs, which have batches by pixels of an order."""
    written = _Written(plan, split_name(file.number), order)
    (plan.rejected / f"{written.name}.parquet").unlink(missing_ok=True)
    parse = partial(parse_block, options=plan.ingest)
    counts: Counter[str] = Counter()
    with written.closing:
        reading, parts = next(read_files([file], parse))
        for part in merged(parts, rows_of_a_run(plan.options)):
            counts.update(count_by_reason(part.rejected, part.counted))
            if len(part.stars):
                written.stars(part.stars)
            if len(part.rejected):
                written.rejected(part.rejected)
    result = {
        "file": asdict(reading.facts),
        "kept": written.kept,
        "rejected": {r.name: counts[r.name] for r in Reason if counts.get(r.name)},
        "problems": list(reading.named_problems),
        "runs": len(written.runs),
    }
    written.index()
    return result, written.files


def split_name(number: int) -> str:
    """Return what the files of an input are called."""
    return f"file-{number:05}"


def is_unchanged(result: dict[str, Any], _: StorePlan, file: InputFile, __: int) -> bool:
    """Return whether a file is still what it was when it was split."""
    return bool(file_sha256(file.path) == result["file"]["sha256"])
