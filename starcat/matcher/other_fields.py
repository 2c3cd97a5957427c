"""Why a frame was not identified: try it mirrored, with x and y exchanged, and in other fields.

A finding is not an answer. It shows what is wrong in the stated camera, and it must pass the bound
on false matches like an answer, with all searches of the frame counted.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from starcat.geometry.camera import Camera
from starcat.matcher.centroids import MeasuredFrame, exchanged, upside_down
from starcat.matcher.refusal import Fact, Reason, Refusal
from starcat.matcher.result import MatchResult

FOV_ERROR = 0.05
"""Error of the focal length that is allowed if none is stated. Data sheets can be this wrong: an
IMX219 with 48.8 deg on paper has 50.5."""

WIDE_FOV_ERROR = 0.15
"""Error of the focal length that is tried first, with the distortion of the stated camera."""

FACTOR = 2.0
"""Fields from the stated field divided by this to the stated field times this are tried."""

WIDEST_DEG = 120.0
"""Widest field that is tried; a spec takes no wider one."""

MARGIN = 1.02
"""Factor by which the focal lengths at both ends are exceeded, so that the ends are found too."""

PARTS = 2
"""Parts on each side of the first one. An error of the focal length bends the sides of triangles:
the smaller the part, the fewer triangles are similar by chance."""

SEARCHES = 2
"""Number of searches before, if the caller does not count them: as stated, and with an error."""


Search = Callable[[MeasuredFrame, float, Camera], MatchResult]
"""The answer to a frame: arguments are the frame, the error of its focal length, and its camera."""


def parts_of_fields(camera: Camera) -> list[tuple[Camera, float]]:
    """Return cameras and errors of the focal length that cover all fields, the nearest first."""
    focal_px = camera.focal_length_px
    wide_deg = min(FACTOR * camera.fov_x_deg, max(WIDEST_DEG, camera.fov_x_deg))
    flat = (
        Camera(camera.width_px, camera.height_px, fov_x_deg=fov_deg).focal_length_px
        for fov_deg in (wide_deg, camera.fov_x_deg / FACTOR)
    )
    shortest, longest = next(flat) / MARGIN, next(flat) * MARGIN
    inner = focal_px * (1.0 - WIDE_FOV_ERROR), focal_px / (1.0 - WIDE_FOV_ERROR)
    parts = [(camera, WIDE_FOV_ERROR)]
    for low_px, high_px in ((shortest, inner[0]), (inner[1], longest)):
        if low_px < high_px:
            for low, high in pairwise(np.geomspace(low_px, high_px, PARTS + 1).tolist()):
                # The lens of another field has another distortion.
                middle = Camera(camera.width_px, camera.height_px, math.sqrt(low * high))
                parts.append((middle, 1.0 - math.sqrt(low / high)))
    return sorted(parts, key=lambda part: abs(math.log(part[0].focal_length_px / focal_px)))


def explained(
    refused: MatchResult,
    frame: MeasuredFrame,
    camera: Camera,
    search: Search,
    *,
    fov_error: float = 0.0,
    with_fields: bool = True,
    flip: bool | None = None,
    is_picture: bool = False,
    limit: float,
    searches: int = SEARCHES,
) -> MatchResult:
    """Return a refused answer with the findings of a second look.

    The frame is tried mirrored, with x and y exchanged unless it ``is_picture``, and,
    ``with_fields``, in fields of half to twice the stated one, the nearest first. The probability
    that chance agrees in any of K searches is at most the sum of their K probabilities.
    ``searches`` is the number of searches of the frame so far; a finding is left out if its
    probability times the number of all searches is above the ``limit``.
    """
    refusal = refused.refusal
    if refusal is None:
        return refused
    parts = parts_of_fields(camera) if with_fields else []
    count = searches + (1 if is_picture else 2) + len(parts)
    up = search(upside_down(frame, camera.height_px), fov_error, camera)
    is_up, is_exchanged = _is_certain(up, limit / count), False
    # With x and y exchanged a frame is mirrored, too. On a square detector both readings fit, and
    # only the roll differs; on another one the centroids leave the frame.
    turned = exchanged(frame)
    if not is_picture and (is_up or _n_inside(turned, camera) > _n_inside(frame, camera)):
        other = search(turned, fov_error, camera)
        is_exchanged = _is_certain(other, limit / count)
        if is_exchanged and (not is_up or other.n_matched > up.n_matched):
            return replace(refused, refusal=_explanation(other, "exchanged", count, None, camera))
        is_exchanged = is_exchanged and other.n_matched == up.n_matched
    if is_up:
        why = _explanation(up, "mirrored", count, None, camera)
        rolls_deg = (up.roll_deg, other.roll_deg) if is_exchanged else None
        return replace(refused, refusal=replace(why, flip=flip, rolls_deg=rolls_deg))
    for part, error in parts:
        answer = search(frame, error, part)
        if answer.camera is not None and _is_certain(answer, limit / count):
            factor = answer.camera.focal_length_px / camera.focal_length_px
            is_near = abs(factor - 1.0) <= WIDE_FOV_ERROR
            why = _explanation(
                answer, "scale" if is_near else "other_field", count, factor - 1.0, camera
            )
            return replace(refused, refusal=why)
    tangents = [
        0.5 * camera.width_px / part.focal_length_px * factor
        for part, error in parts
        for factor in (1.0 - error, 1.0 / (1.0 - error))
    ]
    fields = [2.0 * math.degrees(math.atan(tangent)) for tangent in tangents]
    facts: frozenset[Fact] = refusal.facts | frozenset[Fact](("explained",))
    between = (min(fields), max(fields)) if fields else None
    return replace(refused, refusal=replace(refusal, facts=facts, tried_fov_deg=between))


def _n_inside(frame: MeasuredFrame, camera: Camera) -> int:
    return int(camera.contains(frame.centroids_px).sum())


def _is_certain(answer: MatchResult, limit: float) -> bool:
    return answer.ok and answer.false_match_probability <= limit


def _explanation(
    answer: MatchResult, reason: Reason, searches: int, focal_error: float | None, stated: Camera
) -> Refusal:
    of_database = None if answer.database is None else answer.database.camera
    return Refusal(
        reason,
        answer.n_matched,
        min(1.0, searches * answer.false_match_probability),
        n_centroids=len(answer.star_index) - len(answer.dropped),
        camera=answer.camera,
        focal_error=focal_error,
        stated_fov_deg=None if focal_error is None else stated.fov_x_deg,
        is_of_database=stated == of_database,
    )
