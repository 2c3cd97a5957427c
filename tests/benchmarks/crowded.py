"""Time and memory of frames of very many centroids, by engine, and of a batch with one of them.

    python tests/benchmarks/crowded.py dist/gaia-12deg-1.0.0

Processor time of one call, the smallest of five, and the largest memory that Python allocates in it.
"""

from __future__ import annotations

import sys
import time
import tracemalloc
from collections.abc import Callable

import numpy as np

import starcat

COUNTS = (512, 2_000, 10_000, 50_000)


def measured(ask: Callable[[], object]) -> str:
    """Return the processor time and the memory of a call."""
    seconds = []
    for _ in range(5):
        begun_s = time.process_time()
        ask()
        seconds.append(time.process_time() - begun_s)
    tracemalloc.start()
    ask()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return f"{1e3 * min(seconds):8.1f} ms {peak / 1e6:8.1f} MB"


def main() -> None:
    """Print a line for each engine and number of centroids."""
    random = np.random.default_rng(1)
    for engine in ("c", "numpy"):
        matcher = starcat.Matcher.open(sys.argv[1], engine=engine)
        camera = matcher.database.camera
        frames = starcat.simulate(matcher.database, 200, noise_px=0.3, seed=3)
        for count in COUNTS:
            false = count - len(frames[0].mag)
            spots = random.random((false, 2)) * (camera.width_px, camera.height_px)
            px = np.concatenate([frames[0].centroids_px, spots])
            mag = np.concatenate([frames[0].mag, random.uniform(7.0, 14.0, false)])
            bright = measured(lambda px=px, mag=mag: matcher.identify(px, magnitudes=mag).stars)
            plain = measured(lambda px=px: matcher.identify(px).star_index)
            print(f"{engine:5} {count:6,} with magnitudes {bright}, without {plain}")
        if engine == "c":
            batch = [frame.centroids_px for frame in frames[:199]]
            for count in (512, 513):
                odd = [*batch, random.random((count, 2)) * 1000.0]
                taken = measured(lambda odd=odd: matcher.identify_many(odd, threads=1))
                print(f"batch of 200, one of {count} {taken}")


if __name__ == "__main__":
    main()
