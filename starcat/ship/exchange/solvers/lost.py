"""The database of LOST: a catalog, and the pairs of its stars with a K-vector, in double precision.

The file is a sequence of parts. A part has a type number, flags, a length, and its bytes from the
next multiple of 8; the number 0 ends the file. Values are aligned to their size. LOST solves
fields up to the largest separation of its pairs, and numbers stars in 16 bits.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from starcat.errors import ConfigError
from starcat.geometry.proximity import pairs_within
from starcat.ship.exchange.solvers.sky import SolverSky

MAX_STARS = 32_767
_CATALOG, _PAIRS = 0xF9A283BC, 0x2536F009
_HAS_MAGNITUDE, _HAS_NAME = 1, 2
_BIN_ARCSEC = 5.0
_MIN_DEG = 0.5
"""Closer pairs contribute little information, and centroids of such stars often merge."""

_STAR = np.dtype([("direction", "<f8", (3,)), ("mag", "<f4"), ("name", "<i2"), ("", "V2")])
_INDEX = np.dtype(
    [("pairs", "<i4"), ("", "V4"), ("least", "<f8"), ("most", "<f8"), ("bins", "<i4")]
)


def write_lost(sky: SolverSky, path: Path) -> dict[str, Any]:
    """Write the database of LOST; return its figures."""
    if len(sky.mag) > MAX_STARS:
        raise ConfigError(
            f"{sky.name} has {len(sky.mag):,} stars; LOST allows at most {MAX_STARS:,}: build it "
            "again with a brighter selection.faint_limit_mag",
            key="to",
        )
    count, pairs = _pairs(sky)
    file = bytearray()
    for number, content in ((_PAIRS, pairs), (_CATALOG, _catalog(sky))):
        _add_part(file, number, content)
    _fill(file, 4)
    path.write_bytes(file + bytes(4))
    return {"pairs": count}


def _catalog(sky: SolverSky) -> bytes:
    stars = np.zeros(len(sky.mag), dtype=_STAR)
    stars["direction"] = sky.directions
    stars["mag"] = np.round(100.0 * sky.mag)
    stars["name"] = np.arange(1, len(stars) + 1)
    flags = _HAS_MAGNITUDE | _HAS_NAME
    head = np.int16(len(stars)).tobytes() + np.int8(flags).tobytes()
    # The last star ends with its name, without padding.
    return head.ljust(8, b"\0") + stars.tobytes()[:-2]


def _pairs(sky: SolverSky) -> tuple[int, bytes]:
    focal_px = 0.5 * sky.camera.width_px / np.tan(0.5 * np.radians(sky.fov_deg[1]))
    least_rad = np.radians(_MIN_DEG)
    most_rad = sky.camera.with_focal_length(float(focal_px)).diagonal_rad
    rows, angle = pairs_within(sky.directions, most_rad)
    rows, angle = rows[angle >= least_rad], angle[angle >= least_rad]
    order = np.lexsort((rows[:, 1], rows[:, 0], angle))
    bins = int(np.ceil((most_rad - least_rad) / np.radians(_BIN_ARCSEC / 3600.0)))
    index = np.zeros((), dtype=_INDEX)
    index["pairs"], index["bins"] = len(rows), bins
    index["least"], index["most"] = least_rad, most_rad
    # A pair in the n-th bin counts from the n-th bound on.
    width = (most_rad - least_rad) / bins
    bin_of = np.minimum(np.ceil((angle[order] - least_rad) / width), bins)
    counts = np.searchsorted(bin_of, np.arange(bins + 1), side="right")
    parts = (index, counts.astype("<i4"), rows[order].astype("<i2"))
    return len(rows), b"".join(part.tobytes() for part in parts)


def _add_part(file: bytearray, number: int, content: bytes) -> None:
    _fill(file, 4)
    file += np.array([number, 0, len(content)], dtype="<u4").tobytes()
    _fill(file, 8)
    file += content


def _fill(file: bytearray, size: int) -> None:
    file += bytes(-len(file) % size)
