"""A million lost-in-space frames through the C library: how many answers are wrong.

    python benchmarks/campaign.py [--frames 1000000] [--workers 2] [PRESET ...]

The frames are divided among the presets, whose databases are built from the catalogs in
$STARCAT_CATALOGS, and among four kinds: with noise of 0.5 px only (clean), or also with a tenth of
the stars missing and three false spots (hard); without magnitudes, or with magnitudes and stated
errors of magnitudes (0.3 mag) and centroids. An answer is right if its attitude puts all stars of
the frame within the tolerance of their true places, or if ``judging.py`` accepts it: with noise,
four stars can leave an attitude that is farther off. Frames with fewer than four stars have no
right answer and can have no answer.
"""

from __future__ import annotations

import math
import os
import tempfile
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from false_frames import Scene, Trial
from judging import judge_answer
from rows import FILES, Options, Rows, database, ended

from starcat.matcher.chance import MIN_STARS
from starcat.matcher.matcher import Matcher
from starcat.matcher.result import MatchResult
from starcat.pipeline.simulation.selftest import answers_rightly
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame, simulate_frames

NOISE_PX, NOISE_MAG = 0.5, 0.3
KINDS = {
    "clean": (Noise(NOISE_PX, noise_mag=NOISE_MAG), False),
    "clean, stated": (Noise(NOISE_PX, noise_mag=NOISE_MAG), True),
    "hard": (Noise(NOISE_PX, 0.1, 3, noise_mag=NOISE_MAG), False),
    "hard, stated": (Noise(NOISE_PX, 0.1, 3, noise_mag=NOISE_MAG), True),
}
BATCH = 1000


@lru_cache(maxsize=2)
def matcher_of(folder: Path, is_stated: bool) -> Matcher:
    """Return the matcher of a database; each process opens its own."""
    stated: dict[str, Any] = {"noise_px": NOISE_PX, "noise_mag": NOISE_MAG} if is_stated else {}
    return Matcher.open(folder, engine="c", **stated)


def batch(folder: Path, kind: str, seed: int) -> Counter[str]:
    """Simulate and identify some frames; count what came out."""
    noise, is_stated = KINDS[kind]
    matcher = matcher_of(folder, is_stated)
    database = matcher.database
    given = (database.directions, database.camera, BATCH, noise, seed, database.mag)
    frames = list(simulate_frames(*given))
    scene = Scene(database, database, NOISE_PX)
    mags = [frame.mag for frame in frames] if is_stated else None
    px = [frame.centroids_px for frame in frames]
    found = matcher.identify_many(px, mag=mags, threads=1)
    counted: Counter[str] = Counter()
    for frame, answer in zip(frames, found, strict=True):
        counted["too few"] += frame.n_stars < MIN_STARS
        if answer.status == "identified":
            counted["right" if _is_right(answer, frame, matcher, scene) else "wrong"] += 1
        else:
            counted["none"] += 1
    counted["microseconds"] += round(1e6 * float(np.sum(found.seconds)))
    return counted


def _is_right(answer: MatchResult, frame: SimulatedFrame, matcher: Matcher, scene: Scene) -> bool:
    if not frame.n_stars:
        return False
    if answers_rightly(answer, frame, matcher):
        return True
    trial = Trial(frame.centroids_px, None, (frame.matrix,), noise_px=NOISE_PX)
    return judge_answer(answer, trial, scene, matcher.settings.tolerance_px) == "right"


def main(rows: Rows) -> None:
    """Build the databases, print a line a preset and kind."""
    options = Options(__doc__)
    options.add_argument("presets", nargs="*", default=[])
    options.size("--frames", 1_000_000, BATCH * len(KINDS), "of all presets and kinds together")
    options.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    asked = options.asked()
    names = asked.presets or (["sao-12deg"] if asked.quick else list(FILES))
    batches = math.ceil(asked.frames / (BATCH * len(names) * len(KINDS)))
    total: Counter[str] = Counter()
    print(f"{'':<32}{'frames':>9}{'right':>9}{'wrong':>7}{'none':>7}{'<4 stars':>9}{'us each':>9}")
    with tempfile.TemporaryDirectory() as scratch, ProcessPoolExecutor(asked.workers) as pool:
        begun = time.perf_counter()
        for place, name in enumerate(names):
            folder = database(name, Path(scratch)).folder
            for number, kind in enumerate(KINDS):
                first = 10_000 * (10 * place + number)
                jobs = [pool.submit(batch, folder, kind, first + n) for n in range(batches)]
                counted = sum((job.result() for job in jobs), Counter())
                total += counted
                print_line(f"{name}, {kind}", counted, batches * BATCH)
                rows.expect(not counted["wrong"], f"{name}, {kind}: {counted['wrong']} wrong")
                rows.expect(counted["right"] > 0, f"{name}, {kind}: no right answer")
        elapsed_s = time.perf_counter() - begun
    frames = batches * BATCH * len(names) * len(KINDS)
    print_line("all", total, frames)
    answers = total["right"] + total["wrong"]
    rate, alone = frames / elapsed_s, 1e6 * frames / max(1, total["microseconds"])
    print(f"{rate:,.0f} frames/s by {asked.workers} processes, simulation and builds included")
    print(f"{alone:,.0f} frames/s by the C library in one thread")
    if not total["wrong"]:
        bound = -math.log(0.05)
        print(f"no wrong answer: at most {bound / answers:.1e} of the answers and")
        print(f"{bound / frames:.1e} of the frames are wrong, with a confidence of 95 %")


def print_line(what: str, counted: Counter[str], frames: int) -> None:
    """Print one line of the table."""
    counts = (counted[key] for key in ("right", "wrong", "none", "too few"))
    right, wrong, none, few = counts
    each_us = counted["microseconds"] / frames
    print(
        f"{what:<32}{frames:>9,}{right:>9,}{wrong:>7,}{none:>7,}{few:>9,}{each_us:>9.1f}",
        flush=True,
    )


if __name__ == "__main__":
    ended(main)
