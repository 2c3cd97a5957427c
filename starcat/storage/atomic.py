"""Files that are whole at their final name, or not there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from starcat.errors import OutputError, reason

if TYPE_CHECKING:  # other rooms write files without reading a catalog
    pass


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
