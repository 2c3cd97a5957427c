"""SQL over the tables of gaia-12deg at G <= 8, beside plain DuckDB on the same Parquet files.

Run with ``make bench``. Asked: at most 1.2 times plain DuckDB, and half a second to start. Where
``STARCAT_STORE`` is the folder of a catalog store, places in it are timed too. Asked there, of 47
million rows: at most 60 ms for a cone of 1 degree after opening.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import duckdb

from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.ingest import ingest
from starcat.catalog.selection import select_guide_stars
from starcat.catalog.stars import directions_of
from starcat.pipeline.recipes import ProductInputs, make_product, tile_guide_stars
from starcat.query.session import Session, open_session
from starcat.specs.reading import preset, spec_from_dict
from starcat.storage.parquet import write_parquet

LIMIT_MAG = 8.0
ROUNDS = 15
ROUNDS_SHORT = 101
"""Of a query that takes some milliseconds."""
PLACE = (83.6, -5.4, 10.0)

GROUPS = """
SELECT floor(degrees(separation_rad)) AS from_deg, count(*) AS pairs,
    min(separation_rad) AS least_rad
FROM {pairs} GROUP BY from_deg ORDER BY from_deg"""

CONE = "SELECT star_id, mag, separation_deg FROM a.cone({0}, {1}, {2}) ORDER BY separation_deg"

PLAIN_CONE = """
SELECT star_id, mag, degrees(atan2(
    sqrt(
        power(cos(radians(dec_deg)) * sin(radians(ra_deg - {0})), 2)
        + power(cos(radians({1})) * sin(radians(dec_deg))
            - sin(radians({1})) * cos(radians(dec_deg)) * cos(radians(ra_deg - {0})), 2)
    ),
    sin(radians({1})) * sin(radians(dec_deg))
        + cos(radians({1})) * cos(radians(dec_deg)) * cos(radians(ra_deg - {0}))
)) AS separation_deg
FROM {{stars}}
WHERE dec_deg BETWEEN {1} - {2} AND {1} + {2} AND separation_deg <= {2}
ORDER BY separation_deg"""

STORE_PLACES = {
    "cone of 1 deg": "SELECT star_id, mag, separation_deg FROM cone(83.6, -5.4, 1)",
    "cone at a pole": "SELECT star_id, mag, separation_deg FROM cone(0, 90, 1)",
    "cone at RA 0": "SELECT star_id, mag, separation_deg FROM cone(0, 41.81, 1)",
    "field of 8 x 6 deg": "SELECT count(*) FROM field(83.6, -5.4, 30, 8, 6)",
    "box of 2 x 2 deg": "SELECT count(*) FROM box(359, 1, 40, 42)",
}


def make_tables(folder: Path) -> tuple[Path, Path]:
    """Write the stars and the pairs; return their files."""
    content = preset("gaia-12deg").model_dump(mode="json")
    content["selection"]["faint_limit_mag"] = LIMIT_MAG
    spec = spec_from_dict(content, "bench")
    read = ingest("gaia", [embedded_sky()], epoch_jyear=spec.epoch_jyear)
    stars = select_guide_stars(read.stars, spec.selection).guide_stars
    given = ProductInputs(directions_of(stars), tile_guide_stars(stars, spec), spec)
    paths = folder / "stars.parquet", folder / "pairs.parquet"
    write_parquet(stars, paths[0])
    write_parquet(make_product("pairs", given).table, paths[1])
    return paths


def side_by_side(
    name: str, ours: Callable[[], object], plain: Callable[[], object], rounds: int
) -> None:
    """Time two ways in turn; print the median of each and their ratio."""
    assert ours() == plain(), f"{name}: the answers differ"
    times: dict[str, list[float]] = {"starcat": [], "plain": []}
    for _ in range(rounds):
        for way, run in (("starcat", ours), ("plain", plain)):
            start = time.perf_counter()
            run()
            times[way].append(time.perf_counter() - start)
    own, bare = (sorted(times[way])[rounds // 2] for way in ("starcat", "plain"))
    print(f"{name:<24}{1e3 * own:10.1f} ms{1e3 * bare:10.1f} ms{own / bare:8.2f}")


def start_up(stars: Path) -> None:
    """Print what a query of the command line takes from start to end."""
    ways = {
        "starcat sql": ["-m", "starcat", "sql", str(stars), "SELECT 1"],
        "import duckdb": ["-c", "import duckdb"],
        "python alone": ["-c", ""],
    }
    print(f"\n{'start-up':<24}{'median':>13}")
    for name, arguments in ways.items():
        times = []
        for _ in range(ROUNDS):
            start = time.perf_counter()
            subprocess.run([sys.executable, *arguments], check=True, capture_output=True)
            times.append(time.perf_counter() - start)
        print(f"{name:<24}{1e3 * sorted(times)[ROUNDS // 2]:10.0f} ms")


def rows_of(session: Session, text: str) -> list[tuple[object, ...]]:
    with session.ask(text) as answer:
        return answer.rows(1 << 30)


def places_in_a_store(folder: str) -> None:
    """Print what opening a store and places in it take, and the files that are read."""
    start = time.perf_counter()
    with open_session([folder]) as session:
        opened_s = time.perf_counter() - start
        [(count,)] = rows_of(session, "SELECT count(*) FROM stars")
        files = len(session.views[0].paths)
        print(f"\n{count:,} rows in {files:,} files, opened in {opened_s:.2f} s")
        print(f"{'':<24}{'first':>13}{'median':>13}{'files':>12}{'rows':>10}")
        for name, text in STORE_PLACES.items():
            times = []
            for _ in range(ROUNDS):
                start = time.perf_counter()
                found = rows_of(session, text)
                times.append(1e3 * (time.perf_counter() - start))
            [(_, plan)] = rows_of(session, f"EXPLAIN {text}")
            read = re.search(r"Scanning Files: (\d+)/", plan)
            print(
                f"{name:<24}{times[0]:10.1f} ms{sorted(times)[ROUNDS // 2]:10.1f} ms"
                f"{read[1] if read else files:>6}/{files:<5}{len(found):>10,}"
            )


def main() -> None:
    """Make the tables, ask both ways, print."""
    with tempfile.TemporaryDirectory() as folder:
        stars, pairs = make_tables(Path(folder))
        with open_session([str(stars), str(pairs)]) as session, duckdb.connect() as connection:

            def ours(text: str) -> Callable[[], object]:
                return lambda: rows_of(session, text)

            def plain(text: str) -> Callable[[], object]:
                return lambda: connection.execute(text).fetchall()

            [(count,)] = connection.execute(f"SELECT count(*) FROM '{pairs}'").fetchall()
            size_mib = pairs.stat().st_size / 2**20
            print(f"gaia-12deg at G <= {LIMIT_MAG:g}: {count:,} pairs, {size_mib:.0f} MiB")
            print(f"{'':<24}{'starcat sql':>13}{'plain':>13}{'ratio':>8}")
            bare = PLAIN_CONE.format(*PLACE).format(stars=f"'{stars}'")
            cone = CONE.format(*PLACE)
            side_by_side("cone of 10 deg", ours(cone), plain(bare), ROUNDS_SHORT)
            group = GROUPS.format(pairs="b.pairs"), GROUPS.format(pairs=f"'{pairs}'")
            side_by_side("group-by over pairs", ours(group[0]), plain(group[1]), ROUNDS)
        start_up(stars)
    if store := os.environ.get("STARCAT_STORE"):
        places_in_a_store(store)


if __name__ == "__main__":
    main()
