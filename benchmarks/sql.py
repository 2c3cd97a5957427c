"""SQL over the tables of gaia-12deg at G <= 8, against plain DuckDB on the same Parquet files.

Run with ``make bench``. Required: the same answers, at most 1.2 times the time of plain DuckDB, and
half a second to start. If ``STARCAT_STORE`` is the folder of a catalog store, places in it are
timed too. Required there, with 47 million rows: at most 60 ms for a cone of 1 degree after opening.
"""

from __future__ import annotations

import os
import re
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import duckdb
from rows import Options, Rows, ended, fresh

from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.ingest import ingest_catalog
from starcat.pipeline.recipes import make_product, product_inputs, tile_guide_stars
from starcat.pipeline.selection.selecting import select_guide_stars
from starcat.pipeline.specs.reading import preset, spec_from_dict
from starcat.query.session import Session, open_session
from starcat.storage.parquet import write_parquet

MAX_RATIO, MAX_START_S, MAX_CONE_MS = 1.2, 0.5, 60.0
"""The measured queries."""
SHORT = 7
"""So many times as many rounds for a query that takes some milliseconds."""
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


def make_tables(folder: Path, limit_mag: float) -> tuple[Path, Path]:
    """Write the stars and the pairs; return their files."""
    content = preset("gaia-12deg").model_dump(mode="json")
    content["selection"]["faint_limit_mag"] = limit_mag
    spec = spec_from_dict(content, "bench")
    read = ingest_catalog("gaia", [embedded_sky()], epoch_jyear=spec.epoch_jyear)
    stars = select_guide_stars(read.stars, spec.selection).guide_stars
    given = product_inputs(stars, tile_guide_stars(stars, spec), spec)
    paths = folder / "stars.parquet", folder / "pairs.parquet"
    write_parquet(stars, paths[0])
    write_parquet(make_product("pairs", given).table, paths[1])
    return paths


def side_by_side(
    name: str, ours: Callable[[], object], plain: Callable[[], object], rounds: int
) -> float:
    """Time two ways in turn; print the median of each and their ratio, and return it."""
    if ours() != plain():
        raise ValueError("the answers differ")
    times: dict[str, list[float]] = {"starcat": [], "plain": []}
    for _ in range(rounds):
        for way, run in (("starcat", ours), ("plain", plain)):
            start = time.perf_counter()
            run()
            times[way].append(time.perf_counter() - start)
    own, bare = (sorted(times[way])[rounds // 2] for way in ("starcat", "plain"))
    print(f"{name:<24}{1e3 * own:10.1f} ms{1e3 * bare:10.1f} ms{own / bare:8.2f}")
    return own / bare


def start_up(stars: Path, rounds: int) -> float:
    """Print what a query of the command line takes from start to end; return the seconds."""
    ways = {
        "starcat sql": ["-m", "starcat", "sql", str(stars), "SELECT 1"],
        "import duckdb": ["-c", "import duckdb"],
        "python alone": ["-c", ""],
    }
    print(f"\n{'start-up':<24}{'median':>13}")
    medians = []
    for name, arguments in ways.items():
        times = []
        for _ in range(rounds):
            start = time.perf_counter()
            fresh(*arguments)
            times.append(time.perf_counter() - start)
        medians.append(sorted(times)[rounds // 2])
        print(f"{name:<24}{1e3 * medians[-1]:10.0f} ms")
    return medians[0]


def rows_of(session: Session, text: str) -> list[tuple[object, ...]]:
    with session.ask(text) as answer:
        return answer.rows(1 << 30)


def plain_rows(connection: duckdb.DuckDBPyConnection, text: str) -> list[tuple[object, ...]]:
    return connection.execute(text).fetchall()


def places_in_a_store(folder: str, rounds: int) -> float:
    """Print times and bytes read of a store, for opening and for places; return ms of a cone."""
    start = time.perf_counter()
    with open_session([folder]) as session:
        opened_s = time.perf_counter() - start
        [(count,)] = rows_of(session, "SELECT count(*) FROM stars")
        files = len(session.views[0].paths)
        print(f"\n{count:,} rows in {files:,} files, opened in {opened_s:.2f} s")
        print(f"{'':<24}{'first':>13}{'median':>13}{'files':>12}{'rows':>10}")
        medians = []
        for name, text in STORE_PLACES.items():
            times = []
            for _ in range(rounds):
                start = time.perf_counter()
                found = rows_of(session, text)
                times.append(1e3 * (time.perf_counter() - start))
            [(_, plan)] = rows_of(session, f"EXPLAIN {text}")
            read = re.search(r"Scanning Files: (\d+)/", plan)
            medians.append(sorted(times)[rounds // 2])
            print(
                f"{name:<24}{times[0]:10.1f} ms{medians[-1]:10.1f} ms"
                f"{read[1] if read else files:>6}/{files:<5}{len(found):>10,}"
            )
    return medians[0]


def main(rows: Rows) -> None:
    """Make the tables, ask both ways, print."""
    options = Options(__doc__)
    options.size("--rounds", 15, 1, "repeats of each query")
    options.size("--limit-mag", 8.0, 6.0, "of the stars")
    given = options.asked()

    def judge(name: str, measured: float, most: float) -> None:
        rows.expect(given.quick or measured <= most, f"{name}: {measured:.2f}, asked {most:g}")

    with tempfile.TemporaryDirectory() as folder:
        stars, pairs = make_tables(Path(folder), given.limit_mag)
        with open_session([str(stars), str(pairs)]) as session, duckdb.connect() as connection:

            def compare(name: str, text: str, bare: str, rounds: int) -> None:
                ours, plain = partial(rows_of, session, text), partial(plain_rows, connection, bare)
                with rows.row(name):
                    judge(f"{name}, x plain", side_by_side(name, ours, plain, rounds), MAX_RATIO)

            [(count,)] = plain_rows(connection, f"SELECT count(*) FROM '{pairs}'")
            size_mib = pairs.stat().st_size / 2**20
            print(f"gaia-12deg at G <= {given.limit_mag:g}: {count:,} pairs, {size_mib:.0f} MiB")
            print(f"{'':<24}{'starcat sql':>13}{'plain':>13}{'ratio':>8}")
            bare = PLAIN_CONE.format(*PLACE).format(stars=f"'{stars}'")
            compare("cone of 10 deg", CONE.format(*PLACE), bare, SHORT * given.rounds)
            groups = GROUPS.format(pairs="b.pairs"), GROUPS.format(pairs=f"'{pairs}'")
            compare("group-by over pairs", *groups, given.rounds)
        with rows.row("start-up"):
            judge("start-up, s", start_up(stars, given.rounds), MAX_START_S)
    if store := os.environ.get("STARCAT_STORE"):
        with rows.row("places in a store"):
            judge("cone of a store, ms", places_in_a_store(store, given.rounds), MAX_CONE_MS)
    else:
        print("\nSTARCAT_STORE is not set: places in a store are not timed")


if __name__ == "__main__":
    ended(main)
