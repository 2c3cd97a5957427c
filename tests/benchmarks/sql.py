"""SQL over the tables of gaia-12deg at G <= 8, beside plain DuckDB on the same Parquet files.

Run with ``make bench``. Asked: at most 1.2 times plain DuckDB, and half a second to start.
"""

from __future__ import annotations

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
from starcat.pipeline.recipes import Ingredients, cook, tile_guide_stars
from starcat.query.session import open_session
from starcat.specs.reading import preset, spec_from_dict
from starcat.tables.parquet import write_parquet

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


def make_tables(folder: Path) -> tuple[Path, Path]:
    """Write the stars and the pairs; return their files."""
    content = preset("gaia-12deg").model_dump(mode="json")
    content["selection"]["faint_limit_mag"] = LIMIT_MAG
    spec = spec_from_dict(content, "bench")
    read = ingest("gaia", [embedded_sky()], epoch_jyear=spec.epoch_jyear)
    stars = select_guide_stars(read.stars, spec.selection).guide_stars
    given = Ingredients(directions_of(stars), tile_guide_stars(stars, spec), spec)
    paths = folder / "stars.parquet", folder / "pairs.parquet"
    write_parquet(stars, paths[0])
    write_parquet(cook("pairs", given).table, paths[1])
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


def main() -> None:
    """Make the tables, ask both ways, print."""
    with tempfile.TemporaryDirectory() as folder:
        stars, pairs = make_tables(Path(folder))
        with open_session([str(stars), str(pairs)]) as session, duckdb.connect() as connection:

            def ours(text: str) -> Callable[[], object]:
                def run() -> object:
                    with session.ask(text) as answer:
                        return answer.rows(1 << 30)

                return run

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


if __name__ == "__main__":
    main()
