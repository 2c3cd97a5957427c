"""Finishing: the runs of a pixel in, its partition out; and the stars that border on others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from starcat.storage.atomic import placed
from starcat.storage.schema import product_schema
from starcat.store.brightness import bright_first, write_partition
from starcat.store.index import RunIndex, read_index
from starcat.store.layout import DATASET, REPEATED
from starcat.store.ledger import Digests, digests_of
from starcat.store.neighbours import COLUMNS, add_neighbours
from starcat.store.pixels import (
    HEALPIX_COLUMN,
    MAX_ORDER,
    Pixel,
    Pixels,
    border_of,
    pixel_field,
    runs_of,
)
from starcat.store.runs import places_of, read_shares, with_constants

SKYMAP_ORDER = 6
"""Order of the map of star counts (55 arcmin)."""

STAR_KEYS = ("star_id", "source_file", "source_line")


@dataclass(frozen=True)
class Finish:
    """What is asked of a worker that finishes a partition."""

    pixel: Pixel  # the partition
    beside: tuple[Pixel, ...]  # partitions whose margin has stars of this one
    margin_rad: float  # how far margins reach
    # index, repeated: files that say what the runs hold, and which records are of a star read
    # before
    index: Path
    repeated: Path
    # catalog, borders: folder of the HATS catalog, and for the stars that border on other
    # partitions
    catalog: Path
    borders: Path
    collection: Path  # folder of the whole store
    is_alone: bool  # whether the catalog has but one star


def finish(asked: Finish) -> tuple[dict[str, Any], Digests]:
    """Write a partition."""
    index = read_index(asked.index)
    repeated = _read_places(asked.repeated)
    pixel = asked.pixel
    stars = _in_order(read_shares(index.shares(pixel), pixel.first, pixel.end))
    stars, again = _without_repeated(stars, repeated)
    files: list[Path] = []
    if len(again):
        path = asked.collection / REPEATED / f"{pixel.order}-{pixel.number}.parquet"
        path.parent.mkdir(exist_ok=True)
        with placed(path) as partial:
            schema = product_schema("stars").arrow_schema
            pq.write_table(with_constants(again, schema), partial, compression="zstd")
        files.append(path)
    result: dict[str, Any] = {"rows": len(stars), "repeated": len(again)}
    if not len(stars):
        return result, digests_of(files)

    def around(reach_rad: float) -> Iterator[pa.Table]:
        return _around(index, pixel, reach_rad, repeated)

    stars = add_neighbours(stars, pixel, around, asked.is_alone)
    files += _write_borders(stars, asked)
    path = asked.catalog / DATASET / pixel.path
    result["map"] = _map(stars[HEALPIX_COLUMN].to_numpy())
    ordered, rows = bright_first(stars)
    write_partition(with_constants(ordered, store_schema()), rows, path)
    written = digests_of([*files, path])
    return result | {"sha256": written[path], "bytes": path.stat().st_size}, written


@lru_cache(maxsize=1)
def store_schema() -> pa.Schema:
    """Return the columns of a store."""
    schema = product_schema("stars").arrow_schema
    return pa.schema([pixel_field(), *schema], metadata=schema.metadata)


def _in_order(stars: pa.Table) -> pa.Table:
    """Return stars by pixel and number; records of the same star in reading order."""
    pixels = stars[HEALPIX_COLUMN].to_numpy()
    order = np.argsort(pixels, kind="stable")
    if (np.diff(pixels[order]) == 0).any():
        order = np.lexsort((places_of(stars), stars["star_id"].to_numpy(), pixels))
    return stars.take(pa.array(order))


@lru_cache(maxsize=2)
def _read_places(path: Path) -> NDArray[np.int64]:
    return np.asarray(np.load(path))


def _without_repeated(stars: pa.Table, repeated: NDArray[np.int64]) -> tuple[pa.Table, pa.Table]:
    if not len(repeated):
        return stars, stars.slice(0, 0)
    again = np.isin(places_of(stars), repeated)
    return stars.filter(pa.array(~again)), stars.filter(pa.array(again))


def _around(
    index: RunIndex, pixel: Pixel, reach_rad: float, repeated: NDArray[np.int64]
) -> Iterator[pa.Table]:
    """Give the stars around a pixel in pieces: of each batch those in the border's pixels."""
    order, border = border_of(pixel, reach_rad)
    for share in index.shares_of(order, border):
        piece = read_shares([share], 0, 12 << 2 * MAX_ORDER, COLUMNS)
        pixels = piece[HEALPIX_COLUMN].to_numpy()
        rows = rows_within(pixels, order, border, pixel)
        if len(rows):
            yield _without_repeated(piece.take(pa.array(rows)), repeated)[0]


def _map(pixels: Pixels) -> list[list[int]]:
    """Return the pixels of the map of counts that have stars, and how many; pixels ascend."""
    number, _, count = runs_of(pixels, SKYMAP_ORDER)
    return [number.tolist(), count.tolist()]


def _write_borders(stars: pa.Table, asked: Finish) -> list[Path]:
    """Write the stars that are in the margins of other partitions: one batch for each of those."""
    if not asked.beside:
        return []
    path = border_path(asked.borders, asked.pixel)
    pixels = stars[HEALPIX_COLUMN].to_numpy()
    schema = store_schema()
    with (
        placed(path) as partial,
        pa.OSFile(str(partial), "wb") as sink,
        pa.ipc.new_file(sink, schema) as writer,
    ):
        for other in asked.beside:
            order, border = border_of(other, asked.margin_rad)
            rows = rows_within(pixels, order, border, other)
            some = with_constants(stars.take(pa.array(rows)), schema)
            batches = some.combine_chunks().to_batches()
            writer.write_batch(batches[0] if batches else _empty(schema))
    return [path]


def _empty(schema: pa.Schema) -> pa.RecordBatch:
    return pa.RecordBatch.from_pylist([], schema=schema)


def rows_within(pixels: Pixels, order: int, wanted: Pixels, but: Pixel) -> NDArray[np.int64]:
    """Return the stars that lie in some pixels."""
    shift = 2 * (MAX_ORDER - order)
    begins = np.searchsorted(pixels, wanted << shift)
    ends = np.searchsorted(pixels, (wanted + 1) << shift)
    some = ends > begins
    ranges = [np.arange(b, e) for b, e in zip(begins[some], ends[some], strict=True)]
    rows = np.concatenate(ranges) if ranges else np.empty(0, dtype=np.int64)
    inside = (pixels[rows] >= but.first) & (pixels[rows] < but.end)
    return np.asarray(rows[~inside])


def border_path(folder: Path, pixel: Pixel) -> Path:
    """Return the file of the stars of a partition that border on others."""
    return folder / f"{pixel.order}-{pixel.number}.arrow"


@dataclass(frozen=True)
class Margin:
    """What is asked of a worker that writes the margin of a partition."""

    pixel: Pixel  # the partition
    batches: tuple[tuple[Path, int], ...]  # where its neighbours' stars are
    catalog: Path  # folder of the HATS margin catalog


def write_margin(asked: Margin) -> tuple[dict[str, Any], Digests]:
    """Write the margin of a partition."""
    stars = _read_borders(asked.batches)
    if not len(stars):
        return {"rows": 0}, {}
    path = asked.catalog / DATASET / asked.pixel.path
    keys = (stars["star_id"].to_numpy(), stars[HEALPIX_COLUMN].to_numpy())
    ordered = stars.take(pa.array(np.lexsort(keys)))
    write_partition(ordered, (len(stars),), path)
    return {"rows": len(stars), "bytes": path.stat().st_size}, digests_of([path])


def _read_borders(batches: Sequence[tuple[Path, int]]) -> pa.Table:
    found = []
    for path, number in batches:
        with pa.OSFile(str(path)) as source:
            found.append(pa.ipc.open_file(source).get_batch(number))
    return pa.Table.from_batches(found, found[0].schema).combine_chunks()
