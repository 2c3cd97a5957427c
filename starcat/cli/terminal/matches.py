"""What ``starcat identify`` prints."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from starcat.cli.terminal.console import print_json, print_json_line, print_table
from starcat.cli.terminal.sky_in_time import print_sky_in_time, sky_as_dict
from starcat.errors import NotIdentifiedError
from starcat.geometry.attitude import quaternion_from_matrix, radec_roll_from_matrix
from starcat.images.answering import sky_of_answer
from starcat.matcher.answer_json import answer_content, facts
from starcat.matcher.centroids import MeasuredFrame
from starcat.matcher.database import Database
from starcat.matcher.methods.table import METHODS
from starcat.matcher.result import MatchResult
from starcat.simulation.simulate import Frame
from starcat.sky.observer import Observer

Answered = tuple[MeasuredFrame, MatchResult]

NAMED = 3
"""Frames that are named where some were not identified."""


@dataclass(frozen=True)
class Told:
    """What was said of the frames of a file.

    Attributes
    ----------
    frames, identified : int
        How many there were, and how many of them were identified.
    first : (MeasuredFrame, MatchResult) or None
        The first frame and its answer; None where a stream had no frame.
    unidentified : tuple of str
        Names of the first frames that were not, at most `NAMED` of them.
    """

    frames: int
    identified: int
    first: Answered | None
    unidentified: tuple[str, ...]

    def expect_all_identified(self) -> None:
        """Raise `NotIdentifiedError` unless every frame was identified."""
        missing = self.frames - self.identified
        if missing:
            more = ", ..." if missing > len(self.unidentified) else ""
            raise NotIdentifiedError(
                f"{missing:,} of {self.frames:,} frames not identified "
                f"({', '.join(self.unidentified)}{more}); 'refusal' of each says why, and what to "
                "try"
            )


def print_answers(
    answered: Iterable[Answered],
    database: Database,
    *,
    as_json: bool,
    as_lines: bool = False,
    observer: Observer | None = None,
) -> Told:
    """Print the answers to the frames of a file."""
    kept: list[Answered] = []
    first: Answered | None = None
    count = identified = 0
    missing: list[str] = []
    for frame, result in answered:
        first = first or (frame, result)
        count, identified = count + 1, identified + result.ok
        if not result.ok and len(missing) < NAMED:
            missing.append(f"{frame.name}: {result.status}")
        if as_lines:
            print_json_line(_content(frame, result, observer))
        else:
            kept.append((frame, result))
    if as_json and not as_lines:
        print_json([_content(frame, result, observer) for frame, result in kept])
    elif len(kept) == 1:
        _print_one(*kept[0], database)
    elif kept:
        _print_many(kept, database)
    if observer is not None and not (as_json or as_lines):
        skies = [sky_of_answer(frame, result, observer) for frame, result in kept]
        print_sky_in_time([frame.name for frame, _ in kept], skies)
    return Told(count, identified, first, tuple(missing))


def print_contents(
    contents: Sequence[dict[str, Any]], database: str, *, as_json: bool, as_lines: bool = False
) -> Told:
    """Print the answers that a service gives to the frames of a file."""
    if as_lines:
        for one in contents:
            print_json_line(one)
    elif as_json:
        print_json(list(contents))
    else:
        for one in contents:
            _print_content(one, database)
    missing = [one for one in contents if one["status"] != "identified"]
    named = tuple(f"{one['frame']}: {one['status']}" for one in missing[:NAMED])
    return Told(len(contents), len(contents) - len(missing), None, named)


def _print_content(content: dict[str, Any], database: str) -> None:
    rows: list[tuple[str, Any]] = []
    for name, value in content.items():
        if name == "refusal":
            rows += [("because", value["words"]), ("try", value["advice"])]
        elif value is not None and not isinstance(value, list):
            rows.append((name, f"{value:.9g}" if isinstance(value, float) else value))
    print_table(f"{len(content['stars'])} centroids, {database}", ("", ""), rows)
    if content["status"] == "identified":
        _print_stars(content["stars"])


def _content(
    frame: MeasuredFrame, result: MatchResult, observer: Observer | None
) -> dict[str, Any]:
    content = answer_content(frame, result)
    if observer is not None:
        content["in_time"] = sky_as_dict(sky_of_answer(frame, result, observer))
    return content


def _print_one(frame: MeasuredFrame, result: MatchResult, database: Database) -> None:
    rows: list[tuple[str, Any]] = []
    for name, value in facts(result).items():
        if name == "covariance_arcsec2":
            sigma = np.sqrt(result.covariance_arcsec2.diagonal())
            rows.append(("error about x, y, z arcsec", ", ".join(f"{one:.3g}" for one in sigma)))
        elif name == "refusal":
            rows += [("because", value["words"]), ("try", value["advice"])]
        elif value is not None:
            rows.append((name, f"{value:.9g}" if isinstance(value, float) else value))
    for reason, count in sorted(Counter(reason for _, reason in result.dropped).items()):
        rows.append((f"dropped, {reason.replace('_', ' ')}", count))
    print_table(f"{len(frame.centroids_px)} centroids, {database.name}", ("", ""), rows)
    if result.ok:
        _print_stars(answer_content(frame, result)["stars"])


def _print_stars(stars: Sequence[dict[str, Any]]) -> None:
    heads = ("x px", "y px", "star", "mag", "RA deg", "Dec deg", "dx px", "dy px")
    lines = [
        (f"{s['x_px']:.2f}", f"{s['y_px']:.2f}", s["star"],
         f"{s['mag']:.2f}", f"{s['ra_deg']:.5f}", f"{s['dec_deg']:+.5f}",
         f"{s['dx_px']:+.3f}", f"{s['dy_px']:+.3f}")
        if s["star"] else
        (f"{_shown(s['x_px'])}", f"{_shown(s['y_px'])}", "-", *5 * ("",))
        for s in stars
    ]  # fmt: skip
    print_table("Stars", heads, lines, numbers=(0, 1, 3, 4, 5, 6, 7))


def _shown(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _print_many(answered: Sequence[Answered], database: Database) -> None:
    rows = []
    is_tracked = any(result.origin == "tracking" for _, result in answered)
    for frame, result in answered:
        origin = (result.origin.replace("_", " "),) if is_tracked else ()
        angles = (result.boresight_ra_deg, result.boresight_dec_deg, result.roll_deg)
        why = result.refusal
        rows.append(
            (
                frame.name,
                result.status if why is None or why.reason == result.status else why.reason,
                f"{result.n_matched}/{len(frame.centroids_px)}",
                *(f"{angle:.5f}" if result.ok else "" for angle in angles),
                f"{result.residual_arcsec:.2f}" if result.ok else "",
                f"{result.false_match_probability:.1e}" if result.ok else "",
                *origin,
            )
        )
    names = ("frame", "status", "stars", "RA deg", "Dec deg", "roll deg", "rms arcsec", "chance")
    heads = (*names, "origin") if is_tracked else names
    print_table(f"{len(answered)} frames, {database.name}", heads, rows, numbers=(2, 3, 4, 5, 6, 7))


def print_simulated(frame: Frame, output: Path, *, as_json: bool) -> None:
    """Print the truth about a simulated frame, as JSON; nothing for people, who want to guess."""
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
    """Print the ways to identify stars."""
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
