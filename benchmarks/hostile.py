"""Frames that no answer belongs to, each with a limit of time: answers, and the time that it took.

Grids, lines, clusters, mirror images, scales beyond what is allowed and false spots, half of them
with an error of 2 % allowed in the focal length. Every answer is a wrong one. Run with
``make bench``, or ``--frames 20000`` by hand; the catalog is sought in $STARCAT_CATALOGS.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "builders"))

from hostile_frames import hostile_frame
from rows import Options, Rows, database, ended

from starcat.matcher.matcher import Matcher


def main(rows: Rows) -> None:
    """Build sao-12deg, match it with frames of no sky, print one line per kind."""
    options = Options(__doc__)
    options.size("--frames", 600, 12, "of all kinds together")
    options.add_argument("--first", type=int, default=0, help="seed of the first frame")
    options.add_argument("--limit", type=float, default=0.1, help="seconds a frame")
    given = options.asked()
    with tempfile.TemporaryDirectory() as scratch:
        folder = database("sao-12deg", Path(scratch)).folder
        matcher = Matcher.open(folder, time_limit_s=given.limit)
        seconds, answers, ended = defaultdict(list), defaultdict(int), defaultdict(int)
        for number in range(given.first, given.first + given.frames):
            kind, px, mag, fov_error = hostile_frame(number, matcher.database)
            start = time.perf_counter()
            result = matcher.identify(px, mag=mag, fov_error=fov_error)
            key = kind, fov_error
            seconds[key].append(time.perf_counter() - start)
            answers[key] += result.ok
            ended[key] += result.refusal is not None and result.refusal.reason == "time"
            rows.expect(not result.ok, f"frame {number}, {kind}, {fov_error}: {result}")
    print(f"{'kind':<10}{'error':>7}{'frames':>8}{'answers':>9}{'out of time':>13}", end="")
    print(f"{'median ms':>11}{'most ms':>9}   limit {given.limit * 1e3:.0f} ms")
    for key in sorted(seconds):
        ms = np.array(seconds[key]) * 1e3
        print(f"{key[0]:<10}{key[1]:>7.0%}{len(ms):>8}{answers[key]:>9}{ended[key]:>13}", end="")
        print(f"{np.median(ms):>11.1f}{ms.max():>9.1f}")


if __name__ == "__main__":
    ended(main)
