"""Instructions and cache misses of the C library on the frames of the benchmark, by callgrind.

They do not depend on other load of the machine, and show where the microseconds go. ``matcher.py``
makes the frames and the database. Run with ``make bench``.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import peers
from matcher import make_frames
from rows import LackingError, Options, Rows, database, ended

from starcat.matcher.database import open_database

ONBOARD = Path(__file__).parents[1] / "onboard"

COST = re.compile(
    r"\s*([\d,]+) \(\s*[\d.]+%\)"  # instructions
    r"\s+([\d,.]+)(?: \(\s*[\d.]+%\))?"  # misses of reads in the first cache
    r"\s+([\d,.]+)(?: \(\s*[\d.]+%\))?"  # and of writes
    r"\s+(\S+):(\S+)"  # file and function
)


def print_all(database: Path, frames: Path, scratch: Path) -> None:
    """Print where the instructions of the C library go, for every kind of frames."""
    program, image, counted = scratch / "replay", scratch / "db.img", scratch / "counted.out"
    sources = [*sorted((ONBOARD / "src").glob("*.c")), ONBOARD / "tests" / "replay.c"]
    flags = ["-std=c99", "-O3", "-g", f"-I{ONBOARD / 'include'}", f"-I{ONBOARD / 'src'}"]
    peers.run(["cc", *flags, *map(str, sources), "-o", str(program), "-lm"])
    export = ["export", str(database), "--to", "onboard", "-o", str(image)]
    peers.run([sys.executable, "-m", "starcat", *export])
    for kind in peers.KINDS:
        number = write_replay(frames, kind, scratch / "replay.txt")
        for mode in ("identify", "track"):
            tool = ["--tool=callgrind", "--cache-sim=yes", f"--callgrind-out-file={counted}"]
            given = [str(image), str(scratch / "replay.txt"), mode]
            peers.run(["valgrind", *tool, str(program), *given])
            print_costs(counted, f"{kind} frames, {mode}", number)


def write_replay(frames: Path, kind: str, path: Path) -> int:
    """Write the frames of a kind as the C library's own programs read them; return their number."""
    with np.load(frames) as file:
        given = dict(file)
    starts = given[f"{kind}_starts"]
    centroids, mags = (np.split(given[f"{kind}_{key}"], starts[1:]) for key in ("px", "mag"))
    lines = []
    for px, mag, prior in zip(centroids, mags, given[f"{kind}_priors"], strict=True):
        lines.append(" ".join([str(len(px)), *(float(part).hex() for part in prior)]))
        spots = zip(px[:, 0].tolist(), px[:, 1].tolist(), mag.tolist(), strict=True)
        lines.extend(" ".join(number.hex() for number in spot) for spot in spots)
    path.write_text("\n".join(lines) + "\n")
    return len(starts)


def print_costs(counted: Path, what: str, frames: int) -> None:
    """Print instructions and misses a frame by the library's source files."""
    said = subprocess.run(
        ["callgrind_annotate", "--threshold=100", "--show=Ir,D1mr,D1mw", str(counted)],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    totals: dict[str, np.ndarray] = {}
    for cost in filter(None, map(COST.match, said.splitlines())):
        file, function = cost[4], cost[5]
        if "onboard/src/" in file and "scrub" not in function and "crc" not in function:
            numbers = [float(cost[n].replace(",", "").replace(".", "") or 0) for n in (1, 2, 3)]
            totals[Path(file).name] = totals.get(Path(file).name, np.zeros(3)) + numbers
    if not totals:
        raise ValueError(f"{what}: callgrind names no function of onboard/src")
    print(f"\nC library, {what}, a frame: instructions and misses of the first cache")
    for name, (ir, *misses) in sorted(totals.items(), key=lambda item: -item[1][0]):
        print(f"  {name:<14}{ir / frames:>10,.0f}{sum(misses) / frames:>8.1f}")
    ir, *misses = sum(totals.values(), np.zeros(3))
    print(f"  {'all':<14}{ir / frames:>10,.0f}{sum(misses) / frames:>8.1f}")


def main(rows: Rows) -> None:
    """Build, simulate, count."""
    options = Options(__doc__)
    options.size("--frames", 1000, 20, "of each kind")
    given = options.asked()
    for program in ("cc", "valgrind"):
        if shutil.which(program) is None:
            raise LackingError(f"{program}, which this benchmark runs")
    with tempfile.TemporaryDirectory() as folder, rows.row("the C library"):
        scratch, frames = Path(folder), Path(folder, "frames.npz")
        folder = database("sao-12deg", scratch).folder
        make_frames(open_database(folder), given.frames, frames)
        print_all(folder, frames, scratch)


if __name__ == "__main__":
    ended(main)
