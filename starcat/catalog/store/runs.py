"""Runs: files with the stars of one input, sorted by pixel. A partition reads its share of them.

Splitting an archive writes runs; finishing a partition reads from every run the batches of its
pixels. A run has one Arrow batch for each coarse pixel. A second file has the numbers of its stars
in buckets, to find records of the same star anywhere on the sky.

A column with the same value in the whole run, such as a column that the archive lacks, is stored
as one value in the run's metadata. For 2MASS this saves half of the bytes.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from isal import isal_zlib
from numpy.typing import NDArray

from starcat.catalog.stars.star_table import floats_of, nulls
from starcat.catalog.store.layout import (
    HEALPIX_COLUMN,
    Pixel,
    Pixels,
    at_order,
    healpix_29,
    pixel_field,
    runs_of,
)
from starcat.errors import ConfigError, OutputError
from starcat.storage.atomic import json_bytes, placed, writing
from starcat.storage.schema import product_schema

OPTIONS_NAME = "options.json"
RESUME_ADVICE = "finished parts are kept: make space, then continue with resume=True"
_DONE = "done"


def _checksum(path: Path) -> str:
    """Return the CRC-32 of a file: it detects half-written or damaged files, not manipulation."""
    checksum = 0
    with path.open("rb") as file:
        while data := file.read(1 << 20):
            checksum = isal_zlib.crc32(data, checksum)
    return f"{checksum:08x}"


@dataclass(frozen=True)
class ResumePlan:
    """The hidden folder of a run."""

    folder: Path  # ``.<name>.work`` next to the final folder

    @classmethod
    def of(cls, final: Path) -> ResumePlan:
        """Return the folder for a store."""
        return cls(final.absolute().parent / f".{final.name}.work")

    def __truediv__(self, name: str) -> Path:
        """Return a path in the folder."""
        return self.folder / name

    def begin(self, options: Mapping[str, Any], *, resume: bool) -> None:
        """Make the folder, or resume the run in it."""
        path = self / OPTIONS_NAME
        if path.is_file() and not resume:
            raise OutputError(
                "an unfinished run is there",
                where=self.folder,
                hint=("continue it with {resume:True}", "remove the folder to start again"),
            )
        if path.is_file():
            self._check_options(json.loads(path.read_text(encoding="utf-8")), options)
            return
        with writing(self.folder.parent, "choose another {output}"):
            shutil.rmtree(self.folder, ignore_errors=True)
            (self / _DONE).mkdir(parents=True)
            path.write_bytes(json_bytes(dict(options)))

    def end(self) -> None:
        """Record that the run has ended, so that its folder can be removed.

        The name of the store's folder is then exchanged with the name of an earlier store, whose
        files a later run must not take for its own.
        """
        (self / OPTIONS_NAME).unlink(missing_ok=True)

    def _check_options(self, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
        for key, value in now.items():
            if before.get(key) != value:
                raise ConfigError(
                    f"the unfinished run has {key} {_short(before.get(key))}, this "
                    f"one {_short(value)}",
                    where=self.folder,
                    key=key,
                    value=value,
                    hint="resume it with the same, or remove the folder to start again",
                )

    def done(self, name: str) -> dict[str, Any] | None:
        """Return the result of a finished task, or None."""
        path = self._record(name)
        try:
            record = json.loads(path.read_bytes())
            files: dict[str, str] = record["files"]
            if all(_checksum(self / file) == checksum for file, checksum in files.items()):
                result: dict[str, Any] = record["result"]
                return result
        except (OSError, ValueError, KeyError, TypeError):
            pass
        return None

    def record(self, name: str, result: Mapping[str, Any], written: Iterable[Path]) -> None:
        """Record the result of a finished task."""
        files = {file.relative_to(self.folder).as_posix(): _checksum(file) for file in written}
        path = self._record(name)
        # If a worker was wrongly considered dead, two workers do the same task and write the same.
        partial = path.with_name(f".{path.name}.{os.getpid()}")
        partial.write_bytes(json_bytes({"files": files, "result": dict(result)}))
        partial.replace(path)

    def _record(self, name: str) -> Path:
        return self.folder / _DONE / f"{name}.json"


@dataclass(frozen=True)
class Task:
    """A function call that is made only once: a task with a recorded result is not run again.

    The function returns its result as plain values, and the paths of the files that it wrote.
    """

    plan: ResumePlan
    name: str  # unique in the run
    function: Callable[..., tuple[dict[str, Any], list[Path]]]
    arguments: tuple[Any, ...]
    # returns whether an earlier result is valid for the arguments; None: it always is
    is_valid: Callable[..., bool] | None = None

    def run(self) -> dict[str, Any]:
        """Run and record the task, unless it has a valid result."""
        before = self.plan.done(self.name)
        if before is not None and (self.is_valid is None or self.is_valid(before, *self.arguments)):
            return before
        with writing(self.plan.folder.parent, RESUME_ADVICE):
            result, written = self.function(*self.arguments)
            self.plan.record(self.name, result, written)
        return result


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:60]}…"


BUCKETS = 64
HISTOGRAM_ORDER = 9
"""Order of the pixels for counting stars (7 arcmin): no partition is smaller than such a pixel."""

_CONSTANTS = b"starcat.constants"
_VARIES = object()
_NEEDED = ("mag", "source_file")
"""Columns that are always stored in full, because a partition computes with them."""

_SPREAD = np.uint64(0x9E3779B97F4A7C15)
_LINE_BITS = np.int64(40)

PLACES = np.dtype([("star_id", np.int64), ("place", np.int64)])
"""For each record: the number of its star, and file and line as one number (`run_positions`)."""


@dataclass(frozen=True)
class Run:
    """A run on disk."""

    stars: Path  # Arrow file
    places: Path  # file with `PLACES`, sorted by bucket
    pixels: Pixels  # shape (B,): the coarse pixel of each batch
    buckets: NDArray[np.int64]  # shape (BUCKETS + 1,): start of each bucket in ``places``


Share = tuple[Path, list[int]]
"""A partition's share of a run: the Arrow file, and the ascending numbers of batches."""


def run_positions(stars: pa.Table) -> NDArray[np.int64]:
    """Return file and line of every star as one number, in reading order."""
    file = stars["source_file"].to_numpy().astype(np.int64)
    return np.asarray((file << _LINE_BITS) | stars["source_line"].to_numpy())


def write_run(stars: pa.Table, order: int, folder: Path, name: str) -> tuple[Run, Pixels]:
    """Write stars as a run."""
    pixels = healpix_29(floats_of(stars, "ra_deg"), floats_of(stars, "dec_deg"))
    ascending = np.argsort(pixels, kind="stable")
    pixels = pixels[ascending]
    varying, constants = _without_constants(stars)
    table = varying.combine_chunks().take(pa.array(ascending))
    table = table.add_column(0, HEALPIX_COLUMN, pa.array(pixels))
    table = table.replace_schema_metadata({_CONSTANTS: json.dumps(constants).encode()})
    coarse, begins, rows = runs_of(pixels, order)
    path = folder / f"{name}.arrow"
    with arrow_writer(path, table.schema) as writer:
        for begin, count in zip(begins.tolist(), rows.tolist(), strict=True):
            for batch in table.slice(begin, count).combine_chunks().to_batches():
                writer.write_batch(batch)
    places, buckets = _by_bucket(stars)
    beside = folder / f"{name}.places"
    with placed(beside) as partial:
        partial.write_bytes(places.tobytes())
    return Run(path, beside, coarse, buckets), pixels


@contextmanager
def arrow_writer(path: Path, schema: pa.Schema) -> Iterator[pa.RecordBatchWriter]:
    """Open an Arrow file for batches; it gets its name after the last batch."""
    with (
        placed(path) as partial,
        pa.OSFile(str(partial), "wb") as sink,
        pa.ipc.new_file(sink, schema) as writer,
    ):
        yield writer


def _without_constants(stars: pa.Table) -> tuple[pa.Table, dict[str, Any]]:
    """Remove the columns that have one value in all rows; return these values too."""
    constants: dict[str, Any] = {}
    for name in stars.column_names:
        column = stars[name]
        kind = column.type
        if column.null_count == len(stars):
            constants[name] = None
        elif column.null_count or not (
            pa.types.is_string(kind) or pa.types.is_boolean(kind) or pa.types.is_int32(kind)
        ):
            continue
        elif pc.all(pc.equal(column, column[0])).as_py():
            constants[name] = column[0].as_py()
    return stars.drop_columns(list(constants)), constants


def _by_bucket(stars: pa.Table) -> tuple[NDArray[Any], NDArray[np.int64]]:
    numbers = stars["star_id"].to_numpy()
    bucket = (numbers.view(np.uint64) * _SPREAD >> np.uint64(58)).astype(np.int8)
    order = np.argsort(bucket, kind="stable")
    places = np.empty(len(numbers), dtype=PLACES)
    places["star_id"] = numbers[order]
    places["place"] = run_positions(stars)[order]
    counts = np.bincount(bucket, minlength=BUCKETS)
    return places, np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def read_shares(
    shares: Sequence[Share], first: int, end: int, names: Sequence[str] | None = None
) -> pa.Table:
    """Read the stars of some pixels from their runs."""
    schema = product_schema("stars").arrow_schema
    requested = list(schema.names if names is None else names)
    parts: list[pa.Table] = []
    all_constants: list[dict[str, Any]] = []
    for share in shares:
        table, constants = _read_share(share, requested)
        begin, stop = np.searchsorted(table[HEALPIX_COLUMN].to_numpy(), [first, end])
        parts.append(table.slice(begin, stop - begin))
        all_constants.append(constants)
    return _joined(parts, all_constants, [schema.field(name) for name in requested])


def _read_share(share: Share, names: Sequence[str]) -> tuple[pa.Table, dict[str, Any]]:
    """Return batches of a run as one table sorted by pixel, and the columns of one value."""
    path, batches = share
    with pa.OSFile(str(path)) as source:
        schema = pa.ipc.open_file(source).schema
        places = [k for k, name in enumerate(schema.names) if name in (HEALPIX_COLUMN, *names)]
        options = pa.ipc.IpcReadOptions(included_fields=places)
        reader = pa.ipc.open_file(source, options=options)
        constants = json.loads(schema.metadata[_CONSTANTS])
        return pa.Table.from_batches([reader.get_batch(n) for n in batches]), constants


def _joined(
    parts: Sequence[pa.Table],
    all_constants: Sequence[Mapping[str, Any]],
    fields: Sequence[pa.Field],
) -> pa.Table:
    """Join batches; a column that has one value in all of them stays a constant."""
    common: dict[str, Any] = {}
    pixels = [chunk for part in parts for chunk in part[HEALPIX_COLUMN].chunks]
    columns = [pa.chunked_array(pixels, pa.int64())]
    kept = [pixel_field()]
    for field in fields:
        values = {constants.get(field.name, _VARIES) for constants in all_constants}
        if len(values) == 1 and _VARIES not in values and field.name not in _NEEDED:
            common[field.name] = values.pop()
            continue
        chunks = []
        for part, constants in zip(parts, all_constants, strict=True):
            if field.name in part.column_names:
                chunks += part[field.name].chunks
            else:
                chunks.append(_constant(constants[field.name], len(part), field.type))
        columns.append(pa.chunked_array(chunks, field.type))
        kept.append(field)
    table = pa.Table.from_arrays(columns, schema=pa.schema(kept)).combine_chunks()
    return table.replace_schema_metadata({_CONSTANTS: json.dumps(common).encode()})


def with_constants(stars: pa.Table, schema: pa.Schema) -> pa.Table:
    """Return stars with the columns of one value restored."""
    constants = json.loads((stars.schema.metadata or {}).get(_CONSTANTS, b"{}"))
    columns = [
        stars[field.name]
        if field.name in stars.column_names
        else _constant(constants[field.name], len(stars), field.type)
        for field in schema
    ]
    return pa.Table.from_arrays(columns, schema=schema)


def _constant(value: Any, count: int, kind: pa.DataType) -> pa.Array:
    return nulls(count, kind) if value is None else pa.repeat(pa.scalar(value, kind), count)


@dataclass(frozen=True)
class RunIndex:
    """Batches by coarse pixel."""

    order: int  # order of the coarse pixels
    paths: tuple[Path, ...]  # arrow files of the runs
    pixels: Pixels  # shape (B,): coarse pixel of each batch, ascending
    runs: NDArray[np.int64]  # shape (B,): the run of each batch
    batches: NDArray[np.int64]  # shape (B,): its number in the run
    # shape (R, BUCKETS + 1): start of each bucket of numbers in the places of each run
    buckets: NDArray[np.int64]

    def shares(self, pixel: Pixel) -> list[Share]:
        """Return the batches with the stars of a pixel."""
        return self.shares_of(pixel.order, np.array([pixel.number]))

    def shares_of(self, order: int, pixels: Pixels) -> list[Share]:
        """Return the batches with the stars of several pixels."""
        coarse = at_order(order, pixels, self.order)
        begins = np.searchsorted(self.pixels, coarse)
        ends = np.searchsorted(self.pixels, coarse, side="right")
        ranges = [np.arange(b, e) for b, e in zip(begins, ends, strict=True) if e > b]
        if not ranges:
            return []
        rows = np.concatenate(ranges)
        shares: list[Share] = []
        for run in np.unique(self.runs[rows]).tolist():
            batches = np.sort(self.batches[rows[self.runs[rows] == run]])
            shares.append((self.paths[run], batches.tolist()))
        return shares


def read_runs(path: Path, count: int) -> list[Run]:
    """Read the list of runs of a file."""
    with np.load(path) as arrays:
        return [
            Run(
                path.with_name(f"{path.stem}-{k:04}.arrow"),
                path.with_name(f"{path.stem}-{k:04}.places"),
                arrays[f"batches{k}"],
                arrays[f"buckets{k}"],
            )
            for k in range(count)
        ]


def write_index(path: Path, order: int, runs: Sequence[Run]) -> None:
    """Write the index of all runs."""
    empty = np.empty(0, dtype=np.int64)
    pixels = np.concatenate([empty, *(run.pixels for run in runs)])
    number = np.repeat(np.arange(len(runs)), [len(run.pixels) for run in runs])
    batch = np.concatenate([empty, *(np.arange(len(run.pixels)) for run in runs)])
    ascending = np.argsort(pixels, kind="stable")
    np.savez(
        path,
        order=order,
        paths=np.array([str(run.stars) for run in runs], dtype=np.str_),
        pixels=pixels[ascending],
        runs=number[ascending],
        batches=batch[ascending],
        buckets=np.array([run.buckets for run in runs]).reshape(len(runs), BUCKETS + 1),
    )


@lru_cache(maxsize=2)
def read_index(path: Path) -> RunIndex:
    """Read the index of all runs; a worker reads it once."""
    with np.load(path) as arrays:
        paths = tuple(Path(text) for text in arrays["paths"].tolist())
        names = ("pixels", "runs", "batches", "buckets")
        return RunIndex(int(arrays["order"]), paths, *(arrays[name] for name in names))


def find_repeated(asked: tuple[Path, int]) -> NDArray[np.int64]:
    """Return the records of a bucket of numbers whose star was read before."""
    index, bucket = read_index(asked[0]), asked[1]
    parts = [np.empty(0, PLACES)]
    for path, (begin, end) in zip(index.paths, index.buckets[:, bucket : bucket + 2], strict=True):
        file, offset = path.with_suffix(".places"), begin * PLACES.itemsize
        parts.append(np.fromfile(file, PLACES, end - begin, offset=offset))
    places = np.concatenate(parts)
    numbers = np.sort(places["star_id"])
    some = places[np.isin(places["star_id"], numbers[1:][numbers[1:] == numbers[:-1]])]
    some = some[np.lexsort((some["place"], some["star_id"]))]
    again = some["star_id"][1:] == some["star_id"][:-1]
    return np.sort(some["place"][1:][again])
