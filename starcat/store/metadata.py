"""What makes folders of Parquet files a HATS collection: properties, footers, the map of counts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from starcat.storage.parquet import votable_metadata
from starcat.store.layout import DATASET, PARTITIONS_NAME, write_properties
from starcat.store.pixels import HEALPIX_COLUMN, MAX_ORDER, Pixel
from starcat.version import __version__

HATS_VERSION = "v1.0"


@dataclass(frozen=True)
class Described:
    """A HATS catalog whose partitions are written.

    Attributes
    ----------
    name : str
        The name that it gets.
    kind : str
        ``object`` or ``margin``.
    rows : int
        Its stars.
    bytes : int
        Size of its partitions.
    max_rows : int
        Stars that a partition may hold.
    pixels : tuple of Pixel
        The partitions, by their place on the sky.
    more : dict of str to object
        Further properties.
    """

    name: str
    kind: str
    rows: int
    bytes: int
    max_rows: int
    pixels: tuple[Pixel, ...]
    more: Mapping[str, Any]


def write_slices(
    stars: pa.Table, partitions: Sequence[Pixel], folder: Path, row_group_rows: int
) -> int:
    """Write the partitions of a table that is held in memory."""
    pixels = stars[HEALPIX_COLUMN].to_numpy()
    size = 0
    for pixel in partitions:
        begin, end = np.searchsorted(pixels, [pixel.first, pixel.end])
        path = folder / DATASET / pixel.path
        path.parent.mkdir(parents=True, exist_ok=True)
        rows = stars.slice(begin, end - begin)
        pq.write_table(rows, path, compression="zstd", row_group_size=row_group_rows)
        size += path.stat().st_size
    return size


def write_pixel_list(folder: Path, partitions: Sequence[Pixel]) -> None:
    """Write which partitions a HATS catalog has."""
    lines = "".join(f"{pixel.order},{pixel.number}\n" for pixel in partitions)
    (folder / PARTITIONS_NAME).write_text(f"Norder,Npix\n{lines}", encoding="utf-8", newline="\n")


def describe_catalog(folder: Path, catalog: Described, schema: pa.Schema) -> None:
    """Write what a HATS catalog has beside its partitions."""
    dataset = folder / DATASET
    footers = []
    for pixel in catalog.pixels:
        footer = pq.read_metadata(dataset / pixel.path)
        footer.set_file_path(pixel.path.as_posix())
        footers.append(footer)
    known = {**(schema.metadata or {}), **votable_metadata(schema.empty_table())}
    pq.write_metadata(schema.with_metadata(known), dataset / "_common_metadata")
    pq.write_metadata(schema, dataset / "_metadata", footers)
    write_pixel_list(folder, catalog.pixels)
    write_properties(folder / "hats.properties", _properties(catalog))


def _properties(catalog: Described) -> dict[str, Any]:
    return {
        "obs_collection": catalog.name,
        "dataproduct_type": catalog.kind,
        "hats_nrows": catalog.rows,
        "hats_col_ra": "ra_deg",
        "hats_col_dec": "dec_deg",
        "hats_col_healpix": HEALPIX_COLUMN,
        "hats_col_healpix_order": MAX_ORDER,
        "hats_max_rows": catalog.max_rows,
        "hats_order": max((pixel.order for pixel in catalog.pixels), default=0),
        "hats_npix_suffix": ".parquet",
        "hats_estsize": -(-catalog.bytes // 1024),
        "hats_builder": f"starcat {__version__}",
        "hats_version": HATS_VERSION,
        **catalog.more,
    }


def write_skymap(path: Path, order: int, counts: NDArray[np.int64]) -> None:
    """Write how many stars each pixel has, as a HEALPix map in a FITS file."""
    from astropy.io import fits

    column = fits.Column("PIXELS", "K", array=counts)
    table = fits.BinTableHDU.from_columns([column])
    table.header.update(
        {
            "PIXTYPE": "HEALPIX",
            "ORDERING": "NESTED",
            "COORDSYS": "C",
            "NSIDE": 1 << order,
            "FIRSTPIX": 0,
            "LASTPIX": len(counts) - 1,
            "INDXSCHM": "IMPLICIT",
            "OBJECT": "FULLSKY",
        }
    )
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(path, overwrite=True)


def sum_maps(order: int, maps: Sequence[Sequence[Sequence[int]]]) -> NDArray[np.int64]:
    """Return the sum of maps that list the pixels that have stars."""
    counts = np.zeros(12 * 4**order, dtype=np.int64)
    for pixels, found in maps:
        np.add.at(counts, pixels, found)
    return counts
