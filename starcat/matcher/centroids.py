"""Centroid files: CSV for one frame (``x_px,y_px[,mag][,sigma_px]``), JSON for one or many.

JSON is a frame, a list of frames, or an object with the key ``frames``; a frame is an object
with ``centroids_px`` (pairs of numbers) and, optionally, ``mag`` and ``sigma_px`` (a number or null
for each) and ``name``. Instead of ``mag`` there may be ``magnitude``, or ``flux`` or ``sum``, which
are light: the brighter, the larger.
"""

from __future__ import annotations

import csv
import json
import os
import reprlib
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Pixels, Rows
from starcat.errors import ConfigError, FileMissing, OutputError, SourceError, count_of, reason
from starcat.html_tables import html_table
from starcat.matcher.observation import (
    Dropped,
    Frame,
    Frames,
    known_magnitudes,
    unusable,
    without_repeats,
)
from starcat.matcher.result import MatchResult
from starcat.storage.file_formats import unread_format
from starcat.storage.regular_files import read_regular_file

MAX_CENTROIDS = 512
"""Largest number of centroids of a frame that are searched, also by the C library."""


@dataclass(frozen=True)
class Brightest:
    """The centroids of a frame that are searched, and their whole frame."""

    whole: Frame
    rows: Rows  # rows of the whole frame that are searched, ascending
    dropped: Dropped  # centroids of the whole frame that are not used

    @property
    def frame(self) -> Frame:
        """The centroids that are searched, as a frame."""
        mag, sigma = self.whole.mag, self.whole.sigma_px
        return replace(
            self.whole,
            centroids_px=self.whole.centroids_px[self.rows],
            mag=None if mag is None else mag[self.rows],
            sigma_px=None if sigma is None else sigma[self.rows],
        )

    def answer_of(self, searched: MatchResult) -> MatchResult:
        """Return the answer to the whole frame from the answer to its searched part.

        Centroids that were not searched have no star: in a frame with this many centroids some
        lie near any star by chance.
        """
        star_index = np.full(len(self.whole), -1, dtype=np.int32)
        star_index[self.rows] = searched.star_index
        return replace(
            searched,
            star_index=star_index,
            dropped=self.dropped,
            frame=self.whole,
            n_not_searched=len(self.whole) - len(self.rows) - len(self.dropped),
        )


def brightest_of(frame: Frame) -> Brightest:
    """Return the centroids of a frame that are searched: at most `MAX_CENTROIDS`."""
    px = frame.centroids_px
    inside = frame.camera.contains(px)
    rows = np.flatnonzero(inside)
    dropped = [] if len(rows) == len(px) else unusable(px, inside)
    hashes = _hash(px[rows])
    mag = np.zeros(len(rows))
    if frame.mag is not None:
        mag = np.nan_to_num(known_magnitudes(frame.mag)[rows], nan=np.inf)
    # Centroids at exactly the same place count once. Few frames have any, so it is nearly always
    # enough to sort twice as many centroids as are needed.
    for count in (2 * MAX_CENTROIDS, len(rows)):
        first = _first(mag, hashes, count)
        distinct, repeats = without_repeats(rows[first], px)
        if len(distinct) >= MAX_CENTROIDS:
            break
    return Brightest(frame, np.sort(distinct[:MAX_CENTROIDS]), (*dropped, *repeats))


def brightest_of_frames(frames: Frames) -> tuple[Frames, dict[int, Brightest]]:
    """Return frames with the centroids that are searched, and those frames that had more."""
    counts = np.diff(frames.starts)
    crowded = {int(n): brightest_of(frames[int(n)]) for n in np.flatnonzero(counts > MAX_CENTROIDS)}
    if not crowded:
        return frames, {}
    is_kept = np.ones(len(frames.centroids_px), dtype=bool)
    for n, part in crowded.items():
        is_kept[frames.starts[n] : frames.starts[n + 1]] = False
        is_kept[frames.starts[n] + part.rows] = True
        counts[n] = len(part.rows)
    mag, sigma = frames.mag, frames.sigma_px
    searched = replace(
        frames,
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        centroids_px=frames.centroids_px[is_kept],
        mag=None if mag is None else mag[is_kept],
        sigma_px=None if sigma is None else sigma[is_kept],
    )
    return searched, crowded


def _first(mag: Array, hashes: NDArray[np.uint64], count: int) -> Rows:
    """Return the brightest rows, in order, including all that are as bright as the last one."""
    near = np.arange(len(mag))
    for key in (mag, hashes):
        if len(near) > count:
            values = key[near]
            near = near[values <= np.partition(values, count - 1)[count - 1]]
    return near[np.lexsort((hashes[near], mag[near]))]


def _hash(px: Pixels) -> NDArray[np.uint64]:
    """Return a hash of each pair of coordinates (the mixing function of splitmix64)."""
    x, y = np.ascontiguousarray((px + 0.0).T).view(np.uint64)  # -0.0 becomes 0.0
    return _mixed(_mixed(x) + y)


def _mixed(z: NDArray[np.uint64]) -> NDArray[np.uint64]:
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(z ^ (z >> np.uint64(31)))


BRIGHTNESS = ("mag", "magnitude", "flux", "sum")
"""Names of a column of brightness; the first that a file has is used."""
_LIGHT = ("flux", "sum")
SIGMA = "sigma_px"


@dataclass(frozen=True, eq=False, repr=False)
class MeasuredFrame:
    """The centroids of one frame, as in its file."""

    name: str  # name of the frame; the name of the file if the frame has no name
    centroids_px: Array  # pixels, in the order of the file; shape (N, 2)
    # Magnitudes, NaN for a centroid without one; None if the file has none. For a column of light
    # they are -2.5 log10 of it, with an unknown zero point; shape (N,).
    mag: Array | None = None
    sigma_px: Array | None = None  # noise of each centroid on each axis; NaN if not stated
    # Columns or keys of the file that are not known, and so were not used.
    ignored: tuple[str, ...] = ()

    def __repr__(self) -> str:
        names = {"magnitudes": self.mag, "noises": self.sigma_px}
        known = " and ".join(name for name, values in names.items() if values is not None)
        count = count_of(len(self.centroids_px), "centroid")
        return f"<MeasuredFrame {self.name!r}: {count}{' with ' + known if known else ''}>"

    def _repr_html_(self) -> str:
        """Return the first centroids as a table for a notebook."""
        (x, y), given = self.centroids_px.T, (("mag", self.mag), ("sigma px", self.sigma_px))
        columns = {"x px": x, "y px": y} | {name: one for name, one in given if one is not None}
        rows = zip(*([f"{value:.2f}" for value in one] for one in columns.values()), strict=True)
        return html_table(tuple(columns), rows, len(x), repr(self)[1:-1])


MAX_BYTES = 1 << 30
"""Largest size of a file of centroids: ten million centroids as text."""

HEADLESS = {2: ("x_px", "y_px"), 3: ("x_px", "y_px", "mag")}
"""Columns of a CSV file whose first line is numbers."""


def read_centroid_files(path: str | os.PathLike[str]) -> list[MeasuredFrame]:
    """Read the frames of a centroid file."""
    path = Path(path)
    try:
        # Spreadsheets write a byte order mark before the header.
        text = read_regular_file(path, MAX_BYTES).decode("utf-8-sig")
    except FileMissing as error:
        text = f"{path}: no such file; give centroids (CSV, JSON) or an image"
        raise FileMissing(text) from error
    except SourceError as error:
        raise ConfigError(f"{error}; expected centroids (CSV, JSON)") from error
    except UnicodeDecodeError as error:
        raise _not_text(path, error) from error
    return _json_frames(text, path) if path.suffix.lower() == ".json" else [_csv_frame(text, path)]


def _not_text(path: Path, error: UnicodeDecodeError) -> ConfigError:
    found = unread_format(path, error.object) or f"not a text file ({error})"
    return ConfigError(
        f"{path}: is {found}, which is not supported; convert it to an image (FITS, PNG, TIFF, "
        "JPEG, HEIC, BMP), or to centroids (CSV, JSON)"
    )


def _csv_frame(text: str, path: Path) -> MeasuredFrame:
    rows = csv.DictReader(text.splitlines())
    try:
        names = rows.fieldnames or ()
        if len(names) in HEADLESS and all(map(is_number, names)):
            rows = csv.DictReader(text.splitlines(), HEADLESS[len(names)])
            names = rows.fieldnames or ()
        if {"x_px", "y_px"} - set(names):
            raise ConfigError(
                f"{path}: columns {', '.join(names) or 'none'}; the header has to name x_px and "
                "y_px, and may name mag or flux"
            )
        brightness = next((name for name in BRIGHTNESS if name in names), None)
        beside = [name for name in (brightness, SIGMA) if name is not None and name in names]
        columns = ["x_px", "y_px", *beside]
        measured = [
            [
                _number((row[name] or "nan") if name in beside else row[name], name,
                        f"{path}: line {rows.line_num}")
                for name in columns
            ]
            for row in rows
        ]  # fmt: skip
    except csv.Error as error:
        raise ConfigError(
            f"{path}: not a CSV file ({error}); expected a header with x_px and y_px"
        ) from error
    table = np.array(measured, dtype=np.float64).reshape(-1, len(columns))
    mag = None if brightness is None else _magnitudes(table[:, 2], brightness)
    sigma_px = table[:, -1] if SIGMA in beside else None
    ignored = _unknown(names, ("x_px", "y_px", SIGMA))
    return MeasuredFrame(path.stem, table[:, :2], mag, sigma_px, ignored)


def is_number(text: str) -> bool:
    """Return whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _magnitudes(values: Array, name: str) -> Array:
    """Return magnitudes of a column; NaN for a centroid without light."""
    if name not in _LIGHT:
        return values
    bright = np.where(values > 0.0, values, np.nan)
    return np.asarray(-2.5 * np.log10(bright))


def _unknown(names: Iterable[str], places: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(str(name) for name in names if name not in (*places, *BRIGHTNESS))


def _json_frames(text: str, path: Path) -> list[MeasuredFrame]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
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
            raise ConfigError(f"{at}: {reprlib.repr(pair)}; expected a pair of numbers [x, y]")
        measured.append([_number(pair[0], "x", at), _number(pair[1], "y", at)])
    brightness = next((key for key in BRIGHTNESS if frame.get(key) is not None), None)
    mag = None
    if brightness is not None:
        mag = _magnitudes(_one_each(frame, brightness, len(measured), where), brightness)
    sigma_px = _one_each(frame, SIGMA, len(measured), where) if frame.get(SIGMA) else None
    centroids_px = np.array(measured, dtype=np.float64).reshape(-1, 2)
    ignored = _unknown(frame, ("centroids_px", "name", SIGMA))
    return MeasuredFrame(str(frame.get("name", name)), centroids_px, mag, sigma_px, ignored)


def _one_each(frame: dict[str, Any], key: str, count: int, where: str) -> Array:
    given = frame[key]
    if not isinstance(given, list) or len(given) != count:
        raise ConfigError(f"{where}: {key!r} has to be a list, one for each centroid")
    values = [
        _number("nan" if value is None else value, key, f"{where}: centroid {number}")
        for number, value in enumerate(given, start=1)
    ]
    return np.array(values, dtype=np.float64)


def upside_down(frame: MeasuredFrame, height_px: int) -> MeasuredFrame:
    """Return a frame whose y was counted from the bottom, counted from the top."""
    return replace(frame, centroids_px=frame.centroids_px * (1.0, -1.0) + (0.0, height_px))


def exchanged(frame: MeasuredFrame) -> MeasuredFrame:
    """Return a frame whose centroids were given as (y, x)."""
    return replace(frame, centroids_px=frame.centroids_px[:, ::-1])


def said_of_columns(frames: Sequence[MeasuredFrame]) -> str | None:
    """Return a note for the user about columns that were not used."""
    names = sorted({name for frame in frames for name in frame.ignored})
    if not names:
        return None
    return (
        f"not used, because the name is unknown: {', '.join(names)}; known are x_px, y_px, "
        f"centroids_px, sigma_px, name, and for the brightness {', '.join(BRIGHTNESS)}"
    )


def _number(value: Any, name: str, where: str) -> float:
    """Return a number; one that is not finite is left for the matcher to drop and report."""
    try:
        if isinstance(value, bool):
            raise ValueError
        return float(value)
    except (TypeError, ValueError, OverflowError):  # an integer of 400 digits is too large
        found = reprlib.repr(value)
        raise ConfigError(f"{where}: {name} is {found}; expected a number") from None


def read_stream(lines: Iterable[str], name: str = "stdin") -> Iterator[MeasuredFrame]:
    """Read the frames of a stream, each as soon as it is complete."""
    rest = enumerate(lines, start=1)
    filled = ((number, line.removeprefix("\ufeff")) for number, line in rest if line.strip())
    begin, first = next(filled, (1, ""))
    if not first.lstrip().startswith(("{", "[")):
        yield _csv_frame(first + "".join(line for _, line in rest), Path(name))
        return
    try:
        json.loads(first)
    except (ValueError, RecursionError):  # JSON over several lines
        yield from _json_frames(first + "".join(line for _, line in rest), Path(name))
        return
    for number, line in chain([(begin, first)], filled):
        yield from _json_frames(line, Path(f"{name} {number}"))


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
