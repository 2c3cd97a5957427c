"""Tables as files: whole at their final name, or not there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from starcat.errors import OutputError, reason

if TYPE_CHECKING:  # other rooms write files without reading a catalog
    import pyarrow as pa

    from starcat.catalog.ingest import Ingested


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
    write_table(read.stars, output)
    beside = rejected_path(output)
    if len(read.rejected):
        write_table(read.rejected, beside)
    else:
        beside.unlink(missing_ok=True)


def write_table(table: pa.Table, path: Path) -> None:
    """Write a table as a Parquet file.

    Parameters
    ----------
    table : pyarrow.Table
        Units and meanings are in its field metadata.
    path : Path
        Replaced when the new file is whole.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    from starcat.parquet import write_parquet  # with pyarrow, which naming a file does without

    with whole_file(path) as partial:
        write_parquet(table, partial)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a file to write to, which gets its final name when all of it is there.

    Parameters
    ----------
    path : Path
        The final name; its folder is made, and a file of that name is replaced.

    Yields
    ------
    Path
        Hidden, in the same folder; removed if the writing fails.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        partial.replace(path)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({reason(error)}); choose another --output",
            path=path,
        ) from error
    finally:
        with suppress(OSError):  # where the folder could not be made there is nothing to remove
            partial.unlink(missing_ok=True)
