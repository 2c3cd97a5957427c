"""How often the field of a wrong lens is named: frames of half to twice the field of the database.

The fields are uniform in their logarithm, and the frames have at least six guide stars: the scale
takes one of the degrees of freedom, and fewer stars cannot pass the bound on false matches. Frames
of random centroids follow, for which no field may be named. Each is measured with magnitudes and
without; centroids have noise of 0.5 px, magnitudes of 0.2, and three of each frame are false.

It fails if a field is wrong by more than 2 %, or if fewer than 95 % are named. The largest
processor time of a second look is printed, too.

Run: python benchmarks/other_fields.py [--frames 200]
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rows import Options, Rows, database, ended

from starcat.geometry.camera import Camera
from starcat.matcher.matcher import Matcher
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame, simulate_frames

NOISE = Noise(0.5, noise_mag=0.2, false_stars=3)
FEWEST, RIGHT, NAMED = 6, 0.02, 0.95


def frames(matcher: Matcher) -> Iterator[tuple[float, SimulatedFrame]]:
    sky, own = matcher.database, matcher.database.camera
    generator = np.random.default_rng(38)
    for seed in range(10_000):
        fov_deg = own.fov_x_deg * 2.0 ** generator.uniform(-1.0, 1.0)
        camera = Camera(own.width_px, own.height_px, fov_x_deg=fov_deg)
        yield fov_deg, next(simulate_frames(sky.directions, camera, 1, NOISE, seed, sky.mag))


def field_of(matcher: Matcher, px: np.ndarray, mag: np.ndarray | None) -> tuple[float, float]:
    """Return the field that is named, or that the frame is identified with, and the seconds."""
    before_s = time.process_time()
    first = matcher.identify(px, mag=mag, fov_error=0.05)
    between_s = time.process_time()
    if first.ok:
        return first.camera.fov_x_deg, 0.0
    found = matcher.identify(px, mag=mag, fov_error=0.05, explain=True)
    return found.fits_fov_deg or np.nan, time.process_time() - 2.0 * between_s + before_s


def main(rows: Rows) -> None:
    options = Options(__doc__)
    options.size("--frames", 200, 20, "frames of each kind")
    asked = options.asked()
    with tempfile.TemporaryDirectory() as folder:
        matcher = Matcher.open(database("gaia-12deg", Path(folder)).folder)
        width, height = matcher.database.camera.width_px, matcher.database.camera.height_px
        print("| frames | named within 2 % | wrong | none | largest s |")
        print("|---|---|---|---|---|")
        for words in ("with magnitudes", "without"):
            few, told, times = [], [], []
            for fov_deg, frame in frames(matcher):
                mag = frame.mag if words == "with magnitudes" else None
                named_deg, took_s = field_of(matcher, frame.centroids_px, mag)
                (told if frame.n_stars >= FEWEST else few).append(named_deg / fov_deg - 1.0)
                times.append(took_s)
                if len(told) == asked.frames:
                    break
            for name, errors in ((words, told), (f"{words}, fewer than {FEWEST} stars", few)):
                right, none = np.abs(errors) <= RIGHT, np.isnan(errors)
                wrong = len(errors) - int(right.sum()) - int(none.sum())
                print(f"| {name} | {right.sum()} of {len(errors)} | {wrong} | {none.sum()} | "
                      f"{max(times):.2f} |", flush=True)  # fmt: skip
                rows.expect(not wrong, f"{name}: {wrong} fields are wrong")
            right = int((np.abs(told) <= RIGHT).sum())
            rows.expect(right >= NAMED * len(told), f"{words}: {right} of {len(told)} are named")
            noise = np.random.default_rng(39)
            found = []
            for _ in range(asked.frames // 4):
                px = noise.random((40, 2)) * [width, height]
                found.append(field_of(matcher, px, None if mag is None else noise.random(40)))
            none = sum(np.isnan(named_deg) for named_deg, _ in found)
            longest_s = max(took_s for _, took_s in found)
            print(f"| random, {words} | 0 | {len(found) - none} | {none} | {longest_s:.2f} |")
            rows.expect(none == len(found), f"random, {words}: a field is named")


if __name__ == "__main__":
    ended(main)
