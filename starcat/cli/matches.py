"""The output of ``starcat identify``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcat.cli.console import print_json, print_json_line, print_rows, print_table, say
from starcat.cli.options import option_of
from starcat.database.onboard.flight_limits import FLIGHT_CENTROIDS, centroids_in_flight
from starcat.errors import ConfigError, NotIdentifiedError, advice_in_words, count_of
from starcat.frames.images.batch import BatchItem
from starcat.frames.images.solve_files import FrameAnswer
from starcat.geometry.attitude import quaternion_from_matrix, radec_roll_from_matrix
from starcat.matcher.brightest import MAX_CENTROIDS
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.frame_shape import FrameShape

if TYPE_CHECKING:
    from starcat.pipeline.simulation.simulate import SimulatedFrame

NAMED = 3  # frames that a message names if some were not identified

CORRECTED = ("boresight_ra_deg", "boresight_dec_deg", "roll_deg", "q_body_from_icrs")
"""Facts that the main table shows without and with the correction for aberration."""

OF_CANDIDATE = (
    "n_matched", "false_match_probability", *CORRECTED, "covariance_arcsec2", "residual_arcsec",
)  # fmt: skip
"""Facts that are shown of the candidate of a refused frame."""


@dataclass
class Tally:
    """Numbers of frames and identified frames of a file, and the first answer."""

    frames: int = 0
    identified: int = 0
    first: FrameAnswer | None = None
    unidentified: list[str] = field(default_factory=list)
    files: int = 0
    unusable: list[str] = field(default_factory=list)

    def add(self, name: str, status: str) -> None:
        """Count a frame."""
        self.frames += 1
        if status == "identified":
            self.identified += 1
        elif len(self.unidentified) < NAMED:
            self.unidentified.append(f"{name}: {status}")

    def expect_all_identified(self) -> None:
        """Raise `NotIdentifiedError` unless every frame was identified."""
        missing = self.frames - self.identified
        if missing:
            more = ", ..." if missing > len(self.unidentified) else ""
            raise NotIdentifiedError(
                f"{missing:,} of {self.frames:,} frames not identified "
                f"({', '.join(self.unidentified)}{more})",
                hint="'refusal' of each states the reason and what to try",
            )

    def expect_all_usable(self) -> None:
        """Raise `ConfigError` unless every file of a batch could be used."""
        if self.unusable:
            more = "; ..." if len(self.unusable) > NAMED else ""
            raise ConfigError(
                f"{len(self.unusable):,} of {self.files:,} files cannot be used: "
                f"{'; '.join(self.unusable[:NAMED])}{more}"
            )


def print_answers(
    answers: Iterable[FrameAnswer], database: MatcherDatabase, *, as_json: bool, as_lines: bool
) -> Tally:
    """Print the answers to the frames of a file."""
    tally, kept = Tally(), []
    for answer in answers:
        tally.first = tally.first or answer
        tally.add(answer.frame.name, answer.result.status)
        if as_lines:
            print_json_line(answer.content())
        else:
            kept.append(answer)
    if as_lines:
        return tally
    if as_json:
        print_json([answer.content() for answer in kept])
        return tally
    if len(kept) == 1:
        _print_one(kept[0].content(), database.name)
    elif kept:
        _print_many(kept, database)
    return tally


def print_batch(
    items: Iterable[BatchItem], database: MatcherDatabase, *, as_lines: bool
) -> tuple[Tally, list[BatchItem]]:
    """Print the answers for many files: one JSON line each, as soon as it is found, or a table."""
    tally, done, notes = Tally(), list[BatchItem](), Counter[str]()
    for item in items:
        done.append(item)
        tally.files += 1
        notes.update(item.notes)
        if item.error is not None:
            tally.unusable.append(str(item.error))
            if as_lines:
                said = {"status": "unusable", "message": str(item.error)}
                print_json_line({"file": str(item.path), "frame": item.path.stem, **said})
        for answer in item.answers:
            tally.add(answer.frame.name, answer.result.status)
            if as_lines:
                print_json_line({"file": str(item.path), **answer.content()})
    kept = [] if as_lines else [answer for item in done for answer in item.answers]
    if kept:
        _print_many(kept, database)
    for note, count in notes.items():
        say(f"{note} ({count} of {count_of(tally.files, 'file')})")
    return tally, done


def print_contents(
    contents: Sequence[dict[str, Any]], database: str, *, as_json: bool, as_lines: bool
) -> Tally:
    """Print the answers of a service for the frames of a file."""
    tally = Tally()
    for content in contents:
        tally.add(content["frame"], content["status"])
        if as_lines:
            print_json_line(content)
        elif not as_json:
            _print_one(content, database)
    if as_json and not as_lines:
        print_json(list(contents))
    return tally


def _print_one(content: dict[str, Any], database: str) -> None:
    facts = {name: content[name] for name in content if name not in ("frame", "database")}
    rows = [row for name, value in facts.items() for row in _rows_of_fact(name, value)]
    reasons = Counter(star["dropped"] for star in content["stars"] if "dropped" in star)
    rows += [(f"dropped, {why.replace('_', ' ')}", count) for why, count in sorted(reasons.items())]
    print_table(f"{count_of(len(content['stars']), 'centroid')}, {database}", ("", ""), rows)
    if content["status"] == "identified":
        _print_stars(content["stars"])
    if content.get("in_time"):
        print_sky_in_time([(content["frame"], content["in_time"])])


def _rows_of_fact(name: str, value: Any) -> list[tuple[str, Any]]:
    if name == "refusal":
        message_rows = [
            ("message", value["message"]),
            ("hint", advice_in_words(value["advice"], option_of)),
        ]
        facts = value.get("candidate") or {}
        shown = {key: facts[key] for key in OF_CANDIDATE if key in facts}
        rows = [row for key, fact in shown.items() for row in _rows_of_fact(key, fact)]
        return message_rows + [(f"candidate {key}", text) for key, text in rows]
    if name == "remarks":
        return [("remark", remark) for remark in value]
    if name == "covariance_arcsec2":
        sigma = np.sqrt([_number(value[axis][axis]) for axis in range(3)])
        return [("error about x, y, z arcsec", ", ".join(f"{error:.3g}" for error in sigma))]
    if name == "q_body_from_icrs":
        return [(name, ", ".join(f"{component:+.7f}" for component in value))]
    if name == "in_time":
        corrected = {key: value[key] for key in CORRECTED} if value else {}
        return [
            (f"corrected {key}", text)
            for key in corrected
            for _, text in _rows_of_fact(key, corrected[key])
        ]
    if name == "frame_shape":
        return [] if value is None else _rows_of_shape(FrameShape(**value))
    if name.endswith("_deg"):
        return [(name, f"{value:.4f}")]
    if value is None or isinstance(value, list | dict):
        return []
    digits = 2 if name.endswith("_probability") else 6
    return [(name, f"{value:.{digits}g}" if isinstance(value, float) else value)]


def _rows_of_shape(shape: FrameShape) -> list[tuple[str, str]]:
    """Return the terms of a frame's shape that are larger than their errors."""
    rows = [
        (f"{name.replace('_', ' ')} %", f"{100.0 * value:+.2f} +- {100.0 * error:.2f}")
        for name, (value, error) in shape.significant.items()
    ]
    if rows and shape.turn_deg_s is not None and shape.turn_error_deg_s is not None:
        rows.append(("turn deg/s", f"{shape.turn_deg_s:.3g} +- {shape.turn_error_deg_s:.2g}"))
    return rows


def _print_stars(stars: Sequence[dict[str, Any]]) -> None:
    heads = ("x px", "y px", "star", "mag", "RA deg", "Dec deg", "dx px", "dy px")
    if len(stars) > MAX_CENTROIDS:  # a terminal takes minutes to lay out tens of thousands
        stars = [star for star in stars if star["star"]]
    lines = [
        (f"{s['x_px']:.2f}", f"{s['y_px']:.2f}", s["star"],
         f"{s['mag']:.2f}", f"{s['ra_deg']:.5f}", f"{s['dec_deg']:+.5f}",
         f"{s['dx_px']:+.3f}", f"{s['dy_px']:+.3f}")
        if s["star"] else
        (f"{_shown(s['x_px'])}", f"{_shown(s['y_px'])}", "-", *5 * ("",))
        for s in stars
    ]  # fmt: skip
    print_table("Stars", heads, lines, numbers=(0, 1, 3, 4, 5, 6, 7))


def _number(value: float | None) -> float:
    return np.nan if value is None else value


def _shown(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _print_many(answers: Sequence[FrameAnswer], database: MatcherDatabase) -> None:
    rows = []
    is_tracked = any(answer.result.origin == "tracking" for answer in answers)
    for answer in answers:
        frame, result = answer.frame, answer.result
        origin = (result.origin.replace("_", " "),) if is_tracked else ()
        attitude = result if answer.sky is None else answer.sky
        angles = (attitude.boresight_ra_deg, attitude.boresight_dec_deg, attitude.roll_deg)
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
    skies = [(answer.frame.name, sky.content()) for answer in answers if (sky := answer.sky)]
    ra = "corrected RA deg" if skies else "RA deg"
    names = ("frame", "status", "stars", ra, "Dec deg", "roll deg", "rms arcsec", "chance")
    heads = (*names, "origin") if is_tracked else names
    print_table(
        f"{count_of(len(answers), 'frame')}, {database.name}",
        heads,
        rows,
        numbers=(2, 3, 4, 5, 6, 7),
    )
    _print_candidates(answers)
    if database.image is not None:
        _say_crowded([answer for answer in answers if answer.result.given_as != "picture"])
    _say_remarks_on_frames(answers)
    print_sky_in_time(skies)


def _print_candidates(answers: Sequence[FrameAnswer]) -> None:
    """Print the best attitude of each frame that was refused for its probability."""
    rows = []
    for answer in answers:
        why = answer.result.refusal
        if why is not None and (best := why.candidate) is not None:
            angles = best.boresight_ra_deg, best.boresight_dec_deg, best.roll_deg
            stars = f"{best.n_matched}/{len(answer.frame.centroids_px)}"
            texts = (f"{angle:.5f}" for angle in angles)
            chance = f"{best.false_match_probability:.1e}"
            rows.append((answer.frame.name, stars, *texts, chance))
    if rows:
        heads = ("frame", "stars", "RA deg", "Dec deg", "roll deg", "chance")
        print_table("Candidates of refused frames", heads, rows, numbers=(1, 2, 3, 4, 5))


def _say_remarks_on_frames(answers: Sequence[FrameAnswer]) -> None:
    """Print what was not used of frames; of remarks with numbers of a frame, only the first."""
    remarks = Counter(remark for answer in answers for remark in answer.result.frame_remarks)
    for remark, count in remarks.items():
        say(f"{remark} ({count} of {len(answers)} frames)")
    on_pixels = [
        (answer.frame.name, remark)
        for answer in answers
        for remark in answer.result.remarks_on_frame[len(answer.result.frame_remarks) :]
    ]
    if on_pixels:
        more = f" ({len(on_pixels)} frames have such a remark)" if len(on_pixels) > 1 else ""
        say(f"{on_pixels[0][0]}: {on_pixels[0][1]}{more}")


def _say_crowded(answers: Sequence[FrameAnswer]) -> None:
    """Print how many frames the onboard library refuses; a single frame has a remark for it."""
    counts = [len(answer.frame.centroids_px) for answer in answers]
    crowded = sum(count > FLIGHT_CENTROIDS for count in counts)
    for sentence in centroids_in_flight(max(counts, default=0)):
        say(
            f"{crowded:,} of {len(counts):,} frames have more than {FLIGHT_CENTROIDS} centroids: "
            f"{sentence}"
        )


def print_sky_in_time(skies: Sequence[tuple[str, dict[str, Any]]]) -> None:
    """Print the facts that need a time (`SkyInTime.content`), by the names of the frames."""
    if not skies:
        return
    shown = (
        *("frame", "correction_arcsec", "residual_arcsec"),
        *("sun_angle_deg", "moon_angle_deg", "earth_limb_angle_deg"),
    )
    rows = [{"frame": name, **sky} for name, sky in skies]
    print_rows(rows, f"With aberration, at {skies[0][1]['time']}", shown)
    bodies = [
        {"frame": name, "body": body["name"], **body, "centroid": body["row"] is not None}
        for name, sky in skies
        for body in sky["bodies"]
    ]
    of_body = ("frame", "body", "x_px", "y_px", "mag", "from_boresight_deg", "centroid")
    print_rows(bodies, "Planets in the frame", of_body)


def simulated_facts(frame: SimulatedFrame, output: Path) -> dict[str, Any]:
    """Return the truth about a simulated frame."""
    ra_deg, dec_deg, roll_deg = radec_roll_from_matrix(frame.matrix)
    return {
        "file": str(output),
        "centroids": len(frame.centroids_px),
        "guide_stars": frame.n_stars,
        "false_stars": int(frame.is_false.sum()),
        "boresight_ra_deg": float(ra_deg),
        "boresight_dec_deg": float(dec_deg),
        "roll_deg": float(roll_deg),
        "q_body_from_icrs": quaternion_from_matrix(frame.matrix).tolist(),
    }
