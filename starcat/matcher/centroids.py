"""Files of centroids: tables of text, NumPy arrays, and JSON of one frame or of many.

`starcat.matcher.centroid_columns` has the names of columns, which are the names of keys of JSON,
too. JSON is a frame, a list of frames, an object with the key ``frames``, or one frame per line. A
frame is an object with ``centroids_px`` (pairs of numbers) or with columns, or a list of pairs or
rows. FITS, VOTable and Parquet are read by `starcat.frames.images.centroid_tables`.
"""

from __future__ import annotations

import csv
import io
import json
import os
import reprlib
import sys
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from starcat.arguments import columns_of, numbers_of
from starcat.arrays import Array
from starcat.errors import ConfigError, FileMissing, OutputError, SourceError, count_of, reason
from starcat.html_tables import html_table
from starcat.matcher.centroid_columns import (
    EXPECTED,
    PIXELS,
    choose_columns,
    listed,
    values_of_columns,
)
from starcat.matcher.centroid_text import HEADLESS, decoded_text, read_text_table
from starcat.storage.compressed import GZIP, expanded
from starcat.storage.file_formats import unread_format
from starcat.storage.regular_files import read_regular_file


@dataclass(frozen=True, eq=False, repr=False)
class MeasuredFrame:
    """The centroids of one frame, as in its file.

    Attributes
    ----------
    name : str
        Name of the frame; the name of the file if the frame has no name.
    centroids_px : ndarray of float64, shape (N, 2)
        Pixels, in the order of the file.
    mag : ndarray of float64, shape (N,), or None
        Magnitudes, NaN for a centroid without one; None if the file has none. For a column of
        light they are -2.5 log10 of it, with an unknown zero point.
    sigma_px : ndarray of float64, shape (N,), or None
        Noise of each centroid on each axis, px; NaN if not stated.
    remarks : tuple of str
        What was not used, and what was assumed, in sentences.
    """

    name: str
    centroids_px: Array
    mag: Array | None = None
    sigma_px: Array | None = None
    remarks: tuple[str, ...] = ()

    def __repr__(self) -> str:
        names = {"magnitudes": self.mag, "noises": self.sigma_px}
        extras = " and ".join(name for name, values in names.items() if values is not None)
        count = count_of(len(self.centroids_px), "centroid")
        return f"<MeasuredFrame {self.name!r}: {count}{' with ' + extras if extras else ''}>"

    def _repr_html_(self) -> str:
        """Return the first centroids as a table for a notebook."""
        (x, y), optional = self.centroids_px.T, (("mag", self.mag), ("sigma px", self.sigma_px))
        columns = {"x px": x, "y px": y} | {
            name: values for name, values in optional if values is not None
        }
        rows = zip(
            *([f"{value:.2f}" for value in values] for values in columns.values()), strict=True
        )
        return html_table(tuple(columns), rows, len(x), repr(self)[1:-1])


MAX_BYTES = 1 << 30
"""Largest size of a file of centroids: ten million centroids as text."""

MAX_EXPANDED_BYTES = 1 << 26
"""Largest size of a compressed file of centroids after expansion: a million centroids."""

_NPY, _ZIP = b"\x93NUMPY", b"PK\x03\x04"
_LIBRARY_FORMATS = {
    b"SIMPLE  =": "a FITS file", b"PAR1": "a Parquet file", b"<?xml": "an XML file",
    b"<VOTABLE": "a VOTable",
}  # fmt: skip
"""Beginnings of files that `starcat.frames.images.centroid_tables` reads."""


def read_centroid_files(path: str | os.PathLike[str]) -> list[MeasuredFrame]:
    """Read the frames of a centroid file."""
    path = Path(path)
    return frames_of_data(data_of_centroids(path), path)


def data_of_centroids(path: Path) -> bytes:
    """Return the content of a centroid file, expanded if it is compressed."""
    try:
        data = read_regular_file(path, MAX_BYTES)
    except FileMissing as error:
        text = f"{path}: no such file; give centroids (CSV, JSON) or an image"
        raise FileMissing(text) from error
    except SourceError as error:
        raise ConfigError(f"{error}; expected centroids (CSV, JSON)") from error
    return expanded(data, MAX_EXPANDED_BYTES, path) if data.startswith(GZIP) else data


def frames_of_data(data: bytes, path: Path) -> list[MeasuredFrame]:
    """Return the frames of the content of a centroid file: text, JSON, or arrays of NumPy."""
    if data.startswith((_NPY, _ZIP)):
        return _frames_of_numpy(data, path)
    name = next((name for start, name in _LIBRARY_FORMATS.items() if data.startswith(start)), None)
    if name is not None:
        raise ConfigError(
            f"{path}: is {name}, which only starcat-guide-stars reads",
            hint="install it, or convert the file to centroids (CSV, JSON)",
        )
    file_format, text = unread_format(path, data), decoded_text(data)
    if text is None or file_format is not None:
        file_format = file_format or "not a text file"
        raise ConfigError(
            f"{path}: is {file_format}, which is not supported",
            hint="convert it to an image (FITS, PNG, TIFF, JPEG, HEIC, BMP), or to centroids "
            "(CSV, JSON; as text: UTF-8)",
        )
    if path.suffix.lower() == ".json" and not text.lstrip().startswith(("{", "[")):
        json_of(text, str(path))  # states why it is not JSON
    return list(read_stream(text.splitlines(keepends=True), path.stem, where=str(path)))


def frames_of_table(columns: Mapping[str, Any], name: str, where: str) -> list[MeasuredFrame]:
    """Return the frames of a table of a file: one, or one for each value of its column frame."""

    def wrong_shape(what: str, array: Array, expected: str) -> ConfigError:
        return ConfigError(f"{where}: {what} shape {array.shape}; expected {expected}")

    try:
        values = values_of_columns(columns, f"{where}: has", wrong_shape)
    except ConfigError as error:
        if str(error).startswith(where):
            raise
        raise ConfigError(f"{where}: {error}") from error
    px = np.asarray(values.centroids_px, dtype=np.float64)
    if px.ndim != 2 or px.shape[1] != 2:
        raise wrong_shape(f"{PIXELS} has", px, "(N, 2)")

    def each(values: Any) -> Array | None:
        if values is None:
            return None
        numbers = numbers_of("a column", values, f"({len(px)},)")
        if numbers.shape != (len(px),):
            raise wrong_shape("a column has", numbers, f"({len(px)},), one value per centroid")
        return numbers

    whole = MeasuredFrame(name, px, each(values.mag), each(values.sigma_px), values.remarks)
    return split_frames(whole, values.frame)


def split_frames(whole: MeasuredFrame, names: Any) -> list[MeasuredFrame]:
    """Return the frames of a table by the names of the frame of each row, in their order."""
    if names is None:
        return [whole]
    of_row = np.asarray(names).astype(np.str_)
    mag, sigma_px = whole.mag, whole.sigma_px
    frames = []
    for name in dict.fromkeys(of_row.tolist()):
        rows = np.flatnonzero(of_row == name)
        frames.append(
            replace(
                whole,
                name=name or whole.name,
                centroids_px=whole.centroids_px[rows],
                mag=None if mag is None else mag[rows],
                sigma_px=None if sigma_px is None else sigma_px[rows],
            )
        )
    return frames or [whole]


def _text_frames(text: str, name: str, where: str) -> list[MeasuredFrame]:
    table = read_text_table(text, where)
    layout, values = table.layout, table.values
    whole = MeasuredFrame(
        name,
        layout.pixels(values[layout.x], values[layout.y]),
        None if layout.light is None else layout.magnitudes(values[layout.light]),
        None if layout.sigma is None else values[layout.sigma],
        table.remarks,
    )
    return split_frames(whole, table.frame)


def _frames_of_numpy(data: bytes, path: Path) -> list[MeasuredFrame]:
    """Return the frames of an ``.npy`` or ``.npz`` file."""
    where = str(path)
    try:
        if data.startswith(_NPY):
            return _frames_of_array(np.load(io.BytesIO(data)), path.stem, where)
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
            names = archive.namelist()
            if "xl/workbook.xml" in names:
                raise ConfigError(f"{where}: is a workbook of Excel", hint="save the table as CSV")
            if not all(name.endswith(".npy") for name in names):
                raise ConfigError(
                    f"{where}: is a ZIP archive", hint="unpack it, and give its files"
                )
        if size > MAX_EXPANDED_BYTES:
            raise ConfigError(
                f"{where}: expands to {size:,} bytes; at most {MAX_EXPANDED_BYTES:,} are read",
                hint="Give fewer centroids",
            )
        with np.load(io.BytesIO(data)) as arrays:
            columns = {name: arrays[name] for name in arrays.files}
    except ConfigError:
        raise
    except zipfile.BadZipFile as error:
        raise ConfigError(
            f"{where}: begins as a ZIP archive and cannot be unpacked ({error})",
            hint=(
                "Save the table as CSV if it is a spreadsheet (xlsx, ods)",
                "write it again if it is an npz file of NumPy",
            ),
        ) from error
    except Exception as error:  # damaged bytes make NumPy raise anything, even MemoryError
        raise ConfigError(f"{where}: cannot be read as a file of NumPy ({error})") from error
    if len(columns) == 1 and choose_columns(list(columns)) is None:
        return _frames_of_array(next(iter(columns.values())), path.stem, where)
    return frames_of_table(columns, path.stem, where)


def _frames_of_array(values: Array, name: str, where: str) -> list[MeasuredFrame]:
    columns = columns_of(values)
    if columns is None:
        if values.ndim != 2 or values.shape[1] not in HEADLESS:
            raise ConfigError(
                f"{where}: an array of shape {values.shape}; expected (N, 2) with x and y in "
                "pixels, or (N, 3) with magnitudes, too"
            )
        columns = dict(zip(HEADLESS[values.shape[1]], values.T, strict=True))
    return frames_of_table(columns, name, where)


def json_of(text: str, where: str) -> Any:
    """Return the content of a text of JSON."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{where}: not JSON ({error})") from error


def _json_frames(content: Any, name: str, where: str) -> list[MeasuredFrame]:
    """Return the frames of a content of JSON."""
    beside: tuple[str, ...] = ()
    if isinstance(content, dict) and isinstance(content.get("frames"), list):
        unused = [key for key in content if key != "frames"]
        beside = (f"not used: {listed(unused)}, beside 'frames'",) if unused else ()
        content = content["frames"]
    elif not (isinstance(content, list) and all(map(_is_one_frame, content))):
        content = [content]
    if not content:
        raise ConfigError(f"{where}: no frames; expected at least one")
    several = len(content) > 1
    frames = [
        measured
        for number, frame in enumerate(content, start=1)
        for measured in _json_frame(
            frame,
            f"{name} {number}" if several else name,
            f"{where}: frame {number}" if several else where,
        )
    ]
    if not beside:
        return frames
    return [replace(measured, remarks=(*measured.remarks, *beside)) for measured in frames]


def _is_one_frame(value: Any) -> bool:
    """Return whether an entry of a list of JSON is a frame, and not a row of one."""
    if isinstance(value, dict):
        return any(isinstance(item, list | dict) for item in value.values()) or not value
    return isinstance(value, list) and bool(value) and isinstance(value[0], list | dict)


def _json_frame(frame: Any, name: str, where: str) -> list[MeasuredFrame]:
    """Return a frame of JSON; a table with a column ``frame`` can have several."""
    if isinstance(frame, dict):
        name = str(frame.get("name", name))
        if isinstance(frame.get(PIXELS), list):
            return [_frame_of_pairs(frame, name, where)]
        columns = _columns_of_json(frame)
    else:
        columns = _columns_of_rows(frame, where) if isinstance(frame, list) else None
    if columns is None or choose_columns(list(columns)) is None:
        keys = f"has the keys {listed(list(frame))}" if isinstance(frame, dict) else "is no frame"
        if isinstance(frame, list) and columns:
            keys = f"has the keys {listed(list(columns))}"
        raise ConfigError(
            f"{where}: {keys}; expected an object with '{PIXELS}', a list of [x, y] pairs, or with "
            "the columns 'x_px' and 'y_px'"
        )
    numbers = {
        key: [_number(value, key, f"{where}: row {n}") for n, value in enumerate(values, 1)]
        if key != "frame"
        else values
        for key, values in columns.items()
        if _is_used(key, columns)
    }
    counts = {len(values) for values in numbers.values()}
    if len(counts) > 1:
        raise ConfigError(f"{where}: columns of {min(counts)} and {max(counts)} values")
    return frames_of_table({**columns, **numbers}, name, where)


def _is_used(key: str, columns: Mapping[str, Any]) -> bool:
    layout = choose_columns(list(columns))
    return layout is not None and key not in layout.unused


def _columns_of_json(frame: dict[str, Any]) -> dict[str, Any] | None:
    """Return the columns of an object: lists, or objects of rows as pandas writes them."""
    columns: dict[str, Any] = {}
    for key, values in frame.items():
        columns[key] = list(values.values()) if isinstance(values, dict) else values
    layout = choose_columns([key for key, values in columns.items() if isinstance(values, list)])
    if layout is None:
        return None
    return {key: values for key, values in columns.items() if key != "name"}


def _columns_of_rows(rows: list[Any], where: str) -> dict[str, Any] | None:
    """Return the columns of a list of rows: objects, or lists of two or three numbers."""
    if rows and all(isinstance(row, dict) for row in rows):
        keys = dict.fromkeys(key for row in rows for key in row)
        return {key: [row.get(key) for row in rows] for key in keys}
    counts = {len(row) for row in rows if isinstance(row, list)}
    if not all(isinstance(row, list) for row in rows) or not counts <= set(HEADLESS):
        return None
    if len(counts) > 1:
        raise ConfigError(f"{where}: rows of {min(counts)} and of {max(counts)} numbers")
    names = HEADLESS[counts.pop() if counts else 2]
    return {key: [row[n] for row in rows] for n, key in enumerate(names)}


def _frame_of_pairs(frame: dict[str, Any], name: str, where: str) -> MeasuredFrame:
    measured = []
    for number, pair in enumerate(frame[PIXELS], start=1):
        at = f"{where}: centroid {number}"
        if not isinstance(pair, list) or len(pair) != 2:
            raise ConfigError(f"{at}: {reprlib.repr(pair)}; expected a pair of numbers [x, y]")
        measured.append([_number(pair[0], "x", at), _number(pair[1], "y", at)])
    content = {key: value for key, value in frame.items() if value is not None}
    layout = choose_columns(list(content))
    if layout is None:  # the key is there
        raise ConfigError(f"{where}: {EXPECTED}")
    mag, sigma_px = (
        None
        if key is None or not content[key]
        else _per_centroid(content, key, len(measured), where)
        for key in (layout.light, layout.sigma)
    )
    if layout.light is not None and mag is None:
        mag = _per_centroid(content, layout.light, len(measured), where)
    unused = layout.unused if layout.frame is None else (*layout.unused, layout.frame)
    return MeasuredFrame(
        name,
        np.array(measured, dtype=np.float64).reshape(-1, 2),
        None if mag is None else layout.magnitudes(mag),
        sigma_px,
        replace(layout, unused=unused).remarks,
    )


def _per_centroid(frame: dict[str, Any], key: str, count: int, where: str) -> Array:
    entries = frame[key]
    if not isinstance(entries, list) or len(entries) != count:
        raise ConfigError(f"{where}: {key!r} has to be a list, one for each centroid")
    values = [
        _number(value, key, f"{where}: centroid {number}")
        for number, value in enumerate(entries, start=1)
    ]
    return np.array(values, dtype=np.float64)


def upside_down(frame: MeasuredFrame, height_px: int) -> MeasuredFrame:
    """Return a frame whose y was counted from the bottom, counted from the top."""
    return replace(frame, centroids_px=frame.centroids_px * (1.0, -1.0) + (0.0, height_px))


def exchanged(frame: MeasuredFrame) -> MeasuredFrame:
    """Return a frame whose centroids were given as (y, x)."""
    return replace(frame, centroids_px=frame.centroids_px[:, ::-1])


def _number(value: Any, name: str, where: str) -> float:
    """Return a number, NaN for null, as which JSON has NaN.

    A place that is not finite is left for the matcher to drop and report.
    """
    if value is None:
        return np.nan
    try:
        if isinstance(value, bool):
            raise ValueError
        return float(value)
    except (TypeError, ValueError, OverflowError):  # an integer of 400 digits is too large
        text = reprlib.repr(value)
        raise ConfigError(f"{where}: {name} is {text}; expected a number") from None


def read_stream(
    lines: Iterable[str], name: str = "stdin", *, where: str | None = None
) -> Iterator[MeasuredFrame]:
    """Read the frames of a stream, each as soon as it is complete.

    ``where`` is the file in messages, if the stream is one.
    """
    is_file, where = where is not None, where or name
    rest = enumerate(lines, start=1)
    filled = ((number, line.removeprefix("\ufeff")) for number, line in rest if line.strip())
    begin, first = next(filled, (1, ""))
    if not first.lstrip().startswith(("{", "[")):
        # Lines before the first one are empty; they count in messages.
        text = "\n" * (begin - 1) + first + "".join(line for _, line in rest)
        yield from _text_frames(text, name, where)
        return
    try:
        json.loads(first)
    except (ValueError, RecursionError):  # JSON over several lines
        whole = first + "".join(line for _, line in rest)
        yield from _json_frames(json_of(whole, where), name, where)
        return
    following = next(filled, None) if is_file else None
    if is_file and following is None:
        yield from _json_frames(json.loads(first), name, where)
        return
    before = [(begin, first)] if following is None else [(begin, first), following]
    for number, line in chain(before, filled):
        at = f"{where}: line {number}" if is_file else f"{where} {number}"
        yield from _json_frames(json_of(line, at), f"{name} {number}", at)


def read_stdin() -> Iterator[MeasuredFrame]:
    """Read the frames of stdin, each as soon as it is complete."""
    try:
        yield from read_stream(sys.stdin)
    except UnicodeDecodeError as error:
        raise ConfigError(f"stdin: not text ({error}); expected CSV or JSON") from error


def write_centroids(centroids_px: Array, path: Path, mag: Array | None = None) -> None:
    """Write the centroids of one frame."""
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["x_px", "y_px"] + ([] if mag is None else ["mag"]))
            columns = centroids_px if mag is None else np.column_stack([centroids_px, mag])
            writer.writerows([f"{value:.4f}" for value in row] for row in columns)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({reason(error)})", path=path) from error
