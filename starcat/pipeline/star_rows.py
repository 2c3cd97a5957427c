"""Stars of a catalog store by place: those of a partition, or of any region of the sky.

The store is one of starcat's, or any HATS catalog that has the columns of a star table and the
pixel of order 29 of each star. Row groups whose statistics say that they have nothing of the
region are not read.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from starcat.artifact.other_catalogs import NEEDED
from starcat.errors import ParseError, ProductError, SchemaError
from starcat.pipeline.counterparts import check_star_columns
from starcat.storage.schema import product_schema
from starcat.store.layout import (
    PROPERTIES_NAMES,
    Partition,
    Store,
    check_has_columns,
    open_store,
    parquet_file,
    write_properties,
)
from starcat.store.metadata import write_pixel_list, write_slices
from starcat.store.pixels import (
    HEALPIX_COLUMN,
    MAX_ORDER,
    Pixel,
    Pixels,
    Region,
    healpix_29,
    runs_of,
)

_ALIKE = {
    "string": (
        "large_string",
        "string_view",
        "dictionary<values=string, indices=int32, ordered=0>",
    ),
    "int64": ("uint64",),
}

_DAMAGED = "the store is damaged, make or get it again"
_HINT = "give a catalog store, as 'starcat ingest SOURCE --to hats -o DIR' writes it"


@lru_cache(maxsize=4)
def opened(folder: Path, run: Path) -> Store:
    """Open a store once in each process and run."""
    store = open_store(folder)
    order = store.catalog.properties.get("hats_col_healpix_order", str(MAX_ORDER))
    if order != str(MAX_ORDER):
        raise ProductError(
            f"{folder}: hats_col_healpix_order is {order}; expected pixels of order {MAX_ORDER}",
            path=folder,
        )
    _check_partitions(store)
    for partition in store.catalog.partitions[:1]:
        with parquet_file(partition.paths[0], ParseError, _DAMAGED) as file:
            names = file.schema_arrow.names
        check_has_columns(folder, names, (*NEEDED, _pixel_column(store)), _HINT)
    return store


def _check_partitions(store: Store) -> None:
    """Check that no part of the sky is in two partitions, whose stars would count twice."""
    for before, after in pairwise(store.catalog.partitions):
        if after.pixel.first < before.pixel.end:
            raise ProductError(
                f"{store.folder}: partitions {before.pixel.path.as_posix()} and "
                f"{after.pixel.path.as_posix()} overlap; make the store again",
                path=store.folder,
            )


def rows_of_partition(
    store: Store, partition: Partition, columns: Sequence[str]
) -> Iterator[pa.Table]:
    """Yield the stars of a partition, a row group at a time."""
    first, end = partition.pixel.first, partition.pixel.end
    for path in partition.paths:
        with parquet_file(path, ParseError, _DAMAGED) as file:
            for group in range(file.num_row_groups):
                table = _read(file, group, store, columns, path)
                pixels = table[HEALPIX_COLUMN].to_numpy()
                if len(pixels) and not (pixels.min() >= first and pixels.max() < end):
                    raise ProductError(
                        f"{path}: has stars that are not in pixel {partition.pixel.number} of "
                        f"order {partition.pixel.order}; make the store again",
                        path=path,
                    )
                yield table


def rows_of_region(store: Store, region: Region, columns: Sequence[str]) -> pa.Table:
    """Return the stars of a region."""
    schema = _schema(tuple(columns))
    parts = [schema.empty_table()]
    bounds = np.array(region.ranges, dtype=np.int64)
    for partition in store.catalog.partitions:
        if not _touches(bounds, partition.pixel.first, partition.pixel.end - 1):
            continue
        for path in partition.paths:
            with parquet_file(path, ParseError, _DAMAGED) as file:
                parts += _parts(file, store, region, bounds, columns, path)
    keys = [("star_id", "ascending"), (HEALPIX_COLUMN, "ascending")]
    return pa.concat_tables(parts).sort_by(keys).combine_chunks()


def _parts(
    file: pq.ParquetFile,
    store: Store,
    region: Region,
    bounds: Pixels,
    columns: Sequence[str],
    path: Path,
) -> Iterator[pa.Table]:
    """Yield what the row groups of a file have of a region."""
    column = _pixel_column(store)
    for group in range(file.num_row_groups):
        known = _extent(file.metadata.row_group(group), column)
        if known is not None and not _touches(bounds, *known):
            continue
        pixels = file.read_row_group(group, [column])[column].to_numpy()
        inside = region.level_of(np.asarray(pixels, dtype=np.int64)) >= 0
        if inside.any():
            yield _read(file, group, store, columns, path).filter(pa.array(inside))


def _extent(group: Any, column: str) -> tuple[int, int] | None:
    """Return the lowest and the highest pixel of a row group; None where it does not say."""
    for number in range(group.num_columns):
        chunk = group.column(number)
        if chunk.path_in_schema == column:
            known = chunk.statistics
            return (known.min, known.max) if known is not None and known.has_min_max else None
    return None


def _touches(bounds: Pixels, lowest: int, highest: int) -> bool:
    """Return whether any range reaches into the pixels from the lowest to the highest."""
    place = int(np.searchsorted(bounds[:, 1], lowest, side="right"))
    return place < len(bounds) and bool(bounds[place, 0] <= highest)


def _read(
    file: pq.ParquetFile, group: int, store: Store, columns: Sequence[str], path: Path
) -> pa.Table:
    """Read a row group with the types of a star table; checked."""
    column = _pixel_column(store)
    table = file.read_row_group(group, [*columns, column])
    schema = _schema(tuple(columns))
    arrays = []
    for field in schema:
        values = table[column if field.name == HEALPIX_COLUMN else field.name]
        # Other writers have larger texts, and pixels without a sign, which mean the same.
        is_alike = str(values.type) in _ALIKE.get(str(field.type), ())
        arrays.append(values.cast(field.type) if is_alike else values)
    read = pa.table(dict(zip(schema.names, arrays, strict=True)))
    check_star_columns(read, path)
    if read[HEALPIX_COLUMN].null_count:
        raise SchemaError(
            f"{path}: {column}: found {read[HEALPIX_COLUMN].null_count} rows without a value; "
            "a catalog store has a pixel in every row",
            product="stars",
            field=column,
        )
    return read.cast(schema)


@cache
def _schema(columns: tuple[str, ...]) -> pa.Schema:
    known = product_schema("stars").arrow_schema
    fields = [known.field(name) for name in columns]
    return pa.schema([*fields, pa.field(HEALPIX_COLUMN, pa.int64(), nullable=False)])


def _pixel_column(store: Store) -> str:
    return store.catalog.properties.get("hats_col_healpix", HEALPIX_COLUMN)


def store_of_file(stars: pa.Table, path: Path, folder: Path) -> None:
    """Write a star table as a HATS catalog of twelve partitions, to be read by place."""
    dec_deg = stars["dec_deg"].to_numpy()
    if len(dec_deg) and np.abs(dec_deg).max() > 90.0:
        raise SchemaError(
            f"{path}: dec_deg: found {dec_deg[np.abs(dec_deg).argmax()]}; a declination is from "
            "-90 to 90. Make the table with 'starcat ingest'",
            product="stars",
            field="dec_deg",
        )
    pixels = healpix_29(stars["ra_deg"].to_numpy(), dec_deg)
    order = np.argsort(pixels, kind="stable")
    table = stars.append_column(HEALPIX_COLUMN, pa.array(pixels)).take(pa.array(order))
    partitions = [Pixel(0, number) for number in runs_of(pixels[order], 0)[0].tolist()]
    folder.mkdir(exist_ok=True)
    write_slices(table, partitions, folder, _SMALL_GROUP)
    write_pixel_list(folder, partitions)
    write_properties(folder / PROPERTIES_NAMES[0], {"hats_col_healpix": HEALPIX_COLUMN})


_SMALL_GROUP = 1 << 15
"""Rows of a row group in these, so that a region reads little beside its own."""
