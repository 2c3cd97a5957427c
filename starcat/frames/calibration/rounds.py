"""Identification of the stars in frames of a camera that is hardly known.

The first step finds any frame at any focal length of a range. From there on the camera is fitted
to the stars of all frames that were identified, the frames are identified with that camera, within
a smaller tolerance and farther out, and so on until the stars no longer change.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.errors import ConfigError
from starcat.frames.calibration.fit import (
    CENTRE,
    FOCAL,
    Fit,
    Seen,
    camera_of,
    choose_model,
    chosen_terms,
    cropped,
    fit_camera,
    is_enough,
    start_of,
    values_of,
    with_motion_if_seen,
)
from starcat.geometry.attitude import matrix_from_quaternion
from starcat.geometry.camera import Camera
from starcat.matcher.centroids import MeasuredFrame
from starcat.matcher.chance import MIN_STARS
from starcat.matcher.matcher import Matcher
from starcat.matcher.result import MatchResult
from starcat.matcher.settings import NOISE_DEVIATIONS
from starcat.progress import Progress

WIDE_PX = 6.0  # tolerance while the camera is hardly known
NARROW_PX = 0.5  # smallest tolerance, however good the centroids are

# Ratio of neighbouring focal lengths of the first step, for a method that needs the focal length.
# The tolerance `WIDE_PX` allows an error of more than half of this step.
STEP = 1.015
FOV_ERROR = 0.1  # error of the focal length that the method ``triangle`` finds by itself
FOUND_PX = 4.0  # tolerance of the first step if the focal length is found with the attitude

# Middle parts of the frame that the first step tries: a lens distorts least in the middle.
SHARES = (1.0, 0.7, 0.5)

# Number of centroids of a frame that the first step uses, the brightest ones or, without
# magnitudes, the innermost: a search without an answer takes a tenth of the time of all centroids.
FEW = 16
AT_ONCE = 3  # frames that are tried together at all focal lengths, before others
GROWTH = 1.3  # factor by which the identified part of the frame grows in the next round
MAX_ROUNDS = 12  # largest number of rounds; four to seven are usual

# The models that a round chooses from.
ROUND_MODELS = (
    FOCAL,
    (*FOCAL, "k1"),
    (*FOCAL, "k1", "k2"),
    (*FOCAL, "k1", *CENTRE),
    (*FOCAL, "k1", "k2", *CENTRE),
)


@dataclass(frozen=True)
class IdentifiedFrame:
    """The results of the matcher for the frames."""

    # one result per frame, for the centroids as they were given; centroids outside of the part of
    # the frame that was searched have no star
    results: tuple[MatchResult, ...]
    camera: Camera  # camera of the identification
    tolerance_px: float  # tolerance of the identification

    @property
    def frame_numbers(self) -> list[int]:
        """Numbers of the frames that were identified."""
        return [k for k, result in enumerate(self.results) if result.status == "identified"]

    @property
    def focal_length_px(self) -> float:
        """The focal length that was found with the first identified frame."""
        camera = self.results[self.frame_numbers[0]].camera
        return (camera or self.camera).focal_length_px

    @property
    def stars(self) -> list[bytes]:
        """The star of each centroid, to compare two rounds."""
        return [result.star_index.tobytes() for result in self.results]

    def seen(self, frames: Sequence[MeasuredFrame], matcher: Matcher) -> Seen:
        """Return the stars of the frames that were identified."""
        rows = [np.flatnonzero(self.results[k].star_index >= 0) for k in self.frame_numbers]
        star = [
            self.results[k].star_index[row] for k, row in zip(self.frame_numbers, rows, strict=True)
        ]
        px = [frames[k].centroids_px[row] for k, row in zip(self.frame_numbers, rows, strict=True)]
        return Seen(
            np.repeat(np.arange(len(rows)), [len(row) for row in rows]),
            np.concatenate(px),
            matcher.database.directions[np.concatenate(star)],
            np.array(
                [
                    matrix_from_quaternion(self.results[k].q_body_from_icrs)
                    for k in self.frame_numbers
                ]
            ),
        )


def first_answer(
    matcher: Matcher, frames: Sequence[MeasuredFrame], camera: Camera, focal_px: tuple[float, float]
) -> tuple[Camera, float] | None:
    """Find a focal length at which any frame is identified."""
    size_px = camera.width_px, camera.height_px
    finds_scale = matcher.settings.method == "triangle" and matcher.database.image is None
    error, step = (FOV_ERROR, (1.0 + FOV_ERROR) ** 2) if finds_scale else (0.0, STEP)
    tolerance_px = FOUND_PX if finds_scale else WIDE_PX
    wide = matcher.with_settings(tolerance_px=tolerance_px, noise_px=None)
    usable = [frame for frame in frames if len(frame.centroids_px) >= MIN_STARS]
    usual = np.median([len(frame.centroids_px) for frame in usable]) if usable else 0
    usable.sort(key=lambda frame: abs(len(frame.centroids_px) - usual))
    values = values_of(camera)
    for first in range(0, len(usable), AT_ONCE):
        for share, focal in product(SHARES, _focal_lengths(*focal_px, step)):
            values[0] = focal
            try:
                about = camera_of(values, size_px)
            except ConfigError:  # its distortion folds back at this focal length
                continue
            for frame in usable[first : first + AT_ONCE]:
                identified = identify_part(wide, [frame], about, share, few=FEW, fov_error=error)
                if identified.frame_numbers:
                    seen, noise_px = (
                        identified.seen([frame], matcher),
                        tolerance_px / NOISE_DEVIATIONS,
                    )
                    values[0] = identified.focal_length_px
                    fit = fit_camera(seen, values, FOCAL, noise_px)
                    return camera_of(fit.values, size_px), share
    return None


def identify_part(
    matcher: Matcher,
    frames: Sequence[MeasuredFrame],
    camera: Camera,
    share: float = 1.0,
    *,
    few: int | None = None,
    fov_error: float = 0.0,
) -> IdentifiedFrame:
    """Identify the middle of frames."""
    middle, corner_px = cropped(camera, share)
    results = []
    for frame in frames:
        px = frame.centroids_px - corner_px
        rows = np.flatnonzero(middle.contains(px))
        if few is not None:
            away = np.hypot(*(px[rows] - 0.5 * np.array([middle.width_px, middle.height_px])).T)
            key = away if frame.mag is None else frame.mag[rows]
            rows = np.sort(rows[np.argsort(key, kind="stable")[:few]])
        mag = None if frame.mag is None else frame.mag[rows]
        result = matcher.identify(px[rows], middle, mag=mag, fov_error=fov_error)
        results.append(_of_all(result, rows, len(px)))
    return IdentifiedFrame(tuple(results), camera, matcher.settings.tolerance_px)


def settled(
    matcher: Matcher,
    frames: Sequence[MeasuredFrame],
    camera: Camera,
    share: float,
    progress: Progress,
) -> tuple[IdentifiedFrame, Fit | None]:
    """Identify and fit in turn until the stars no longer change."""
    size_px, tolerance_px = (camera.width_px, camera.height_px), WIDE_PX
    before: list[bytes] = []
    fit = None
    for number in range(MAX_ROUNDS):
        asked = matcher.with_settings(tolerance_px=tolerance_px, noise_px=None)
        identified = identify_part(asked, frames, camera, share)
        progress("round", number + 1, None)
        if not identified.frame_numbers or (share == 1.0 and identified.stars == before):
            return identified, fit if identified.frame_numbers else None
        values, noise_px = values_of(camera), tolerance_px / NOISE_DEVIATIONS
        seen = with_motion_if_seen(identified.seen(frames, matcher), values, size_px, noise_px)
        fit = supported_fit(seen, values, size_px, tolerance_px)
        camera = camera_of(fit.values, size_px)
        if share == 1.0:
            before = identified.stars
            needed_px = NOISE_DEVIATIONS * fit.noise_px
            tolerance_px = min(tolerance_px, max(NARROW_PX, needed_px))
        share = min(1.0, GROWTH * share)
    return identified, fit


def supported_fit(seen: Seen, values: Array, size_px: tuple[int, int], tolerance_px: float) -> Fit:
    """Return the fit of the model of a round that the stars support."""
    free: tuple[str, ...] = FOCAL
    noise_px = tolerance_px / NOISE_DEVIATIONS
    if is_enough(seen):
        free = chosen_terms(choose_model(seen, values, size_px, noise_px, ROUND_MODELS))
    for terms in (free, FOCAL):
        fit = fit_camera(seen, start_of(values, terms, size_px), terms, noise_px)
        with suppress(ConfigError):  # the fit to all frames can fold although the trials do not
            camera_of(fit.values, size_px)
            break
    return fit


def _focal_lengths(shortest: float, longest: float, step: float) -> list[float]:
    """Return the middles of the parts of a range that a step covers, the middle one first."""
    parts = max(1, math.ceil(math.log(longest / shortest) / math.log(step)))
    edges = np.geomspace(shortest, longest, parts + 1)
    grid = np.sqrt(edges[:-1] * edges[1:])
    away = np.abs(np.log(grid) - 0.5 * math.log(shortest * longest))
    return list(grid[np.argsort(away, kind="stable")].tolist())


def _of_all(result: MatchResult, rows: NDArray[np.int64], count: int) -> MatchResult:
    """Return the answer for some centroids as an answer for all of them."""
    index = np.full(count, -1, dtype=np.int32)
    index[rows] = result.star_index
    dropped = tuple((int(rows[row]), reason) for row, reason in result.dropped)
    return replace(result, star_index=index, dropped=dropped)
