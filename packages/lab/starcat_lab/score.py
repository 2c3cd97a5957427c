"""The score of an answer: the frame's truth compared with the matcher's answer.

One flat record per frame; every success rule is a condition on its fields, so a rate under any
rule is a query over the records.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.geometry import Camera, matrix_from_quaternion, quaternion_from_matrix, turn_between
from starcat.matcher import ARCSEC, MatcherDatabase, MatchResult
from starcat.pipeline.simulation import SimulatedFrame


@dataclass(frozen=True)
class Score:
    """One frame and its answer."""

    frame: int
    n_centroids: int  # content of the frame; guide stars only if detected
    n_guide_stars: int
    n_false: int
    status: str  # status of the answer: ``identified``, ``no_match`` or ``too_few_stars``
    # centroids that the best attitude names; with the right star; with a star that is elsewhere
    n_named: int
    n_right: int
    n_wrong: int
    is_reference_right: bool  # the guide star nearest to the centre of the frame has its own name
    # largest displacement of a corner of the frame, pixels; NaN without an attitude
    attitude_error_px: float
    boresight_error_arcsec: float  # the same, across and about the true boresight
    roll_error_arcsec: float
    false_match_probability: float  # the probability that the matcher states
    # bound and corner displacement of the answer, or of the candidate of a refused frame
    best_probability: float
    best_error_px: float
    time_ms: float  # processor time of the identification


FIELDS = tuple(field.name for field in fields(Score))
"""Columns of the records."""


def score(
    number: int,
    frame: SimulatedFrame,
    result: MatchResult,
    database: MatcherDatabase,
    camera: Camera,
    reach_px: float,
    time_ms: float,
) -> Score:
    """Compare an answer with the truth, or the candidate of a frame that was refused."""
    candidate = None if result.refusal is None else result.refusal.candidate
    best = result if candidate is None else candidate
    # No limit would accept a candidate that is refused for another reason than its probability.
    is_answer = result.refusal is None or result.refusal.reason == "chance"
    probability = best.false_match_probability if is_answer else math.nan
    named = best.star_index
    is_named = named >= 0
    right = is_named & (named == frame.star_index)
    other = np.flatnonzero(is_named & ~right)
    star_px = camera.pixels_from_directions(database.directions[named[other]] @ frame.matrix.T)
    away = np.hypot(*(star_px - frame.centroids_px[other]).T)
    error_px, across, about = _attitude_errors(frame.matrix, result.q_body_from_icrs, camera)
    best_error_px, _, _ = _attitude_errors(frame.matrix, best.q_body_from_icrs, camera)
    return Score(
        frame=number,
        n_centroids=len(frame.star_index),
        n_guide_stars=frame.n_stars,
        n_false=int(frame.is_false.sum()),
        status=result.status,
        n_named=int(is_named.sum()),
        n_right=int(right.sum()),
        n_wrong=int((~(away <= reach_px)).sum()),
        is_reference_right=_is_reference_right(frame, right, camera),
        attitude_error_px=error_px,
        boresight_error_arcsec=across,
        roll_error_arcsec=about,
        false_match_probability=result.false_match_probability,
        best_probability=probability,
        best_error_px=best_error_px,
        time_ms=time_ms,
    )


def reference_of(frame: SimulatedFrame, camera: Camera) -> int | None:
    """Return the centroid of the guide star nearest to the centre."""
    guides = np.flatnonzero(frame.star_index >= 0)
    if not len(guides):
        return None
    offset = frame.centroids_px[guides] - [0.5 * camera.width_px, 0.5 * camera.height_px]
    return int(guides[np.argmin(np.hypot(*offset.T))])


def _is_reference_right(frame: SimulatedFrame, right: NDArray[np.bool_], camera: Camera) -> bool:
    reference = reference_of(frame, camera)
    return reference is not None and bool(right[reference])


def _attitude_errors(truth: Array, q: Array, camera: Camera) -> tuple[float, float, float]:
    """Return the errors of an attitude: at the corners (pixels), across and about (arcsec)."""
    if not np.isfinite(q).all():
        return math.nan, math.nan, math.nan
    x, y, z = turn_between(quaternion_from_matrix(truth).tolist(), q.tolist())
    turn, corners = matrix_from_quaternion(q) @ truth.T, camera.corner_directions
    moved = np.linalg.norm(corners @ turn.T - corners, axis=1).max() * camera.focal_length_px
    return float(moved), ARCSEC * math.hypot(x, y), ARCSEC * abs(z)
