"""Parts of the 2MASS point source catalog at any size, in the archive's layout.

Positions crowd along the galactic plane, counts grow tenfold in 2.5 magnitudes, and the parts are
zones of declination with equal numbers of records, as in the archive. Some records are upper
limits, blends, databases, minor planets, galaxies or repeated, about as often as in the archive.
The same number of rows gives the same records, in any order of the parts and for any number of
processes; the compressed bytes may differ from one kind of processor to another.

    python benchmarks/twomass_parts.py FOLDER --rows 5000000
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from isal import igzip
from synthetic import put

from starcat.catalog.source import data_source

PARTS = next(file.parts for file in data_source("2mass").files)
FAINTEST_KS_MAG = 15.5
COUNTS_SLOPE = 0.40
"""Decadic logarithm of the counts a magnitude."""

_PLANE_WIDTH_DEG = 8.0
BLOCK_ROWS = 4096
"""Records that are written at once: they fit the cache, which makes it nearly twice as fast."""

SATURATED_KS_MAG = 4.5

LIMIT_KS_MAG = 14.3
"""Magnitude at which the signal is ten times the noise in Ks (Skrutskie et al. 2006, table 1)."""

FAINT_KINDS = (
    (0.10, {"|AAA|222|": "|AAU|220|", "|0.023|0.025|77.1|": r"|\N|\N|\N|"}),
    (0.25, {"|AAA|222|": "|ABD|222|"}),
    (0.40, {"|AAA|222|": "|AAC|222|"}),
)
"""Shares of the records fainter than `LIMIT_KS_MAG`, and the texts to replace in them. The
archive gives upper limits and lower grades there; the shares are guesses."""

KINDS = (
    ("confused", 0.05, {"|111|000|": "|111|00c|"}),
    ("diffraction spike", 0.02, {"|111|000|": "|111|ddd|"}),
    ("blended", 0.02, {"|111|000|": "|222|000|"}),
    ("repeated", 0.015, {"|1|1|0|": "|2|0|0|"}),
    ("extended", 0.0035, {"|CCCCCCCCCC|0|0|": "|CCCCCCCCCC|1|0|"}),
    ("within an extended source", 0.002, {"|CCCCCCCCCC|0|0|": "|CCCCCCCCCC|2|0|"}),
    ("artifact", 0.0001, {"|111|000|": "|111|00D|"}),
    ("minor planet", 0.00004, {"|CCCCCCCCCC|0|0|": "|CCCCCCCCCC|0|1|"}),
)
"""Kinds of records that are not plain stars, their share of all, and the texts to replace. The
extended source catalog has 1,647,599 of the 470,992,970 sources (Skrutskie et al. 2006); the other
shares are guesses. The released archive has no databases in capitals: these are here to be
rejected."""

_CELLS = (360, 1440)
"""Zones of the sine of the declination, and cells of right ascension in each."""

NORTH_GALACTIC_POLE = (192.859481, 27.128251)
"""ICRS, degrees (ESA 1997, Hipparcos vol. 1, section 1.5.3)."""


@cache
def cell_weights() -> np.ndarray:
    """Return how many stars the cells of the sky have, relative to each other."""
    zones, cells = _CELLS
    sine = -1.0 + (np.arange(zones) + 0.5) * 2.0 / zones
    ra = np.radians((np.arange(cells) + 0.5) * 360.0 / cells)
    pole_ra, pole_dec = np.radians(NORTH_GALACTIC_POLE)
    cosine = np.sqrt(1.0 - sine**2)[:, None]
    latitude_sine = sine[:, None] * np.sin(pole_dec) + cosine * np.cos(pole_dec) * np.cos(
        ra - pole_ra
    )
    latitude_deg = np.degrees(np.arcsin(latitude_sine))
    return 0.15 + np.exp(-np.abs(latitude_deg) / _PLANE_WIDTH_DEG)


def positions(part: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return right ascension and declination of a part's records, degrees."""
    zones, cells = _CELLS
    weights = cell_weights()
    share = np.concatenate([[0.0], np.cumsum(weights.ravel() / weights.sum())])
    generator = np.random.default_rng([2, part])
    # The cells are numbered from the south pole on, so a range of shares is a zone of the sky.
    drawn = (part + np.sort(generator.random(count))) / len(PARTS)
    cell = np.clip(np.searchsorted(share, drawn, side="right") - 1, 0, zones * cells - 1)
    ra = (cell % cells + generator.random(count)) * 360.0 / cells
    sine = -1.0 + (cell // cells + generator.random(count)) * 2.0 / zones
    return ra, np.degrees(np.arcsin(sine))


TEMPLATE = (
    "RRRRRRRRRR|DDDDDDDDDD|0.07|0.06|90|hhmmsssszddmmsss |JJJJJJ|0.024|0.026|91.2|"
    "HHHHHH|0.031|0.032|80.4|KKKKKK|0.023|0.025|77.1|AAA|222|111|000|665566|PPPPPP|NNN|"
    "CCCCCCCCCC|0|0|EEEEEEEEEE|o|1999-10-03|42|301.250|-12.875|-83.2|TTTTTTTTTTTT|"
    "1.02|0.98|1.10|JJJJJJ|0.019|HHHHHH|0.022|KKKKKK|0.024|15302|187|se|1|1|0|"
    "\\N|\\N|\\N|\\N|0|\\N|69157|1590591|120\n"
)
"""A record; the fields of letters are written for each star."""


def part_bytes(part: int, count: int, first_key: int) -> bytes:
    """Return the records of a part."""
    ra, dec = positions(part, count)
    generator = np.random.default_rng([3, part])
    ks = FAINTEST_KS_MAG + np.log10(1.0 - generator.random(count)) / COUNTS_SLOPE
    h = ks + np.abs(generator.normal(0.12, 0.12, count))
    j = h + np.abs(generator.normal(0.45, 0.25, count))
    columns = {
        "ra": ra,
        "dec": dec,
        "j": j,
        "h": h,
        "ks": ks,
        "prox": generator.exponential(12.0, count) + 1.0,
        "jdate": generator.uniform(2450600.0, 2451950.0, count),
        "key": np.arange(first_key, first_key + count),
        "luck": generator.random(count),
    }
    starts = range(0, count, BLOCK_ROWS)
    return b"".join(
        _block({name: values[k : k + BLOCK_ROWS] for name, values in columns.items()})
        for k in starts
    )


def _block(stars: dict[str, np.ndarray]) -> bytes:
    """Return the records of some stars."""
    key, dec = stars["key"], stars["dec"]
    records = np.tile(np.frombuffer(TEMPLATE.encode(), dtype=np.uint8), (len(key), 1))
    fields: list[tuple[str, np.ndarray, int]] = [
        ("R" * 10, stars["ra"], 6), ("D" * 10, dec, 6), ("J" * 6, stars["j"], 3),
        ("H" * 6, stars["h"], 3), ("K" * 6, stars["ks"], 3), ("P" * 6, stars["prox"], 1),
        ("N" * 3, key % 360, 0), ("C" * 10, key + 1, 0), ("E" * 10, key, 0),
        ("T" * 12, stars["jdate"], 4),
    ]  # fmt: skip
    for name, values, decimals in fields:
        width = len(name)
        first, *others = _places(name)
        put(records, first, values, width, decimals, blank=0)
        for other in others:
            records[:, other - 1 : other - 1 + width] = records[:, first - 1 : first - 1 + width]
    put(records, TEMPLATE.index("hhmm") + 1, _clock(stars["ra"] / 15.0, 100), 8, blank=ord("0"))
    put(records, TEMPLATE.index("zdd") + 2, _clock(np.abs(dec), 10), 7, blank=ord("0"))
    records[:, TEMPLATE.index("zdd")] = np.where(dec < 0, ord("-"), ord("+"))
    records[:, TEMPLATE.index("|o|") + 1] = np.where(dec < 12.0, ord("s"), ord("n"))
    _write(records, stars["ks"] < SATURATED_KS_MAG, {"|AAA|222|": "|DDD|333|"})
    _write_kinds(records, stars["luck"], [kind[1:] for kind in KINDS])
    # The same draw decides for faint records, which have no other kind.
    faint = np.where(stars["ks"] > LIMIT_KS_MAG, stars["luck"] - _SHARE_OF_KINDS, -1.0)
    _write_kinds(records, faint / (1.0 - _SHARE_OF_KINDS), FAINT_KINDS)
    return records[records != 0].tobytes()


_SHARE_OF_KINDS = sum(share for _, share, _ in KINDS)


def _write_kinds(
    records: np.ndarray, luck: np.ndarray, kinds: Sequence[tuple[float, dict[str, str]]]
) -> None:
    """Give each kind its share of the records: those whose number from 0 to 1 is in its range."""
    ends = np.cumsum([0.0, *(share for share, _ in kinds)])
    for first, end, (_, changes) in zip(ends[:-1], ends[1:], kinds, strict=True):
        _write(records, (luck >= first) & (luck < end), changes)


def _write(records: np.ndarray, where: np.ndarray, changes: dict[str, str]) -> None:
    """Write words over words of the template, letters that differ only; the rest of them is cut."""
    rows = np.flatnonzero(where)
    for old, new in changes.items():
        at = TEMPLATE.index(old)
        for k, letter in enumerate(new.ljust(len(old), "\0").encode()):
            if letter != ord(old[k]):
                records[rows, at + k] = letter


@cache
def _places(name: str) -> list[int]:
    """Return the places of a field, counted from 1."""
    return [k + 1 for k in range(len(TEMPLATE)) if TEMPLATE.startswith(name, k)]


def _clock(hours: np.ndarray, parts_a_second: int) -> np.ndarray:
    """Return hours (or degrees) as the digits of hours, minutes and parts of a second."""
    total = np.floor(hours * 3600.0 * parts_a_second).astype(np.int64)
    minutes, rest = np.divmod(total, 60 * parts_a_second)
    return (minutes // 60 * 100 + minutes % 60) * 100 * parts_a_second + rest


def write_part(folder: Path, part: int, count: int, first_key: int) -> Path:
    """Write a part, gzipped, under the archive's name for it."""
    path = folder / f"psc_{PARTS[part]}.gz"
    path.write_bytes(igzip.compress(part_bytes(part, count, first_key), 1, mtime=0))
    return path


def write_parts(folder: Path, rows: int, workers: int = 2) -> list[Path]:
    """Write all 92 parts with this many rows in total, in parallel."""
    folder.mkdir(parents=True, exist_ok=True)
    ends = np.linspace(0, rows, len(PARTS) + 1).astype(int)
    counts, firsts = np.diff(ends).tolist(), (ends[:-1] + 1).tolist()
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        parts = range(len(PARTS))
        return list(pool.map(write_part, [folder] * len(PARTS), parts, counts, firsts))


def main() -> None:
    """Write a folder of parts and say how fast."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    began = time.perf_counter()
    paths = write_parts(given.folder, given.rows, given.workers)
    took = time.perf_counter() - began
    size = sum(path.stat().st_size for path in paths)
    sys.stderr.write(
        f"{len(paths)} parts, {given.rows:,} rows, {size:,} bytes in {took:.1f} s: "
        f"{given.rows / took:,.0f} rows/s\n"
    )


if __name__ == "__main__":
    main()
