"""A slew of 0.1 to 2 deg per frame with both engines, compared with the same frames lost in space.

Frames have 0.5 px of noise, every star is missing with p = 0.1, and 3 spots are false; some frames
follow a jump of 40 deg. *tracked*: a Tracker, jumps included. *prior*: a prior attitude that is
wrong by up to an angle. *lost*: no prior. Magnitudes are not given. Milliseconds are processor time
of the call alone.

Run with ``python benchmarks/tracking.py [ARTIFACT] [--frames N]``; without a database
gaia-12deg is built. It fails if an answer is wrong or no frame is identified.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "builders"))

from rows import Options, Rows, database, ended
from slew import is_near, slew, wrong_by

from starcat.matcher.c_engine import is_compiled
from starcat.matcher.matcher import Matcher
from starcat.matcher.result import MatchResult
from starcat.matcher.settings import Engine
from starcat.matcher.tracking import Tracker
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame

NOISE = Noise(0.5, drop_probability=0.1, false_stars=3)
PRIORS_DEG = (0.1, 0.5, 2.0, 5.0, 20.0)
FEW = 1_000
"""Frames with a prior attitude, or without one."""


Ask = Callable[[SimulatedFrame], Callable[[np.ndarray], MatchResult]]
"""Returns for a frame what is to be timed, given its centroids."""


def near_prior(
    matcher: Matcher, most_deg: float, generator: np.random.Generator, frame: SimulatedFrame
) -> Callable[[np.ndarray], MatchResult]:
    """Return the call of a matcher with a prior that is wrong by up to an angle."""
    angle_rad = np.radians(most_deg) * generator.uniform() ** (1.0 / 3.0)
    prior = wrong_by(frame.matrix, angle_rad, generator)
    return partial(matcher.identify, prior=prior, prior_error_deg=most_deg)


def report(rows: Rows, name: str, frames: Iterable[SimulatedFrame], ask: Ask) -> list[MatchResult]:
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
    rows.expect(0 < right == ok, f"{name}: right/wrong/no answers {counts}")
    return answers


def measure(rows: Rows, engine: Engine, database: Path, count: int) -> None:
    """Print the rows of an engine."""
    jumps = set(range(count // 4, count, max(1, count // 4)))
    matcher = Matcher.open(database, engine=engine)
    matcher.identify(np.zeros((0, 2)))
    frames = list(slew(matcher.database, count, NOISE, 7, jumps))
    tracker = Tracker(matcher)
    answers = report(rows, f"{engine} tracked", frames, lambda _: tracker.identify)
    after = sum(answers[jump].ok for jump in jumps)
    print(f"{'':<18}{after} of {len(jumps)} jumps recovered in their own frame")
    for most_deg in PRIORS_DEG:
        near = partial(near_prior, matcher, most_deg, np.random.default_rng(5))
        report(rows, f"{engine} prior {most_deg:g} deg", frames[:FEW], near)
    report(rows, f"{engine} lost", frames[:FEW], lambda _: matcher.identify)


def main(rows: Rows) -> None:
    """Print both engines."""
    options = Options(__doc__)
    options.add_argument("database", type=Path, nargs="?")
    options.size("--frames", 10_000, 40, "of the slew")
    given = options.asked()
    if not is_compiled():
        rows.lacking.append("the compiled C library: its rows are left out")
    print(f"{'':<18}{'right/wrong/no':>14}{'tracked':>9}{'median':>9}{'p95':>9}{'p99 ms':>9}")
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.database or database("gaia-12deg", Path(scratch)).folder
        for engine in ("numpy", "c") if is_compiled() else ("numpy",):
            with rows.row(engine):
                measure(rows, engine, folder, given.frames)


if __name__ == "__main__":
    ended(main)
