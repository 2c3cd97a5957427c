"""Frames of a camera whose pixels are not square, although the matcher assumes square pixels.

The pixels of each frame are 3 to 10 % wider than high, or higher than wide, and an error of the
focal length is allowed, so that a stripe of the frame fits stars of the database. An answer whose
boresight is farther than `RIGHT_DEG` from the true one is wrong. Frames of square pixels, with the
same noise, are measured for comparison.

It fails if an answer is wrong.

Run: python benchmarks/shapes.py [--frames 10000]
"""

from __future__ import annotations

import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
from rows import Options, Rows, database, ended

from starcat.geometry.attitude import random_attitudes
from starcat.matcher.matcher import Matcher
from starcat.simulation.simulate import Noise, Sky, simulate_frame

RIGHT_DEG = 0.1
NOISE = Noise(0.4, 0.1, 3, noise_mag=0.2)
FOV_ERRORS = (0.0, 0.02, 0.05)


def outcomes(matcher: Matcher, fov_error: float, frames: int, *, is_square: bool) -> Counter[str]:
    """Return how many frames are right, wrong, or refused for which reason."""
    stars, camera, found = matcher.database, matcher.database.camera, Counter[str]()
    sky = Sky(stars.directions, stars.mag, np.arange(len(stars.mag), dtype=np.int32))
    generator = np.random.default_rng([37, round(1000 * fov_error), is_square])
    for matrix in random_attitudes(frames, generator):
        frame = simulate_frame(sky, camera, matrix, NOISE, generator)
        stretch = (
            1.0 if is_square else generator.uniform(1.03, 1.10) ** generator.choice([-0.5, 0.5])
        )
        px = camera.middle_px + (frame.centroids_px - camera.middle_px) * [stretch, 1.0 / stretch]
        inside = camera.contains(px)
        answer = matcher.identify(px[inside], mag=frame.mag[inside], fov_error=fov_error)
        if answer.refusal is not None:
            found[answer.refusal.reason] += 1
            continue
        apart = np.linalg.norm(answer.matrix[2] - matrix[2])
        is_right = np.degrees(2.0 * np.arcsin(0.5 * apart)) <= RIGHT_DEG
        found["right" if is_right else "wrong"] += 1
    return found


def main(rows: Rows) -> None:
    """Print a row for each error that is allowed, with square pixels and without."""
    options = Options(__doc__)
    options.size("--frames", 1000, 1, "of each row")
    frames = options.asked().frames
    with tempfile.TemporaryDirectory() as folder:
        path = database("gaia-12deg", Path(folder)).folder
        print("| pixels | noise stated | focal length | right | wrong | refused, by reason |")
        print("|---|---|---|---|---|---|")
        for is_square in (True, False):
            for stated in ({}, {"noise_px": NOISE.noise_px, "noise_mag": NOISE.noise_mag}):
                matcher = Matcher.open(path, **stated)
                for fov_error in FOV_ERRORS:
                    found = outcomes(matcher, fov_error, frames, is_square=is_square)
                    right, wrong = found.pop("right", 0), found.pop("wrong", 0)
                    reasons = ", ".join(f"{name} {n}" for name, n in found.most_common())
                    kind = "square" if is_square else "3 to 10 % not square"
                    said = "yes" if stated else "no"
                    print(
                        f"| {kind} | {said} | {fov_error:.0%} | {right} | {wrong} | {reasons} |",
                        flush=True,
                    )
                    rows.expect(wrong == 0, f"{kind}, {said}, {fov_error:.0%}: {wrong} wrong")


if __name__ == "__main__":
    ended(main)
