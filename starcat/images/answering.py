"""Files and streams of frames answered one after the other, and what is written beside."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

from starcat.errors import ConfigError
from starcat.geometry.camera import Camera
from starcat.images.identification import (
    MeasuredFile,
    Near,
    PictureOptions,
    draw,
    identify_frames,
    measure,
)
from starcat.images.wcs_file import expect_room_for_wcs, write_wcs
from starcat.matcher.centroids import MeasuredFrame, read_stream, upside_down
from starcat.matcher.matcher import Matcher
from starcat.matcher.result import MatchResult

if TYPE_CHECKING:
    from starcat.sky.in_time import SkyInTime
    from starcat.sky.observer import Observer

STDIN = Path("-")


def measure_input(
    path: Path,
    *,
    flip: bool | None = None,
    wcs: Path | None = None,
    options: PictureOptions | None = None,
) -> MeasuredFile:
    """Read centroids from a file or from stdin, or find them in an image."""
    if path == STDIN:
        # Its frames are only ever gone through.
        measured = MeasuredFile(cast(Sequence[MeasuredFrame], _frames_of_stdin()))
    else:
        measured = measure(path, flip=flip, options=options)
    if wcs is not None:
        expect_room_for_wcs(wcs, path, is_picture=measured.image is not None)
    return measured


def _frames_of_stdin() -> Iterator[MeasuredFrame]:
    try:
        yield from read_stream(sys.stdin)
    except UnicodeDecodeError as error:
        raise ConfigError(f"stdin: not text ({error}); expected CSV or JSON") from error


def camera_of_size(
    measured: MeasuredFile, size_px: tuple[int, int] | None, known: Camera
) -> Camera:
    """Return the camera of frames of which nothing is known but their size."""
    width, height = size_px or (known.width_px, known.height_px)
    if measured.image is not None:
        height, width = measured.image.shape
        if size_px not in (None, (width, height)):
            raise ConfigError(
                f"the image has {width} x {height} px, --size says {size_px[0]} x {size_px[1]}; "
                "leave --size out",
                key="size",
            )
    return Camera(width, height, fov_x_deg=known.fov_x_deg)


def answer_each(
    matcher: Matcher,
    measured: MeasuredFile,
    camera: Camera,
    observer: Observer | None = None,
    *,
    flip: bool | None = None,
    fov_error: float | None = None,
    near: Near | None = None,
    fov_deg: tuple[float, float] | None = None,
) -> Iterator[tuple[MeasuredFrame, MatchResult]]:
    """Identify the frames of a file or stream, one when it is asked for."""
    for given in measured.frames:
        turned = bool(flip) and measured.image is None
        frame = upside_down(given, camera.height_px) if turned else given
        one = replace(measured, frames=[frame])
        [result] = identify_frames(matcher, one, camera, observer, fov_error, near, fov_deg)
        yield frame, result


def sky_of_answer(
    frame: MeasuredFrame, result: MatchResult, observer: Observer | None
) -> SkyInTime | None:
    """Return what a time adds to the answer to a frame."""
    if observer is None or result.database is None or result.camera is None:
        return None
    from starcat.sky.in_time import sky_in_time

    database = result.database
    return sky_in_time(result, database, frame.centroids_px, result.camera, observer)


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
    observer: Observer | None = None,
) -> None:
    """Write what is asked for beside the answer to a frame."""
    if picture is not None and result.database is not None:
        database = result.database
        eye = result.camera or camera
        sky = sky_of_answer(frame, result, observer)
        draw(picture, replace(measured, frames=[frame]), result, database, eye, sky)
    if wcs is not None and measured.image is not None:
        write_wcs(wcs, source, measured.image, result, flip=flip)
