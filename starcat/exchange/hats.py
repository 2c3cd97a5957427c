"""Star tables as HATS catalogs: Parquet files by HEALPix pixel, which LSDB opens as they are.

Every star gets ``_healpix_29``, its nested pixel of order 29 (0.4 mas); all partitions are pixels
of one order, the lowest at which none holds more rows than asked for. The table is held in
memory. No margin catalog, sky map or MOC is written: readers do without.

References
----------
HATS 1.0, IVOA Note; Gorski et al. 2005 (HEALPix).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from starcat.catalog.stars import floats_of
from starcat.errors import ConfigError
from starcat.version import __version__, install_command

MAX_ORDER = 29
HEALPIX_COLUMN = "_healpix_29"
NEEDED = ("star_id", "ra_deg", "dec_deg")
MAX_ROWS = 1_000_000
PROPERTIES_NAME = "hats.properties"
_PIXELS_A_FOLDER = 10_000


@dataclass(frozen=True)
class HatsCatalog:
    """What a HATS catalog holds.

    Attributes
    ----------
    rows : int
        Stars written.
    left_out : int
        Rows without a position, which have no place on the sky.
    order : int
        HEALPix order of the partitions' pixels.
    partitions : int
        Number of files.
    """

    rows: int
    left_out: int
    order: int
    partitions: int


def write_hats(stars: pa.Table, folder: Path, name: str, max_rows: int = MAX_ROWS) -> HatsCatalog:
    """Write a star table as a HATS catalog.

    Parameters
    ----------
    stars : pyarrow.Table
        With ``star_id``, ``ra_deg`` and ``dec_deg``.
    folder : Path
        Made; it must not exist.
    name : str
        The name that the catalog gets.
    max_rows : int
        Rows that a partition may hold at most.

    Returns
    -------
    HatsCatalog
        The counts of what was written.

    Raises
    ------
    ConfigError
        If the table lacks a column, has no star with a position or more than `max_rows` in
        one place, or cdshealpix is not installed.
    """
    table, left_out = _with_pixels(stars, name)
    pixels = table[HEALPIX_COLUMN].to_numpy()
    order = _partition_order(pixels, max_rows, name)
    numbers, starts = np.unique(pixels >> 2 * (MAX_ORDER - order), return_index=True)
    ends = [*starts[1:], len(pixels)]
    (folder / "dataset").mkdir(parents=True)
    footers: list[pq.FileMetaData] = []
    for number, start, end in zip(numbers.tolist(), starts, ends, strict=True):
        place = partition_path(order, number)
        (folder / "dataset" / place).parent.mkdir(parents=True, exist_ok=True)
        rows = table.slice(start, end - start)
        pq.write_table(
            rows,
            folder / "dataset" / place,
            compression="zstd",
            row_group_size=max_rows,
            metadata_collector=footers,
        )
        footers[-1].set_file_path(place.as_posix())
    pq.write_metadata(table.schema, folder / "dataset" / "_common_metadata")
    pq.write_metadata(table.schema, folder / "dataset" / "_metadata", footers)
    pixel_list = "".join(f"{order},{number}\n" for number in numbers.tolist())
    _write_text(folder / "partition_info.csv", f"Norder,Npix\n{pixel_list}")
    _write_text(folder / PROPERTIES_NAME, _properties(name, len(table), order, max_rows))
    return HatsCatalog(len(table), left_out, order, len(numbers))


def partition_path(order: int, pixel: int) -> Path:
    """Return where in the dataset the file of a pixel is.

    Parameters
    ----------
    order, pixel : int
        Nested HEALPix.

    Returns
    -------
    Path
        Relative to ``dataset/``.

    Examples
    --------
    >>> partition_path(6, 41234).as_posix()
    'Norder=6/Dir=40000/Npix=41234.parquet'
    """
    first = pixel // _PIXELS_A_FOLDER * _PIXELS_A_FOLDER
    return Path(f"Norder={order}") / f"Dir={first}" / f"Npix={pixel}.parquet"


def healpix_29(ra_deg: NDArray[np.float64], dec_deg: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the nested HEALPix pixels of order 29 that positions lie in.

    Parameters
    ----------
    ra_deg, dec_deg : ndarray of float64, shape (N,)
        Positions, degrees, finite.

    Returns
    -------
    ndarray of int64, shape (N,)
        Pixels as LSDB computes them, which uses the same library.

    Raises
    ------
    ConfigError
        If cdshealpix is not installed.
    """
    try:
        from cdshealpix.nested import lonlat_to_healpix
    except ImportError as error:
        raise ConfigError(
            f"HATS needs the package cdshealpix, which is not installed; {install_command('hats')}"
        ) from error
    from astropy import units
    from astropy.coordinates import Latitude, Longitude

    if not len(ra_deg):
        return np.empty(0, dtype=np.int64)
    pixels: Any = lonlat_to_healpix(
        Longitude(ra_deg, units.deg), Latitude(dec_deg, units.deg), MAX_ORDER
    )
    return np.asarray(pixels, dtype=np.int64)


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
    field = pa.field(
        HEALPIX_COLUMN,
        pa.int64(),
        nullable=False,
        metadata={"description": "Nested HEALPix pixel of order 29, ICRS", "ucd": "pos.healpix"},
    )
    table = placed.add_column(0, field, pa.array(pixels)).replace_schema_metadata(None)
    return table.sort_by([(HEALPIX_COLUMN, "ascending"), ("star_id", "ascending")]), int(
        np.count_nonzero(~is_placed)
    )


def _partition_order(pixels: NDArray[np.int64], max_rows: int, name: str) -> int:
    """Return the lowest order at which no pixel has more than so many rows; pixels ascend."""
    for order in range(MAX_ORDER + 1):
        _, counts = np.unique(pixels >> 2 * (MAX_ORDER - order), return_counts=True)
        if counts.max() <= max_rows:
            return order
    raise ConfigError(
        f"{name}: {counts.max()} stars are in one place, more than the {max_rows} that a "
        "partition may hold; allow more with --max-partition-rows"
    )


def _properties(name: str, rows: int, order: int, max_rows: int) -> str:
    known = {
        "obs_collection": name,
        "dataproduct_type": "object",
        "hats_nrows": rows,
        "hats_col_ra": "ra_deg",
        "hats_col_dec": "dec_deg",
        "hats_col_healpix": HEALPIX_COLUMN,
        "hats_col_healpix_order": MAX_ORDER,
        "hats_max_rows": max_rows,
        "hats_order": order,
        "hats_npix_suffix": ".parquet",
        "hats_builder": f"starcat {__version__}",
        "hats_version": "v1.0",
    }
    return "".join(f"{key}={value}\n" for key, value in known.items())


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8", newline="\n")
