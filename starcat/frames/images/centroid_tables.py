"""Frames of centroid files in the formats that need a library: FITS, VOTable and Parquet.

Every other format is read by `starcat.matcher.centroids`, which needs NumPy only. Names of columns
are those of `starcat.matcher.centroid_columns`.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from starcat.arguments import columns_of
from starcat.errors import ConfigError
from starcat.frames.images.contents import FITS, FileContent, is_table
from starcat.matcher.centroid_columns import EXPECTED, choose_columns, listed
from starcat.matcher.centroids import (
    MAX_EXPANDED_BYTES,
    MeasuredFrame,
    frames_of_data,
    frames_of_table,
)

_PARQUET, _XML = b"PAR1", (b"<?xml", b"<VOTABLE")

Table = Mapping[str, Any]


def frames_of_content(content: FileContent) -> list[MeasuredFrame]:
    """Return the frames of a file of centroids of any format."""
    data, path = content.data, content.path
    if data.startswith(FITS):
        return _frames("FITS", _fits_tables, data, path)
    if data.startswith(_PARQUET):
        return _frames("Parquet", _parquet_tables, data, path)
    if data.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(_XML):
        return _frames("VOTable", _votable_tables, data, path)
    return frames_of_data(data, path)


def _frames(kind: str, tables_of: Any, data: bytes, path: Path) -> list[MeasuredFrame]:
    """Return the frames of the tables of a file; tables without positions are left out."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about the style of headers
            tables = [table for table in tables_of(data, path) if table]
    except (ConfigError, MemoryError):
        raise
    except Exception as error:  # damaged bytes make a library raise whatever it happens to
        raise ConfigError(f"cannot be read as {kind} ({error})", where=path) from error
    readable = [table for table in tables if choose_columns(list(table)) is not None]
    if not readable:
        columns = "; ".join(listed(list(table)) for table in tables)
        has = f"a table with the columns {columns}" if columns else "neither a table nor an image"
        raise ConfigError(f"has {has}; {EXPECTED}", where=path)
    several = len(readable) > 1
    return [
        frame
        for number, table in enumerate(readable, start=1)
        for frame in frames_of_table(
            table,
            f"{path.stem} {number}" if several else path.stem,
            f"{path}: table {number}" if several else str(path),
        )
    ]


def _fits_tables(data: bytes, path: Path) -> Iterator[Table]:
    from astropy.io import fits

    with fits.open(io.BytesIO(data), memmap=False) as parts:
        for part in filter(is_table, parts):
            names = [str(name) for name in part.columns.names]
            used = _used(names)
            yield {name: np.asarray(part.data[name]) if name in used else None for name in names}


def _used(names: Sequence[str]) -> set[str | None]:
    """Return the columns that are read; the others can be large, and stay where they are."""
    layout = choose_columns(names)
    return set() if layout is None else {layout.x, layout.y, *layout.beside, layout.frame}


def _votable_tables(data: bytes, path: Path) -> Iterator[Table]:
    from astropy.io import votable

    for table in votable.parse(io.BytesIO(data)).iter_tables():
        yield columns_of(table.to_table(use_names_over_ids=True)) or {}


def _parquet_tables(data: bytes, path: Path) -> Iterator[Table]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = pq.ParquetFile(pa.BufferReader(data))
    facts = file.metadata
    size = sum(facts.row_group(n).total_byte_size for n in range(facts.num_row_groups))
    if max(size, 8 * facts.num_rows) > MAX_EXPANDED_BYTES:
        raise ConfigError(
            f"{facts.num_rows:,} rows of {size:,} bytes; at most {MAX_EXPANDED_BYTES:,} "
            "bytes are read",
            where=path,
            hint="Give fewer centroids",
        )
    names = [str(name) for name in file.schema_arrow.names]
    used = [name for name in names if name in _used(names)]
    yield {**dict.fromkeys(names), **(columns_of(file.read(used)) or {})}
