"""HATS catalogs of any star table, divided as a test asks for, by pyarrow alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from starcat.catalog.store.layout import HEALPIX_COLUMN, MAX_ORDER, Pixel, healpix_29
from starcat.catalog.store.plan import partition_pixels

ORDER = 14


def write_catalog(stars: pa.Table, folder: Path, max_rows: int, group_rows: int = 1 << 16) -> int:
    """Write a star table as a HATS catalog of partitions of different orders; return how many."""
    places = healpix_29(stars["ra_deg"].to_numpy(), stars["dec_deg"].to_numpy())
    table = stars.append_column(HEALPIX_COLUMN, pa.array(places)).sort_by(HEALPIX_COLUMN)
    places = np.sort(places)
    pixels, counts = np.unique(places >> 2 * (MAX_ORDER - ORDER), return_counts=True)
    most = max(max_rows, int(counts.max(initial=0)))
    chosen = partition_pixels(pixels, counts, ORDER, most, folder.name)
    for pixel in chosen:
        path = folder / "dataset" / pixel.path
        path.parent.mkdir(parents=True, exist_ok=True)
        start, end = np.searchsorted(places, [pixel.first, pixel.end])
        pq.write_table(table.slice(start, end - start), path, row_group_size=group_rows)
    write_facts(folder, chosen, len(stars))
    return len(chosen)


def write_facts(folder: Path, pixels: tuple[Pixel, ...], rows: int) -> None:
    """Write the properties file that makes a folder a HATS catalog."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [f"{pixel.order},{pixel.number}" for pixel in pixels]
    (folder / "partition_info.csv").write_text("\n".join(["Norder,Npix", *lines]) + "\n")
    facts = {
        "obs_collection": folder.name, "dataproduct_type": "object", "hats_nrows": rows,
        "hats_col_ra": "ra_deg", "hats_col_dec": "dec_deg", "hats_col_healpix": HEALPIX_COLUMN,
        "hats_col_healpix_order": MAX_ORDER, "hats_npix_suffix": ".parquet",
    }  # fmt: skip
    text = "".join(f"{key}={value}\n" for key, value in facts.items())
    (folder / "hats.properties").write_text(text)
