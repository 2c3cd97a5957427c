"""Commands interrupted at random times: how each ends, and what it leaves.

    python benchmarks/interrupts.py [--count 200] [--seed 1] [--quick]

`build`, `ingest --to hats` and `evaluate` on made stars get SIGINT or SIGTERM at a time drawn
from the length of an undisturbed run. Each has to end with 130 or 143, or by the signal itself if
Python had not begun or was already leaving, and never by another signal. Half-done files may not
stay next to the output of a build, and the same command has to succeed afterwards.
"""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "builders"))

from archives import plain_sao
from rows import Options, Rows, ended

STARCAT = (sys.executable, "-m", "starcat")

SPEC = """\
name = "small"
version = "1.0.0"
epoch_jyear = 2026.0
catalog.source = "sao"
selection.faint_limit_mag = 6.5
camera = { width_px = 512, height_px = 512, fov_x_deg = 20.0 }
boresights.count = 500
self_test = { frames = 50 }
"""

STARS = 2_000


def commands(folder: Path) -> dict[str, tuple[list[str], Path]]:
    """Return the commands and the output of each."""
    stars, whole = f"sao={folder / 'stars.dat'}", folder / "whole" / "small-1.0.0"
    return {
        "build": (
            ["build", str(folder / "small.toml"), "--input", stars, "-o", str(folder / "dist")],
            folder / "dist" / "small-1.0.0",
        ),
        "ingest": (
            ["ingest", "sao", "--input", stars, "--to", "hats", "-o", str(folder / "hats")],
            folder / "hats",
        ),
        "evaluate": (
            ["evaluate", str(whole), "--noise-px", "0.5,1", "--frames", "20", "-o",
             str(folder / "evaluation")],
            folder / "evaluation",
        ),
    }  # fmt: skip


def interrupted(command: list[str], number: int, wait_s: float) -> tuple[int, str]:
    """Return how a command ended that got a signal after a time, and what it said."""
    run = subprocess.Popen([*STARCAT, *command], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    time.sleep(wait_s)
    run.send_signal(number)
    _, said = run.communicate(timeout=120)
    return run.returncode, said.decode()


def main(rows: Rows) -> None:
    """Interrupt the commands, and print a line for each way to end."""
    options = Options(__doc__)
    options.size("--count", 200, 9, "interruptions of all commands together")
    options.add_argument("--seed", type=int, default=1)
    given = options.asked()
    generator = np.random.default_rng(given.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "stars.dat").write_bytes(b"".join(plain_sao(STARS, 8.0)))
        (folder / "small.toml").write_text(SPEC)
        known, lengths_s, found = commands(folder), {}, Counter[tuple[str, str, int]]()
        whole = [*known["build"][0][:-1], str(folder / "whole")]
        subprocess.run([*STARCAT, *whole], check=True, capture_output=True)
        for name, (command, output) in known.items():
            before = time.perf_counter()
            subprocess.run([*STARCAT, *command], check=True, capture_output=True)
            lengths_s[name] = time.perf_counter() - before
            shutil.rmtree(output)
        for attempt in range(given.count):
            name = list(known)[attempt % len(known)]
            command, output = known[name]
            number = [signal.SIGINT, signal.SIGTERM][int(generator.integers(2))]
            unfinished = output.with_name(f".{output.name}.work")  # folder of an unfinished ingest
            code, said = interrupted(command, number, generator.uniform(0.0, lengths_s[name]))
            found[name, number.name, code] += 1
            ended_well = code in (0, 128 + number, -number)
            rows.expect(ended_well, f"{name} {attempt}, {number.name}: exit {code}: {said}")
            is_told = code <= 0 or "interrupted; " in said
            rows.expect(is_told, f"{name} {attempt}, {number.name}: says {said!r}")
            if name == "build":
                known_names = {output.name, f"{output.name}.build.json"}
                left = {path.name for path in output.parent.glob("*")} - known_names
                rows.expect(not left, f"build {attempt}: left {sorted(left)}")
            if attempt % (5 * len(known)) < len(known):
                if name == "ingest" and code <= 0:  # it was done: it writes over nothing
                    shutil.rmtree(output, ignore_errors=True)
                more = ["--resume"] if name == "ingest" and unfinished.exists() else []
                done = subprocess.run([*STARCAT, *command, *more], capture_output=True, text=True)
                rows.expect(done.returncode == 0, f"{name} {attempt}, {code}, again: {done.stderr}")
            shutil.rmtree(output, ignore_errors=True)
            shutil.rmtree(unfinished, ignore_errors=True)
    print(f"{'command':<10}{'signal':<9}{'exit':>5}{'times':>7}")
    for (name, sent, code), times in sorted(found.items()):
        print(f"{name:<10}{sent:<9}{code:>5}{times:>7}")


if __name__ == "__main__":
    ended(main)
