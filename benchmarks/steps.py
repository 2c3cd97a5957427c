"""Steps of the C library in flight, and how many frames a budget of steps identifies.

    python benchmarks/steps.py [--frames 1000]

Clean and hard frames of gaia-12deg, made as in ``starcat export`` (0.5 px of noise; in hard frames
a tenth of the stars are missing, 3 spots are false and magnitudes have errors of 0.3), are
identified with the limits of flight and with stated noise: without a prior, and with a prior that
is wrong by up to 0.5 deg. The table has the steps of a frame, the least ``max_steps`` that
identifies 99 % of the frames, and the percentage of frames that each of `BUDGETS` identifies.
Run with ``make bench``; fails if an answer is wrong.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "builders"))

import peers
from rows import Options, Rows, database, ended
from slew import wrong_by

from starcat.exchange.onboard import export_image
from starcat.onboard.flight_limits import FLIGHT_CENTROIDS, FLIGHT_STEPS
from starcat.onboard.reading import read_onboard_image
from starcat.simulation.in_flight import KINDS, NOISE_PX, SEED
from starcat.simulation.simulate import SimulatedFrame, simulate_frames

ONBOARD = Path(__file__).parents[1] / "onboard"

NOISE_MAG = 0.3

PRIOR_DEG = 0.5

METHODS = ("triangle", "pyramid")

BUDGETS = (15_128, 26_376, 36_000)
"""Budgets of the examples in the manual, for a Cortex-M7."""

HEADINGS = ("call", "frames", "median", "99 %", "largest", "max_steps for 99 %")


@dataclass(frozen=True)
class Replayed:
    """What the library answers to frames."""

    right: np.ndarray  # bool, one per frame
    wrong: int
    steps: np.ndarray  # int, one per frame


def write_frames(frames: list[SimulatedFrame], path: Path) -> None:
    """Write frames as the program replay reads them: the brightest centroids, and a prior."""
    generator, lines = np.random.default_rng(SEED), []
    for frame in frames:
        angle_rad = np.radians(PRIOR_DEG) * generator.uniform() ** (1.0 / 3.0)
        prior = wrong_by(frame.matrix, angle_rad, generator).tolist()
        rows = brightest(frame)
        lines.append(" ".join([str(len(rows)), *map(float.hex, prior)]))
        spots = np.column_stack([frame.centroids_px[rows], frame.mag[rows]]).tolist()
        lines.extend(" ".join(map(float.hex, spot)) for spot in spots)
    path.write_text("\n".join(lines) + "\n")


def brightest(frame: SimulatedFrame) -> np.ndarray:
    """Return the rows of the centroids that the library gets."""
    return np.argsort(frame.mag, kind="stable")[:FLIGHT_CENTROIDS]


def replay(
    program: Path, image: Path, path: Path, truths: list[np.ndarray], mode: str, max_steps: int
) -> Replayed:
    """Let the library identify frames within a number of steps; compare its stars.

    ``truths`` has for each frame the row of the image of each centroid's star, -1 for false spots.
    """
    options = [mode, "1", str(NOISE_PX), str(NOISE_MAG), str(max_steps)]
    ran = subprocess.run(
        [str(program), str(image), str(path), *options], capture_output=True, text=True, check=True
    )
    answers = [np.array(line.split(), dtype=int) for line in ran.stdout.splitlines()]
    right, wrong = np.zeros(len(truths), bool), 0
    for row, (answer, truth) in enumerate(zip(answers, truths, strict=True)):
        is_identified, stars = answer[0] == 0, answer[4:]
        is_matched = stars >= 0
        is_same = (stars == truth) & is_matched
        right[row] = is_identified and 2 * is_same.sum() > is_matched.sum()
        wrong += int(is_identified and not right[row])
    return Replayed(right, wrong, np.array([answer[3] for answer in answers]))


def least_budget(replayed: Replayed, fraction: float = 0.99) -> int | None:
    """Return the steps within which a fraction of all frames was identified."""
    steps = np.sort(replayed.steps[replayed.right])
    wanted = int(np.ceil(fraction * len(replayed.right)))
    return int(steps[wanted - 1]) if wanted <= len(steps) else None


def main(rows: Rows) -> None:
    """Build, export, compile, replay, print."""
    options = Options(__doc__)
    options.size("--frames", 1000, 50, "of each kind")
    count = options.asked().frames
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        program, path, image = scratch / "replay", scratch / "frames.txt", scratch / "db.img"
        sources = [*sorted((ONBOARD / "src").glob("*.c")), ONBOARD / "tests" / "replay.c"]
        flags = ["-std=c99", "-O2", f"-I{ONBOARD / 'include'}"]
        peers.run(["cc", *flags, *map(str, sources), "-o", str(program), "-lm"])
        built = database("gaia-12deg", scratch)
        cells = [*HEADINGS, *(f"{budget:,}" for budget in BUDGETS)]
        print(f"| {' | '.join(cells)} |\n|{'---|' * len(cells)}")
        for method in METHODS:
            sky = export_image(built.folder, "onboard", image, method=method, replace=True).sky
            numbers = read_onboard_image(image).star_id
            order = np.argsort(numbers)
            row_of_star = order[np.searchsorted(numbers, sky.star_id, sorter=order)]
            for kind, noise in KINDS.items():
                frames = list(
                    simulate_frames(sky.directions, sky.camera, count, noise, SEED, sky.mag)
                )
                write_frames(frames, path)
                stars = [frame.star_index[brightest(frame)] for frame in frames]
                truths = [np.where(star >= 0, row_of_star[star], -1) for star in stars]
                for mode in ("identify", "track") if method == "triangle" else ("identify",):
                    name = f"{mode}, {method}s" if mode == "identify" else mode
                    full = replay(program, image, path, truths, mode, FLIGHT_STEPS)
                    within = [
                        replay(program, image, path, truths, mode, budget) for budget in BUDGETS
                    ]
                    rows.expect(
                        not any(each.wrong for each in (full, *within)), f"{name}: wrong answers"
                    )
                    budget = least_budget(full)
                    print(
                        f"| {name} | {kind} | "
                        + " | ".join(f"{x:,.0f}" for x in np.percentile(full.steps, [50, 99, 100]))
                        + f" | {'none' if budget is None else format(budget, ',')} | "
                        + " | ".join(f"{100.0 * each.right.mean():.1f}" for each in within)
                        + " |",
                        flush=True,
                    )


if __name__ == "__main__":
    ended(main)
