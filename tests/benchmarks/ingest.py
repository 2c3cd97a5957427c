"""Ingest of full-size files beside the fastest bare parser of the same files.

Each measurement is a fresh process; seconds exclude imports, memory is the process's peak.
Run with ``make bench``; a first argument ``--runs N`` sets the repeats (default 3).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from synthetic import make_sao, make_tycho2

CHILD = """
import json, resource, sys, time
sys.path.insert(0, {here!r})
from pathlib import Path
import bare_parsers, pyarrow.parquet
from starcat.catalog.ingest import ingest, write_star_tables
paths = [Path(p) for p in {paths!r}]
files = [f for p in paths for f in (sorted(p.iterdir()) if p.is_dir() else [p])]
start = time.perf_counter()
if {what!r} == "ingest":
    read = ingest({source!r}, paths, epoch_jyear=2026.0)
    rows = read.rows_read
    write_star_tables(read, Path({out!r}))
else:
    rows = getattr(bare_parsers, {what!r})(files, {source!r})
seconds = time.perf_counter() - start
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps([rows, seconds, peak]))
"""


def measure(what: str, source: str, path: Path, scratch: Path) -> tuple[int, float, float]:
    """Run one measurement in a fresh process; return rows, seconds and peak MiB."""
    code = CHILD.format(
        here=str(Path(__file__).parent),
        paths=[str(path)],
        what=what,
        source=source,
        out=str(scratch / "out.parquet"),
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    rows, seconds, peak = json.loads(done.stdout.splitlines()[-1])
    return rows, seconds, peak


def compare(title: str, source: str, path: Path, bare: list[str], runs: int, limit: float) -> None:
    """Measure ingest and the bare parsers in turn and print the medians."""
    scratch = path.parent
    seen: dict[str, list[tuple[int, float, float]]] = {}
    for _ in range(runs):
        for what in ("ingest", *bare):
            seen.setdefault(what, []).append(measure(what, source, path, scratch))
    best = {what: min(run[1] for run in done) for what, done in seen.items()}
    fastest = min(best[what] for what in bare)
    print(f"\n{title}")
    for what, done in seen.items():
        rows, peak = done[0][0], max(run[2] for run in done)
        spread = "-".join(f"{s:.2f}" for s in sorted(run[1] for run in done)[:: max(1, runs - 1)])
        ratio = best[what] / fastest
        print(
            f"  {what:<18}{rows:>10,} rows {best[what]:>7.2f} s ({spread}) {peak:>7.0f} MiB "
            f"{ratio:>6.2f} x fastest bare" + (f"  (limit {limit} x)" if what == "ingest" else "")
        )


def main() -> None:
    """Make the files, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=3)
    runs = parser.parse_args().runs
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        compare("SAO, 258,997 records", "sao", make_sao(root), ["numpy_slices"], runs, 2.0)
        bare = ["pyarrow_csv", "numpy_slices"]
        for compressed in (True, False):
            form = "compressed" if compressed else "plain"
            made = make_tycho2(root / form, compress=compressed)
            compare(f"Tycho-2, 20 {form} parts", "tycho2", made, bare, runs, 2.5)
        together = root / "one" / "tyc2.dat"
        together.parent.mkdir()
        with together.open("wb") as file:
            for part in sorted((root / "plain").glob("tyc2.dat.*")):
                file.write(part.read_bytes())
        compare("Tycho-2, one plain file", "tycho2", together, bare, 1, 2.5)


if __name__ == "__main__":
    main()
