"""How a store is made, and what that takes of memory."""

from __future__ import annotations

from dataclasses import dataclass

from starcat.errors import ConfigError
from starcat.store.plan import MAX_ROWS

MARGIN_ARCSEC = 10.0
MEMORY_BYTES = 2 << 30
"""What all processes together may take, for two workers."""

_BASE_BYTES = 260 << 20
_BYTES_A_RUN_ROW = 1_000
_BYTES_A_PARTITION_ROW = 1_000
_RUN_ROWS = (20_000, 250_000)


@dataclass(frozen=True)
class StoreOptions:
    """How a store is made."""

    max_partition_rows: int = MAX_ROWS  # stars that a partition may hold
    margin_arcsec: float = MARGIN_ARCSEC  # how far the margin of a partition reaches
    # memory of all processes together; the bytes of the store do not depend on it
    memory_bytes: int = MEMORY_BYTES
    workers: int = 2  # processes on this machine
    scheduler: str | None = None  # address of a Dask cluster to use instead
    # resume, replace: whether to go on with an unfinished run, and to replace a store that differs
    resume: bool = False
    replace: bool = False


def rows_of_a_run(options: StoreOptions) -> int:
    """Return how many stars a run may have within the memory that is allowed."""
    each = (options.memory_bytes - _BASE_BYTES) // options.workers - _BASE_BYTES
    needed = options.max_partition_rows * _BYTES_A_PARTITION_ROW
    if options.scheduler is None and each < needed:
        least = (needed + _BASE_BYTES) * options.workers + _BASE_BYTES
        raise ConfigError(
            f"--memory {options.memory_bytes >> 20} MiB is too little for {options.workers} "
            f"workers and partitions of {options.max_partition_rows:,} stars, which want "
            f"{-(-least >> 20)} MiB; allow more, or use fewer --workers or a smaller "
            "--max-partition-rows",
            key="memory",
            value=options.memory_bytes,
        )
    least, most = _RUN_ROWS
    return int(min(max(each // _BYTES_A_RUN_ROW, least), most))
