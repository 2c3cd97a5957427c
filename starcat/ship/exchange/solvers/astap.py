"""The star database of ASTAP: one file per area of the sky, with 5 bytes per star, brightest first.

A head of 110 bytes ends with the size of a record. Three bytes are the right ascension in 2^24
steps less one. All ones mark a heading, with the high byte of the declination and the magnitude in
tenths for the following stars. A star's record has the two lower bytes of the declination.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.errors import ConfigError
from starcat.ship.exchange.solvers.sky import SolverSky

WIDEST_DEG = 20.0
"""For wider fields ASTAP reads another kind of file."""

_HEAD_BYTES, _RECORD_BYTES = 110, 5
_RA_STEPS, _DEC_STEPS = 2**24 - 1, 2**23 - 1
_FAINTEST, _BRIGHTEST = 239, -16  # tenths of a magnitude; 16 is added to store them in a byte


@dataclass(frozen=True)
class Areas:
    """A division of the sky into rings of declination, and of each ring into cells."""

    name: str  # prefix of the file names that ASTAP looks for
    suffix: str
    bounds_deg: tuple[float, ...]  # bounds of the rings, from the south pole
    cells: tuple[int, ...]

    def files(self, ra_deg: NDArray[np.float64], dec_deg: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the numbers in ASTAP's file names: 100 r + c for ring r and cell c, from one."""
        ring = np.searchsorted(self.bounds_deg[1:-1], dec_deg, side="left")
        cells = np.array(self.cells)[ring]
        cell = np.minimum((ra_deg % 360.0 * cells / 360.0).astype(np.int64), cells - 1)
        return np.asarray(100 * (ring + 1) + cell + 1)

    @property
    def names(self) -> list[int]:
        """Numbers of all areas, ring and cell."""
        return [
            100 * ring + cell
            for ring, cells in enumerate(self.cells, 1)
            for cell in range(1, cells + 1)
        ]


def _both(south: tuple[int, ...]) -> tuple[int, ...]:
    return (*south, *south[::-1])


_WIDE_SINES = [1.0 - (2 * ring + 1) ** 2 / 289.0 for ring in range(8, -1, -1)]
_WIDE_RINGS = [float(x) for x in np.degrees(np.arcsin(_WIDE_SINES))]
_NARROW_RINGS = [90.0 / 17.5 * ring for ring in range(18)]
WIDE = Areas(
    "g17",
    "290",
    (-90.0, *[-x for x in _WIDE_RINGS[:0:-1]], *_WIDE_RINGS, 90.0),
    _both((1, *range(4, 33, 4))),
)
"""290 areas of 9.5 deg; all cells of a ring have the same size."""
NARROW = Areas(
    "h17",
    "1476",
    (-90.0, *[-x for x in _NARROW_RINGS[:0:-1]], *_NARROW_RINGS, 90.0),
    _both((1, 3, 9, 15, 21, 27, 33, 38, 43, 48, 52, 56, 60, 63, 65, 67, 68, 69)),
)
"""1,476 areas of 5.1 deg."""


def write_astap(sky: SolverSky, folder: Path) -> dict[str, Any]:
    """Write the star database of ASTAP into a folder; return its figures."""
    if sky.fov_deg[0] > WIDEST_DEG:
        raise ConfigError(
            f"{sky.name} is for fields of {sky.fov_deg[0]:g} deg; ASTAP solves those up to "
            f"{WIDEST_DEG:g} deg with such files",
            hint="choose another {form}",
        )
    areas = NARROW if sky.fov_deg[0] < 6.0 else WIDE
    folder.mkdir()
    area = areas.files(sky.ra_deg, sky.dec_deg)
    head = f"{sky.name} epoch J{sky.epoch_jyear:g} starcat".encode()[: _HEAD_BYTES - 2]
    head = head.ljust(_HEAD_BYTES - 1, b" ") + bytes([_RECORD_BYTES])
    for name in areas.names:
        path = folder / f"{areas.name}_{name:04d}.{areas.suffix}"
        path.write_bytes(head + records(sky, np.flatnonzero(area == name)))
    return {"areas": len(areas.names)}


def records(sky: SolverSky, rows: NDArray[np.int64]) -> bytes:
    """Return the records of the stars of an area, brightest first."""
    tenths = np.clip(np.round(10.0 * sky.mag[rows]), _BRIGHTEST, _FAINTEST).astype(np.int64)
    dec = np.round(sky.dec_deg[rows] / 90.0 * _DEC_STEPS).astype(np.int64)
    ra = np.round(sky.ra_deg[rows] % 360.0 / 360.0 * _RA_STEPS).astype(np.int64)
    # The highest value marks a heading.
    ra = np.minimum(ra, _RA_STEPS - 1)
    order = np.lexsort((rows, dec >> 16, tenths))
    written = bytearray()
    heading: tuple[int, int] | None = None
    for row in order.tolist():
        high, mag = int(dec[row] >> 16), int(tenths[row])
        if heading != (high, mag):
            heading = (high, mag)
            written += bytes([255, 255, 255, high + 128, mag + 16])
        written += int(ra[row]).to_bytes(3, "little") + int(dec[row] & 0xFFFF).to_bytes(2, "little")
    return bytes(written)
