"""Star tables as files: a file is whole at its final name, or not there."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # other rooms write files without reading a catalog
    from starcat.catalog.ingest import Ingested


def rejected_path(output: Path) -> Path:
    """Return where the rejected rows go that belong to a star table."""
    return output.with_name(f"{output.stem}.rejected{output.suffix}")


def write_star_tables(read: Ingested, output: Path) -> None:
    """Write a star table, and its rejected rows beside it where there are any."""
    from starcat.storage.parquet import write_table

    write_table(read.stars, output)
    beside = rejected_path(output)
    if len(read.rejected):
        write_table(read.rejected, beside)
    else:
        beside.unlink(missing_ok=True)
