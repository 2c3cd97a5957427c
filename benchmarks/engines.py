"""Whether the C library names the same stars as numpy, on frames of all kinds.

    python benchmarks/engines.py [--frames 20000] [--workers 2] [--folder FOLDER]

Frames are of the kinds of ``false_frames.py``; with another shape than the camera's, of
``shapes.py``; and clean, hard, few and crowded ones. Each has its own tolerance or noise, with
magnitudes or without, with the focal length known or not, from the whole sky or near a prior.
Status, stars, a fitted focal length, and the reason of a refusal are compared. Three kinds of
frames do not count as differences: frames whose probability of chance is within 10 % of the
accepted probability, by its logarithm; frames on which a limit of steps ended one of the searches,
because the two count steps differently; and frames with two right answers, such as two exposures in
one frame, which have their own column.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from false_frames import KINDS, NO_SKY, Scene, Trial
from false_matches import NOISE_MAG, STATED, databases, matcher_of
from judging import judge_answer
from rows import Options, Rows, ended
from shapes import KINDS as SHAPES
from shapes import NOISE as NOISE_OF_SHAPES

from starcat.geometry.attitude import after_turn, quaternion_from_matrix
from starcat.matcher.matcher import Matcher
from starcat.matcher.result import MatchResult
from starcat.pipeline.simulation.simulate import Noise, simulate_frames

BATCH = 100

FOV_ERROR = 0.02

MAX_STEPS = 200_000
"""Steps of numpy: a second or two."""

DIFFERENCES = "status", "stars", "focal length", "reason"

ORDINARY = {
    "clean": Noise(0.25, noise_mag=0.2),
    "hard": Noise(0.4, 0.3, 6, noise_mag=0.3),
    "few": Noise(0.4, 0.75, 2, noise_mag=0.3),
    "crowded": Noise(0.3, 0.5, 40, noise_mag=0.3),
}

OTHER_SHAPES = {kind: NOISE_OF_SHAPES for kind in SHAPES if kind not in ("as stated", "mirrored")}


@dataclass(frozen=True)
class Job:
    """Some frames of a kind."""

    folders: tuple[Path, Path]
    kind: str
    first: int
    count: int


def made(kind: str, generator: np.random.Generator, scene: Scene) -> Trial:
    """Return a frame of a kind."""
    if kind in KINDS:
        return KINDS[kind](generator, scene)
    noise, database = (ORDINARY | OTHER_SHAPES)[kind], scene.database
    seed, camera = int(generator.integers(1 << 31)), database.camera
    [frame] = simulate_frames(database.directions, camera, 1, noise, seed, database.mag)
    px, mag = frame.centroids_px, frame.mag
    if kind in OTHER_SHAPES:
        px = camera.middle_px + SHAPES[kind](px - camera.middle_px, camera, generator)
        inside = camera.contains(px)
        px, mag = px[inside], mag[inside]
    with_mag = generator.random() < 0.5
    return Trial(px, mag if with_mag else None, (frame.matrix,), noise_px=noise.noise_px)


def difference(
    one: MatchResult, other: MatchResult, accepted: float, is_right: Callable[[MatchResult], bool]
) -> str | None:
    """Return what differs between two answers to a frame; None if nothing does."""
    reasons = [None if answer.refusal is None else answer.refusal.reason for answer in (one, other)]
    is_same = one.status == other.status and np.array_equal(one.star_index, other.star_index)
    if "steps" in reasons:
        return "steps"
    if is_same and reasons[0] == reasons[1]:
        if one.camera is None or other.camera is None:
            return None
        focal = one.camera.focal_length_px / other.camera.focal_length_px
        return None if abs(focal - 1.0) < 1e-5 else "focal length"
    chances = [answer.false_match_probability if answer.ok else answer.refusal and
               answer.refusal.false_match_probability for answer in (one, other)]  # fmt: skip
    logs = [math.log(max(chance or 1.0, 1e-300)) for chance in chances]
    limit = math.log(accepted)
    if any(abs(log - limit) <= 0.1 * abs(limit) for log in logs):
        return "at the limit"
    if one.status != other.status:
        return "status"
    if is_same:
        return "reason"
    return "both right" if one.ok and is_right(one) and is_right(other) else "stars"


def run(job: Job) -> tuple[Counter[str], list[str]]:
    """Make and identify the frames of a job; count and return the differences."""
    plain, deeper = (matcher_of(folder) for folder in job.folders)
    counted: Counter[str] = Counter()
    told = []
    for seed in range(job.first, job.first + job.count):
        generator = np.random.default_rng([22, seed, *job.kind.encode()])
        stated = STATED[generator.integers(len(STATED))]
        settings: dict[str, Any] = stated.settings
        scene = Scene(plain.database, deeper.database, stated.noise_px)
        trial = made(job.kind, generator, scene)
        if trial.mag is not None and generator.random() < 0.5:
            settings |= {"noise_mag": NOISE_MAG}
        asked = _asked(generator, trial, scene)
        answers = [_identify(plain, engine, settings, trial, asked) for engine in ("c", "numpy")]
        reach_px = replace(plain.settings, **settings).tolerance_px
        found = difference(
            *answers,
            plain.settings.max_false_match_probability,
            lambda answer: judge_answer(answer, trial, scene, reach_px) == "right",  # noqa: B023
        )
        counted[found or "same"] += 1
        counted["identified"] += answers[0].ok
        if found in DIFFERENCES:
            why = [None if answer.ok else answer.refusal.reason for answer in answers]
            told.append(f"{job.kind} {seed}: {found} {why}; {settings}, {sorted(asked)}: {answers}")
    return counted, told


def _asked(generator: np.random.Generator, trial: Trial, scene: Scene) -> dict[str, Any]:
    """Return options for a frame: three in four from the whole sky with a known camera."""
    way = generator.random()
    if way < 0.15:
        return {"fov_error": FOV_ERROR}
    if way < 0.25 and trial.attitudes:
        truth = quaternion_from_matrix(trial.attitudes[0]).tolist()
        prior = after_turn(truth, tuple(generator.normal(scale=0.005, size=3)))
        return {"prior": prior, "prior_error_deg": 1.0}
    return {}


def _identify(
    plain: Matcher, engine: Any, settings: dict[str, Any], trial: Trial, asked: dict[str, Any]
) -> MatchResult:
    steps = {"max_steps": MAX_STEPS} if engine == "numpy" else {}
    matcher = plain.with_settings(engine=engine, **settings, **steps)
    identify: Callable[..., MatchResult] = matcher.identify
    return identify(trial.centroids_px, mag=trial.mag, **asked)


def main(rows: Rows) -> None:
    """Compare, and print one line per kind."""
    options = Options(__doc__)
    options.size("--frames", 20_000, 220, "of all kinds together")
    options.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    options.add_argument("--folder", type=Path, help="where the databases are, or will be")
    asked = options.asked()
    kinds = [*ORDINARY, *KINDS, *OTHER_SHAPES]
    # Frames without a sky take numpy its whole search: fewer of them.
    parts = [0.25 if kind in NO_SKY else 1.0 for kind in kinds]
    each = asked.frames / sum(parts)
    columns = "same", "identified", "at the limit", "steps", "both right", *DIFFERENCES
    print(f"{'kind':<22}{'frames':>8}", *(f"{name:>13}" for name in columns))
    total: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as scratch, ProcessPoolExecutor(asked.workers) as pool:
        places = databases(asked.folder or Path(scratch))
        folders = places["gaia-12deg"], places["dense-24deg"]
        for kind, part in zip(kinds, parts, strict=True):
            count = math.ceil(part * each)
            firsts = range(0, count, BATCH)
            jobs = [Job(folders, kind, n, min(BATCH, count - n)) for n in firsts]
            counted: Counter[str] = Counter()
            for one, told in pool.map(run, jobs):
                counted += one
                rows.failed.extend(told)
            total += counted
            line = (f"{counted[name]:>13,}" for name in columns)
            print(f"{kind:<22}{count:>8,}", *line, flush=True)
    compared = sum(total.values()) - total["identified"] - total["steps"]
    differ = sum(total[name] for name in DIFFERENCES)
    print(f"{differ} of {compared:,} frames differ")


if __name__ == "__main__":
    ended(main)
