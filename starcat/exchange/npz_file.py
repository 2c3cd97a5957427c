"""Tables as npz: one array a column, for numpy alone.

``<column>`` holds the values; null is NaN, 0, False or an empty text, and ``<column>.is_null``
says where, if anywhere. A ragged column has all items in ``<column>`` and
``<column>.offsets``: row i is ``values[offsets[i]:offsets[i + 1]]``.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.errors import SchemaError
from starcat.exchange.numpy_columns import NumpyColumn

_NAME_BYTES = (1 << 16) - 1
"""What an entry of a zip file has room for."""


def write_npz(columns: list[NumpyColumn], path: Path) -> None:
    """Write columns as an npz file."""
    # Not numpy.savez: it takes a column named "file" for its own argument.
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for column in columns:
            values = _texts(column) if column.is_text else column.values
            _add(archive, column.name, values)
            if column.offsets is not None:
                _add(archive, f"{column.name}.offsets", column.offsets)
            if column.is_null.any():
                _add(archive, f"{column.name}.is_null", column.is_null)


def _texts(column: NumpyColumn) -> NDArray[np.str_]:
    for text in column.values:
        if text.endswith("\0"):
            raise SchemaError(
                f"column {column.name!r}: numpy would lose the end of the text {text!r}; take the "
                "null character out, or choose another format",
                field=column.name,
                found=text,
            )
    return column.values.astype(np.str_)


def _add(archive: zipfile.ZipFile, name: str, values: NDArray[Any]) -> None:
    if len(f"{name}.npy".encode()) > _NAME_BYTES:
        raise SchemaError(
            f"column {name[:20]}... has a name of {len(name)} letters, which npz has no room for; "
            "rename it with AS",
            field=name,
        )
    if f"{name}.npy" in archive.namelist():
        raise SchemaError(
            f"column {name!r}: the file has an array of that name already, for a column's lists "
            "or nulls; rename the column with AS",
            field=name,
        )
    # An entry opened by its name is dated 1980, so that the bytes are the same every time.
    with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
        np.lib.format.write_array(stream, np.ascontiguousarray(values), allow_pickle=False)
