"""Files of identified frames to a lesson, and a lesson to the section of a spec, with evidence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pydantic import ValidationError

from starcat.artifact.manifest import manifest_digest
from starcat.artifact.reader import DatabaseFolder, open_artifact
from starcat.calibration.answers import SkyStars, read_answers
from starcat.calibration.learn import FAMILY, MIN_FRAMES, Distrusted, Lesson, learn_from_frames
from starcat.selection.rules.distrust import Observed
from starcat.specs.keys import toml_value
from starcat.specs.reading import what_is_wrong
from starcat.stars.star_table import directions_of, floats_of
from starcat.storage.atomic import write_file
from starcat.storage.digests import file_sha256


@dataclass(frozen=True)
class Learnt:
    """A lesson, what it was learnt from, and the section of the spec of a patch release."""

    lesson: Lesson
    stars: SkyStars
    n_frames: int
    n_identified: int
    colour_bands: str | None
    observed: Observed

    def __repr__(self) -> str:
        terms = self.lesson.terms
        return (
            f"<Learnt {self.stars.name}: {self.n_identified} of {self.n_frames} frames, zero point "
            f"{terms.zero_point_mag:+.3f} mag, colour term {terms.colour_term or 0.0:+.3f}, "
            f"{len(self.lesson.distrusted)} stars to distrust>"
        )

    @property
    def toml(self) -> str:
        """The section of the spec, with the evidence as comments."""
        return observed_toml(self)

    @property
    def table(self) -> pa.Table:
        """What was seen of each star that the frames should show, a row each."""
        return star_table(self)

    def evidence(self, star: Distrusted) -> str:
        """Return why a star is distrusted, in words."""
        told = [_evidence(self.lesson, star.row, verdict) for verdict in (star.verdict, *star.also)]
        return "; ".join(told)

    def name_of(self, star: Distrusted) -> str:
        """Return the designation of a star, its number where it has none."""
        name = " ".join(self.stars.designation[star.row].split())
        return name or str(self.stars.star_id[star.row])


def learn_files(
    folder: Path, paths: Sequence[Path], *, by_frame: bool = False, min_frames: int = MIN_FRAMES
) -> Learnt:
    """Learn from the answers of ``starcat identify`` that files hold."""
    artifact = open_artifact(folder)
    stars, bands = sky_stars(artifact)
    answers = read_answers(paths, stars)
    count = len(answers.names)
    before = artifact.spec.selection.observed
    lesson = learn_from_frames(
        answers.sightings,
        stars,
        count,
        by_frame=by_frame,
        min_frames=min_frames,
        colour_term=before.colour_term,
    )
    terms = lesson.terms
    known = stars.colour[np.isfinite(stars.colour)]
    rejected = {int(stars.star_id[one.row]) for one in lesson.distrusted}
    # mag may have the colour term of an earlier lesson; the section is about the catalog's own.
    slope = before.colour_term + (terms.colour_term or 0.0)
    zero_point_mag = terms.zero_point_mag - before.colour_term * before.reference_colour_mag
    reference = before.reference_colour_mag
    if not before.colour_term:
        reference = float(np.median(known)) if len(known) and slope else 0.0
    content = {
        "zero_point_mag": round(zero_point_mag, 5),
        "colour_term": round(slope, 5),
        "colour_bands": bands if slope else None,
        "reference_colour_mag": round(reference, 4),
        "reject": tuple(sorted(rejected | set(before.reject))),
        "frames": count,
        "database": stars.name,
        "manifest_sha256": manifest_digest(artifact.manifest),
        "results_sha256": tuple(file_sha256(path) for path in paths),
    }
    try:
        observed = Observed.model_validate(content)
    except ValidationError as error:
        raise what_is_wrong(error, "learnt", Observed, "section") from error
    return Learnt(lesson, stars, answers.n_frames, count, bands, observed)


def sky_stars(artifact: DatabaseFolder) -> tuple[SkyStars, str | None]:
    """Return the stars of a database, and the bands of their colours: those that most have."""
    table, manifest = artifact.stars, artifact.manifest
    colour, bands = floats_of(table, "colour_mag"), None
    counts = pc.value_counts(table["colour_bands"].drop_null()).to_pylist()
    if counts:
        bands = str(min(counts, key=lambda one: (-one["counts"], one["values"]))["values"])
        is_other = pc.fill_null(pc.not_equal(table["colour_bands"], bands), True)
        colour[is_other.to_numpy()] = np.nan
    stars = SkyStars(
        f"{manifest['name']}-{manifest['version']}",
        table["star_id"].to_numpy(),
        tuple(name or "" for name in table["designation"].to_pylist()),
        directions_of(table),
        floats_of(table, "mag"),
        colour,
    )
    return stars, bands


def _evidence(lesson: Lesson, row: int, verdict: str) -> str:
    records = lesson.records
    frames = f"in {records.n_seen[row]} frames"
    if verdict in ("too_faint", "too_bright"):
        word = verdict.removeprefix("too_")
        off, error = abs(records.mag_residual[row]), records.mag_error[row]
        return f"{off:.2f} +- {error:.2f} mag too {word} {frames}"
    if verdict == "variable":
        usual = float(np.median(lesson.mag_noise.sigma))
        own = records.mag_scatter[row]
        return f"its magnitude scatters by {own:.2f} mag, others' by {usual:.2f}, {frames}"
    if verdict == "moved":
        east, north = records.offset_arcsec[row]
        angle = math.degrees(math.atan2(east, north)) % 360.0
        error = records.offset_error_arcsec[row]
        return (
            f"{math.hypot(east, north):.1f} +- {error:.1f} arcsec away, position angle "
            f"{angle:.0f} deg, {frames}"
        )
    if verdict == "double":
        usual = float(np.median(lesson.offset_noise.sigma))
        own = records.offset_scatter_arcsec[row]
        return (
            f"its place scatters by {own:.1f} arcsec on an axis, others' by {usual:.1f}, {frames}"
        )
    return (
        f"missed in {records.n_missed[row]} of {records.n_expected[row]} frames that should show it"
    )


def observed_toml(learnt: Learnt) -> str:
    """Return the section of a spec that a patch release is built from, with the evidence."""
    observed, lesson = learnt.observed, learnt.lesson
    terms = lesson.terms
    lines = [
        f"# Learnt from {learnt.n_identified} identified frames of {learnt.n_frames} with the "
        f"database {observed.database}.",
        f"# Zero point {terms.zero_point_mag:+.4f} +- {terms.zero_point_error_mag:.4f} mag.",
    ]
    if terms.colour_term is not None:
        lines.append(
            f"# Colour term {terms.colour_term:+.4f} +- {terms.colour_term_error:.4f} "
            f"({learnt.colour_bands}) beside what the database has."
        )
    lines += [
        f"# Of {lesson.n_judged} stars these are distrusted; chance would name one of them all "
        f"with a probability of {FAMILY:g}.",
        "[selection.observed]",
    ]
    known = {int(learnt.stars.star_id[one.row]): one for one in lesson.distrusted}
    for name, value in observed.model_dump(mode="json").items():
        if name != "reject":
            lines += [] if value in (None, []) else [f"{name} = {toml_value(value)}"]
            continue
        lines.append("reject = [")
        for number in value:
            one = known.get(number)
            why = "distrusted before"
            if one is not None:
                why = f"{learnt.name_of(one)}: {one.verdict}, {learnt.evidence(one)}"
            lines.append(f"    {number},  # {why}")
        lines.append("]")
    return "\n".join(lines) + "\n"


def write_observed(learnt: Learnt, path: Path) -> None:
    """Write the section of a spec."""
    write_file(path, observed_toml(learnt).encode())


def star_table(learnt: Learnt) -> pa.Table:
    """Return what was seen of each star that the frames should show, a row each."""
    records, stars = learnt.lesson.records, learnt.stars
    verdict = {one.row: one.verdict for one in learnt.lesson.distrusted}
    rows = np.flatnonzero((records.n_seen > 0) | (records.n_expected > 0))
    numbers = {
        "mag": stars.mag,
        "colour_mag": stars.colour,
        "observed_mag": records.observed_mag,
        "residual_mag": records.mag_residual,
        "residual_error_mag": records.mag_error,
        "scatter_mag": records.mag_scatter,
        "east_arcsec": records.offset_arcsec[:, 0],
        "north_arcsec": records.offset_arcsec[:, 1],
        "offset_error_arcsec": records.offset_error_arcsec,
        "scatter_arcsec": records.offset_scatter_arcsec,
    }
    columns: dict[str, Any] = {
        "star_id": stars.star_id[rows],
        "designation": [stars.designation[row] or None for row in rows.tolist()],
        "verdict": pa.array([verdict.get(row) for row in rows.tolist()], pa.string()),
        "frames_seen": records.n_seen[rows],
        "frames_expected": records.n_expected[rows],
        "frames_missed": records.n_missed[rows],
    }
    columns |= {name: pa.array(values[rows], from_pandas=True) for name, values in numbers.items()}
    return pa.table(columns)


def content_of(learnt: Learnt) -> dict[str, Any]:
    """Return all of it as JSON has it."""
    lesson, terms = learnt.lesson, learnt.lesson.terms
    limit = lesson.limit_mag
    return {
        "database": learnt.stars.name,
        "frames": learnt.n_frames,
        "identified": learnt.n_identified,
        "measured_magnitudes": lesson.n_sightings,
        "zero_point_mag": terms.zero_point_mag,
        "zero_point_error_mag": terms.zero_point_error_mag,
        "colour_bands": learnt.colour_bands,
        "colour_term": terms.colour_term,
        "colour_term_error": terms.colour_term_error,
        "limit_mag": limit if math.isfinite(limit) else None,
        "noise_mag": float(np.median(lesson.mag_noise.sigma)),
        "star_scatter_mag": lesson.mag_noise.of_stars,
        "noise_arcsec": float(np.median(lesson.offset_noise.sigma)),
        "star_scatter_arcsec": lesson.offset_noise.of_stars,
        "judged": lesson.n_judged,
        "chance": FAMILY,
        "distrusted": [
            {
                "star_id": str(learnt.stars.star_id[one.row]),
                "star": learnt.name_of(one),
                "verdict": one.verdict,
                "also": list(one.also),
                "evidence": learnt.evidence(one),
                "log10_chance": one.log_chance,
            }
            for one in lesson.distrusted
        ],
        "observed": learnt.observed.model_dump(mode="json"),
        "stars": [
            {**row, "star_id": str(row["star_id"])} for row in star_table(learnt).to_pylist()
        ],
    }
