"""Star tables as files: whole at their final name, or not there."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import pyarrow as pa

from starcat.catalog.ingest import Ingested
from starcat.errors import OutputError, reason
from starcat.parquet import write_parquet


def rejected_path(output: Path) -> Path:
    """Return where the rejected rows go that belong to a star table.

    Parameters
    ----------
    output : Path
        File of the star table.

    Returns
    -------
    Path
        ``<stem>.rejected<suffix>`` beside it.
    """
    return output.with_name(f"{output.stem}.rejected{output.suffix}")


def write_star_tables(read: Ingested, output: Path) -> None:
    """Write a star table, and its rejected rows beside it where there are any.

    Parameters
    ----------
    read : Ingested
        An ingested catalog.
    output : Path
        Parquet file; replaced when the new one is whole.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    _write(read.stars, output)
    beside = rejected_path(output)
    if len(read.rejected):
        _write(read.rejected, beside)
    else:
        beside.unlink(missing_ok=True)


def _write(table: pa.Table, path: Path) -> None:
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_parquet(table, partial)
        partial.replace(path)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({reason(error)}); choose another --output",
            path=path,
        ) from error
    finally:
        with suppress(OSError):  # where the folder could not be made there is nothing to remove
            partial.unlink(missing_ok=True)
