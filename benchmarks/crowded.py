"""Time and memory of frames of very many centroids, by engine, and of a batch with one of them.

Processor time of one call, the smallest of five, and the most memory that Python allocates in it.

Run with ``python benchmarks/crowded.py [ARTIFACT]``; without a database gaia-12deg is built.
It fails if a frame of 50,000 centroids takes more than 50 MB, or 50 ms in C.
"""

from __future__ import annotations

import tempfile
import time
import tracemalloc
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from rows import Options, Rows, database, ended

from starcat.matcher.c_engine import is_compiled
from starcat.matcher.matcher import Matcher
from starcat.matcher.settings import Engine
from starcat.pipeline.simulation.simulate import Noise, simulate_frames

COUNTS = (512, 2_000, 10_000, 50_000)
MAX_MS, MAX_MB = 50.0, 50.0


def measured(ask: Callable[[], object]) -> tuple[float, float]:
    """Return the processor time of a call, ms, and its memory, MB."""
    seconds = []
    for _ in range(5):
        begun_s = time.process_time()
        ask()
        seconds.append(time.process_time() - begun_s)
    tracemalloc.start()
    ask()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return 1e3 * min(seconds), peak / 1e6


def measure(rows: Rows, engine: Engine, database: Path, *, is_judged: bool) -> None:
    """Print a line for each number of centroids, and for each batch."""
    matcher, random = Matcher.open(database, engine=engine), np.random.default_rng(1)
    sky = matcher.database
    size, noise = (sky.camera.width_px, sky.camera.height_px), Noise(0.3)
    frames = list(simulate_frames(sky.directions, sky.camera, 200, noise, 3, mag=sky.mag))
    for count in COUNTS:
        false = count - len(frames[0].mag)
        px = np.concatenate([frames[0].centroids_px, random.random((false, 2)) * size])
        mag = np.concatenate([frames[0].mag, random.uniform(7.0, 14.0, false)])
        for name, known in (("with magnitudes", mag), ("without", None)):
            ms, mb = measured(partial(matcher.identify, px, mag=known))
            print(f"{engine:6}{count:7,} {name:16}{ms:8.1f} ms{mb:8.1f} MB")
            rows.expect(mb <= MAX_MB, f"{engine}: {count} centroids take {mb:.0f} MB")
            is_slow = is_judged and engine == "c" and ms > MAX_MS
            rows.expect(not is_slow, f"{engine}: {count} centroids take {ms:.0f} ms")
    if engine == "c":
        for count in (512, 513):
            odd = [*(one.centroids_px for one in frames[1:]), random.random((count, 2)) * size]
            ms, mb = measured(partial(matcher.identify_many, odd, threads=1))
            print(f"{engine:6}batch of 200, one of {count}: {ms:.1f} ms")


def main(rows: Rows) -> None:
    """Print both engines."""
    options = Options(__doc__)
    options.add_argument("database", type=Path, nargs="?")
    given = options.asked()
    if not is_compiled():
        rows.lacking.append("the compiled C library: its rows are left out")
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.database or database("gaia-12deg", Path(scratch)).folder
        for engine in ("numpy", "c") if is_compiled() else ("numpy",):
            with rows.row(engine):
                measure(rows, engine, folder, is_judged=not given.quick)


if __name__ == "__main__":
    ended(main)
