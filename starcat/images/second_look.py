"""A second look at a frame without an answer: whether it is mirrored, or of another scale.

What is found so is no answer. It tells what to change, and stands in the refusal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from starcat.geometry.camera import Camera
from starcat.matcher.centroids import MeasuredFrame, upside_down
from starcat.matcher.refusal import Reason, Refusal
from starcat.matcher.result import MatchResult

FOV_ERROR = 0.05
"""Error of the focal length that is allowed where none is stated. Data sheets are off by so much:
an IMX219 with 48.8 deg on paper has 50.5."""

WIDE_FOV_ERROR = 0.15
"""Error that a second look allows."""

Search = Callable[[MeasuredFrame, float], MatchResult]
"""The answer to a frame with an error of the focal length."""


def look_again(
    search: Search,
    frame: MeasuredFrame,
    camera: Camera,
    refused: MatchResult,
    fov_error: float,
    *,
    is_scale_free: bool,
    flip: bool | None = None,
) -> MatchResult:
    """Return a refused answer with a refusal that says what was found in a second look, if any."""
    mirrored = search(upside_down(frame, camera.height_px), fov_error)
    if mirrored.ok:
        return _refused(refused, mirrored, "mirrored", None, flip)
    if is_scale_free:
        scaled = search(frame, WIDE_FOV_ERROR)
        if scaled.ok and scaled.camera is not None:
            factor = scaled.camera.focal_length_px / camera.focal_length_px
            return _refused(refused, scaled, "scale", factor - 1.0)
    return refused


def _refused(
    refused: MatchResult,
    found: MatchResult,
    reason: Reason,
    focal_error: float | None,
    flip: bool | None = None,
) -> MatchResult:
    usable = len(found.star_index) - len(found.dropped)
    chance = found.false_match_probability
    why = Refusal(
        reason, found.n_matched, chance, n_centroids=usable, camera=found.camera,
        focal_error=focal_error, flip=flip,
    )  # fmt: skip
    return replace(refused, refusal=why)
