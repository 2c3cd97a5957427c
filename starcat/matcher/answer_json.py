"""What ``starcat identify --json`` says of a frame, as plain values."""

from __future__ import annotations

import math
from typing import Any

from starcat.matcher.centroids import MeasuredFrame
from starcat.matcher.result import MatchResult

Content = dict[str, Any]


def answer_content(frame: MeasuredFrame, result: MatchResult) -> Content:
    """Return a frame's answer as JSON has it."""
    return {"frame": frame.name, **facts(result), "stars": _stars(frame, result)}


def facts(result: MatchResult) -> Content:
    """Return what an answer says of the whole frame."""
    found: Content = {"status": result.status, "origin": result.origin}
    found["n_matched"] = result.n_matched
    if result.ok:
        camera = result.camera
        found |= {
            "boresight_ra_deg": result.boresight_ra_deg,
            "boresight_dec_deg": result.boresight_dec_deg,
            "roll_deg": result.roll_deg,
            "q_body_from_icrs": result.q_body_from_icrs.tolist(),
            "covariance_arcsec2": [
                [_or_none(value) for value in row] for row in result.covariance_arcsec2.tolist()
            ],
            "residual_arcsec": result.residual_arcsec,
            "false_match_probability": result.false_match_probability,
            "focal_length_px": None if camera is None else camera.focal_length_px,
            "focal_length_error_px": result.focal_length_error_px,
        }
    elif result.refusal is not None:
        why = result.refusal
        found["refusal"] = {
            "reason": why.reason,
            "words": why.message,
            "advice": why.hint,
            "n_matched": why.n_matched,
            "false_match_probability": why.false_match_probability,
            "share": why.share,
        }
    return {**found, "time_s": _or_none(result.time_s)}


def _stars(frame: MeasuredFrame, result: MatchResult) -> list[Content]:
    reasons, stars = dict(result.dropped), result.stars
    row_of = {spot: row for row, spot in enumerate(stars.spot.tolist())}
    numbers = ("mag", "ra_deg", "dec_deg", "dx_px", "dy_px", "separation_arcsec", "difference_mag")
    columns = {name: getattr(stars, name).tolist() for name in numbers}
    content = []
    for number, (x, y) in enumerate(frame.centroids_px.tolist()):
        one: Content = {"x_px": _or_none(x), "y_px": _or_none(y), "star": None, "mag": None}
        row = row_of.get(number)
        if row is not None:
            one |= {"star": stars.star[row], "star_id": str(stars.star_id[row])}
            one |= {name: _or_none(column[row]) for name, column in columns.items()}
        if number in reasons:
            one["dropped"] = reasons[number]
        content.append(one)
    return content


def _or_none(value: float) -> float | None:
    """Return a number that JSON has: it has neither NaN nor infinity."""
    return value if math.isfinite(value) else None
