"""The plan of a store: how and where it is made, and which pixels are its partitions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from starcat.catalog.parts import IngestOptions
from starcat.errors import ConfigError
from starcat.store.layout import REJECTED, REPEATED, Pixel, Pixels
from starcat.store.runs import ResumePlan

MAX_ROWS = 500_000
"""Stars of a partition at most: a worker finishes one in some 400 MB."""

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
    """How a store is made."""

    max_partition_rows: int = MAX_ROWS  # stars that a partition may hold
    margin_arcsec: float = MARGIN_ARCSEC  # how far the margin of a partition reaches
    # memory of all processes together; the bytes of the store do not depend on it
    memory_bytes: int = MEMORY_BYTES
    workers: int = 2  # processes on this machine
    scheduler: str | None = None  # address of a Dask cluster to use instead
    resume: bool = False  # go on with an unfinished run
    replace: bool = False  # replace a store that differs


def rows_of_a_run(options: StoreOptions) -> int:
    """Return how many stars a run may have within the memory that is allowed."""
    each = (options.memory_bytes - _BASE_BYTES) // options.workers - _BASE_BYTES
    needed = options.max_partition_rows * _BYTES_A_PARTITION_ROW
    if options.scheduler is None and each < needed:
        least = (needed + _BASE_BYTES) * options.workers + _BASE_BYTES
        raise ConfigError(
            f"memory_bytes {options.memory_bytes >> 20} MiB is too little for {options.workers} "
            f"worker processes and partitions of {options.max_partition_rows:,} stars, which want "
            f"{-(-least >> 20)} MiB; allow more, or use fewer workers or a smaller "
            "max_partition_rows",
            key="memory",
            value=options.memory_bytes,
            fields=("memory_bytes", "workers", "max_partition_rows"),
        )
    least, most = _RUN_ROWS
    return int(min(max(each // _BYTES_A_RUN_ROW, least), most))


@dataclass(frozen=True)
class StorePlan:
    """What every task that makes a store knows: what is read, how, and where files go."""

    name: str
    ingest: IngestOptions
    options: StoreOptions
    resume: ResumePlan
    # folders: the store before it gets its final name, and in it the HATS catalog and its margin,
    # rejected records, and records whose star was read before
    store: Path
    catalog: Path
    margin: Path
    rejected: Path
    repeated: Path
    runs: Path
    borders: Path  # of the stars that are in the margins of other partitions

    @classmethod
    def of(cls, output: Path, ingest: IngestOptions, options: StoreOptions) -> StorePlan:
        """Return the plan of a store with a final place."""
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
        """How far the margin of a partition reaches."""
        return float(np.radians(self.options.margin_arcsec / 3600.0))


def partition_pixels(
    pixels: Pixels, counts: NDArray[np.int64], order: int, max_rows: int, name: str
) -> tuple[Pixel, ...]:
    """Return the largest pixels that hold no more stars than allowed and cover all of them."""
    chosen: list[Pixel] = []
    for level in range(order + 1):
        parent, first = np.unique(pixels >> 2 * (order - level), return_index=True)
        if not len(parent):
            break
        total = np.add.reduceat(counts, first)
        fits = total <= max_rows
        chosen += [Pixel(level, number) for number in parent[fits].tolist()]
        left = ~np.repeat(fits, np.diff([*first, len(pixels)]))
        pixels, counts = pixels[left], counts[left]
    if len(pixels):
        raise ConfigError(
            f"{name}: {counts.max()} stars are in one place, more than the {max_rows} that a "
            "partition may hold; allow more with max_partition_rows",
            fields=("max_partition_rows",),
        )
    return tuple(sorted(chosen, key=lambda pixel: pixel.first))


def spill_order(rows: int) -> int:
    """Return the order of the coarse pixels that runs have batches of."""
    least, most = _SPILL_ORDERS
    return next((k for k in range(least, most) if rows <= 12 * 4**k * _ROWS_A_BATCH), most)
