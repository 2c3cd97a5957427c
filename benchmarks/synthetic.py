"""Archive files of full size and true layout, made from the excerpts' own records.

Records of an excerpt are repeated and given new identities, positions, motions and
magnitudes, so that every byte has the archive's format and the sky has the archive's density.
"""

from __future__ import annotations

import gzip
import os
from pathlib import Path

import numpy as np

SAO_ROWS = 258_997
TYCHO2_ROWS = 2_539_913
TYCHO2_PARTS = 20


def catalogs_folder() -> Path:
    """Return the folder of the excerpts."""
    default = Path(__file__).parents[2] / "shared" / "catalogs"
    return Path(os.environ.get("STARCAT_CATALOGS", default))


def read_lines(path: Path, length: int) -> np.ndarray:
    """Return the records of an excerpt as a matrix of bytes, line ends included."""
    data = gzip.decompress(path.read_bytes())
    return np.frombuffer(data, dtype=np.uint8).reshape(-1, length + 1)


def put(
    records: np.ndarray,
    first: int,
    values: np.ndarray,
    width: int,
    decimals: int = 0,
    blank: int = ord(" "),
) -> None:
    """Write numbers into a field, right-aligned, as Fortran would."""
    scaled = np.rint(np.abs(values) * 10.0**decimals).astype(np.int64)
    if len(scaled) and scaled.max() < 2**31:
        scaled = scaled.astype(np.int32)
    places = [first - 1 + k for k in range(width)]
    if decimals:
        point = places.pop(width - 1 - decimals)
        records[:, point] = ord(".")
    started = np.zeros(len(values), dtype=bool)
    rest, is_negative = scaled, values < 0
    for k, place in enumerate(reversed(places)):
        is_used = (rest > 0) | (k <= decimals)
        rest, digit = rest // 10, rest
        digit = (digit - 10 * rest + 48).astype(np.uint8)
        sign = is_negative & ~is_used & ~started
        records[:, place] = np.where(is_used, digit, np.where(sign, ord("-"), blank))
        started |= sign


def random_sky(count: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return uniform positions, degrees."""
    ra = generator.random(count) * 360.0
    dec = np.degrees(np.arcsin(generator.uniform(-1.0, 1.0, count)))
    return ra, dec


def by_region(ra: np.ndarray, dec: np.ndarray) -> np.ndarray:
    """Return the order of GSC regions, roughly: zones of 7.5 deg, then right ascension."""
    return np.lexsort((dec, np.floor(ra / 3.75), np.floor(dec / 7.5)))


def make_sao(folder: Path, catalogs: Path | None = None, rows: int = SAO_ROWS) -> Path:
    """Write a file with the layout of sao.dat, and by default with its size."""
    generator = np.random.default_rng(1)
    lines = read_lines((catalogs or catalogs_folder()) / "sao.dat.gz", 204)
    records = lines[generator.integers(len(lines), size=rows)].copy()
    ra, dec = random_sky(rows, generator)
    put(records, 1, np.arange(1, rows + 1), 6)
    put(records, 81, generator.uniform(4.0, 10.9, rows), 4, 1)
    put(records, 118, generator.integers(1, 359_083, rows), 6)
    put(records, 161, generator.normal(0.0, 0.003, rows), 7, 4)
    put(records, 178, generator.normal(0.0, 0.04, rows), 6, 3)
    put(records, 184, np.radians(ra), 10, 8)
    put(records, 194, np.radians(dec), 11, 8)
    path = folder / "sao.dat"
    records.tofile(path)
    return path


def make_tycho2(
    folder: Path, catalogs: Path | None = None, rows: int = TYCHO2_ROWS, *, compress: bool
) -> Path:
    """Write the 20 parts of tyc2.dat, plain or compressed; return their folder."""
    folder.mkdir(parents=True, exist_ok=True)
    generator = np.random.default_rng(2)
    lines = read_lines((catalogs or catalogs_folder()) / "tyc2.dat.gz", 206)
    all_ra, all_dec = random_sky(rows, generator)
    order = by_region(all_ra, all_dec)
    all_ra, all_dec = all_ra[order], all_dec[order]
    thousands = -(-rows // (1000 * TYCHO2_PARTS))
    for start in range(0, rows, 1000 * thousands):
        part, count = start // (1000 * thousands), min(1000 * thousands, rows - start)
        records = lines[generator.integers(len(lines), size=count)].copy()
        number = start + np.arange(count)
        ra, dec = all_ra[number], all_dec[number]
        put(records, 1, 1 + number // 267, 4)
        put(records, 6, 1 + number % 267, 5)
        for first, values in ((16, ra), (29, dec), (153, ra), (166, dec)):
            put(records, first, values, 12, 8)
        for first in (42, 50):
            put(records, first, generator.normal(0.0, 20.0, count), 7, 1)
        for first in (111, 124):
            put(records, first, generator.uniform(7.0, 12.5, count), 6, 3)
        for first in (58, 62):
            put(records, first, generator.integers(3, 90, count), 3)
        for first in (66, 71):
            put(records, first, generator.uniform(0.5, 4.0, count), 4, 1)
        for first in (76, 84):
            put(records, first, generator.uniform(1900.0, 1991.0, count), 7, 2)
        for first in (118, 131):
            put(records, first, generator.uniform(0.01, 0.3, count), 5, 3)
        name = f"tyc2.dat.{part:02d}"
        if compress:
            (folder / f"{name}.gz").write_bytes(gzip.compress(records.tobytes(), 6, mtime=0))
        else:
            records.tofile(folder / name)
    return folder
