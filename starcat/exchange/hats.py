"""Star tables as HATS catalogs: Parquet files by HEALPix pixel, which LSDB opens as they are.

The table is held in memory, and becomes a catalog without margin: catalogs of any size are made by
``starcat ingest --to hats``, with the same pixels and the same files beside the partitions.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from starcat.catalog.stars import floats_of
from starcat.errors import ConfigError
from starcat.store.metadata import Described, describe_catalog, write_slices
from starcat.store.pixels import HEALPIX_COLUMN, MAX_ORDER, healpix_29, pixel_field
from starcat.store.plan import partition_pixels

NEEDED = ("star_id", "ra_deg", "dec_deg")
MAX_ROWS = 1_000_000
PROPERTIES_NAME = "hats.properties"


@dataclass(frozen=True)
class HatsCatalog:
    """What a HATS catalog holds."""

    rows: int
    left_out: int  # rows without a position, which have no place on the sky
    order: int  # highest HEALPix order of the partitions' pixels
    partitions: int


def write_hats(stars: pa.Table, folder: Path, name: str, max_rows: int = MAX_ROWS) -> HatsCatalog:
    """Write a star table as a HATS catalog."""
    table, left_out = _with_pixels(stars, name)
    found, counts = np.unique(table[HEALPIX_COLUMN].to_numpy(), return_counts=True)
    partitions = partition_pixels(found, counts, MAX_ORDER, max_rows, name)
    written = write_slices(table, partitions, folder, max_rows)
    describe_catalog(folder, Described(name, "object", written, max_rows, {}), table.schema)
    order = max(pixel.order for pixel in partitions)
    return HatsCatalog(len(table), left_out, order, len(partitions))


def _with_pixels(stars: pa.Table, name: str) -> tuple[pa.Table, int]:
    """Return the stars that have a position, by pixel and star, and how many have none."""
    missing = [column for column in NEEDED if column not in stars.column_names]
    if missing:
        raise ConfigError(
            f"{name}: not a star table, it has no column {', '.join(missing)}; HATS is for star "
            "tables, choose another format"
        )
    ra_deg, dec_deg = floats_of(stars, "ra_deg"), floats_of(stars, "dec_deg")
    is_placed = np.isfinite(ra_deg) & np.isfinite(dec_deg)
    if not is_placed.any():
        raise ConfigError(f"{name}: none of its {len(stars)} rows has a position on the sky")
    pixels = healpix_29(ra_deg[is_placed], dec_deg[is_placed])
    placed = stars.filter(pa.array(is_placed))
    table = placed.add_column(0, pixel_field(), pa.array(pixels)).replace_schema_metadata(None)
    return table.sort_by([(HEALPIX_COLUMN, "ascending"), ("star_id", "ascending")]), int(
        np.count_nonzero(~is_placed)
    )
