"""Calibration of the camera of files: their frames, and what is known of their camera before."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from starcat.calibration.calibrate import Calibration, calibrate_frames
from starcat.errors import ConfigError
from starcat.geometry.camera import Camera
from starcat.images.solve_files import IdentifyOptions, measure
from starcat.matcher.centroids import MeasuredFrame
from starcat.matcher.matcher import Matcher
from starcat.progress import Progress, no_progress

USUAL_ERROR = 0.1
"""Share by which the focal length of the camera to start from may be wrong, where no range of
fields is given."""


def calibrate_files(
    matcher: Matcher,
    paths: Sequence[Path],
    *,
    camera: Camera | None = None,
    size_px: tuple[int, int] | None = None,
    fov_deg: tuple[float, float] | None = None,
    flip: bool | None = None,
    progress: Progress = no_progress,
) -> Calibration:
    """Find the camera that took the frames of files."""
    frames, image_size_px = measured_frames(paths, flip=flip, progress=progress)
    known, focal_px = starting_camera(
        matcher.database.camera,
        camera=camera,
        size_px=size_px,
        image_size_px=image_size_px,
        fov_deg=fov_deg,
    )
    return calibrate_frames(matcher, frames, known, focal_px, progress)


def measured_frames(
    paths: Sequence[Path], *, flip: bool | None = None, progress: Progress = no_progress
) -> tuple[list[MeasuredFrame], tuple[int, int] | None]:
    """Read the frames of files."""
    frames: list[MeasuredFrame] = []
    size_px: tuple[int, int] | None = None
    for number, path in enumerate(paths, start=1):
        measured = measure(path, IdentifyOptions(flip=flip))
        frames += measured.frames
        if measured.image is not None:
            height, width = measured.image.shape
            if size_px is not None and size_px != (width, height):
                raise ConfigError(
                    f"{path}: {width} x {height} px, the images before it {size_px[0]} x "
                    f"{size_px[1]}; give the frames of one camera"
                )
            size_px = width, height
        progress("measure", number, len(paths))
    return frames, size_px


def starting_camera(
    own: Camera,
    *,
    camera: Camera | None = None,
    size_px: tuple[int, int] | None = None,
    image_size_px: tuple[int, int] | None = None,
    fov_deg: tuple[float, float] | None = None,
) -> tuple[Camera, tuple[float, float]]:
    """Return what is known of a camera before its calibration."""
    if camera is not None and size_px is not None:
        raise ConfigError("give either a camera or its size, not both; a camera has a size")
    known = camera or own
    said = size_px or (None if camera is None else (camera.width_px, camera.height_px))
    if image_size_px is not None and said not in (None, image_size_px):
        raise ConfigError(
            f"the images have {image_size_px[0]} x {image_size_px[1]} px, the camera "
            f"{said[0]} x {said[1]}; give the camera of these images, or none"
        )
    wanted = said or image_size_px or (known.width_px, known.height_px)
    if fov_deg is None:
        if wanted != (known.width_px, known.height_px):
            raise ConfigError(
                f"the frames have {wanted[0]} x {wanted[1]} px, the camera of the database "
                f"{known.width_px} x {known.height_px}; say the field across their width with "
                "--fov, such as 5:20, or give a camera file"
            )
        focal = known.focal_length_px
        return known, (focal / (1.0 + USUAL_ERROR), focal * (1.0 + USUAL_ERROR))
    shortest, longest = _focal_range(wanted[0], *fov_deg)
    if wanted != (known.width_px, known.height_px):
        known = Camera(*wanted, float(np.sqrt(shortest * longest)))
    return known, (shortest, longest)


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
