"""The plan of a store: its options, its folders, and the pixels of its partitions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from starcat.catalog.parts import IngestOptions
from starcat.catalog.store.layout import REJECTED, REPEATED, Pixel, Pixels
from starcat.catalog.store.runs import ResumePlan
from starcat.errors import AsWritten, ConfigError

MAX_ROWS = 500_000
"""Most stars in a partition: a worker needs about 400 MB to finish one."""

MARGIN_ARCSEC = 10.0
MEMORY_BYTES = 2 << 30

_BASE_BYTES = 260 << 20
_BYTES_A_RUN_ROW = 1_000
_BYTES_A_PARTITION_ROW = 1_000
_RUN_ROWS = (20_000, 250_000)
_ROWS_A_BATCH = 8_192
_SPILL_ORDERS = (2, 6)


@dataclass(frozen=True)
class StoreOptions:
    """Options for making a store."""

    max_partition_rows: int = MAX_ROWS  # most stars in a partition
    margin_arcsec: float = MARGIN_ARCSEC  # width of the margin of a partition
    # memory of all processes together; the bytes of the store do not depend on it
    memory_bytes: int = MEMORY_BYTES
    workers: int = 2  # processes on this machine
    scheduler: str | None = None  # address of a Dask cluster to use instead
    resume: bool = False  # continue an unfinished run
    replace: bool = False  # replace a store that differs


def rows_of_a_run(options: StoreOptions) -> int:
    """Return the number of stars in a run that the memory limit allows."""
    each = (options.memory_bytes - _BASE_BYTES) // options.workers - _BASE_BYTES
    needed = options.max_partition_rows * _BYTES_A_PARTITION_ROW
    if options.scheduler is None and each < needed:
        least = (needed + _BASE_BYTES) * options.workers + _BASE_BYTES
        raise ConfigError(
            f"it is too little for {options.workers} "
            f"worker processes and partitions of {options.max_partition_rows:,} stars, which need "
            f"{-(-least >> 20)} MiB",
            parameter="memory_bytes",
            value=AsWritten(f"{options.memory_bytes >> 20} MiB"),
            hint=("allow more", "use fewer {workers} or a smaller {max_partition_rows}"),
        )
    least, most = _RUN_ROWS
    return int(min(max(each // _BYTES_A_RUN_ROW, least), most))


@dataclass(frozen=True)
class StorePlan:
    """The data that every task of a store needs: inputs, options and output folders."""

    name: str
    ingest: IngestOptions
    options: StoreOptions
    resume: ResumePlan
    # folders: the store before its final name, and within it the HATS catalog and its margin,
    # rejected records, and records whose star was read before
    store: Path
    catalog: Path
    margin: Path
    rejected: Path
    repeated: Path
    runs: Path
    borders: Path  # folder for the stars that are in the margins of other partitions

    @classmethod
    def of(cls, output: Path, ingest: IngestOptions, options: StoreOptions) -> StorePlan:
        """Return the plan of a store with its final folder."""
        name, resume = output.name, ResumePlan.of(output)
        store = resume / "store"
        return cls(
            name,
            ingest,
            options,
            resume,
            store,
            store / name,
            store / f"{name}_margin",
            store / REJECTED,
            store / REPEATED,
            resume / "runs",
            resume / "borders",
        )

    @property
    def margin_rad(self) -> float:
        """Width of the margin of a partition."""
        return float(np.radians(self.options.margin_arcsec / 3600.0))


def partition_pixels(
    pixels: Pixels, counts: NDArray[np.int64], order: int, max_rows: int, name: str
) -> tuple[Pixel, ...]:
    """Return the largest pixels with at most the allowed number of stars that cover all stars."""
    partitions: list[Pixel] = []
    for level in range(order + 1):
        parent, first = np.unique(pixels >> 2 * (order - level), return_index=True)
        if not len(parent):
            break
        total = np.add.reduceat(counts, first)
        fits = total <= max_rows
        partitions += [Pixel(level, number) for number in parent[fits].tolist()]
        is_crowded = ~np.repeat(fits, np.diff([*first, len(pixels)]))
        pixels, counts = pixels[is_crowded], counts[is_crowded]
    if len(pixels):
        raise ConfigError(
            f"{counts.max()} stars are in one place, more than the {max_rows} that a "
            "partition may hold",
            where=name,
            hint="allow more with {max_partition_rows}",
        )
    return tuple(sorted(partitions, key=lambda pixel: pixel.first))


def spill_order(rows: int) -> int:
    """Return the order of the coarse pixels by which runs have batches."""
    least, most = _SPILL_ORDERS
    return next((k for k in range(least, most) if rows <= 12 * 4**k * _ROWS_A_BATCH), most)
