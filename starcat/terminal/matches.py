"""What ``starcat identify`` prints."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from starcat.geometry.attitude import quaternion_from_matrix, radec_roll_from_matrix
from starcat.matcher.centroids import MeasuredFrame
from starcat.matcher.database import Database
from starcat.matcher.methods.table import METHODS
from starcat.matcher.result import MatchResult
from starcat.simulation.simulate import Frame
from starcat.terminal.console import print_json, print_table


def print_matches(
    frames: Sequence[MeasuredFrame],
    results: Sequence[MatchResult],
    database: Database,
    *,
    as_json: bool,
) -> None:
    """Print the answers to the frames of a file.

    Parameters
    ----------
    frames : sequence of MeasuredFrame
        What was asked.
    results : sequence of MatchResult
        The answers, in the same order.
    database : Database
        Names and magnitudes.
    as_json : bool
        Whether to print JSON: an object for one frame, a list for several.
    """
    if as_json:
        content = [
            _as_dict(frame, result, database) for frame, result in zip(frames, results, strict=True)
        ]
        print_json(content[0] if len(content) == 1 else content)
    elif len(frames) == 1:
        _print_one(frames[0], results[0], database)
    else:
        _print_many(frames, results, database)


def _as_dict(frame: MeasuredFrame, result: MatchResult, database: Database) -> dict[str, Any]:
    return {"frame": frame.name, **_facts(result), "stars": _stars(frame, result, database)}


def _facts(result: MatchResult) -> dict[str, Any]:
    facts: dict[str, Any] = {"status": result.status, "n_matched": result.n_matched}
    if result.status == "identified":
        facts |= {
            "boresight_ra_deg": result.boresight_ra_deg,
            "boresight_dec_deg": result.boresight_dec_deg,
            "roll_deg": result.roll_deg,
            "q_body_from_icrs": result.q_body_from_icrs.tolist(),
            "residual_arcsec": result.residual_arcsec,
            "false_match_probability": result.false_match_probability,
        }
    return facts


def _stars(frame: MeasuredFrame, result: MatchResult, database: Database) -> list[dict[str, Any]]:
    reasons = dict(result.dropped)
    stars = []
    for number, row in enumerate(result.star_index):
        x, y = frame.centroids_px[number]
        star: dict[str, Any] = {"x_px": float(x), "y_px": float(y), "star": None, "mag": None}
        if row >= 0:
            star |= {
                "star": database.designation[row].decode() or str(database.star_id[row]),
                "star_id": int(result.star_ids[number]),
                "mag": float(database.mag[row]),
            }
        if number in reasons:
            star["dropped"] = reasons[number]
        stars.append(star)
    return stars


def _print_one(frame: MeasuredFrame, result: MatchResult, database: Database) -> None:
    rows = [
        (name, f"{value:.9g}" if isinstance(value, float) else value)
        for name, value in _facts(result).items()
    ]
    for reason, count in sorted(Counter(reason for _, reason in result.dropped).items()):
        rows.append((f"dropped, {reason.replace('_', ' ')}", count))
    print_table(f"{len(frame.centroids_px)} centroids, {database.name}", ("", ""), rows)
    if result.status == "identified":
        print_table(
            "Stars",
            ("x px", "y px", "star", "mag"),
            [
                (f"{s['x_px']:.2f}", f"{s['y_px']:.2f}", s["star"] or "-",
                 "" if s["mag"] is None else f"{s['mag']:.2f}")
                for s in _stars(frame, result, database)
            ],
            numbers=(0, 1, 3),
        )  # fmt: skip


def _print_many(
    frames: Sequence[MeasuredFrame], results: Sequence[MatchResult], database: Database
) -> None:
    rows = []
    for frame, result in zip(frames, results, strict=True):
        angles = (result.boresight_ra_deg, result.boresight_dec_deg, result.roll_deg)
        known = result.status == "identified"
        rows.append(
            (
                frame.name,
                result.status,
                f"{result.n_matched}/{len(frame.centroids_px)}",
                *(f"{angle:.5f}" if known else "" for angle in angles),
                f"{result.residual_arcsec:.2f}" if known else "",
                f"{result.false_match_probability:.1e}" if known else "",
            )
        )
    heads = ("frame", "status", "stars", "RA deg", "Dec deg", "roll deg", "rms arcsec", "chance")
    print_table(f"{len(frames)} frames, {database.name}", heads, rows, numbers=(2, 3, 4, 5, 6, 7))


def print_simulated(frame: Frame, output: Path, *, as_json: bool) -> None:
    """Print the truth about a simulated frame, as JSON; nothing for people, who want to guess.

    Parameters
    ----------
    frame : Frame
        Centroids and the true attitude.
    output : Path
        The file that was written.
    as_json : bool
        Whether to print JSON, with the names that `print_matches` gives an answer.
    """
    if not as_json:
        return
    ra_deg, dec_deg, roll_deg = radec_roll_from_matrix(frame.matrix)
    print_json(
        {
            "file": str(output),
            "centroids": len(frame.centroids_px),
            "guide_stars": frame.n_stars,
            "false_stars": int(frame.is_false.sum()),
            "boresight_ra_deg": float(ra_deg),
            "boresight_dec_deg": float(dec_deg),
            "roll_deg": float(roll_deg),
            "q_body_from_icrs": quaternion_from_matrix(frame.matrix).tolist(),
        }
    )


def print_methods(*, as_json: bool) -> None:
    """Print the ways to identify stars.

    Parameters
    ----------
    as_json : bool
        Whether to print JSON.
    """
    rows = [
        {"method": name, "needs": list(method.products), "description": method.description}
        for name, method in METHODS.items()
    ]
    if as_json:
        print_json(rows)
        return
    print_table(
        "Methods",
        ("method", "needs", "how"),
        [(row["method"], ", ".join(row["needs"]), row["description"]) for row in rows],
    )
