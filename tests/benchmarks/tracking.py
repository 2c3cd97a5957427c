"""A slew of 0.1 to 2 deg a frame, followed with both engines, beside the same frames lost in space.

Frames have 0.5 px of noise, every star is missing with p = 0.1, and 3 spots are false; some frames
follow a jump of 40 deg. *tracked*: a Tracker, jumps included. *prior*: a prior attitude that is
wrong by up to an angle. *lost*: no prior. Magnitudes are not given. Milliseconds are processor time
of the call alone.

Run with ``python tests/benchmarks/tracking.py ARTIFACT [--frames N]``.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "builders"))

from slew import slew

from starcat.geometry.attitude import after_turn, quaternion_from_matrix, turn_between
from starcat.matcher.c_engine import is_compiled
from starcat.matcher.matcher import Engine, Matcher
from starcat.matcher.result import MatchResult
from starcat.matcher.tracking import Tracker
from starcat.simulation.simulate import Frame, Noise

NOISE = Noise(0.5, drop_probability=0.1, false_stars=3)
BORESIGHT_DEG, ROLL_DEG = 0.05, 0.5
"""An answer is right if its attitude is within both."""

PRIORS_DEG = (0.1, 0.5, 2.0, 5.0, 20.0)
FEW = 1_000
"""Frames that are asked with a prior attitude, or none."""


def is_right(answer: MatchResult, frame: Frame) -> bool:
    """Return whether an answer is that of its frame."""
    truth = quaternion_from_matrix(frame.matrix).tolist()
    x, y, z = np.degrees(turn_between(truth, answer.q_body_from_icrs.tolist()))
    return bool(np.hypot(x, y) <= BORESIGHT_DEG and abs(z) <= ROLL_DEG)


def wrong_by(frame: Frame, most_deg: float, generator: np.random.Generator) -> np.ndarray:
    """Return an attitude that is wrong by up to an angle."""
    turn = generator.normal(size=3)
    turn *= np.radians(most_deg) * generator.uniform() ** (1.0 / 3.0) / np.linalg.norm(turn)
    x, y, z = turn.tolist()
    return np.array(after_turn(quaternion_from_matrix(frame.matrix).tolist(), (x, y, z)))


def report(
    name: str, frames: Iterable[Frame], ask: Callable[[Frame], Callable[[], MatchResult]]
) -> list[MatchResult]:
    """Print one line: right, wrong and no answers, how many were tracked, and milliseconds."""
    answers, ms, right = [], [], 0
    for frame in frames:
        call = ask(frame)
        start = time.process_time()
        found = call()
        ms.append(1e3 * (time.process_time() - start))
        answers.append(found)
        right += found.ok and is_right(found, frame)
    ok = sum(found.ok for found in answers)
    tracked = sum(found.ok and found.origin == "tracking" for found in answers)
    counts = f"{right}/{ok - right}/{len(answers) - ok}"
    parts = "".join(f"{value:9.3f}" for value in np.percentile(ms, [50, 95, 99]))
    print(f"{name:<18}{counts:>14}{tracked:>9}{parts}", flush=True)
    return answers


def main() -> None:
    """Print both engines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("artifact", type=Path)
    parser.add_argument("--frames", type=int, default=10_000)
    arguments = parser.parse_args()
    count = arguments.frames
    jumps = set(range(count // 4, count, max(1, count // 4)))
    engines: tuple[Engine, ...] = ("numpy", "c") if is_compiled() else ("numpy",)
    print(f"{'':<18}{'right/wrong/no':>14}{'tracked':>9}{'median':>9}{'p95':>9}{'p99 ms':>9}")
    for engine in engines:
        matcher = Matcher.open(arguments.artifact, engine=engine)
        database = matcher.database
        matcher.identify(np.zeros((0, 2)))
        frames = list(slew(database, count, NOISE, 7, jumps))
        tracker = Tracker(matcher)

        def lost(frame: Frame, matcher: Matcher = matcher) -> Callable[[], MatchResult]:
            return lambda: matcher.identify(frame.centroids_px)

        def follow(frame: Frame, tracker: Tracker = tracker) -> Callable[[], MatchResult]:
            return lambda: tracker.identify(frame.centroids_px)

        answers = report(f"{engine} tracked", frames, follow)
        after = sum(answers[jump].ok for jump in jumps)
        print(f"{'':<18}{after} of {len(jumps)} jumps recovered in their own frame")
        for most_deg in PRIORS_DEG:
            generator = np.random.default_rng(5)

            def near(
                frame: Frame,
                matcher: Matcher = matcher,
                most_deg: float = most_deg,
                generator: np.random.Generator = generator,
            ) -> Callable[[], MatchResult]:
                prior = wrong_by(frame, most_deg, generator)
                return lambda: matcher.identify(
                    frame.centroids_px, prior=prior, prior_error_deg=most_deg
                )

            report(f"{engine} prior {most_deg:g} deg", frames[:FEW], near)
        report(f"{engine} lost", frames[:FEW], lost)


if __name__ == "__main__":
    main()
