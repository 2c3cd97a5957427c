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
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "builders"))

from slew import is_near, slew, wrong_by

from starcat.matcher.c_engine import is_compiled
from starcat.matcher.matcher import Engine, Matcher
from starcat.matcher.result import MatchResult
from starcat.matcher.tracking import Tracker
from starcat.simulation.simulate import Frame, Noise

NOISE = Noise(0.5, drop_probability=0.1, false_stars=3)
PRIORS_DEG = (0.1, 0.5, 2.0, 5.0, 20.0)
FEW = 1_000
"""Frames that are asked with a prior attitude, or none."""


Ask = Callable[[Frame], Callable[[np.ndarray], MatchResult]]
"""Returns for a frame what is to be timed, given its centroids."""


def near_prior(
    matcher: Matcher, most_deg: float, generator: np.random.Generator, frame: Frame
) -> Callable[[np.ndarray], MatchResult]:
    """Return the call of a matcher with a prior that is wrong by up to an angle."""
    angle_rad = np.radians(most_deg) * generator.uniform() ** (1.0 / 3.0)
    prior = wrong_by(frame.matrix, angle_rad, generator)
    return partial(matcher.identify, prior=prior, prior_error_deg=most_deg)


def report(name: str, frames: Iterable[Frame], ask: Ask) -> list[MatchResult]:
    """Print one line: right, wrong and no answers, how many were tracked, and milliseconds."""
    answers, ms, right = [], [], 0
    for frame in frames:
        call = ask(frame)
        start = time.process_time()
        found = call(frame.centroids_px)
        ms.append(1e3 * (time.process_time() - start))
        answers.append(found)
        right += found.ok and is_near(found.q_body_from_icrs, frame.matrix)
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

        answers = report(f"{engine} tracked", frames, lambda _, t=tracker: t.identify)
        after = sum(answers[jump].ok for jump in jumps)
        print(f"{'':<18}{after} of {len(jumps)} jumps recovered in their own frame")
        for most_deg in PRIORS_DEG:
            near = partial(near_prior, matcher, most_deg, np.random.default_rng(5))
            report(f"{engine} prior {most_deg:g} deg", frames[:FEW], near)
        report(f"{engine} lost", frames[:FEW], lambda _, m=matcher: m.identify)


if __name__ == "__main__":
    main()
