"""Fields of view from 1 to 90 deg: what `init` chooses, what it costs and how it identifies.

Run with ``make bench``. Each field is a fresh process, so that its peak memory is its own. Frames
are those of the self-test: 0.5 px and 0.2 mag of noise; the hard ones lack a tenth of their stars
and have three false ones. The last line of a field is the same frames without magnitudes.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from starcat.matcher.c_engine import is_compiled
from starcat.matcher.matcher import Matcher
from starcat.pipeline.build import build
from starcat.pipeline.log import peak_memory_bytes
from starcat.pipeline.starter import starter_spec
from starcat.simulation.selftest import NOISE_MAG, self_test
from starcat.simulation.simulate import Noise, simulate_frames
from starcat.specs.build_spec import CameraSpec

FIELDS_DEG = (1, 2, 5, 8, 12, 20, 35, 50, 90)
SIZE_PX = 1280, 960
FRAMES, SEED, NOISE_PX, TOLERANCE_PX = 500, 1, 0.5, 2.0


def measure(fov_deg: float) -> dict[str, float]:
    """Build what `init` chooses for a camera, identify frames; return the row of the table."""
    camera = CameraSpec(width_px=SIZE_PX[0], height_px=SIZE_PX[1], fov_x_deg=fov_deg)
    starter = starter_spec("camera", camera)
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        made = build(starter.spec, {}, Path(folder))
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
        rates = self_test(numpy, FRAMES, NOISE_PX, SEED)
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
        matcher.identify(frame.centroids_px, magnitudes=frame.mag if is_bright else None)
        times.append(time.perf_counter() - start)
    # The first frames wait for what a matcher makes once.
    return 1e3 * float(np.median(times[10:]))


def print_row(fov_deg: float, row: dict[str, float]) -> None:
    """Print a row of the table as Markdown has it."""
    cells = [
        f"{fov_deg:g}", f"{row['limit']:g}", f"{row['stars']:,.0f}", f"{row['a field']:.0f}",
        f"{row['boresights']:,.0f}", f"{row['triangles']:,.0f}", f"{row['products']:.0f}",
        f"{row['s']:.0f}", f"{row['GiB']:.1f}", f"{row['clean']:.1f}", f"{row['hard']:.1f}",
        f"{row['numpy ms']:.1f}", f"{row.get('c ms', np.nan):.2f}",
        f"{row['clean, no magnitudes']:.1f}", f"{row['hard, no magnitudes']:.1f}",
        f"{row['numpy bare ms']:.1f}", f"{row.get('c bare ms', np.nan):.2f}",
        f"{row['wrong']:.0f}",
    ]  # fmt: skip
    print(f"| {' | '.join(cells)} |", flush=True)


def main() -> None:
    """Print the table."""
    heads = (
        "field, deg", "limit, G", "guide stars", "a field", "boresights", "triangles", "products",
        "build, s", "GiB", "clean, %", "hard, %", "numpy, ms", "C, ms", "clean, no mag.",
        "hard, no mag.", "numpy, ms", "C, ms", "wrong",
    )  # fmt: skip
    print("\nFields of view, each with what `starcat init` chooses (1280 x 960 px)")
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    for fov_deg in FIELDS_DEG:
        done = subprocess.run(
            [sys.executable, __file__, str(fov_deg)], capture_output=True, text=True, check=True
        )
        print_row(fov_deg, json.loads(done.stdout))


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(measure(float(sys.argv[1]))))
    else:
        main()
