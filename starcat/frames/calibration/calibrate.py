"""Frames and a range of focal lengths to a camera with its errors.

Here the rounds of identification end in the last comparison of models, the camera of the terms
that the frames support, and the values and errors of terms that they do not support.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from starcat.arrays import Array
from starcat.errors import CalibrationError
from starcat.frames.calibration.fit import (
    AXES,
    COMPLETE,
    PARAMETERS,
    Fit,
    Trial,
    camera_of,
    choose_model,
    chosen_terms,
    fit_camera,
    is_enough,
    start_of,
    values_of,
    with_motion_if_seen,
)
from starcat.frames.calibration.rounds import IdentifiedFrame, first_answer, identify_part, settled
from starcat.geometry.attitude import quaternion_from_matrix
from starcat.geometry.camera import Camera
from starcat.matcher.centroids import MeasuredFrame
from starcat.matcher.frame_shape import turn_of_motion_deg_s
from starcat.matcher.matcher import Matcher
from starcat.matcher.observation import remarks_on_pixels
from starcat.matcher.result import MatchResult
from starcat.progress import Progress, no_progress
from starcat.results import entry, in_record, readable

# Fewest identified frames of a calibration: with fewer, leaving some out tests nothing.
MIN_FRAMES = 3
MAX_NAMED = 10  # frames that a message names at most
SKEWED = 5.0  # pixels are said not to be square if an axis is off by this many standard errors


@dataclass(frozen=True, eq=False, repr=False)
class CalibratedFrame:
    """The result of one frame.

    Attributes
    ----------
    name : str
        Name of the frame.
    status : str
        The status as in `MatchResult`.
    n_centroids, n_matched : int
        Numbers of all centroids, and of centroids with a star.
    residual_px : float
        Root mean square residual on each axis; NaN unless identified.
    q_body_from_icrs : ndarray of float64, shape (4,)
        Attitude with the calibrated camera; NaN unless identified.
    reason : str
        Why the frame was not identified; empty if it was.
    remarks : tuple of str
        What of its file was not used or was assumed, and whether coordinates are hardly pixels.
    stretch, shear : float
        Stretch and shear of its rows, as in `FrameShape`; 0 if the frames do not support motions,
        NaN unless identified.
    turn_deg_s : float or None
        Speed of the boresight that stretch and shear mean; None if the camera does not state
        ``readout_s``.
    """

    name: str = field(metadata=entry(key="frame"))
    status: str
    n_centroids: int
    n_matched: int
    residual_px: float
    q_body_from_icrs: Array
    reason: str = field(metadata=entry(is_none_if_empty=True))
    remarks: tuple[str, ...] = ()
    stretch: float = float("nan")
    shear: float = float("nan")
    turn_deg_s: float | None = None

    __repr__ = readable


@dataclass(frozen=True)
class Calibration:
    """A camera that was found from frames of stars.

    Attributes
    ----------
    camera : Camera
        The camera with the terms that the frames support; the other terms are 0, and the principal
        point is in the middle.
    fit : Fit
        These terms with covariance, noise and residuals.
    complete : Fit
        The fit with all usual terms free, whether they are supported or not.
    axes : Fit
        The supported terms with aspect and skew free too, which no camera file has. Without them
        if `has_motion`: they cannot be separated from the mean motion.
    trials : tuple of Trial
        The comparison of models on frames that they were not fitted to. Empty if there are too few
        stars to compare models; then only the focal length is fitted.
    frames : tuple of CalibratedFrame
        One result per frame, in the order of the input.
    """

    camera: Camera
    fit: Fit = field(metadata=entry(key="supported"))
    complete: Fit = field(metadata=entry(key="all_terms"))
    axes: Fit
    trials: tuple[Trial, ...] = field(metadata=entry(key="models"))
    frames: tuple[CalibratedFrame, ...]

    @property
    @in_record()
    def residual_px(self) -> float:
        """Standard deviation of a centroid on each axis about the fit."""
        return self.fit.noise_px

    @property
    @in_record()
    def stars(self) -> int:
        """Number of centroids that the camera was fitted to."""
        return len(self.fit.seen)

    @property
    def n_identified(self) -> int:
        """Number of frames that the camera was fitted to."""
        return len(self.fit.seen.matrices)

    @property
    def has_motion(self) -> bool:
        """Whether each frame has a stretch and a shear of its own, as of a rolling shutter."""
        return self.fit.seen.motion is not None

    @property
    def has_square_pixels(self) -> bool:
        """Whether aspect and skew are 0 within `SKEWED` of their errors, or not known."""
        return all(
            abs(self.axes.values[PARAMETERS.index(name)]) <= SKEWED * self.axes.errors[name]
            for name in AXES
            if name in self.axes.free
        )

    def __repr__(self) -> str:
        return (
            f"<Calibration {self.camera.in_words}: {self.n_identified} of {len(self.frames)} "
            f"frames, {len(self.fit.seen)} stars, residual {self.fit.noise_px:.3f} px, "
            f"{', '.join(self.fit.free)}>"
        )


def calibrate_frames(
    matcher: Matcher,
    frames: Sequence[MeasuredFrame],
    camera: Camera,
    focal_px: tuple[float, float],
    progress: Progress = no_progress,
) -> Calibration:
    """Find the camera that took frames, with a focal length in a range; the tolerance is found."""
    begun = first_answer(matcher, frames, camera, focal_px)
    if begun is None:
        asked = identify_part(matcher, frames, camera)
        raise _too_few(frames, asked, focal_px)
    identified, fit = settled(matcher, frames, *begun, progress)
    if fit is None or len(identified.frame_numbers) < MIN_FRAMES:
        raise _too_few(frames, identified, focal_px)
    progress("models", 0, None)
    return _finished(matcher, frames, identified, fit, camera.readout_s)


def _finished(
    matcher: Matcher,
    frames: Sequence[MeasuredFrame],
    identified: IdentifiedFrame,
    fit: Fit,
    readout_s: float | None,
) -> Calibration:
    size_px = identified.camera.width_px, identified.camera.height_px
    seen = with_motion_if_seen(identified.seen(frames, matcher), fit.values, size_px, fit.noise_px)
    trials, terms = [], fit.free
    if is_enough(seen):
        trials = choose_model(seen, fit.values, size_px, fit.noise_px)
        terms = chosen_terms(trials)
    fit = fit_camera(seen, start_of(fit.values, terms, size_px), terms, fit.noise_px)
    fitted = camera_of(fit.values, size_px)
    # The camera of the last round can have had other terms: identify the frames once more.
    last = matcher.with_settings(tolerance_px=identified.tolerance_px, noise_px=None)
    again = identify_part(last, frames, fitted)
    if len(again.frame_numbers) >= len(identified.frame_numbers):
        identified = again
    seen = with_motion_if_seen(
        identified.seen(frames, matcher), values_of(fitted), size_px, fit.noise_px
    )
    fit = fit_camera(seen, values_of(fitted), terms, fit.noise_px)
    every = tuple(name for name in PARAMETERS if name in {*terms, *COMPLETE})
    axes = terms if seen.motion is not None else (*terms, *AXES)
    camera = replace(camera_of(fit.values, size_px), readout_s=readout_s)
    return Calibration(
        camera,
        fit,
        fit_camera(seen, fit.values, every, fit.noise_px),
        fit_camera(seen, fit.values, axes, fit.noise_px),
        tuple(trials),
        _outcomes(frames, identified, fit, camera),
    )


def _outcomes(
    frames: Sequence[MeasuredFrame], identified: IdentifiedFrame, fit: Fit, camera: Camera
) -> tuple[CalibratedFrame, ...]:
    outcomes = []
    for k, (frame, result) in enumerate(zip(frames, identified.results, strict=True)):
        residual_px, q = float("nan"), np.full(4, np.nan)
        stretch, shear, turn_deg_s = float("nan"), float("nan"), None
        if result.status == "identified":
            row = identified.frame_numbers.index(k)
            residuals_px = fit.residual_px[fit.seen.frame == row]
            residual_px = float(np.sqrt(np.mean(residuals_px**2)))
            q = quaternion_from_matrix(fit.seen.matrices[row])
            motion = (0.0, 0.0) if fit.seen.motion is None else fit.seen.motion[row].tolist()
            shear, stretch = motion
            if camera.readout_s is not None:
                turn_deg_s = math.hypot(shear, stretch) * turn_of_motion_deg_s(camera)
        count, matched = len(frame.centroids_px), result.n_matched
        reason = result.refusal.message if result.refusal else ""
        # The result is of the centroids in the frame alone.
        remarks = *frame.remarks, *remarks_on_pixels(frame.centroids_px, camera)
        outcome = CalibratedFrame(
            frame.name, result.status, count, matched, residual_px, q, reason, remarks,
            stretch, shear, turn_deg_s,
        )  # fmt: skip
        outcomes.append(outcome)
    return tuple(outcomes)


def _too_few(
    frames: Sequence[MeasuredFrame], identified: IdentifiedFrame, focal_px: tuple[float, float]
) -> CalibrationError:
    """Return the error about frames that were not identified."""
    width_px = identified.camera.width_px
    fields = sorted(float(2.0 * np.degrees(np.arctan(0.5 * width_px / f))) for f in focal_px)
    failed = [
        f"{frame.name} ({_why(frame, result)})"
        for frame, result in zip(frames, identified.results, strict=True)
        if result.status != "identified"
    ]
    more = len(failed) - MAX_NAMED
    named = ", ".join(failed[:MAX_NAMED]) + (f" and {more} more" if more > 0 else "")
    count, across = len(identified.frame_numbers), f"{fields[0]:.4g} to {fields[1]:.4g} deg"
    if count >= MIN_FRAMES:  # they were identified, and no camera in the range fits them
        return CalibrationError(
            f"{count} of {len(frames)} frames are identified, but no camera with a field of "
            f"{across} across the width fits them",
            hint="give a range of fields that holds the true one ({fov_deg})",
        )
    missing = f". Not identified: {named}" if failed else ""
    return CalibrationError(
        f"{count} of {len(frames)} frames are identified with fields of {across} across the "
        f"width; a calibration needs {MIN_FRAMES}{missing}",
        hint=(
            "Give more frames",
            "a wider range of fields ({fov_deg})",
            "the other value of {flip}",
            "a database that was built for about this field and these stars",
        ),
    )


def _why(frame: MeasuredFrame, result: MatchResult) -> str:
    words = result.refusal.message if result.refusal else result.status.replace("_", " ")
    return f"{len(frame.centroids_px)} centroids: {words}"
