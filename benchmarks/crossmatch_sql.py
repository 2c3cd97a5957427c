"""A crossmatch in SQL between two stores, compared with pyacid on the same stores in the same run.

Both find all pairs within a radius, with their separations. The pairs have to equal the result of
astropy's ``search_around_sky``. Each program runs in its own process; the time is the best of some
rounds from the query to the answer, after opening. Memory is the sum of the peaks of its
processes.

pyacid is not a dependency of starcat: ``pip install pyacid==0.6.1`` in this environment, or
``--peer PYTHON`` for the Python of another environment that has it.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rows import LackingError, Options, Rows, ended, fresh

RADIUS_ARCSEC = 2.0

_MAP = """name = "{name}"
frame = "ICRS"
epoch = 2000.0
[columns]
star_id = "number"
ra = {{ value = "ra", unit = "deg" }}
dec = {{ value = "dec", unit = "deg" }}
[magnitudes]
V = "mag"
"""


def main(rows: Rows) -> None:
    """Print a row for each pair of stores."""
    options = Options(__doc__)
    options.size("--sky", 482_176, 20_000, "stars of the sky")
    options.size("--dense", 2_000_000, 40_000, "stars of each of two catalogs around a pole")
    options.size("--rounds", 3, 1, "rounds")
    options.add_argument("--peer", default=sys.executable, help="Python that has pyacid")
    asked = options.asked()
    cases = {
        "embedded sky x 300,000": (embedded(asked.sky), disturbed(embedded(asked.sky), 300_000)),
        "pole x pole": (pole(asked.dense, 1), disturbed(pole(asked.dense, 1), asked.dense)),
    }
    for name, (one, two) in cases.items():
        with tempfile.TemporaryDirectory() as scratch, rows.row(name):
            folder = Path(scratch)
            for label, places in (("one", one), ("two", two)):
                make_store(folder, label, places)
            expected = astropy_pairs(one, two)
            print(f"{name}: {len(one):,} x {len(two):,} stars, {len(expected):,} pairs", flush=True)
            for program, python in (("starcat", sys.executable), ("pyacid", asked.peer)):
                with rows.row(f"{name}, {program}"):
                    told = run(python, program, folder, asked.rounds)
                    found = pq.read_table(folder / f"{program}.parquet")
                    same = set(zip(*(found[k].to_pylist() for k in "ij"), strict=True))
                    is_same = same == expected and len(found) == len(expected)
                    rows.expect(is_same or program != "starcat", f"{name}: other pairs")
                    print(
                        f"  {program:8} {told['best_s']:7.2f} s  {told['memory_mb']:6.0f} MB  "
                        f"{len(found):,} pairs, {'those' if is_same else 'NOT those'} of astropy",
                        flush=True,
                    )


def embedded(count: int) -> np.ndarray:
    """Return places of the embedded sky, the brightest first."""
    from starcat.catalog.archives.gaia import embedded_sky
    from starcat.catalog.ingest import ingest_catalog

    stars = ingest_catalog("gaia", [embedded_sky()], neighbours=False).stars
    stars = stars.sort_by("mag").slice(0, count)
    return np.column_stack([stars["ra_deg"].to_numpy(), stars["dec_deg"].to_numpy()])


def pole(count: int, seed: int) -> np.ndarray:
    """Return places within 15 degrees of the north pole, evenly spread."""
    generator = np.random.default_rng(seed)
    height = generator.uniform(np.cos(np.radians(15.0)), 1.0, count)
    return np.column_stack([generator.uniform(0.0, 360.0, count), np.degrees(np.arcsin(height))])


def disturbed(places: np.ndarray, count: int) -> np.ndarray:
    """Return half as many of some places, half an arcsecond off, and as many near others."""
    generator = np.random.default_rng(9)
    own = generator.permutation(places)[: count // 2]
    near = own + generator.normal(scale=0.5 / 3600.0, size=own.shape) / np.column_stack(
        [np.maximum(np.cos(np.radians(own[:, 1])), 1e-3), np.ones(len(own))]
    )
    far = generator.permutation(places)[: count - count // 2]
    far = far + generator.uniform(-0.05, 0.05, far.shape)
    found = np.concatenate([near, far])
    return np.column_stack([np.mod(found[:, 0], 360.0), np.clip(found[:, 1], -90.0, 90.0)])


def make_store(folder: Path, name: str, places: np.ndarray) -> None:
    """Write places as a table, and make a HATS store with margins of it as ``ingest`` does."""
    number = np.arange(len(places))
    table = {"number": number, "ra": places[:, 0], "dec": places[:, 1], "mag": number * 0.0 + 9.0}
    pq.write_table(pa.table(table), folder / f"{name}.parquet")
    (folder / f"{name}.toml").write_text(_MAP.format(name=name))
    fresh(
        *("-m", "starcat", "ingest", folder / f"{name}.toml", "--input"),
        *(folder / f"{name}.parquet", "--to", "hats", "-o", folder / "hats" / name),
    )


def astropy_pairs(one: np.ndarray, two: np.ndarray) -> set[tuple[int, int]]:
    """Return the pairs within the radius."""
    import astropy.units as u
    from astropy.coordinates import SkyCoord

    skies = [SkyCoord(*places.T, unit="deg") for places in (one, two)]
    i, j, _, _ = skies[1].search_around_sky(skies[0], RADIUS_ARCSEC * u.arcsec)
    return set(zip(i.tolist(), j.tolist(), strict=True))


def run(python: str, program: str, folder: Path, rounds: int) -> dict[str, float]:
    """Run a program of this file in a process of its own."""
    import subprocess

    if python == sys.executable and program == "pyacid" and find_spec("acid") is None:
        raise LackingError("pyacid is not installed; pip install pyacid==0.6.1, or --peer PYTHON")
    command = [python, __file__, "--program", program, str(folder), str(rounds)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr.strip()[-300:] or "nothing")
    told: dict[str, float] = json.loads(done.stdout.strip().split("\n")[-1])
    return told


def with_starcat(folder: Path, timed: Callable[[Callable[[], pa.Table]], None]) -> None:
    """Ask starcat."""
    from starcat.query.session import Limits, open_session

    text = (
        "SELECT a_star_id AS i, b_star_id AS j, separation_arcsec AS d "
        f"FROM crossmatch('one', 'two', {RADIUS_ARCSEC}, epoch := NULL)"
    )
    given = [str(folder / "hats" / name) for name in ("one", "two")]
    with open_session(given, Limits(time_s=600.0, memory_gb=8.0)) as session:

        def asked() -> pa.Table:
            with session.ask(text) as answer:
                return answer.batches().read_all()

        timed(asked)


def with_pyacid(folder: Path, timed: Callable[[Callable[[], pa.Table]], None]) -> None:
    """Ask pyacid, with two workers."""
    # The stores have the map of their rows as skymap.fits, which it does not know.
    os.environ["ACID_WORK_AUTOSIZE"] = "0"
    import acid

    text = (
        "SELECT a.star_id AS i, b.star_id AS j, d FROM one AS a JOIN two AS b ON "
        f"XMATCH(radius_arcsec => {RADIUS_ARCSEC}, mode => 'all', dist_col => 'd')"
    )
    known = "".join(f"  {k}: {{path: {folder}/hats/{k}}}\n" for k in ("one", "two"))
    (folder / "catalogs.yaml").write_text(f"catalogs:\n{known}")
    with acid.Connection(str(folder / "catalogs.yaml"), workers=2, progress=False) as database:
        timed(lambda: database.sql(text).to_arrow())


def serve(program: str, folder: Path, rounds: int) -> None:
    """Time one program in this process, and write the pairs that it finds."""
    times: list[float] = []
    memory_mb = [0.0]

    def timed(ask: Callable[[], pa.Table]) -> None:
        for _ in range(rounds):
            start = time.perf_counter()
            table = ask()
            times.append(time.perf_counter() - start)
        memory_mb[:] = [largest_mb()]
        pq.write_table(table, folder / f"{program}.parquet")

    {"starcat": with_starcat, "pyacid": with_pyacid}[program](folder, timed)
    print(json.dumps({"best_s": min(times), "memory_mb": memory_mb[0]}))


def largest_mb() -> float:
    """Return what this process and its children had in memory at most, each at its own time."""
    status = {}
    for path in Path("/proc").glob("[0-9]*/status"):
        with suppress(OSError):
            lines = (line.split(":", 1) for line in path.read_text().splitlines())
            status[int(path.parent.name)] = dict(lines)
    own, found = {os.getpid()}, -1
    while found != len(own):
        found = len(own)
        own |= {pid for pid, told in status.items() if int(told["PPid"]) in own}
    return sum(int(status[pid].get("VmHWM", "0 kB").split()[0]) for pid in own) / 1024.0


if __name__ == "__main__":
    if sys.argv[1:2] == ["--program"]:
        serve(sys.argv[2], Path(sys.argv[3]), int(sys.argv[4]))
    else:
        ended(main)
