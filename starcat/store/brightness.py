"""The order of a partition's stars: the brightest first, and each group by pixel.

Readers skip row groups by the least and greatest magnitude in them. Were the stars in the order of
their pixels alone, every group would have a bright star; in groups of brightness, who wants the
bright stars of the whole sky reads one part in 64 of it, and who wants a place still finds the
stars of each group in the order of the sky.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from starcat.catalog.stars import floats_of
from starcat.storage.atomic import placed
from starcat.store.pixels import HEALPIX_COLUMN

ROW_GROUP_ROWS = 1 << 16
_SHARES = (64, 8)
"""The brightest 64th of the stars, then up to the brightest 8th, then the others."""

_LEAST_ROWS = 1024
"""A group of brightness that would be smaller than this is not made."""


def bright_first(stars: pa.Table) -> tuple[pa.Table, tuple[int, ...]]:
    """Return the stars of a partition in the order in which they are written."""
    group = _groups(floats_of(stars, "mag"))
    order = np.argsort(group, kind="stable")
    counts = np.bincount(group)
    return stars.take(pa.array(order)), tuple(counts[counts > 0].tolist())


def _groups(mag: NDArray[np.float64]) -> NDArray[np.int8]:
    known = mag[~np.isnan(mag)]
    ranks = [len(known) // share for share in _SHARES if len(known) // share >= _LEAST_ROWS]
    cuts = np.partition(known, ranks)[ranks] if ranks else known[:0]
    # A magnitude that is a limit belongs to the fainter group, however many stars have it.
    group = np.searchsorted(cuts, mag, side="right").astype(np.int8)
    group[np.isnan(mag)] = len(cuts) + 1
    return group


def write_partition(stars: pa.Table, rows: tuple[int, ...], path: Path) -> None:
    """Write a partition, the same bytes for the same stars and library."""
    path.parent.mkdir(parents=True, exist_ok=True)
    begin = 0
    encodings = _encodings(stars.schema)
    with placed(path) as partial, pq.ParquetWriter(partial, stars.schema, **encodings) as writer:
        for count in rows:
            writer.write_table(stars.slice(begin, count), row_group_size=ROW_GROUP_ROWS)
            begin += count


def _encodings(schema: pa.Schema) -> dict[str, object]:
    """Return how columns are encoded: numbers that ascend by their differences."""
    texts = [f.name for f in schema if pa.types.is_string(f.type) and f.name != "designation"]
    encoding = {f.name: "BYTE_STREAM_SPLIT" for f in schema if pa.types.is_floating(f.type)}
    for name in (HEALPIX_COLUMN, "star_id", "source_line"):
        encoding[name] = "DELTA_BINARY_PACKED"
    encoding["designation"] = "DELTA_LENGTH_BYTE_ARRAY"
    return {
        "compression": "zstd",
        "compression_level": 1,
        "use_dictionary": texts,
        "column_encoding": {name: kind for name, kind in encoding.items() if name in schema.names},
        "write_statistics": True,
    }
