"""Files and streams of frames answered one after the other, and what is written beside."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

from starcat.errors import ConfigError
from starcat.geometry.camera import Camera
from starcat.images.identification import (
    MeasuredFile,
    PriorOption,
    draw,
    identify_frames,
    measure,
)
from starcat.images.wcs_file import expect_room_for_wcs, write_wcs
from starcat.matcher.centroids import MeasuredFrame, read_stream
from starcat.matcher.matcher import Matcher
from starcat.matcher.result import MatchResult
from starcat.matcher.tracking import Tracker

STDIN = Path("-")


def measure_input(path: Path, *, flip: bool | None = None, wcs: Path | None = None) -> MeasuredFile:
    """Read centroids from a file or from stdin, or find them in an image.

    Parameters
    ----------
    path : Path
        As for `measure`; ``-`` for centroids from stdin.
    flip : bool, optional
        As for `measure`.
    wcs : Path, optional
        FITS copy of the picture that is to be written.

    Returns
    -------
    MeasuredFile
        The frames of stdin can be gone through once, and are read as they come.

    Raises
    ------
    ConfigError
        As `measure`, and while the frames of stdin are read; if there can be no such copy.
    """
    if path == STDIN:
        # Its frames are only ever gone through.
        measured = MeasuredFile(cast(Sequence[MeasuredFrame], _frames_of_stdin()))
    else:
        measured = measure(path, flip=flip)
    if wcs is not None:
        expect_room_for_wcs(wcs, path, is_picture=measured.image is not None)
    return measured


def _frames_of_stdin() -> Iterator[MeasuredFrame]:
    try:
        yield from read_stream(sys.stdin)
    except UnicodeDecodeError as error:
        raise ConfigError(f"stdin: not text ({error}); expected CSV or JSON") from error


def answer_each(
    matcher: Matcher | Tracker,
    measured: MeasuredFile,
    camera: Camera,
    prior: PriorOption | None = None,
) -> Iterator[tuple[MeasuredFrame, MatchResult]]:
    """Identify the frames of a file or stream, one when it is asked for.

    Parameters
    ----------
    matcher, measured, camera, prior
        As for `identify_frames`.

    Yields
    ------
    (MeasuredFrame, MatchResult)
        A frame and its answer.
    """
    for frame in measured.frames:
        [result] = identify_frames(matcher, replace(measured, frames=[frame]), camera, prior)
        yield frame, result


def write_extras(
    source: Path,
    measured: MeasuredFile,
    frame: MeasuredFrame,
    result: MatchResult,
    camera: Camera,
    *,
    picture: Path | None = None,
    wcs: Path | None = None,
    flip: bool | None = None,
) -> None:
    """Write what is asked for beside the answer to a frame.

    Parameters
    ----------
    source : Path
        The file that the frame is of.
    measured : MeasuredFile
        What was read from it.
    frame : MeasuredFrame
        The frame.
    result : MatchResult
        Its answer.
    camera : Camera
        The camera, for its size.
    picture : Path, optional
        PNG or SVG file of the frame with its stars named.
    wcs : Path, optional
        FITS copy of the picture with the world coordinates; only if it was identified.
    flip : bool, optional
        As for `measure`.

    Raises
    ------
    ConfigError
        If the picture is of another kind.
    NotIdentifiedError
        If there is no attitude to write.
    OutputError
        If a file cannot be written.
    """
    if picture is not None and result.asked is not None:
        database = result.asked.database
        draw(picture, replace(measured, frames=[frame]), result, database, camera)
    if wcs is not None and measured.image is not None:
        write_wcs(wcs, source, measured.image, result, flip=flip)
