"""Steps of the C library in flight for each preset, and the budget of steps of a mission.

    python benchmarks/steps.py [--frames 1000] [--preset gaia-12deg ...] [--profile small]
                               [--database FOLDER ...] [--centroids 64] [--clock-mhz 100]
                               [--keep FOLDER]

Clean and hard frames, made as in ``starcat export`` (0.5 px of noise; in hard frames a tenth of
the stars are missing, 3 spots are false and magnitudes have errors of 0.3), are identified with the
limits of flight and with stated noise: without a prior, and with a prior that is wrong by up to
0.5 deg. The first table has the steps of a frame, and the least ``max_steps`` that identifies 99 %
of the frames that are identified without this limit. `--database` takes the folder of a database
that is built instead of building a preset. `--keep` leaves the images and the frames in a folder,
for ``make -C onboard microcontroller``.

The second table is the budget of the first database: the least ``max_steps``, rounded up, that
identifies 99 % of all hard frames, and the longest time of it by the bound on instructions, which
docs/onboard-manual.md has. Run with ``make bench``; fails if an answer is wrong.
"""

from __future__ import annotations

import math
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "builders"))

import peers
from rows import FILES, Options, Rows, database, ended
from slew import wrong_by

from starcat.database.onboard.flight_limits import FLIGHT_CENTROIDS, FLIGHT_STARS, FLIGHT_STEPS
from starcat.database.onboard.profiles import PROFILES
from starcat.database.onboard.reading import read_onboard_image
from starcat.pipeline.simulation.in_flight import KINDS, NOISE_PX, SEED
from starcat.pipeline.simulation.simulate import SimulatedFrame, simulate_frames
from starcat.ship.exchange.onboard import export_image

ONBOARD = Path(__file__).parents[1] / "onboard"

NOISE_MAG = 0.3

PRIOR_DEG = 0.5

MANUAL = ONBOARD.parent / "docs" / "onboard-manual.md"

FRACTION = 0.99
"""The part of the frames that a budget identifies."""

CYCLES = 1.5
"""Cycles of an instruction in the example of the manual."""

CLOCKS_MHZ = (100, 400)

LOOK_UPS = 5000
"""Most look-ups of a call (``STARCAT_MOST_TRIANGLES``)."""

STEPS = (
    "preset",
    "call",
    "frames",
    "identified",
    "median",
    "99 %",
    "largest",
    "`max_steps` for 99 %",
)

BUDGET = ("clock", "call", "`max_steps`", "hard frames identified", "longest time")


@dataclass(frozen=True)
class Replayed:
    """What the library answers to frames."""

    right: np.ndarray  # bool, one per frame
    wrong: int
    steps: np.ndarray  # int, one per frame


def write_frames(frames: list[SimulatedFrame], path: Path, most: int) -> None:
    """Write frames as the program replay reads them: the brightest centroids, and a prior."""
    generator, lines = np.random.default_rng(SEED), []
    for frame in frames:
        angle_rad = np.radians(PRIOR_DEG) * generator.uniform() ** (1.0 / 3.0)
        prior = wrong_by(frame.matrix, angle_rad, generator).tolist()
        rows = brightest(frame, most)
        lines.append(" ".join([str(len(rows)), *map(float.hex, prior)]))
        spots = np.column_stack([frame.centroids_px[rows], frame.mag[rows]]).tolist()
        lines.extend(" ".join(map(float.hex, spot)) for spot in spots)
    path.write_text("\n".join(lines) + "\n")


def brightest(frame: SimulatedFrame, most: int) -> np.ndarray:
    """Return the rows of the centroids that the library gets."""
    return np.argsort(frame.mag, kind="stable")[:most]


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


def least_budget(steps: np.ndarray, frames: int) -> int | None:
    """Return the ``max_steps`` that identifies 99 % of frames; None if fewer are identified.

    ``steps`` has the steps of the frames that are identified without this limit.
    """
    wanted = math.ceil(FRACTION * frames)
    return int(np.sort(steps)[wanted - 1]) if wanted <= len(steps) else None


@dataclass(frozen=True)
class Bound:
    """The bound on the instructions of a call (docs/onboard-manual.md, Time)."""

    once: int
    per_step: int
    per_look_up: int

    def longest_s(self, steps: int, clock_mhz: float) -> float:
        """Return the longest time of a call with a number of steps."""
        looked_up = self.per_look_up * min(steps, LOOK_UPS)
        return 1e-6 * CYCLES * (self.once + self.per_step * steps + looked_up) / clock_mhz


def cortex_m7_bounds(manual: str) -> dict[str, Bound]:
    """Return the bounds of the manual for a Cortex-M7, by call."""
    rows = re.findall(r"^\| (`starcat_.*?) \| ([\d,]+) \| ([\d,]+) \| ([\d,]+) \|", manual, re.M)
    return {
        call: Bound(*(int(number.replace(",", "")) for number in numbers))
        for call, *numbers in rows
    }


@dataclass(frozen=True)
class Budget:
    """A ``max_steps`` and the percentage of hard frames that it identifies."""

    max_steps: int
    identified: float


def budget_rows(
    budgets: Mapping[str, Budget], bounds: Mapping[str, Bound], clock_mhz: float
) -> list[str]:
    """Return the rows of the budget for one clock: each call, and both in a session."""
    both_steps, both_s, rows = 0, 0.0, []
    for call, budget in budgets.items():
        longest_s = bounds[call].longest_s(budget.max_steps, clock_mhz)
        both_steps, both_s = both_steps + budget.max_steps, both_s + longest_s
        cells = f"{call} | {budget.max_steps:,} | {budget.identified:.1f} % | {longest_s:.2f} s"
        rows.append(f"| {clock_mhz:g} MHz | {cells} |")
    return [
        *rows,
        f"| {clock_mhz:g} MHz | both, in a session | {both_steps:,} | | {both_s:.2f} s |",
    ]


def heading(cells: Sequence[str]) -> str:
    """Return the head of a table."""
    return f"| {' | '.join(cells)} |\n|{'---|' * len(cells)}"


@dataclass(frozen=True)
class Replays:
    """The program replay, compiled once for each limit of stars, and the files that it reads."""

    folder: Path
    profile: str
    frames: int
    centroids: int

    def compiled(self, most_near: int) -> Path:
        """Return the program for images with this many stars around a field."""
        stars = max(most_near, FLIGHT_STARS)
        program = self.folder / f"replay-{stars}"
        if not program.exists():
            sources = [*sorted((ONBOARD / "src").glob("*.c")), ONBOARD / "tests" / "replay.c"]
            limits = [f"-DSTARCAT_MAX_STARS={stars}", f"-DSTARCAT_MAX_CENTROIDS={self.centroids}"]
            flags = ["-std=c99", "-O2", f"-I{ONBOARD / 'include'}", *limits]
            peers.run(["cc", *flags, *map(str, sources), "-o", str(program), "-lm"])
        return program


def method_of(folder: Path) -> str:
    """Return the method of a database's image: triangles if it has them."""
    return "triangle" if (folder / "triangles.parquet").exists() else "pyramid"


def measure(rows: Rows, name: str, folder: Path, replays: Replays) -> dict[str, Budget]:
    """Print the steps of a database's frames; return the budget of each call for hard frames."""
    profile, count = replays.profile, replays.frames
    method = "pyramid" if profile == "small" else method_of(folder)
    image = replays.folder / f"{name}-{profile}.img"
    exported = export_image(folder, "onboard", image, profile=profile, method=method, replace=True)
    sky, program = exported.sky, replays.compiled(exported.image.most_near)
    numbers = read_onboard_image(image).star_id
    order, budgets = np.argsort(numbers), {}
    for kind, noise in KINDS.items():
        frames = list(simulate_frames(sky.directions, sky.camera, count, noise, SEED, sky.mag))
        path = replays.folder / f"{name}-{kind}.txt"
        write_frames(frames, path, replays.centroids)
        truths = []
        for frame in frames:
            star = frame.star_index[brightest(frame, replays.centroids)]
            star_id = np.where(star >= 0, sky.star_id[star], -1)
            at = np.minimum(np.searchsorted(numbers, star_id, sorter=order), len(order) - 1)
            truths.append(np.where(numbers[order[at]] == star_id, order[at], -1))
        for mode in ("identify", "track"):
            call = f"`starcat_{mode}_frame`" + (f", {method}s" if mode == "identify" else "")
            full = replay(program, image, path, truths, mode, FLIGHT_STEPS)
            rows.expect(full.wrong == 0, f"{name}, {call}: {full.wrong} wrong answers")
            least = least_budget(full.steps[full.right], int(full.right.sum()))
            cells = [name, call, kind, f"{100.0 * full.right.mean():.1f} %"]
            cells += [f"{x:,.0f}" for x in (*np.percentile(full.steps, [50, 99, 100]), least or 0)]
            print(f"| {' | '.join(cells)} |", flush=True)
            least = least_budget(full.steps[full.right], count)
            if kind == "hard" and least is not None:
                max_steps = 1000 * math.ceil(least / 1000)
                within = replay(program, image, path, truths, mode, max_steps)
                rows.expect(within.wrong == 0, f"{name}, {call}: wrong within {max_steps}")
                budgets[call] = Budget(max_steps, 100.0 * float(within.right.mean()))
    return budgets


def main(rows: Rows) -> None:
    """Build, export, compile, replay, print."""
    options = Options(__doc__)
    options.size("--frames", 1000, 50, "of each kind")
    options.add_argument("--preset", action="append", choices=list(FILES), help="default: all")
    options.add_argument("--database", action="append", type=Path, help="the folder of a database")
    options.add_argument("--profile", default="full", choices=list(PROFILES), help="of the image")
    options.add_argument("--centroids", default=FLIGHT_CENTROIDS, type=int, help="most of a frame")
    options.add_argument("--keep", type=Path, help="leave images and frames in this folder")
    options.add_argument("--clock-mhz", action="append", type=float, help="of the budget")
    asked = options.asked()
    budgets: dict[str, dict[str, Budget]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        kept = asked.keep or Path(scratch)
        kept.mkdir(parents=True, exist_ok=True)
        replays = Replays(kept, asked.profile, asked.frames, asked.centroids)
        folders = {folder.name: folder for folder in asked.database or ()}
        every = [] if folders else ["gaia-12deg"] if asked.quick else list(FILES)
        print(heading(STEPS))
        for name in (*folders, *(asked.preset or every)):
            with rows.row(name):
                folder = folders.get(name) or database(name, Path(scratch)).folder
                budgets[name] = measure(rows, name, folder, replays)
    bounds = cortex_m7_bounds(MANUAL.read_text(encoding="utf-8"))
    for name, budget in list(budgets.items())[:1]:
        rows.expect(len(budget) == 2, f"{name}: no max_steps identifies 99 % of the hard frames")
        print(f"\n{name}, Cortex-M7, {CYCLES} cycles per instruction\n\n{heading(BUDGET)}")
        for clock_mhz in asked.clock_mhz or CLOCKS_MHZ:
            print("\n".join(budget_rows(budget, bounds, clock_mhz)))


if __name__ == "__main__":
    ended(main)
