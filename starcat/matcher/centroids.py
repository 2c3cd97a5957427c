"""Centroid files: CSV for one frame (``x_px,y_px[,mag]``), JSON for one or many.

JSON is a frame, a list of frames, or an object with the key ``frames``; a frame is an object
with ``centroids_px`` (pairs of numbers) and, optionally, ``mag`` (a number or null for each) and
``name``.
"""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.errors import ConfigError, OutputError, reason

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MeasuredFrame:
    """The centroids of one frame, as a file has them.

    Attributes
    ----------
    name : str
        Name of the frame; that of the file where the frame has none of its own.
    centroids_px : ndarray of float64, shape (N, 2)
        Pixels, in the order of the file.
    mag : ndarray of float64, shape (N,), or None
        Magnitudes, NaN where a centroid has none; None where the file has none.
    """

    name: str
    centroids_px: Array
    mag: Array | None = None


def read_frames(path: str | os.PathLike[str]) -> list[MeasuredFrame]:
    """Read the frames of a centroid file.

    Parameters
    ----------
    path : str or path-like
        CSV with a header that names ``x_px`` and ``y_px``, or JSON (ending ``.json``).

    Returns
    -------
    list of MeasuredFrame
        In the order of the file; one for CSV.

    Raises
    ------
    ConfigError
        If the file cannot be read, lacks a column or key, or holds what is not a number, with
        the line or frame.
    """
    path = Path(path)
    try:
        # Spreadsheets put a mark of the byte order before the header.
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({reason(error)})") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a text file ({error}); expected CSV or JSON") from error
    return _json_frames(text, path) if path.suffix.lower() == ".json" else [_csv_frame(text, path)]


def _csv_frame(text: str, path: Path) -> MeasuredFrame:
    rows = csv.DictReader(text.splitlines())
    try:
        names = rows.fieldnames or ()
        if {"x_px", "y_px"} - set(names):
            raise ConfigError(
                f"{path}: columns {', '.join(names) or 'none'}; the header has to name x_px and "
                "y_px, and may name mag"
            )
        has_mag = "mag" in names
        measured = [
            (
                _number(row["x_px"], "x_px", f"{path}: line {rows.line_num}"),
                _number(row["y_px"], "y_px", f"{path}: line {rows.line_num}"),
                _number(row["mag"] or "nan", "mag", f"{path}: line {rows.line_num}")
                if has_mag
                else math.nan,
            )
            for row in rows
        ]
    except csv.Error as error:
        raise ConfigError(
            f"{path}: not a CSV file ({error}); expected a header with x_px and y_px"
        ) from error
    table = np.array(measured, dtype=np.float64).reshape(-1, 3)
    return MeasuredFrame(path.stem, table[:, :2], table[:, 2] if has_mag else None)


def _json_frames(text: str, path: Path) -> list[MeasuredFrame]:
    try:
        content = json.loads(text)
    except ValueError as error:
        raise ConfigError(f"{path}: not JSON ({error})") from error
    if isinstance(content, dict) and "frames" in content:
        content = content["frames"]
    frames = content if isinstance(content, list) else [content]
    if not frames:
        raise ConfigError(f"{path}: no frames; expected at least one")
    several = len(frames) > 1
    return [
        _json_frame(
            frame,
            f"{path.stem} {number}" if several else path.stem,
            f"{path}: frame {number}" if several else str(path),
        )
        for number, frame in enumerate(frames, start=1)
    ]


def _json_frame(frame: Any, name: str, where: str) -> MeasuredFrame:
    if not isinstance(frame, dict) or not isinstance(frame.get("centroids_px"), list):
        raise ConfigError(
            f"{where}: expected an object with 'centroids_px', a list of [x, y] pairs"
        )
    measured = []
    for number, pair in enumerate(frame["centroids_px"], start=1):
        at = f"{where}: centroid {number}"
        if not isinstance(pair, list) or len(pair) != 2:
            raise ConfigError(f"{at}: {json.dumps(pair)}; expected a pair of numbers [x, y]")
        measured.append([_number(pair[0], "x", at), _number(pair[1], "y", at)])
    mag = frame.get("mag")
    if mag is not None:
        if not isinstance(mag, list) or len(mag) != len(measured):
            raise ConfigError(f"{where}: 'mag' has to be a list, one for each centroid")
        mag = np.array(
            [
                _number("nan" if value is None else value, "mag", f"{where}: centroid {number}")
                for number, value in enumerate(mag, start=1)
            ],
            dtype=np.float64,
        )
    centroids_px = np.array(measured, dtype=np.float64).reshape(-1, 2)
    return MeasuredFrame(str(frame.get("name", name)), centroids_px, mag)


def _number(value: Any, name: str, where: str) -> float:
    """Return a number; one that is not finite is left for the matcher to drop and report."""
    try:
        if isinstance(value, bool):
            raise ValueError
        return float(value)
    except (TypeError, ValueError):
        raise ConfigError(f"{where}: {name} is {value!r}; expected a number") from None


def read_stream(lines: Iterable[str], name: str = "stdin") -> Iterator[MeasuredFrame]:
    """Read the frames of a stream, each as soon as it is there.

    Parameters
    ----------
    lines : iterable of str
        CSV or JSON as `read_frames` takes them, or JSON with a frame on every line.
    name : str, default "stdin"
        What the stream is called in messages and in names of frames.

    Yields
    ------
    MeasuredFrame
        In the order of the stream. Where the first line is JSON by itself, a line is read when
        the frame before it was taken; all else is read to its end first.

    Raises
    ------
    ConfigError
        As `read_frames`.
    """
    rest = enumerate(lines, start=1)
    filled = ((number, line.removeprefix("\ufeff")) for number, line in rest if line.strip())
    begin, first = next(filled, (1, ""))
    if not first.lstrip().startswith(("{", "[")):
        yield _csv_frame(first + "".join(line for _, line in rest), Path(name))
        return
    try:
        json.loads(first)
    except ValueError:  # JSON over several lines
        yield from _json_frames(first + "".join(line for _, line in rest), Path(name))
        return
    for number, line in chain([(begin, first)], filled):
        yield from _json_frames(line, Path(f"{name} {number}"))


def write_centroids(centroids_px: Array, path: Path, mag: Array | None = None) -> None:
    """Write the centroids of one frame.

    Parameters
    ----------
    centroids_px : ndarray of float64, shape (N, 2)
        Pixels.
    path : Path
        CSV file, replaced if it exists.
    mag : ndarray of float64, shape (N,), optional
        Magnitudes, as a third column.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["x_px", "y_px"] + ([] if mag is None else ["mag"]))
            columns = centroids_px if mag is None else np.column_stack([centroids_px, mag])
            writer.writerows([f"{value:.4f}" for value in row] for row in columns)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({reason(error)})", path=path) from error
