"""A catalog store on disk: a HATS collection, with additional files of starcat.

::

    DIR/
      collection.properties     names the catalog and its margin
      store.json                inputs with digests, counts by reason, partitions with digests
      NAME/                     HATS catalog: the stars
        hats.properties  partition_info.csv  skymap.fits
        dataset/_metadata  _common_metadata  Norder=K/Dir=D/Npix=P.parquet
      NAME_margin/              HATS margin catalog: each partition's neighbours across its border
      rejected/                 rejected records, one file for each input that has any
      repeated/                 records whose star was read before, whole, by partition

Catalogs from other sources are supported too: a collection, or a single HATS catalog.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from starcat.errors import (
    ConfigError,
    ProductError,
    SchemaError,
    SourceError,
    StarcatError,
    TargetMissing,
    reason,
)
from starcat.storage.schema import product_schema
from starcat.version import install_command

MAX_ORDER = 29
HEALPIX_COLUMN = "_healpix_29"
_PIXELS_A_FOLDER = 10_000

_DEEPEST = 12
"""A border consists of pixels at most this many orders finer: at most 16,388 pixels."""

_FIRST_WIDTH_RAD = 0.45 * np.sqrt(np.pi / 3.0)

Pixels = NDArray[np.int64]


@dataclass(frozen=True, order=True)
class Pixel:
    """A pixel of the sky that a partition covers.

    Examples
    --------
    >>> Pixel(6, 41234).path.as_posix()
    'Norder=6/Dir=40000/Npix=41234.parquet'
    >>> Pixel(1, 5).first, Pixel(1, 5).end == Pixel(1, 6).first
    (360287970189639680, True)
    """

    order: int
    number: int  # nested

    @property
    def first(self) -> int:
        """The first pixel of order 29 in this pixel."""
        return self.number << 2 * (MAX_ORDER - self.order)

    @property
    def end(self) -> int:
        """The number after the last pixel of order 29 in this pixel."""
        return (self.number + 1) << 2 * (MAX_ORDER - self.order)

    @property
    def path(self) -> Path:
        """Path of its file, relative to ``dataset/``."""
        folder = self.number // _PIXELS_A_FOLDER * _PIXELS_A_FOLDER
        return Path(f"Norder={self.order}") / f"Dir={folder}" / f"Npix={self.number}.parquet"

    def at(self, order: int) -> Pixels:
        """Return the pixels of another order that overlap it."""
        return at_order(self.order, np.array([self.number], dtype=np.int64), order)


def at_order(order: int, pixels: Pixels, other: int) -> Pixels:
    """Return the pixels of another order that overlap some pixels."""
    if other <= order:
        return np.unique(pixels >> 2 * (order - other))
    shift = 2 * (other - order)
    return np.unique((pixels[:, None] << shift) + np.arange(1 << shift))


def runs_of(pixels: Pixels, order: int) -> tuple[Pixels, Pixels, Pixels]:
    """Return the pixels of an order that contain stars, their first rows, and their counts."""
    lower = pixels >> 2 * (MAX_ORDER - order)
    begins = np.flatnonzero(np.diff(lower, prepend=-1))
    return lower[begins], begins, np.diff(begins, append=len(pixels))


def pixel_field() -> pa.Field:
    """Return the column of the stars' pixels."""
    meaning = {"description": "Nested HEALPix pixel of order 29, ICRS", "ucd": "pos.healpix"}
    return pa.field(HEALPIX_COLUMN, pa.int64(), nullable=False, metadata=meaning)


def healpix_29(ra_deg: NDArray[np.float64], dec_deg: NDArray[np.float64]) -> Pixels:
    """Return the nested HEALPix pixels of order 29 of positions."""
    from astropy import units
    from astropy.coordinates import Latitude, Longitude

    if not len(ra_deg):
        return np.empty(0, dtype=np.int64)
    pixels: Any = _nested().lonlat_to_healpix(
        Longitude(ra_deg, units.deg), Latitude(dec_deg, units.deg), MAX_ORDER
    )
    return np.asarray(pixels, dtype=np.int64)


def border_of(pixel: Pixel, width_rad: float) -> tuple[int, Pixels]:
    """Return pixels that cover everything within a distance of a pixel."""
    order = min(border_order(width_rad), pixel.order + _DEEPEST)
    if width_rad > _FIRST_WIDTH_RAD:
        return 0, np.arange(12, dtype=np.int64)
    if order >= pixel.order:
        depth = order - pixel.order
        return order, _valid(
            *_nested().external_neighbours(np.array([pixel.number]), pixel.order, depth)
        )
    coarse = pixel.at(order)
    return order, np.union1d(coarse, neighbours_of(coarse, order))


def neighbours_of(pixels: Pixels, order: int) -> Pixels:
    """Return the pixels that touch given pixels, at an edge or a corner."""
    return _valid(_nested().neighbours(pixels, order))


def border_order(width_rad: float) -> int:
    """Return the highest order whose pixels are all at least as wide as a width."""
    widths = least_width_rad(np.arange(MAX_ORDER + 1))
    return max(0, int(np.searchsorted(-widths, -width_rad, side="right")) - 1)


def least_width_rad(order: NDArray[np.integer[Any]]) -> NDArray[np.float64]:
    """Return a lower limit of the width of the pixels of an order."""
    return np.asarray(_FIRST_WIDTH_RAD / 2.0 ** np.asarray(order, dtype=np.float64))


def _valid(*parts: Any) -> Pixels:
    """Return sorted pixels without duplicates, and without -1 (the library's "no neighbour")."""
    together = np.concatenate([np.ravel(part) for part in parts]).astype(np.int64)
    return np.unique(together[together >= 0])


def _nested() -> Any:
    try:
        import cdshealpix.nested as nested
    except ImportError as error:
        raise ConfigError(
            "HATS needs the package cdshealpix, which is not installed",
            hint=install_command("hats"),
        ) from error
    return nested


COLLECTION_NAME = "collection.properties"
MANIFEST_NAME = "store.json"
PROPERTIES_NAMES = ("hats.properties", "properties")
PARTITIONS_NAME = "partition_info.csv"
SKYMAP_NAME = "skymap.fits"
DATASET = "dataset"
REJECTED = "rejected"
REPEATED = "repeated"

_CATALOG_FILES = (
    *(PROPERTIES_NAMES[0], PARTITIONS_NAME, SKYMAP_NAME),
    *(f"{DATASET}/{name}" for name in ("_metadata", "_common_metadata")),
    f"{DATASET}/Norder=*/Dir=*/Npix=*.parquet",
)
"""The files of a HATS catalog that starcat writes."""


@dataclass(frozen=True)
class Partition:
    """A part of the sky and the files with its stars."""

    pixel: Pixel  # the part
    paths: tuple[Path, ...]  # one file; other programs' catalogs can have several


@dataclass(frozen=True)
class HatsFolder:
    """A HATS catalog on disk."""

    folder: Path  # the folder with ``hats.properties``
    properties: dict[str, str]  # content of this file
    partitions: tuple[Partition, ...]  # sorted by the first pixel of order 29

    @property
    def name(self) -> str:
        """The name that the catalog states, or else the name of its folder."""
        return self.properties.get("obs_collection", self.folder.name)


@dataclass(frozen=True)
class Store:
    """A catalog store, or a HATS catalog from another source."""

    folder: Path  # the given folder
    catalog: HatsFolder  # the stars
    margin: HatsFolder | None  # each partition's neighbours across its border

    @property
    def margin_arcsec(self) -> float:
        """Width of the margin, arcseconds; 0 without a margin."""
        return float(self.margin.properties["hats_margin_threshold"]) if self.margin else 0.0

    @cached_property
    def is_ours(self) -> bool:
        """Whether starcat made it and states its inputs."""
        return (self.folder / MANIFEST_NAME).is_file()


def is_store(folder: Path) -> bool:
    """Return whether a folder is a HATS collection or catalog."""
    return any((folder / name).is_file() for name in (COLLECTION_NAME, *PROPERTIES_NAMES))


def store_files(folder: Path) -> set[str]:
    """Return the names of the files of a store that starcat made; empty for other folders."""
    if not (folder / MANIFEST_NAME).is_file() or not (folder / COLLECTION_NAME).is_file():
        return set()
    try:
        name = primary_of(folder).relative_to(folder).as_posix()
    except StarcatError:
        return set()
    catalogs = (folder / name, folder / f"{name}_margin")
    inside = [path for catalog in catalogs for path in _catalog_paths(catalog)]
    beside = [path for part in (REJECTED, REPEATED) for path in (folder / part).glob("*.parquet")]
    names = {path.relative_to(folder).as_posix() for path in (*inside, *beside)}
    return {MANIFEST_NAME, COLLECTION_NAME, *names}


def catalog_files(folder: Path) -> set[str]:
    """Return the names of the files of a HATS catalog that starcat can have written."""
    return {path.relative_to(folder).as_posix() for path in _catalog_paths(folder)}


def _catalog_paths(folder: Path) -> list[Path]:
    return [path for pattern in _CATALOG_FILES for path in folder.glob(pattern)]


def open_store(folder: Path) -> Store:
    """Open a catalog store, without reading stars."""
    if not folder.exists():
        raise TargetMissing(
            "does not exist", where=folder, hint="give the folder of a HATS catalog"
        )
    if not (folder / COLLECTION_NAME).is_file():
        return Store(folder, _read_catalog(folder), None)
    inner = primary_of(folder)
    margin = read_properties(folder / COLLECTION_NAME).get("default_margin")
    return Store(
        folder, _read_catalog(inner), _read_catalog(_within(folder, margin)) if margin else None
    )


def primary_of(folder: Path) -> Path:
    """Return the folder of the stars of a collection."""
    primary = read_properties(folder / COLLECTION_NAME).get("hats_primary_table_url")
    if not primary:
        raise ProductError(
            "has no hats_primary_table_url; expected the name of the catalog's folder",
            where=folder / COLLECTION_NAME,
            path=folder,
            hint="Get the collection again",
        )
    return _within(folder, primary)


@contextmanager
def parquet_file(
    path: Path, refusal: type[SourceError | ProductError], advice: str
) -> Iterator[pq.ParquetFile]:
    """Open a Parquet file; the library's errors become errors of starcat."""
    try:
        with pq.ParquetFile(path) as file:
            yield file
    except (OSError, pa.ArrowException, KeyError) as error:
        why = reason(error) if isinstance(error, OSError) else str(error)
        message = f"{path}: cannot be read as Parquet ({why}); {advice}"
        raise refusal(message, path=path) from error


def groups_within(footer: pq.FileMetaData, column: str, limit: float | None) -> list[int]:
    """Return the row groups that can contain stars with a magnitude within a limit."""
    leaves = [footer.schema.column(k).path for k in range(footer.num_columns)]
    index = leaves.index(column)
    groups = []
    for k in range(footer.num_row_groups):
        group = footer.row_group(k)
        statistics = group.column(index).statistics
        is_known = limit is not None and statistics is not None
        is_blank = (
            is_known and statistics.has_null_count and statistics.null_count == group.num_rows
        )
        is_faint = is_known and statistics.has_min_max and statistics.min > limit
        if not (is_blank or is_faint):
            groups.append(k)
    return groups


def star_columns(available: Sequence[str]) -> list[str]:
    """Return the columns to read of a table of stars; nearest neighbours are computed again."""
    names = product_schema("stars").arrow_schema.names
    return [name for name in names if name in available and not name.startswith("nearest_")]


def check_has_columns(
    path: Path, columns: Sequence[str], expected: Sequence[str], advice: str
) -> None:
    """Check that a table of stars has the required columns."""
    lacking = [name for name in expected if name not in columns]
    if lacking:
        raise SchemaError(
            f"no column {', '.join(lacking)}",
            where=path,
            product="stars",
            field=lacking[0],
            found=list(columns),
            expected=expected,
            hint=advice,
        )


def _within(folder: Path, name: str) -> Path:
    """Return a folder of the collection; raise if it is outside of the collection."""
    if Path(name).is_absolute() or ".." in Path(name).parts or "://" in name:
        raise ProductError(
            f"names {name!r}, which is not in the collection",
            where=folder / COLLECTION_NAME,
            path=folder,
            hint="give the folder of the catalog itself",
        )
    return folder / name


def _read_catalog(folder: Path) -> HatsFolder:
    path = next((folder / name for name in PROPERTIES_NAMES if (folder / name).is_file()), None)
    if path is None:
        raise ProductError(
            f"no {' or '.join(PROPERTIES_NAMES)}; expected a HATS catalog, as 'starcat "
            "ingest SOURCE --to hats -o DIR' writes it",
            where=folder,
        )
    properties = read_properties(path)
    suffix = properties.get("hats_npix_suffix", ".parquet")
    partitions = [_partition(folder, pixel, suffix) for pixel in pixels_of(folder)]
    return HatsFolder(
        folder, properties, tuple(sorted(partitions, key=lambda partition: partition.pixel.first))
    )


def pixels_of(folder: Path) -> list[Pixel]:
    """Return the pixels that the catalog lists, or the pixels of its files if it has no list."""
    path = folder / PARTITIONS_NAME
    if not path.is_file():
        paths = folder.glob(f"{DATASET}/Norder=*/Dir=*/Npix=*")
        return [pixel for pixel in map(_pixel_of, sorted(paths)) if pixel is not None]
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            return [Pixel(int(row["Norder"]), int(row["Npix"])) for row in csv.DictReader(stream)]
    except (KeyError, TypeError, ValueError) as error:
        raise ProductError(
            f"cannot be read ({error!r}); expected lines of Norder,Npix",
            where=path,
            hint="Get the catalog again",
        ) from error


def _pixel_of(path: Path) -> Pixel | None:
    order = path.parent.parent.name.removeprefix("Norder=")
    number = path.name.removeprefix("Npix=").partition(".")[0]
    return Pixel(int(order), int(number)) if order.isdigit() and number.isdigit() else None


def _partition(folder: Path, pixel: Pixel, suffix: str) -> Partition:
    path = folder / DATASET / pixel.path
    if suffix != ".parquet":
        path = path.with_name(f"Npix={pixel.number}{suffix.rstrip('/')}")
    paths = tuple(sorted(path.glob("*.parquet"))) if path.is_dir() else (path,)
    if not paths or not all(each.is_file() for each in paths):
        raise ProductError(
            f"partition {pixel.path.as_posix()} is missing; the catalog is not whole",
            where=folder,
            hint="Get it again, or make it with 'starcat ingest SOURCE --to hats -o DIR'",
        )
    return Partition(pixel, paths)


def read_properties(path: Path) -> dict[str, str]:
    """Read a file of properties."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ProductError(f"cannot be read ({error})", where=path) from error
    pairs = (line.partition("=") for line in lines if line.strip() and line[0] not in "#!")
    return {key.strip(): value.strip().replace("\\:", ":") for key, _, value in pairs}


def write_properties(path: Path, properties: Mapping[str, Any]) -> None:
    """Write a file of properties; the same content gives the same bytes."""
    text = "".join(f"{key}={value}\n" for key, value in properties.items())
    path.write_text(text, encoding="utf-8", newline="\n")
