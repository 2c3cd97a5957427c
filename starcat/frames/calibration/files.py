"""Calibration of the camera of files: frames in; a camera file and a drawing of residuals out.

Comments in the camera file give the errors of the camera; the drawing shows the residuals over
the detector and with the radius.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcat.arguments import HasFolder, check_type, columns_of, path_of, whole_number, wrong_type
from starcat.arrays import Array
from starcat.errors import ConfigError, count_of
from starcat.frames.calibration.calibrate import Calibration, calibrate_frames
from starcat.frames.calibration.fit import PARAMETERS
from starcat.frames.images.batch import frame_files
from starcat.frames.images.measure import measure_file
from starcat.geometry.camera import Camera
from starcat.geometry.distortion import checked_pair
from starcat.matcher.centroids import MeasuredFrame
from starcat.matcher.matcher import Matcher
from starcat.matcher.observation import (
    BEYOND_PX,
    FrameLike,
    as_arrays,
    frame_of_table,
    is_frame,
    outside_of,
    remarks_of,
)
from starcat.matcher.options import IdentifyOptions
from starcat.matcher.result import MatchResult
from starcat.pipeline.report.plots import STYLE, headline
from starcat.pipeline.specs.camera_file import camera_toml
from starcat.progress import Progress, no_progress
from starcat.resources import PathLike
from starcat.storage.atomic import write_file
from starcat.storage.figures import check_kind, own_style, write_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Share by which the focal length of the first camera can be wrong, if no range of fields is
# given.
USUAL_ERROR = 0.1


def frames_given(frames: Any) -> tuple[list[Path | MeasuredFrame], list[Camera]]:
    """Return the files and frames that a caller gives to calibrate a camera from.

    Files are given as paths, folders and patterns, frames in any form that `Matcher.identify`
    takes or as its results; both alone or in a sequence. Of results their cameras are returned,
    too, those of identified frames first.
    """
    if _is_file(frames) or _is_one_frame(frames):
        frames = [frames]
    if not isinstance(frames, Iterable):
        raise wrong_type("frames", frames, _FRAMES)
    inputs: list[Path | MeasuredFrame] = []
    results: list[MatchResult] = []
    for number, item in enumerate(frames, start=1):
        if _is_file(item):
            inputs += frame_files([str(path_of("frames", item))])
        elif _is_one_frame(item) or isinstance(item, list | tuple):
            frame = item.frame if isinstance(item, MatchResult) else item
            if frame is None:
                raise ConfigError(
                    f"result {number} does not hold its frame, as after pickling",
                    parameter="frames",
                    hint="give the frame",
                )
            if isinstance(item, MatchResult):
                results.append(item)
            name = str(getattr(frame, "name", "") or f"frame {number}")
            frame = frame_of_table(frame)
            remarks = remarks_of(frame)
            inputs.append(MeasuredFrame(name, *as_arrays(frame), remarks=remarks))
        else:
            raise wrong_type(f"frame {number} of frames", item, _FRAMES)
    results.sort(key=lambda result: not result.ok)
    cameras = [
        result.camera or result.frame.camera for result in results if result.frame is not None
    ]
    return list(dict.fromkeys(inputs)), cameras


def _is_file(value: object) -> bool:
    return isinstance(value, str | os.PathLike)


def _is_one_frame(value: Any) -> bool:
    if isinstance(value, np.ndarray) and value.dtype.names is None:
        return value.ndim == 2
    return isinstance(value, MatchResult) or is_frame(value) or columns_of(value) is not None


_FRAMES = "files, folders, patterns, or frames of starcat.simulate or starcat.read_frames"


def calibrate(
    database: Matcher | HasFolder | PathLike,
    frames: PathLike | FrameLike | MatchResult | Iterable[PathLike | FrameLike | MatchResult],
    *,
    camera: Camera | None = None,
    size_px: tuple[int, int] | None = None,
    fov_deg: tuple[float, float] | None = None,
    method: str | None = None,
    flip: bool | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Find focal length, principal point and distortion of a camera from frames of stars.

    Parameters
    ----------
    database : Database, Matcher, str or path-like
        A database for about this field: the result of `starcat.open`, the folder
        ``<name>-<version>``, or a matcher of it.
    frames : paths, frames or results, one or a sequence of them
        Images or files of centroids of one camera, folders and patterns, as for ``starcat
        identify``; or frames as for `Matcher.identify`, for example from `simulate` or
        `read_frames`; or results, which contain their frames.
    camera : Camera, optional
        The camera to start from; by default the camera of the results, or else the database's.
    size_px : tuple of int, optional
        Width and height, if no camera is given; by default the size of the images, or else of the
        camera to start from. No centroid may then lie outside of it by more than noise.
    fov_deg : tuple of float, optional
        Smallest and largest field across the width, degrees; by default the camera's field, with
        a focal length that may be wrong by a tenth.
    method : str, optional
        Method of identification; by default the best that the database's products
        allow. A matcher has its own.
    flip : bool, optional
        Whether the first row of an image is its bottom; by default as the file states.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    Calibration
        ``camera``, the errors and covariance of the fitted parameters, and the comparison of
        models on frames that were left out of the fit.

    Raises
    ------
    ConfigError, ProductError
        If a file cannot be read, or the facts about the camera contradict each other.
    CalibrationError
        If too few frames can be identified; the message lists them with the reasons.
    """
    if camera is not None:
        check_type("camera", camera, Camera, "a starcat.Camera")
    if size_px is not None:
        checked_pair("size_px", size_px)
        width_px, height_px = (whole_number("size_px", side, 1) for side in size_px)
        size_px = width_px, height_px
    matcher = database if isinstance(database, Matcher) else Matcher.open(database, method)
    advance = progress or no_progress
    inputs, of_results = frames_given(frames)
    measured, image_size_px = measured_frames(inputs, flip=flip, progress=advance)
    is_stated = not (camera is None and size_px is None)
    if of_results and not is_stated:
        _expect_one_size(of_results)
    start, focal_px = starting_camera(
        matcher.database.camera,
        of_results=of_results[0] if of_results else None,
        camera=camera,
        size_px=size_px,
        image_size_px=image_size_px,
        fov_deg=fov_deg,
    )
    if not is_stated and image_size_px is None:
        _expect_inside(measured, start, "the results" if of_results else "the database")
    return calibrate_frames(matcher, measured, start, focal_px, advance)


def _expect_one_size(cameras: Sequence[Camera]) -> None:
    """Raise `ConfigError` if the cameras of results have several sizes."""
    sizes = dict.fromkeys(f"{camera.width_px} x {camera.height_px}" for camera in cameras)
    if len(sizes) > 1:
        raise ConfigError(
            f"the results are of cameras of {' and '.join(sizes)} px; expected one camera",
            hint=("give the results of one camera", "state the camera of all frames ({camera})"),
        )


def _expect_inside(frames: Sequence[MeasuredFrame], camera: Camera, whose: str) -> None:
    """Raise `ConfigError` if frames whose size nobody stated are larger than a camera."""
    found = [(frame, *outside_of(frame.centroids_px, camera)) for frame in frames]
    worst, _, beyond_px = max(found, key=lambda one: one[2], default=(None, 0, 0.0))
    if worst is None or beyond_px <= BEYOND_PX:
        return
    count = sum(len(frame.centroids_px) for frame in frames)
    raise ConfigError(
        f"{sum(outside for _, outside, _ in found)} of {count_of(count, 'centroid')} lie outside "
        f"of {camera.width_px} x {camera.height_px} px, the size of the camera of {whose}, by up "
        f"to {beyond_px:.0f} px ({worst.name})",
        hint=(
            "state the size of the frames ({size_px}), with the field across their width "
            "({fov_deg}) if it is another size",
            "give their camera ({camera})",
        ),
    )


def measured_frames(
    inputs: Sequence[Path | MeasuredFrame],
    *,
    flip: bool | None = None,
    progress: Progress = no_progress,
) -> tuple[list[MeasuredFrame], tuple[int, int] | None]:
    """Read the frames of files; frames that are measured already stay as they are."""
    frames: list[MeasuredFrame] = []
    size_px: tuple[int, int] | None = None
    paths = [entry for entry in inputs if isinstance(entry, Path)]
    names = iter(names_of_files(paths))
    for number, path in enumerate(inputs, start=1):
        if isinstance(path, MeasuredFrame):
            frames.append(path)
            continue
        name = next(names)
        measured = measure_file(path, IdentifyOptions(flip=flip))
        for frame in measured.frames:
            frames.append(replace(frame, name=name) if frame.name == path.stem else frame)
        if measured.image is not None:
            height, width = measured.image.shape
            if size_px is not None and size_px != (width, height):
                raise ConfigError(
                    f"{width} x {height} px, the images before it {size_px[0]} x {size_px[1]}",
                    where=path,
                    hint="give the frames of one camera",
                )
            size_px = width, height
        progress("measure", number, len(inputs))
    return frames, size_px


def names_of_files(paths: Sequence[Path]) -> list[str]:
    """Return a unique name for the frame of each file.

    The name is the file's name without its suffix; if several files share it, the path without
    the suffix; if they share that too, the path.
    """
    ways = [[path.stem, str(path.with_suffix("")), str(path)] for path in paths]
    counts = Counter(name for names in ways for name in set(names))
    return [next((name for name in names if counts[name] == 1), names[-1]) for names in ways]


def starting_camera(
    database_camera: Camera,
    *,
    of_results: Camera | None = None,
    camera: Camera | None = None,
    size_px: tuple[int, int] | None = None,
    image_size_px: tuple[int, int] | None = None,
    fov_deg: tuple[float, float] | None = None,
) -> tuple[Camera, tuple[float, float]]:
    """Return the camera and the range of focal lengths with which a calibration begins."""
    if camera is not None and size_px is not None:
        raise ConfigError("give either a camera or its size, not both; a camera has a size")
    start = camera or of_results or database_camera
    said = size_px or (None if camera is None else (camera.width_px, camera.height_px))
    if image_size_px is not None and said not in (None, image_size_px):
        raise ConfigError(
            f"the images have {image_size_px[0]} x {image_size_px[1]} px, the camera {said[0]} x "
            f"{said[1]}",
            hint="give the camera of these images, or none",
        )
    frame_size_px = said or image_size_px or (start.width_px, start.height_px)
    if fov_deg is None:
        if frame_size_px != (start.width_px, start.height_px):
            raise ConfigError(
                f"the frames have {frame_size_px[0]} x {frame_size_px[1]} px, the camera of the "
                f"{'results' if of_results else 'database'} {start.width_px} x {start.height_px}",
                hint=(
                    "say the field across their width with {fov_deg}, such as 5:20",
                    "give a camera file",
                ),
            )
        focal = start.focal_length_px
        return start, (focal / (1.0 + USUAL_ERROR), focal * (1.0 + USUAL_ERROR))
    shortest, longest = _focal_range(frame_size_px[0], *checked_pair("fov_deg", fov_deg))
    if frame_size_px != (start.width_px, start.height_px):
        start = Camera(*frame_size_px, float(np.sqrt(shortest * longest)))
    return start, (shortest, longest)


def _focal_range(width_px: int, low_deg: float, high_deg: float) -> tuple[float, float]:
    """Return the focal lengths of a range of fields, the shortest first."""
    if not 0.0 < low_deg <= high_deg < 180.0:
        raise ConfigError(
            f"the range of fields is {low_deg:g} to {high_deg:g} deg; expected the smaller one "
            "first, above 0 and below 180"
        )
    half_rad = np.radians(0.5 * np.array([high_deg, low_deg]))
    shortest, longest = (0.5 * width_px / np.tan(half_rad)).tolist()
    return shortest, longest


def calibrated_toml(calibration: Calibration) -> str:
    """Return the TOML text of a calibrated camera."""
    fit = calibration.fit
    lines = [
        f"# Calibrated from {calibration.n_identified} frames with {len(fit.seen)} stars.",
        f"# Residual: {fit.noise_px:.3f} px on each axis. Standard errors:",
    ]
    for name, error in fit.errors.items():
        value = fit.values[PARAMETERS.index(name)]
        lines.append(f"#   {name} = {value:.6g} +- {error:.2g}")
    return "\n".join([*lines, "", camera_toml(calibration.camera)])


def write_camera(calibration: Calibration, path: Path) -> None:
    """Write a calibrated camera as a camera file."""
    write_file(path, calibrated_toml(calibration).encode())


_BLUE, _GREY, _RED = "#2c6e9e", "#b9c4cc", "#d1495b"
_LONG_ARROW = 0.06  # length of an arrow of three standard deviations, in widths of the detector
_BINS = 8


def draw_residuals(calibration: Calibration, path: Path) -> None:
    """Draw the residuals of a calibration."""
    check_kind(path)
    with own_style(STYLE):
        write_figure(_figure(calibration), path)


def _figure(calibration: Calibration) -> Figure:
    from matplotlib.figure import Figure

    fit = calibration.fit
    figure = Figure(figsize=(11.0, 4.9))
    below = (
        f"{len(fit.seen):,} stars of {calibration.n_identified} frames; standard deviation "
        f"{fit.noise_px:.3f} px on each axis; fitted: {', '.join(fit.free)}"
    )
    headline(figure, f"Residuals: {calibration.camera.in_words}", below)
    _draw_arrows(figure.add_axes((0.055, 0.11, 0.5, 0.73)), calibration)
    along, across = _polar(calibration)
    for axes, residual_px, name in (
        (figure.add_axes((0.635, 0.53, 0.35, 0.31)), along, "outwards, px"),
        (figure.add_axes((0.635, 0.11, 0.35, 0.31)), across, "sideways, px"),
    ):
        _draw_profile(axes, calibration, residual_px, name)
    return figure


def _draw_arrows(axes: Axes, calibration: Calibration) -> None:
    fit, camera = calibration.fit, calibration.camera
    enlarged = _LONG_ARROW * camera.width_px / (3.0 * fit.noise_px)
    x, y = (fit.seen.centroids_px - fit.residual_px).T
    dx, dy = (fit.residual_px * enlarged).T
    stray = np.hypot(*fit.residual_px.T) > 4.5 * fit.noise_px
    for which, colour in ((~stray, _BLUE), (stray, _RED)):
        # Arrows of stray centroids point to the measured place, but have a largest length.
        longest = 2.0 * _LONG_ARROW * camera.width_px
        size = np.minimum(1.0, longest / np.maximum(np.hypot(dx, dy), 1e-9))[which]
        axes.quiver(
            x[which], y[which], dx[which] * size, dy[which] * size, color=colour,
            angles="xy", scale_units="xy", scale=1.0, width=0.0022, headwidth=4.0,
        )  # fmt: skip
    axes.plot(*camera.principal_point_px, "+", color=_RED, ms=12, mew=1.4)
    axes.set(xlim=(0, camera.width_px), ylim=(camera.height_px, 0), aspect="equal")
    axes.set(xlabel=f"x, px (arrows {enlarged:.0f} times enlarged; cross: principal point)")
    axes.set(ylabel="y, px")


def _polar(calibration: Calibration) -> tuple[Array, Array]:
    """Return the residuals along and across the radius from the principal point."""
    fit = calibration.fit
    away = fit.seen.centroids_px - calibration.camera.principal_point_px
    unit = away / np.maximum(np.hypot(*away.T), 1e-9)[:, None]
    along = np.einsum("ij,ij->i", unit, fit.residual_px)
    return along, unit[:, 0] * fit.residual_px[:, 1] - unit[:, 1] * fit.residual_px[:, 0]


def _draw_profile(axes: Axes, calibration: Calibration, residual_px: Array, name: str) -> None:
    fit = calibration.fit
    radius = np.hypot(*(fit.seen.centroids_px - calibration.camera.principal_point_px).T)
    limit = 4.5 * fit.noise_px
    axes.axhline(0.0, color="#333", lw=0.8)
    axes.plot(radius, residual_px, ".", color=_GREY, ms=3)
    inside = np.abs(residual_px) <= limit
    order = np.flatnonzero(inside)[np.argsort(radius[inside], kind="stable")]
    for stars in np.array_split(order, min(_BINS, max(1, len(order) // 5))):
        error = residual_px[stars].std() / np.sqrt(len(stars))
        axes.errorbar(
            radius[stars].mean(), residual_px[stars].mean(), error, fmt="o", color=_BLUE, ms=4,
            capsize=2,
        )  # fmt: skip
    axes.set(ylim=(-limit, limit), ylabel=name, xlim=(0, None))
    axes.set_xlabel("distance from the principal point, px")
