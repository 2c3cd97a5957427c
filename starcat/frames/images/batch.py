"""Many files to answers in one run: folders, patterns and lists of pictures or centroids.

The database is opened once. A few processes measure pictures while the previous pictures are
identified, in the order of the files. A file that cannot be used has an error in place of answers,
and the run continues with the other files.
"""

from __future__ import annotations

import glob
import multiprocessing
import re
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from starcat.arguments import path_of
from starcat.errors import ConfigError
from starcat.frames.images.contents import IMAGE_SUFFIXES
from starcat.frames.images.measure import LocalInputs, MeasuredFile, measure_file
from starcat.frames.images.solve_files import FileAnswers, FrameAnswer
from starcat.frames.images.stated_camera import stated_camera
from starcat.matcher.blind import half_widths
from starcat.matcher.centroids import MeasuredFrame
from starcat.matcher.matcher import Matcher
from starcat.matcher.options import IdentifyOptions
from starcat.matcher.tracking import Tracker
from starcat.resources import PathLike
from starcat.storage.file_formats import RAW_MAKERS

CENTROID_SUFFIXES = (
    ".csv", ".json", ".tsv", ".ecsv", ".vot", ".parquet", ".npy", ".npz", ".xyls", ".axy", ".ldac",
    ".cat",
)  # fmt: skip
TILE_PX = 256  # longest side of the small picture that is kept of each

_FEW = 6  # for this number of pictures or fewer, starting processes would take longer
_MAX_WORKERS = 4
_AHEAD = 2  # pictures per process that are measured in advance

_COARSE = 8  # step in pixels at which the background of a tile is sampled

Small = NDArray[np.uint8]


@dataclass(frozen=True)
class BatchItem:
    """One file of many: its answers, or the reason why there are none."""

    path: Path
    answers: tuple[FrameAnswer, ...] = ()
    error: ConfigError | None = None
    notes: tuple[str, ...] = ()
    small: Small | None = None  # a picture reduced to a tile of a contact sheet


@dataclass(frozen=True)
class _Measured:
    file: MeasuredFile
    small: Small | None


def is_batch(inputs: Sequence[str]) -> bool:
    """Return whether inputs are many: more than one, a folder or a pattern."""
    return len(inputs) > 1 or Path(inputs[0]).is_dir() or _is_pattern(inputs[0])


def files_of(inputs: Sequence[str]) -> list[Path]:
    """Return the files of folders, patterns and names, each once, numbers in names in order.

    For a folder they are its pictures, or its files of centroids if it has no pictures.
    """
    paths: dict[Path, None] = {}
    for entry in inputs:
        if entry == "-":
            raise ConfigError("stdin (-) goes alone", hint="give either - or files")
        if Path(entry).is_dir():
            files = _of_folder(Path(entry))
        elif _is_pattern(entry):
            files = [Path(name) for name in glob.glob(entry, recursive=True)]
            files = [path for path in files if path.is_file()]
            if not files:
                raise ConfigError(
                    f"{entry!r}: no file has such a name",
                    hint="check the folder, or put the pattern in quotes",
                )
        else:
            files = [Path(entry)]
        paths |= dict.fromkeys(sorted(files, key=_in_order))
    return list(paths)


def frame_files(inputs: Sequence[str]) -> list[Path]:
    """Return the files of folders, patterns and names, or stdin (``-``) alone."""
    return files_of(inputs) if not inputs or is_batch(inputs) else [Path(inputs[0])]


def read_frames(file: PathLike) -> list[MeasuredFrame]:
    """Read the frames of files of centroids, or detect the stars of pictures.

    Parameters
    ----------
    file : str or path-like
        A picture (FITS, PNG, TIFF, JPEG, HEIC, BMP), a file of centroids (text such as CSV, ECSV
        or a catalog of SExtractor; JSON, FITS, VOTable, Parquet, npy, npz), a folder, or a pattern
        such as ``"night/*.jpg"``.

    Returns
    -------
    list of MeasuredFrame
        ``centroids_px`` of shape (N, 2), ``mag`` and ``sigma_px`` of shape (N,) or None, and
        ``remarks``, for example on columns that were not used.

    Raises
    ------
    ConfigError
        If a file does not exist, or is neither a picture nor a file of centroids. Of several files
        the first such file ends the reading, and the message names it.
    """
    files = frame_files([str(path_of("file", file))])
    frames: list[MeasuredFrame] = []
    for path in files:
        try:
            frames += measure_file(path).frames
        except ConfigError as error:
            if len(files) == 1:
                raise
            error.problem += f" (one of the {len(files)} files of {file})"
            error.hint = (
                *error.advice,
                "to leave the file out, read each file by itself with starcat.read_frames",
                "give a pattern without it",
            )
            raise
    return frames


def _is_pattern(name: str) -> bool:
    return glob.has_magic(name) and not Path(name).exists()


def _of_folder(folder: Path) -> list[Path]:
    files = [path for path in folder.iterdir() if path.is_file() and path.name[0] != "."]
    for suffixes in ((*IMAGE_SUFFIXES, *RAW_MAKERS), CENTROID_SUFFIXES):
        matches = [path for path in files if path.suffix.lower() in suffixes]
        if matches:
            return matches
    raise ConfigError(
        f"neither pictures ({', '.join(IMAGE_SUFFIXES)}) nor centroids "
        f"({', '.join(CENTROID_SUFFIXES)}) are in this folder",
        where=folder,
    )


def _in_order(path: Path) -> tuple[Any, ...]:
    """Return a key that puts img_2 before img_10."""
    parts = re.split(r"(\d+)", str(path))
    return tuple(int(part) if part.isdecimal() else part for part in parts)


def identify_files(
    paths: Sequence[Path],
    matcher: Matcher,
    options: IdentifyOptions | None = None,
    local: LocalInputs | None = None,
    *,
    workers: int | None = None,
) -> Iterator[BatchItem]:
    """Measure files and identify their frames, in the order of the files.

    By default as many processes measure as there are processors, at most four, and none for a
    few files; their number changes no answer. With `LocalInputs.track` the frames of all files
    are one sequence.
    """
    options, local = options or IdentifyOptions(), local or LocalInputs()
    if options.is_range:
        half_widths(matcher.database)  # a database without levels is refused before any work
    tracker = Tracker(matcher) if local.track else None
    if workers is None:
        workers = min(multiprocessing.cpu_count(), _MAX_WORKERS) if len(paths) > _FEW else 0
    for path, measured in zip(paths, _measured_files(paths, options, local, workers), strict=True):
        if isinstance(measured, ConfigError):
            if tracker is not None:  # time passes in a frame that cannot be read, too
                tracker.record(None)
            yield BatchItem(path, error=measured)
            continue
        file, frame_answers = measured.file, list[FrameAnswer]()
        try:
            camera, of_file = stated_camera(file.shape, matcher.database, options, local)
            answers = FileAnswers(path, matcher, file, camera, of_file, local, tracker)
            frame_answers.extend(answers)
        except ConfigError as error:
            if tracker is not None:
                for _ in file.frames[len(frame_answers) :]:
                    tracker.record(None)
            yield BatchItem(path, error=error, small=measured.small)
            continue
        notes = answers.notes(frame_answers[0] if frame_answers else None)
        yield BatchItem(path, tuple(frame_answers), notes=tuple(notes), small=measured.small)


def _measured_files(
    paths: Sequence[Path], options: IdentifyOptions, local: LocalInputs, workers: int
) -> Iterator[_Measured | ConfigError]:
    if not workers:
        for path in paths:
            yield _measured(path, options, local)
        return
    pending: deque[Future[_Measured | ConfigError]] = deque()
    # Spawned: a copy of a process with the threads of a library in it may hang.
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))
    try:
        for path in paths:
            pending.append(pool.submit(_measured, path, options, local))
            if len(pending) > _AHEAD * workers:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    except BrokenProcessPool as error:
        raise ConfigError(
            "a process that measured pictures was ended from outside, perhaps because memory ran "
            "out",
            hint="give fewer or smaller pictures at once",
        ) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _measured(path: Path, options: IdentifyOptions, local: LocalInputs) -> _Measured | ConfigError:
    """Measure a file; an image itself is too large to be handed on."""
    try:
        file = measure_file(path, options, local)
    except ConfigError as error:
        return ConfigError(
            error.problem,
            parameter=error.parameter,
            value=error.value,
            hint=error.hint,
            where=error.where,
        )
    small = None if file.image is None else small_picture(file.image)
    return _Measured(replace(file, image=None), small)


def small_picture(image: NDArray[Any], side_px: int = TILE_PX) -> Small:
    """Return an image as a tile: the brightest pixel of each block, so that no star is lost."""
    step = max(1, -(-max(image.shape) // side_px))
    rows, columns = (np.arange(0, side, step) for side in image.shape)
    finite = np.nan_to_num(image.astype(np.float32))
    tile = np.maximum.reduceat(np.maximum.reduceat(finite, rows, axis=0), columns, axis=1)
    height, width = tile.shape
    tile -= scipy.ndimage.median_filter(tile[::_COARSE, ::_COARSE], _COARSE)[
        np.arange(height)[:, None] // _COARSE, np.arange(width) // _COARSE
    ]
    noise = float(np.quantile(np.abs(tile), 0.68))
    bright = max(float(np.quantile(tile, 0.999)), 8.0 * noise, 1e-9)
    part = np.clip((tile - noise) / (bright - noise), 0.0, 1.0)
    return np.asarray(np.rint(30.0 + 225.0 * np.sqrt(part)), dtype=np.uint8)
