"""Finish a store: make the partition of a pixel from runs, and write the stars near its borders.

The brightest stars of a partition come first; within a group of brightness stars are sorted by
pixel. Readers skip row groups by their smallest and largest magnitude. So the bright stars of the
whole sky can be found by reading one part in 64.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from starcat.catalog.ingest import unmoved_epochs
from starcat.catalog.parts import merged, parse_block, read_files
from starcat.catalog.source_files import InputFile
from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.catalog.stars.verdict import Reason, count_by_reason
from starcat.catalog.store.layout import (
    DATASET,
    HEALPIX_COLUMN,
    MAX_ORDER,
    Pixel,
    Pixels,
    border_of,
    pixel_field,
    runs_of,
)
from starcat.catalog.store.plan import StorePlan, rows_of_a_run
from starcat.catalog.store.runs import (
    HISTOGRAM_ORDER,
    Run,
    RunIndex,
    arrow_writer,
    read_index,
    read_shares,
    run_positions,
    with_constants,
    write_run,
)
from starcat.geometry.proximity import nearest_chords, separation_from_chord
from starcat.geometry.sphere import chord_from_separation
from starcat.storage.atomic import file_sha256, placed
from starcat.storage.schema import product_schema


@dataclass
class _Written:
    """The runs written for a file so far."""

    plan: StorePlan
    name: str  # name of its files
    order: int  # order of the coarse pixels of runs
    kept: int = 0  # number of stars
    runs: list[Run] = field(default_factory=list)
    pixels: list[Any] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    writer: pq.ParquetWriter | None = None
    closing: ExitStack = field(default_factory=ExitStack)

    def stars(self, stars: pa.Table) -> None:
        """Write a run, and count its stars by pixel."""
        name = f"{self.name}-{len(self.runs):04}"
        run, pixels = write_run(stars, self.order, self.plan.runs, name)
        self.runs.append(run)
        self.kept += len(stars)
        fine, _, counts = runs_of(pixels, HISTOGRAM_ORDER)
        self.pixels.append((fine, counts))
        self.files += [run.stars, run.places]

    def rejected(self, rejected: pa.Table) -> None:
        """Append to the file's rejected records, in the order of their lines."""
        path = self.plan.rejected / f"{self.name}.parquet"
        if self.writer is None:
            schema = product_schema("rejected").arrow_schema
            partial = self.closing.enter_context(placed(path))
            writer = pq.ParquetWriter(partial, schema, compression="zstd", compression_level=1)
            self.writer = self.closing.enter_context(writer)
            self.files.append(path)
        self.writer.write_table(rejected.sort_by("source_line"))

    def index(self) -> None:
        """Write the contents of the runs: batches, buckets and counts by pixel."""
        path = self.plan.runs / f"{self.name}.npz"
        pixels = np.concatenate([pixel for pixel, _ in self.pixels] or [np.empty(0, np.int64)])
        counts = np.concatenate([count for _, count in self.pixels] or [np.empty(0, np.int64)])
        fine, row = np.unique(pixels, return_inverse=True)
        arrays = {"pixels": fine, "counts": np.bincount(row, counts, len(fine)).astype(np.int64)}
        for k, run in enumerate(self.runs):
            arrays |= {f"batches{k}": run.pixels, f"buckets{k}": run.buckets}
        with placed(path) as partial, partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        self.files.append(path)


def split(plan: StorePlan, file: InputFile, order: int) -> tuple[dict[str, Any], list[Path]]:
    """Split an input into runs with batches by pixels of an order."""
    written = _Written(plan, split_name(file.number), order)
    (plan.rejected / f"{written.name}.parquet").unlink(missing_ok=True)
    parse = partial(parse_block, options=plan.ingest)
    counts: Counter[str] = Counter()
    with written.closing:
        reading, parts = next(read_files([file], parse))
        for part in merged(parts, rows_of_a_run(plan.options)):
            counts.update(count_by_reason(part.rejected, part.counted))
            if len(part.stars):
                written.stars(part.stars)
            if len(part.rejected):
                written.rejected(part.rejected)
    result = {
        "file": asdict(reading.facts),
        "kept": written.kept,
        "rejected": {r.name: counts[r.name] for r in Reason if counts.get(r.name)},
        "problems": list(reading.named_problems),
        "runs": len(written.runs),
    }
    written.index()
    return result, written.files


def split_name(number: int) -> str:
    """Return the name of the files for an input."""
    return f"file-{number:05}"


def is_unchanged(result: dict[str, Any], _: StorePlan, file: InputFile, __: int) -> bool:
    """Return whether a file is unchanged since it was split."""
    return bool(file_sha256(file.path) == result["file"]["sha256"])


COLUMNS = ("star_id", "x", "y", "z", "mag", "source_file", "source_line")
"""Columns needed of the surrounding stars."""

_SPACINGS = 3.0
"""Radius of the first search in mean distances of the stars: in a uniform sky, one star in 10^12
needs a second search."""

Around = Callable[[float], Iterator[pa.Table]]
"""Yields the stars outside a partition but within a distance (radians) of it, in pieces."""


@dataclass
class _Nearest:
    """The nearest neighbours found so far."""

    chord: NDArray[np.float64]
    mag: NDArray[np.float64]
    star_id: NDArray[np.int64]


def add_neighbours(stars: pa.Table, pixel: Pixel, around: Around, is_alone: bool) -> pa.Table:
    """Return the stars of a partition with the columns of the nearest neighbour."""
    if is_alone or not len(stars):
        return stars
    area = 4.0 * np.pi / (12 * 4**pixel.order)
    reach = float(min(_SPACINGS * np.sqrt(area / len(stars)), np.pi))
    directions = directions_of(stars)
    nearest = _among(stars, directions, list(around(reach)))
    while len(rows := np.flatnonzero(nearest.chord > chord_from_separation(reach) * (1.0 - 1e-9))):
        if reach >= np.pi:
            break
        reach = _farther(reach, float(nearest.chord[rows].max()))
        for piece in around(reach):
            _look(nearest, rows, directions, piece)
    mag = floats_of(stars, "mag")
    apart = np.degrees(separation_from_chord(nearest.chord)) * 3600.0
    stars = stars.append_column("nearest_separation_arcsec", pa.array(apart))
    delta = nearest.mag - mag
    return stars.append_column("nearest_delta_mag", pa.array(delta, mask=np.isnan(delta)))


def _farther(reach: float, chord: float) -> float:
    if not np.isfinite(chord):
        return min(8.0 * reach, np.pi)
    separation = float(separation_from_chord(np.array(chord)))
    return separation * (1.0 + 1e-6) if separation < 1.0 else np.pi


def _among(stars: pa.Table, directions: NDArray[np.float64], pieces: list[pa.Table]) -> _Nearest:
    """Return the nearest neighbours among the stars themselves and the stars in some pieces."""
    parts = [stars.select(["star_id", "mag"]), *(p.select(["star_id", "mag"]) for p in pieces)]
    number = np.concatenate([part["star_id"].to_numpy() for part in parts])
    mag = np.concatenate([floats_of(part, "mag") for part in parts])
    both = np.concatenate([directions, *(directions_of(piece) for piece in pieces)])
    rows = np.arange(len(stars))
    chord, index = nearest_chords(directions, both, rows, number)
    return _Nearest(chord, np.append(mag, np.nan)[index], np.append(number, 0)[index])


def _look(
    nearest: _Nearest, rows: NDArray[np.int64], directions: NDArray[np.float64], piece: pa.Table
) -> None:
    """Replace the neighbours of some rows by stars of a piece that are nearer."""
    if not len(piece):
        return
    number = piece["star_id"].to_numpy()
    nobody = np.full(len(rows), -1)
    chord, index = nearest_chords(directions[rows], directions_of(piece), nobody, number)
    mag, number = floats_of(piece, "mag")[index], number[index]
    is_nearer = chord < nearest.chord[rows]
    # At equal distance, take the star with the lower number.
    is_nearer |= (chord == nearest.chord[rows]) & (number < nearest.star_id[rows])
    rows = rows[is_nearer]
    nearest.chord[rows], nearest.mag[rows] = chord[is_nearer], mag[is_nearer]
    nearest.star_id[rows] = number[is_nearer]


SKYMAP_ORDER = 6
"""Order of the map of star counts (55 arcmin)."""

ROW_GROUP_ROWS = 1 << 16
_SHARES = (64, 8)
"""The brightest 64th of the stars, then up to the brightest 8th, then the remaining stars."""

_MIN_ROWS = 1024
"""Smallest number of stars in a group of brightness."""


def finish(
    plan: StorePlan,
    pixel: Pixel,
    beside: tuple[Pixel, ...],
    index_path: Path,
    repeated_path: Path,
    is_alone: bool,
) -> tuple[dict[str, Any], list[Path]]:
    """Write the partition of a pixel, and its stars that are in the margins of other partitions.

    The given files list the contents of the runs, and the records whose star was read before. If
    the whole catalog has only one star, it has no neighbour.
    """
    index, repeated = read_index(index_path), _read_places(repeated_path)
    stars = read_shares(index.shares(pixel), pixel.first, pixel.end)
    stars, again = _without_repeated(stars, repeated)
    files: list[Path] = []
    if len(again):
        path = plan.repeated / f"{pixel.order}-{pixel.number}.parquet"
        path.parent.mkdir(exist_ok=True)
        with placed(path) as partial:
            schema = product_schema("stars").arrow_schema
            again = again.take(pa.array(_ascending(again)))
            pq.write_table(with_constants(again, schema), partial, compression="zstd")
        files.append(path)
    result: dict[str, Any] = {"rows": len(stars), "repeated": len(again)}
    result["unmoved"] = unmoved_epochs(stars, plan.ingest.epoch_jyear)
    if not len(stars):
        return result, files

    def around(reach_rad: float) -> Iterator[pa.Table]:
        return _around(index, pixel, reach_rad, repeated)

    stars = add_neighbours(stars, pixel, around, is_alone)
    order = _ascending(stars)
    pixels = stars[HEALPIX_COLUMN].to_numpy()[order]
    # Pixels with stars, ascending, and their numbers of stars.
    number, _, count = runs_of(pixels, SKYMAP_ORDER)
    result["map"] = [number.tolist(), count.tolist()]
    files += _write_borders(stars, order, pixels, plan, pixel, beside)
    path = plan.catalog / DATASET / pixel.path
    bright_first, rows = _bright_first(floats_of(stars, "mag")[order])
    ordered = stars.take(pa.array(order[bright_first]))
    write_partition(with_constants(ordered, store_schema()), rows, path)
    result |= {"sha256": file_sha256(path), "bytes": path.stat().st_size}
    return result, [*files, path]


@lru_cache(maxsize=1)
def store_schema() -> pa.Schema:
    """Return the columns of a store."""
    schema = product_schema("stars").arrow_schema
    return pa.schema([pixel_field(), *schema], metadata=schema.metadata)


def _ascending(stars: pa.Table) -> NDArray[np.int64]:
    """Return the rows by pixel and number; records of the same star in reading order."""
    pixels = stars[HEALPIX_COLUMN].to_numpy()
    order = np.argsort(pixels, kind="stable")
    if (np.diff(pixels[order]) == 0).any():
        order = np.lexsort((run_positions(stars), stars["star_id"].to_numpy(), pixels))
    return order


@lru_cache(maxsize=2)
def _read_places(path: Path) -> NDArray[np.int64]:
    return np.asarray(np.load(path))


def _without_repeated(stars: pa.Table, repeated: NDArray[np.int64]) -> tuple[pa.Table, pa.Table]:
    if not len(repeated):
        return stars, stars.slice(0, 0)
    again = np.isin(run_positions(stars), repeated)
    return stars.filter(pa.array(~again)), stars.filter(pa.array(again))


def _around(
    index: RunIndex, pixel: Pixel, reach_rad: float, repeated: NDArray[np.int64]
) -> Iterator[pa.Table]:
    """Yield the stars around a pixel in pieces: from each batch the stars in border pixels."""
    order, border = border_of(pixel, reach_rad)
    for share in index.shares_of(order, border):
        piece = read_shares([share], 0, 12 << 2 * MAX_ORDER, COLUMNS)
        pixels = piece[HEALPIX_COLUMN].to_numpy()
        rows = rows_within(pixels, order, border, pixel)
        if len(rows):
            yield _without_repeated(piece.take(pa.array(rows)), repeated)[0]


def _write_borders(
    stars: pa.Table,
    order: NDArray[np.int64],
    pixels: Pixels,
    plan: StorePlan,
    pixel: Pixel,
    beside: tuple[Pixel, ...],
) -> list[Path]:
    """Write the stars that are in the margins of other partitions: one batch per partition.

    ``pixels`` has the pixel of each row.
    """
    if not beside:
        return []
    path = border_path(plan, pixel)
    schema = store_schema()
    with arrow_writer(path, schema) as writer:
        for other in beside:
            rows = order[rows_within(pixels, *border_of(other, plan.margin_rad), other)]
            some = with_constants(stars.take(pa.array(rows)), schema)
            batches = some.combine_chunks().to_batches()
            empty = pa.RecordBatch.from_pylist([], schema=schema)
            writer.write_batch(batches[0] if batches else empty)
    return [path]


def rows_within(pixels: Pixels, order: int, border: Pixels, but: Pixel) -> NDArray[np.int64]:
    """Return the rows of the stars in border pixels, except the stars of one pixel."""
    shift = 2 * (MAX_ORDER - order)
    begins = np.searchsorted(pixels, border << shift)
    ends = np.searchsorted(pixels, (border + 1) << shift)
    some = ends > begins
    ranges = [np.arange(b, e) for b, e in zip(begins[some], ends[some], strict=True)]
    rows = np.concatenate(ranges) if ranges else np.empty(0, dtype=np.int64)
    inside = (pixels[rows] >= but.first) & (pixels[rows] < but.end)
    return np.asarray(rows[~inside])


def border_path(plan: StorePlan, pixel: Pixel) -> Path:
    """Return the file with the stars of a partition that are in other partitions' margins."""
    return plan.borders / f"{pixel.order}-{pixel.number}.arrow"


def write_margin(
    plan: StorePlan, pixel: Pixel, batches: tuple[tuple[Path, int], ...]
) -> tuple[dict[str, Any], list[Path]]:
    """Write the margin of a partition, from batches of the border files of its neighbours."""
    stars = _read_borders(batches)
    if not len(stars):
        return {"rows": 0}, []
    path = plan.margin / DATASET / pixel.path
    keys = (stars["star_id"].to_numpy(), stars[HEALPIX_COLUMN].to_numpy())
    ordered = stars.take(pa.array(np.lexsort(keys)))
    write_partition(ordered, (len(stars),), path)
    return {"rows": len(stars), "bytes": path.stat().st_size}, [path]


def _read_borders(batches: Sequence[tuple[Path, int]]) -> pa.Table:
    loaded = []
    for path, number in batches:
        with pa.OSFile(str(path)) as source:
            loaded.append(pa.ipc.open_file(source).get_batch(number))
    return pa.Table.from_batches(loaded, loaded[0].schema).combine_chunks()


def _bright_first(mag: NDArray[np.float64]) -> tuple[NDArray[np.int64], tuple[int, ...]]:
    """Return the order for writing the stars of a partition, and the rows per group."""
    group = _groups(mag)
    counts = np.bincount(group)
    return np.argsort(group, kind="stable"), tuple(counts[counts > 0].tolist())


def _groups(mag: NDArray[np.float64]) -> NDArray[np.int8]:
    mags = mag[~np.isnan(mag)]
    ranks = [len(mags) // share for share in _SHARES if len(mags) // share >= _MIN_ROWS]
    cuts = np.partition(mags, ranks)[ranks] if ranks else mags[:0]
    # Stars with exactly the limiting magnitude all belong to the fainter group.
    group = np.searchsorted(cuts, mag, side="right").astype(np.int8)
    group[np.isnan(mag)] = len(cuts) + 1
    return group


def write_partition(stars: pa.Table, rows: tuple[int, ...], path: Path) -> None:
    """Write a partition; the same stars and library version give the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    begin = 0
    encodings = _encodings(stars.schema)
    with placed(path) as partial, pq.ParquetWriter(partial, stars.schema, **encodings) as writer:
        for count in rows:
            writer.write_table(stars.slice(begin, count), row_group_size=ROW_GROUP_ROWS)
            begin += count


def _encodings(schema: pa.Schema) -> dict[str, object]:
    """Return the encodings of columns: ascending numbers are stored as differences."""
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
