"""Splitting: one archive file in, its stars out as runs and its rejected records as a table."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from starcat.catalog.ingest import count_by_reason
from starcat.catalog.parts import FileReading, IngestOptions, Part, merged, parse_block, read_files
from starcat.catalog.source import data_source
from starcat.catalog.source_files import InputFile
from starcat.catalog.verdict import Reason
from starcat.storage.atomic import placed
from starcat.storage.digests import file_sha256
from starcat.storage.schema import product_schema
from starcat.store.ledger import Digests, digests_of
from starcat.store.pixels import runs_of
from starcat.store.runs import HISTOGRAM_ORDER, Run, write_run


@dataclass(frozen=True)
class Split:
    """What is asked of a worker that splits a file.

    Attributes
    ----------
    number : int
        Number of the file among the inputs.
    file : InputFile
        The file.
    how : Reading
        Which catalog, band, epoch and limit.
    order : int
        Order of the coarse pixels of the runs.
    run_rows : int
        Stars of a run: what is held in memory.
    runs, rejected : Path
        Folders for the runs, and for the rejected records.
    """

    number: int
    file: InputFile
    how: IngestOptions
    order: int
    run_rows: int
    runs: Path
    rejected: Path

    @property
    def name(self) -> str:
        """What its files are called."""
        return f"file-{self.number:05}"


@dataclass
class _Written:
    """What has been written of a file so far."""

    asked: Split
    runs: list[Run] = field(default_factory=list)
    pixels: list[Any] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    writer: pq.ParquetWriter | None = None
    closing: ExitStack = field(default_factory=ExitStack)

    def stars(self, stars: pa.Table) -> None:
        """Write a run, and count its stars by pixel."""
        name = f"{self.asked.name}-{len(self.runs):04}"
        run, pixels = write_run(stars, self.asked.order, self.asked.runs, name)
        self.runs.append(run)
        fine, _, counts = runs_of(pixels, HISTOGRAM_ORDER)
        self.pixels.append((fine, counts))
        self.files += [run.stars, run.places]

    def rejected(self, rejected: pa.Table) -> None:
        """Append to the file's rejected records, in the order of their lines."""
        path = self.asked.rejected / f"{self.asked.name}.parquet"
        if self.writer is None:
            schema = product_schema("rejected").arrow_schema
            partial = self.closing.enter_context(placed(path))
            writer = pq.ParquetWriter(partial, schema, compression="zstd", compression_level=1)
            self.writer = self.closing.enter_context(writer)
            self.files.append(path)
        self.writer.write_table(rejected.sort_by("source_line"))

    def index(self) -> Path:
        """Write what the runs hold: batches, buckets and counts by pixel."""
        path = self.asked.runs / f"{self.asked.name}.npz"
        pixels = np.concatenate([found for found, _ in self.pixels] or [np.empty(0, np.int64)])
        counts = np.concatenate([count for _, count in self.pixels] or [np.empty(0, np.int64)])
        fine, place = np.unique(pixels, return_inverse=True)
        arrays = {
            "pixels": fine,
            "counts": np.bincount(place, counts, len(fine)).astype(np.int64),
        }
        for k, run in enumerate(self.runs):
            arrays |= {f"batches{k}": run.pixels, f"rows{k}": run.rows, f"buckets{k}": run.buckets}
        with placed(path) as partial, partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        self.files.append(path)
        return path


def split(asked: Split) -> tuple[dict[str, Any], Digests]:
    """Split a file."""
    (asked.rejected / f"{asked.name}.parquet").unlink(missing_ok=True)
    written = _Written(asked)
    reading = FileReading(asked.file, asked.number, data_source(asked.how.source_name))
    counts: dict[str, int] = {}
    parse = partial(parse_block, options=asked.how)
    with written.closing:
        for _, parts in read_files([reading], parse):
            for part in merged(_counted(parts, counts), asked.run_rows):
                if len(part.stars):
                    written.stars(part.stars)
                if len(part.rejected):
                    written.rejected(part.rejected)
    kept = sum(int(run.rows.sum()) for run in written.runs)
    facts = reading.facts
    result = {
        "file": {
            "name": facts.name,
            "sha256": facts.sha256,
            "bytes": facts.bytes,
            "rows": facts.rows,
        },
        "kept": kept,
        "rejected": {r.name: counts[r.name] for r in Reason if counts.get(r.name)},
        "problems": list(reading.named_problems),
        "runs": len(written.runs),
    }
    written.index()
    return result, digests_of(written.files)


def is_unchanged(asked: Split, result: dict[str, Any]) -> bool:
    """Return whether a file is still what it was when it was split."""
    return bool(file_sha256(asked.file.path) == result["file"]["sha256"])


def _counted(parts: Iterable[Part], counts: dict[str, int]) -> Iterator[Part]:
    """Count rejected records by reason as they come."""
    for part in parts:
        for name, count in count_by_reason(part.rejected, part.counted).items():
            counts[name] = counts.get(name, 0) + count
        yield part
