"""Whole archives compared with the fastest bare parse of the same parts: time, CPU and memory.

`twomass_parts` makes the parts, or they are given as a folder. Each case is a separate command; its
memory is the sum over its processes, sampled every 50 ms, and its CPU time the sum over them. The
bare parse is zlib and pyarrow's CSV reader with the used columns typed, one process per worker.
Wall times are meaningful only on a quiet machine; CPU times of the same run can be compared on any
machine. The case hats-import, in its own environment, runs only if it is named. The benchmark
fails if a case fails, or if the build from the store has other guide stars than the build from the
parts.

    python benchmarks/scale.py --rows 5000000
    python benchmarks/scale.py --parts FOLDER --cases bare build
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
import zlib
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import peers
import pyarrow as pa
from pyarrow import csv
from rows import Options, Rows, ended, need
from twomass_parts import write_parts

SAMPLE_S = 0.05
ARCHIVE_ROWS = 470_992_970


@dataclass(frozen=True)
class Measured:
    """What a command took."""

    seconds: float
    cpu_s: float
    peak_mib: float
    out: str


def tree(root: int) -> list[int]:
    """Return a process and all that it has started, by number."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                status = (entry / "stat").read_text()
            except OSError:  # it has ended
                continue
            parent = int(status.rpartition(")")[2].split()[1])
            children.setdefault(parent, []).append(int(entry.name))
    found = [root]
    for process in found:
        found += children.get(process, [])
    return found


def resident_mib(processes: list[int]) -> float:
    """Return the memory that processes hold together."""
    pages = 0
    for process in processes:
        try:
            pages += int(Path(f"/proc/{process}/statm").read_text().split()[1])
        except (OSError, IndexError):
            continue
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def measure(command: list[str]) -> Measured:
    """Run a command to its end."""
    before, began, peak = os.times(), time.perf_counter(), 0.0
    with tempfile.TemporaryFile("w+") as out:
        running = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
        while running.poll() is None:
            peak = max(peak, resident_mib(tree(running.pid)))
            time.sleep(SAMPLE_S)
        seconds, after = time.perf_counter() - began, os.times()
        out.seek(0)
        said = out.read()
    if running.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with {running.returncode}:\n{said}")
    cpu_s = after.children_user + after.children_system
    cpu_s -= before.children_user + before.children_system
    return Measured(seconds, cpu_s, peak, said)


def bare_parse(path: Path) -> int:
    """Parse a part and drop it; return its rows."""
    from starcat.catalog.archives.twomass import COLUMNS
    from starcat.catalog.source import data_source

    [layout] = data_source("2mass").files
    used = [layout.column(name) for name in COLUMNS["psc"]]
    table = csv.read_csv(
        pa.BufferReader(zlib.decompress(path.read_bytes(), 31)),
        read_options=csv.ReadOptions(
            column_names=[column.name for column in layout.columns],
            use_threads=False,
            block_size=1 << 22,
        ),
        parse_options=csv.ParseOptions(delimiter=layout.delimiter, quote_char=False),
        convert_options=csv.ConvertOptions(
            include_columns=[column.name for column in used],
            column_types={c.name: pa.binary() if c.is_text else pa.float64() for c in used},
            null_values=["", r"\N"],
            strings_can_be_null=True,
            check_utf8=False,
        ),
    )
    return len(table)


def bare(folder: Path, workers: int) -> int:
    """Parse all parts of a folder; return their rows."""
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        return sum(pool.map(bare_parse, sorted(folder.glob("psc_*.gz"))))


@dataclass(frozen=True)
class Given:
    """What the cases are run on."""

    parts: Path
    rows: int
    scratch: Path
    store: Path
    workers: int


def commands(given: Given) -> dict[str, list[str]]:
    """Return the commands, by name; each is compared with the first that is run.

    A store is of the preset's band; a build has as many guide stars as from the whole archive.
    """
    faint_limit_mag = 4.4 + 2.5 * math.log10(ARCHIVE_ROWS / given.rows)
    starcat, workers = [sys.executable, "-m", "starcat"], ["--workers", str(given.workers)]
    ingest = [*starcat, "ingest", "2mass", "--to", "hats", "--band", "(J+H)/2", "--replace"]
    build = [
        *(*starcat, "build", "--preset", "2mass-8x6", "--set", "self_test.min_identified=0"),
        *("--set", f"selection.faint_limit_mag={faint_limit_mag:.2f}"),
        *("--set", f"catalog.read_limit_mag={max(8.0, faint_limit_mag + 1.0):.2f}"),
        *("-o", str(given.scratch / "built"), "--replace", *workers, "--input"),
    ]
    return {
        "bare": [sys.executable, __file__, "--bare", "--parts", str(given.parts), *workers],
        "store": [*ingest, "--input", str(given.parts), "-o", str(given.store), *workers],
        "build": [*build, f"2mass={given.parts}"],
        "from-store": [*build, f"2mass={given.store}"],
    }


def hats_import(given: Given) -> list[str]:
    """Return the command of hats-import, in an environment of its own, for the same columns."""
    from starcat.catalog.archives.twomass import COLUMNS
    from starcat.catalog.source import data_source

    [layout] = data_source("2mass").files
    used = {n: "str" if layout.column(n).is_text else "float64" for n in COLUMNS["psc"]}
    columns = json.dumps([[column.name for column in layout.columns], used])
    python, peer = peers.environment("hats-import"), Path(__file__).with_name("hats_peer.py")
    folder = given.scratch / "hats-import"
    return [python, *map(str, (peer, given.parts, folder, given.workers)), columns]


CASES = ("bare", "store", "build", "from-store", "hats-import")


def guide_stars_of(folder: Path) -> str:
    """Return the digest of the guide stars that a build has written."""
    [manifest] = (folder / "built").glob("*/manifest.json")
    return str(json.loads(manifest.read_text())["products"]["stars"]["content_sha256"])


def main(rows: Rows) -> None:
    """Make the parts, run the cases in turn and print what they took."""
    options = Options(__doc__)
    options.size("--rows", 5_000_000, 200_000, "of the parts, given or made")
    options.add_argument("--parts", type=Path, help="a folder of parts that are there already")
    options.add_argument("--store", type=Path, help="where the store is, or is made and left")
    options.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES[:-1]))
    options.add_argument("--workers", type=int, default=2)
    options.add_argument("--runs", type=int, default=1)
    options.add_argument("--bare", action="store_true", help=argparse.SUPPRESS)
    asked = options.asked()
    if asked.bare:
        print(bare(asked.parts, asked.workers))
        return
    need("distributed", "cdshealpix")
    with tempfile.TemporaryDirectory() as folder:
        scratch, parts = Path(folder), asked.parts
        if parts is None:
            parts = scratch / "parts"
            write_parts(parts, asked.rows, asked.workers)
        given = Given(parts, asked.rows, scratch, asked.store or scratch / "store", asked.workers)
        print(f"{asked.rows:,} rows in {len(list(parts.glob('psc_*.gz')))} parts")
        first: Measured | None = None
        made: set[str] = set()
        for name in asked.cases * asked.runs:
            with rows.row(name):
                is_peer = name == "hats-import"
                took = measure(hats_import(given) if is_peer else commands(given)[name])
                first = first or took
                print_times(name, took, first, given)
                if name == "bare" and asked.parts is None and int(took.out) != asked.rows:
                    raise ValueError(f"{int(took.out):,} records read")
                if name in ("build", "from-store"):
                    made.add(guide_stars_of(scratch))
        rows.expect(len(made) < 2, "the build from the store has other guide stars")


def print_times(name: str, took: Measured, first: Measured, given: Given) -> None:
    """Print the row of a case."""
    times = took.seconds / first.seconds, took.cpu_s / first.cpu_s
    print(
        f"  {name:<10}{took.seconds:>8.1f} s {took.cpu_s:>8.1f} s CPU"
        f"{1e6 * took.cpu_s / given.rows:>7.2f} us CPU a row {took.peak_mib:>7.0f} MiB"
        f"{times[0]:>7.2f} x time {times[1]:>6.2f} x CPU of the first",
        flush=True,
    )


if __name__ == "__main__":
    ended(main)
