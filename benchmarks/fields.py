"""Fields of view from 1 to 90 deg: what `init` chooses, what it costs and how it identifies.

Run with ``make bench``. Each field is a fresh process, so that its peak memory is its own. Frames
are made as in the self-test: 0.5 px and 0.2 mag of noise; hard frames lack a tenth of their stars
and have three false stars. The last line of a field is the same frames without magnitudes.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rows import Options, Rows, ended, fresh

from starcat.matcher.c_engine import is_compiled
from starcat.matcher.matcher import Matcher
from starcat.pipeline.build import build
from starcat.pipeline.log import peak_memory_bytes
from starcat.pipeline.simulation.selftest import NOISE_MAG, self_test
from starcat.pipeline.simulation.simulate import Noise, simulate_frames
from starcat.pipeline.specs.build_spec import CameraSpec
from starcat.pipeline.starter import starter_spec

FIELDS_DEG = (1, 2, 5, 8, 12, 20, 35, 50, 90)
SIZE_PX = 1280, 960
SEED, NOISE_PX, TOLERANCE_PX = 1, 0.5, 2.0


def measure(fov_deg: float, frames: int) -> dict[str, float]:
    """Build what `init` chooses for a camera, identify frames; return the row of the table."""
    camera = CameraSpec(width_px=SIZE_PX[0], height_px=SIZE_PX[1], fov_x_deg=fov_deg)
    starter = starter_spec("camera", camera)
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        made = build(starter.spec, Path(folder))
        row: dict[str, float] = {
            "limit": starter.spec.selection.faint_limit_mag,
            "stars": made.manifest["products"]["stars"]["rows"],
            "a field": made.coverage.summary.stars.median,
            "boresights": starter.spec.boresights.count,
            "triangles": made.manifest["products"]["triangles"]["rows"],
            "products": 7 - len(starter.left_out),
            "s": time.perf_counter() - start,
            "GiB": (peak_memory_bytes() or 0) / 2**30,
        }
        numpy = Matcher.open(made.folder, tolerance_px=TOLERANCE_PX, engine="numpy")
        rates = self_test(numpy, frames, NOISE_PX, SEED)
        for rate in rates:
            row[rate.name] = 100.0 * rate.identified_share
        row["wrong"] = sum(rate.wrong for rate in rates)
        row["4+"] = 100.0 * rates[0].identifiable / rates[0].frames
        for engine in ("numpy", "c") if is_compiled() else ("numpy",):
            matcher = Matcher.open(made.folder, tolerance_px=TOLERANCE_PX, engine=engine)  # type: ignore[arg-type]
            row[f"{engine} ms"] = median_ms(matcher, is_bright=True)
            row[f"{engine} bare ms"] = median_ms(matcher, is_bright=False)
    return row


def median_ms(matcher: Matcher, *, is_bright: bool) -> float:
    """Return the median time of clean frames with or without magnitudes."""
    database, noise = matcher.database, Noise(NOISE_PX, noise_mag=NOISE_MAG)
    frames = list(
        simulate_frames(database.directions, database.camera, 110, noise, SEED, database.mag)
    )
    times = []
    for frame in frames:
        start = time.perf_counter()
        matcher.identify(frame.centroids_px, mag=frame.mag if is_bright else None)
        times.append(time.perf_counter() - start)
    # The first frames wait for what a matcher makes once.
    return 1e3 * float(np.median(times[10:]))


COLUMNS = (
    ("field, deg", "{field:g}"), ("limit, G", "{limit:g}"), ("guide stars", "{stars:,.0f}"),
    ("a field", "{a field:.0f}"), ("boresights", "{boresights:,.0f}"),
    ("triangles", "{triangles:,.0f}"), ("products", "{products:.0f}"), ("build, s", "{s:.0f}"),
    ("GiB", "{GiB:.1f}"), ("clean, %", "{clean:.1f}"), ("hard, %", "{hard:.1f}"),
    ("numpy, ms", "{numpy ms:.1f}"), ("C, ms", "{c ms:.2f}"),
    ("clean, no mag.", "{clean, no magnitudes:.1f}"),
    ("hard, no mag.", "{hard, no magnitudes:.1f}"), ("numpy, ms", "{numpy bare ms:.1f}"),
    ("C, ms", "{c bare ms:.2f}"), ("wrong", "{wrong:.0f}"),
)  # fmt: skip
"""Heading and text of each column of the table, which is Markdown."""


def main(rows: Rows) -> None:
    """Print the table."""
    options = Options(__doc__)
    options.size("--frames", 500, 20, "of each kind")
    given = options.asked()
    print("\nFields of view, each with what `starcat init` chooses (1280 x 960 px)")
    print(f"| {' | '.join(head for head, _ in COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    for fov_deg in (20,) if given.quick else FIELDS_DEG:
        with rows.row(f"{fov_deg} deg"):
            found = json.loads(fresh(__file__, fov_deg, given.frames))
            row = {"field": fov_deg, "c ms": np.nan, "c bare ms": np.nan} | found
            print(f"| {' | '.join(text.format_map(row) for _, text in COLUMNS)} |", flush=True)
            rows.expect(not row["wrong"], f"{fov_deg} deg: {row['wrong']:.0f} wrong answers")


if __name__ == "__main__":
    if len(sys.argv) == 3 and sys.argv[1].isdigit():
        print(json.dumps(measure(float(sys.argv[1]), int(sys.argv[2]))))
    else:
        ended(main)
