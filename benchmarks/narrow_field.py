"""A field of 2 degrees with stars as dense as Tycho-2: the first answer of a process.

The catalog is made from a seed: 1.87 million stars to VT 12.1, as many up to each magnitude as
Tycho-2 has, and denser near the galactic plane. Its database has triangles alone, as 'starcat init'
proposes for such a field. Each row is a process of its own: it opens the database and identifies
one frame, first without search tables kept by a process before it, then with them.

Run: python benchmarks/narrow_field.py [--folder FOLDER]; a folder keeps the database for later runs
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rows import Options, Rows, ended

from starcat.catalog.source import give_map
from starcat.database.products.table import USUAL_PRODUCTS
from starcat.geometry.sphere import radec_from_directions
from starcat.pipeline.build import build
from starcat.pipeline.specs.reading import spec_from_dict

STARS = 1_870_000
COUNTS = ((1.0, 12), (6.0, 5.0e3), (8.0, 4.1e4), (10.0, 3.26e5), (11.0, 8.50e5), (12.1, 1.87e6))
"""Number of stars up to each magnitude, as in Tycho-2."""

PLANE_DEG, CONTRAST = 12.0, 3.0
"""Scale height of the stars near the galactic plane, and their density at its middle, in units of
the density far from it."""

MAX_FIRST_S, MAX_MIB = 0.6, 250.0
"""Limits of a process that finds tables: its first answer, and all of its memory."""

GALACTIC_POLE = (-0.8676661490190047, -0.1980763734312015, 0.4559837761750669)

MAP = """name = "dense"
frame = "ICRS"
epoch = 2000.0
[columns]
star_id = "number"
ra = { value = "ra", unit = "deg" }
dec = { value = "dec", unit = "deg" }
[magnitudes]
VT = "vt"
"""

FIRST = """
import json, sys, time
began = time.process_time()
import starcat
from starcat.pipeline.simulation.simulate import Noise, simulate_frames
matcher = starcat.Matcher.open(sys.argv[1])
[frame] = simulate_frames(
    matcher.database.directions, matcher.database.camera, 1, Noise(0.3, noise_mag=0.2), 7,
    matcher.database.mag,
)
opened = time.process_time()
found = matcher.identify(frame.centroids_px, mag=frame.mag)
first = time.process_time()
matcher.identify(frame.centroids_px, mag=frame.mag)
second = time.process_time()
[peak] = [line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")]
print(json.dumps({
    "status": found.status, "open": opened - began, "first": first - opened,
    "second": second - first, "mib": int(peak) / 1024,
}))
"""


def main(rows: Rows) -> None:
    """Print a row for a process without tables, and one for a process that finds them."""
    options = Options(__doc__)
    options.size("--stars", STARS, 60_000, "stars of the catalog")
    options.size("--boresights", 30_000, 2_000, "fields of the tiling")
    options.size("--fov", 2.0, 8.0, "field of view, degrees")
    options.add_argument("--folder", type=Path, help="where catalog and database are kept")
    asked = options.asked()
    with tempfile.TemporaryDirectory() as scratch:
        folder = asked.folder or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        database = folder / "narrow-1.0.0"
        if not database.is_dir():
            with rows.row("build"):
                built = build_field(folder, asked.stars, asked.boresights, asked.fov)
                stars = built.manifest["products"]["stars"]["rows"]
                print(f"{stars:,} guide stars; seconds: {built.times_s}", flush=True)
        environment = {**os.environ, "STARCAT_CACHE": str(Path(scratch) / "cache")}
        for name in ("tables are made", "tables are kept"):
            with rows.row(name):
                ran = subprocess.run(
                    [sys.executable, "-c", FIRST, database], env=environment, check=True,
                    capture_output=True, text=True,
                )  # fmt: skip
                told = json.loads(ran.stdout)
                print(
                    f"{name:16} {told['status']}: open {told['open']:.2f} s, first identify "
                    f"{told['first']:.3f} s, second {1e3 * told['second']:.2f} ms of processor "
                    f"time; {told['mib']:.0f} MiB",
                    flush=True,
                )
                rows.expect(told["status"] == "identified", f"{name}: a right answer")
                if name == "tables are kept" and not asked.quick:
                    rows.expect(told["first"] <= MAX_FIRST_S, f"{name}: {told['first']:.2f} s")
                    rows.expect(told["mib"] <= MAX_MIB, f"{name}: {told['mib']:.0f} MiB")


def build_field(folder: Path, stars: int, boresights: int, fov_deg: float):
    """Build the database of a generated catalog."""
    make_catalog(folder, stars)
    give_map(folder / "dense.toml")
    spec = spec_from_dict(spec_of(boresights, fov_deg), "narrow")
    return build(spec, folder, inputs={"dense": [folder / "dense.parquet"]})


def spec_of(boresights: int, fov_deg: float) -> dict[str, object]:
    """Return the spec of a narrow field."""
    off = {name: {"enabled": False} for name in USUAL_PRODUCTS if name != "triangles"}
    return {
        "name": "narrow",
        "version": "1.0.0",
        "epoch_jyear": 2026.0,
        "catalog": {"source": "dense", "band": "VT"},
        "selection": {
            "faint_limit_mag": 11.0,
            "max_stars_per_field": 12,
            "doubles": {"min_separation_deg": 0.0039 * fov_deg, "max_delta_mag": 3.0},
        },
        "camera": {"width_px": 1024, "height_px": 1024, "fov_x_deg": fov_deg},
        "boresights": {"count": boresights, "brightest": 10},
        "products": off,
    }


def make_catalog(folder: Path, stars: int) -> None:
    """Write ``dense.parquet`` and its map."""
    generator = np.random.default_rng(2)
    places, pole = np.empty((0, 3)), np.array(GALACTIC_POLE)
    while len(places) < stars:
        drawn = generator.normal(size=(stars, 3))
        drawn /= np.linalg.norm(drawn, axis=1)[:, None]
        height_deg = np.abs(np.degrees(np.arcsin(drawn @ pole)))
        density = 1.0 + (CONTRAST - 1.0) * np.exp(-height_deg / PLANE_DEG)
        places = np.concatenate([places, drawn[generator.random(stars) * CONTRAST < density]])
    ra, dec = radec_from_directions(places[:stars])
    limits, counts = np.array(COUNTS).T
    rank = counts[-1] * (np.arange(stars) + 0.5) / stars
    mag = np.interp(np.log10(np.maximum(rank, counts[0])), np.log10(counts), limits)
    generator.shuffle(mag)
    table = pa.table({"number": np.arange(1, stars + 1), "ra": ra, "dec": dec, "vt": mag})
    pq.write_table(table, folder / "dense.parquet")
    (folder / "dense.toml").write_text(MAP)


if __name__ == "__main__":
    ended(main)
