"""Plans against simulated frames: errors, probability of acquisition, and time.

    python benchmarks/planning.py [--attitudes 200] [--frames 30] [--long 10000]

The database is ``gaia-12deg``. At each attitude frames are simulated with 0.5 px and 0.2 mag of
noise and a magnitude limit, and identified by a matcher with the noise of a centroid stated; some
frames lack stars and have false ones. The last row plans one attitude per minute with an orbit.
"""

from __future__ import annotations

import sys
import tempfile
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from rows import Options, Rows, database, ended

import starcat
from starcat.arrays import Array
from starcat.frames.planning.plan_result import Plan
from starcat.geometry.attitude import quaternion_from_matrix, random_attitudes
from starcat.matcher.stars import ARCSEC
from starcat.pipeline.simulation.simulate import Noise, Sky, simulate_frame

NOISE_PX, NOISE_MAG, SEED = 0.5, 0.2, 38
KINDS = {  # limit of magnitudes, probability of a star to be missing, false stars
    "limit 5.0": (5.0, 0.0, 0),
    "limit 5.5": (5.5, 0.0, 0),
    "limit 5.5, 3 of 10 missing, 3 false": (5.5, 0.3, 3),
}
MAX_S = 60.0


def simulated(plan: Plan, folder: Path, frames: int, noise: Noise) -> tuple[Array, Array]:
    """Return the share of identified frames, and the errors about x, y and z, by attitude."""
    matcher = starcat.Matcher.open(folder, noise_px=NOISE_PX)
    stars = matcher.database
    sky = Sky(stars.directions, stars.mag, np.arange(len(stars.mag), dtype=np.int32))
    generator = np.random.default_rng(SEED)
    rate, error = np.zeros(len(plan)), np.full((len(plan), 3), np.nan)
    for row, matrix in enumerate(plan.attitudes.matrices):
        turns = []
        for _ in range(frames):
            frame = simulate_frame(sky, stars.camera, matrix, noise, generator)
            answer = matcher.identify(frame.centroids_px, mag=frame.mag)
            if answer.ok:
                d = answer.matrix @ matrix.T
                turns.append([d[1, 2] - d[2, 1], d[2, 0] - d[0, 2], d[0, 1] - d[1, 0]])
        rate[row] = len(turns) / frames
        if 2 * len(turns) > frames:
            error[row] = 0.5 * ARCSEC * np.sqrt(np.mean(np.square(turns), axis=0))
    return rate, error


def orbit_table(times: list[datetime]) -> dict[str, object]:
    """Return a circular orbit of 7,000 km and 98 deg."""
    angle = 1.078e-3 * 60.0 * np.arange(len(times))
    c, s, tilt = np.cos(angle), np.sin(angle), np.radians(98.0)
    place = 7000.0 * np.array([c, s * np.cos(tilt), s * np.sin(tilt)])
    speed = 7.546 * np.array([-s, c * np.cos(tilt), c * np.sin(tilt)])
    names = ("x_km", "y_km", "z_km", "vx_km_s", "vy_km_s", "vz_km_s")
    return {"time": times, **dict(zip(names, (*place, *speed), strict=True))}


def main(rows: Rows) -> None:
    """Print the figures of the plans."""
    options = Options(__doc__)
    options.size("--attitudes", 200, 10, "attitudes of each kind")
    options.size("--frames", 30, 10, "frames of each attitude")
    options.size("--long", 10_000, 200, "attitudes of the row that measures time")
    asked = options.asked()
    with tempfile.TemporaryDirectory() as place:
        folder = database("gaia-12deg", Path(place)).folder
        generator = np.random.default_rng(SEED)
        turned = random_attitudes(asked.attitudes, generator)
        q = np.array([quaternion_from_matrix(matrix) for matrix in turned])
        for name, (limit, drop, false) in KINDS.items():
            with rows.row(name):
                plan = starcat.plan(
                    folder, q, noise_px=NOISE_PX, noise_mag=NOISE_MAG, limit_mag=limit,
                    drop_probability=drop, false_stars=false,
                )  # fmt: skip
                noise = Noise(NOISE_PX, drop, false, noise_mag=NOISE_MAG, limit_mag=limit)
                rate, error = simulated(plan, folder, asked.frames, noise)
                apart = 100.0 * (plan.acquisition.mean() - rate.mean())
                ratio = np.nanmedian(error / plan.error_arcsec, axis=0)
                print(
                    f"{name}: acquisition planned {100 * plan.acquisition.mean():.1f} %, simulated "
                    f"{100 * rate.mean():.1f} %; error simulated over planned (median) "
                    f"{', '.join(f'{one:.3f}' for one in ratio)}"
                )
                if not asked.quick:
                    rows.expect(abs(apart) <= 3.0, f"{name}: acquisition is off by {apart:.1f}")
                    rows.expect(bool(np.all(np.abs(ratio - 1.0) <= 0.1)), f"{name}: error {ratio}")
        with rows.row("time"):
            start = datetime(2027, 3, 1, tzinfo=UTC)
            times = [start + timedelta(minutes=k) for k in range(asked.long)]
            many = generator.normal(size=(asked.long, 4))
            many /= np.linalg.norm(many, axis=1)[:, None]
            before = time.process_time()
            table = {"time": times, "q_body_from_icrs": many}
            limits = {"Sun": 30.0, "Moon": 15.0, "Earth": 20.0}
            made = starcat.plan(folder, table, orbit=orbit_table(times), keep_out_deg=limits)
            gone = time.process_time() - before
            print(f"{len(made):,} attitudes with an orbit: {gone:.1f} s of processor time")
            if not asked.quick:
                rows.expect(gone <= MAX_S, f"{len(made):,} attitudes take {gone:.1f} s")


if __name__ == "__main__":
    sys.exit(ended(main))
