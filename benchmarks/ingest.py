"""Ingest of full-size files compared with the fastest bare parser of the same files.

Each measurement is a fresh process; seconds exclude imports, memory is the process's peak.
Run with ``make bench``. It fails where ingest reads another number of records or is over its limit.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rows import Options, Rows, ended, fresh, need_catalogs
from synthetic import SAO_ROWS, TYCHO2_ROWS, make_sao, make_tycho2

CHILD = """
import json, resource, sys, time
sys.path.insert(0, {here!r})
from pathlib import Path
import bare_parsers, pyarrow.parquet
from starcat.catalog.ingest import ingest_catalog, write_star_tables
paths = [Path(p) for p in {paths!r}]
files = [f for p in paths for f in (sorted(p.iterdir()) if p.is_dir() else [p])]
start = time.perf_counter()
if {what!r} == "ingest":
    read = ingest_catalog({source!r}, paths, epoch_jyear=2026.0)
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
    rows, seconds, peak = json.loads(fresh("-c", code).splitlines()[-1])
    return rows, seconds, peak


@dataclass(frozen=True)
class Files:
    """Files of an archive, and the required speed of their ingest."""

    title: str
    source: str
    path: Path
    records: int
    bare: tuple[str, ...]  # the parsers to compare with
    limit: float  # most seconds, divided by the seconds of the fastest bare parser


def compare(files: Files, runs: int) -> float:
    """Measure ingest and the bare parsers in turn, print the best; return its ratio to theirs."""
    seen: dict[str, list[tuple[int, float, float]]] = {}
    for _ in range(runs):
        for what in ("ingest", *files.bare):
            taken = measure(what, files.source, files.path, files.path.parent)
            seen.setdefault(what, []).append(taken)
    best = {what: min(run[1] for run in done) for what, done in seen.items()}
    fastest = min(best[what] for what in files.bare)
    print(f"\n{files.title}")
    for what, done in seen.items():
        rows, peak = done[0][0], max(run[2] for run in done)
        spread = "-".join(f"{s:.2f}" for s in sorted(run[1] for run in done)[:: max(1, runs - 1)])
        ratio = best[what] / fastest
        print(
            f"  {what:<18}{rows:>10,} rows {best[what]:>7.2f} s ({spread}) {peak:>7.0f} MiB "
            f"{ratio:>6.2f} x fastest bare"
            + (f"  (limit {files.limit} x)" if what == "ingest" else "")
        )
        if rows != files.records:
            raise ValueError(f"{what} read {rows:,} of {files.records:,} records")
    return best["ingest"] / fastest


def made(root: Path, sao: int, tycho2: int) -> Iterator[Files]:
    """Make the files in sequence."""
    path = make_sao(root, rows=sao)
    yield Files(f"SAO, {sao:,} records", "sao", path, sao, ("numpy_slices",), 2.0)
    bare = "pyarrow_csv", "numpy_slices"
    for form in ("compressed", "plain"):
        parts = make_tycho2(root / form, rows=tycho2, compress=form == "compressed")
        yield Files(f"Tycho-2, 20 {form} parts", "tycho2", parts, tycho2, bare, 2.5)
    together = root / "one" / "tyc2.dat"
    together.parent.mkdir()
    with together.open("wb") as file:
        for part in sorted((root / "plain").glob("tyc2.dat.*")):
            file.write(part.read_bytes())
    yield Files("Tycho-2, one plain file", "tycho2", together, tycho2, bare, 2.5)


def main(rows: Rows) -> None:
    """Make the files, measure, print."""
    options = Options(__doc__)
    options.size("--runs", 3, 1, "repeats of each measurement")
    options.size("--sao", SAO_ROWS, 5_000, "records of SAO")
    options.size("--tycho2", TYCHO2_ROWS, 20_000, "records of Tycho-2")
    given = options.asked()
    need_catalogs("sao.dat.gz", "tyc2.dat.gz")
    with tempfile.TemporaryDirectory() as folder:
        for files in made(Path(folder), given.sao, given.tycho2):
            with rows.row(files.title):
                ratio = compare(files, given.runs)
                is_fast = given.quick or ratio <= files.limit
                rows.expect(is_fast, f"{files.title}: {ratio:.2f} x, over {files.limit} x")


if __name__ == "__main__":
    ended(main)
