"""HEALPix pixels: where a star lies, what borders on a pixel, partitions, and growing regions.

All numbers are nested. Every star of a store has its pixel of order 29 (0.4 mas), of which the
number at a lower order is a prefix. What lies within one hop of a place in a region lies in the
region with one ring more, so that a chain of stars, each within a hop of the next, can be followed
across the borders of partitions.

References
----------
Gorski et al. 2005, ApJ 622, 759 (HEALPix); HATS 1.0, IVOA Note.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from starcat.errors import ConfigError
from starcat.version import install_command

MAX_ORDER = 29
HEALPIX_COLUMN = "_healpix_29"
_PIXELS_A_FOLDER = 10_000

_DEEPEST = 12
"""A border is made of pixels at most so many orders below: 16,388 of them."""

_FIRST_WIDTH_RAD = 0.45 * np.sqrt(np.pi / 3.0)

Pixels = NDArray[np.int64]


@dataclass(frozen=True, order=True)
class Pixel:
    """A pixel of the sky, as a partition covers it.

    Examples
    --------
    >>> Pixel(6, 41234).path.as_posix()
    'Norder=6/Dir=40000/Npix=41234.parquet'
    >>> Pixel(1, 5).first, Pixel(1, 5).end == Pixel(1, 6).first
    (360287970189639680, True)
    """

    order: int
    number: int  # nested

    @property
    def first(self) -> int:
        """The first pixel of order 29 in it."""
        return self.number << 2 * (MAX_ORDER - self.order)

    @property
    def end(self) -> int:
        """The pixel of order 29 behind its last one."""
        return (self.number + 1) << 2 * (MAX_ORDER - self.order)

    @property
    def path(self) -> Path:
        """Where its file is, relative to ``dataset/``."""
        folder = self.number // _PIXELS_A_FOLDER * _PIXELS_A_FOLDER
        return Path(f"Norder={self.order}") / f"Dir={folder}" / f"Npix={self.number}.parquet"

    def at(self, order: int) -> Pixels:
        """Return the pixels of another order that it has a part in."""
        return at_order(self.order, np.array([self.number], dtype=np.int64), order)


def at_order(order: int, pixels: Pixels, other: int) -> Pixels:
    """Return the pixels of another order that some pixels have a part in."""
    if other <= order:
        return np.unique(pixels >> 2 * (order - other))
    shift = 2 * (other - order)
    return np.unique((pixels[:, None] << shift) + np.arange(1 << shift))


def runs_of(pixels: Pixels, order: int) -> tuple[Pixels, Pixels, Pixels]:
    """Return which pixels of an order stars are in, where each begins, and how many it has."""
    lower = pixels >> 2 * (MAX_ORDER - order)
    begins = np.flatnonzero(np.diff(lower, prepend=-1))
    return lower[begins], begins, np.diff(begins, append=len(pixels))


def pixel_field() -> pa.Field:
    """Return the column of the stars' pixels."""
    meaning = {"description": "Nested HEALPix pixel of order 29, ICRS", "ucd": "pos.healpix"}
    return pa.field(HEALPIX_COLUMN, pa.int64(), nullable=False, metadata=meaning)


def healpix_29(ra_deg: NDArray[np.float64], dec_deg: NDArray[np.float64]) -> Pixels:
    """Return the nested HEALPix pixels of order 29 that positions lie in."""
    from astropy import units
    from astropy.coordinates import Latitude, Longitude

    if not len(ra_deg):
        return np.empty(0, dtype=np.int64)
    pixels: Any = _nested().lonlat_to_healpix(
        Longitude(ra_deg, units.deg), Latitude(dec_deg, units.deg), MAX_ORDER
    )
    return np.asarray(pixels, dtype=np.int64)


def border_of(pixel: Pixel, width_rad: float) -> tuple[int, Pixels]:
    """Return pixels that hold everything within a distance of a pixel."""
    order = min(border_order(width_rad), pixel.order + _DEEPEST)
    if width_rad > _FIRST_WIDTH_RAD:
        return 0, np.arange(12, dtype=np.int64)
    if order >= pixel.order:
        depth = order - pixel.order
        return order, _valid(
            *_nested().external_neighbours(np.array([pixel.number]), pixel.order, depth)
        )
    own = pixel.at(order)
    return order, np.union1d(own, neighbours_of(own, order))


def neighbours_of(pixels: Pixels, order: int) -> Pixels:
    """Return the pixels that touch others, at an edge or a corner."""
    return _valid(_nested().neighbours(pixels, order))


def border_order(width_rad: float) -> int:
    """Return the highest order of which no pixel is narrower than a width."""
    widths = least_width_rad(np.arange(MAX_ORDER + 1))
    return max(0, int(np.searchsorted(-widths, -width_rad, side="right")) - 1)


def least_width_rad(order: NDArray[np.integer[Any]]) -> NDArray[np.float64]:
    """Return a width that no pixel of an order falls short of."""
    return np.asarray(_FIRST_WIDTH_RAD / 2.0 ** np.asarray(order, dtype=np.float64))


def _valid(*parts: Any) -> Pixels:
    """Return pixels in order, each once; the library has -1 where a pixel has no neighbour."""
    together = np.concatenate([np.ravel(part) for part in parts]).astype(np.int64)
    return np.unique(together[together >= 0])


def _nested() -> Any:
    try:
        import cdshealpix.nested as nested
    except ImportError as error:
        raise ConfigError(
            f"HATS needs the package cdshealpix, which is not installed; {install_command('hats')}"
        ) from error
    return nested


FINEST_RINGS = 8
"""Orders that the pixels of the rings may be above that of the pixel within: 1024 or so a ring."""

WHOLE_SKY = ((0, 12 << 2 * MAX_ORDER),)


@dataclass(frozen=True)
class StoreRegion:
    """A pixel and the rings around it."""

    core: Pixel | None  # the pixel in the middle; None for the whole sky
    order: int  # order of the rings' pixels
    pixels: Pixels  # shape (N,): pixels of the rings, ascending
    levels: NDArray[np.int64]  # shape (N,): number of the ring that each is in, from 1

    @property
    def ranges(self) -> tuple[tuple[int, int], ...]:
        """The pixels of order 29 in it: first and end of each run, ascending."""
        if self.core is None:
            return WHOLE_SKY
        shift = 2 * (MAX_ORDER - self.order)
        breaks = np.flatnonzero(np.diff(self.pixels) != 1) + 1
        runs = [run for run in np.split(self.pixels, breaks) if len(run)]
        both = [(int(run[0]) << shift, (int(run[-1]) + 1) << shift) for run in runs]
        return tuple(sorted([(self.core.first, self.core.end), *both]))

    def level_of(self, pixels: Pixels) -> NDArray[np.int64]:
        """Return which ring places are in."""
        if self.core is None:
            return np.zeros(len(pixels), dtype=np.int64)
        found = np.full(len(pixels), -1, dtype=np.int64)
        if len(self.pixels):
            coarse = pixels >> 2 * (MAX_ORDER - self.order)
            place = np.minimum(np.searchsorted(self.pixels, coarse), len(self.pixels) - 1)
            found = np.where(self.pixels[place] == coarse, self.levels[place], found)
        found[(pixels >= self.core.first) & (pixels < self.core.end)] = 0
        return found


def region_around(pixel: Pixel, hop_rad: float, rings: int) -> StoreRegion:
    """Return the region with so many rings around a pixel."""
    widest, finest = least_width_rad(np.array([0, min(pixel.order + FINEST_RINGS, MAX_ORDER)]))
    nothing = np.empty(0, dtype=np.int64)
    if not hop_rad <= widest:
        return StoreRegion(None, 0, nothing, nothing)
    width_rad = max(hop_rad, float(finest))
    order = border_order(width_rad)
    core = pixel
    if order < pixel.order:
        core = Pixel(order, int(pixel.at(order)[0]))
    found = [border_of(core, width_rad)[1]]
    inner = np.array([core.number], dtype=np.int64) if core.order == order else nothing
    for _ in range(rings - 1):
        around = np.setdiff1d(neighbours_of(found[-1], order), found[-1])
        around = np.setdiff1d(around, found[-2] if len(found) > 1 else inner)
        coarse = around >> 2 * (order - core.order)
        found.append(around[coarse != core.number])
        if not len(found[-1]):
            break
    pixels = np.concatenate(found)
    levels = np.repeat(np.arange(1, len(found) + 1), [len(ring) for ring in found])
    ascending = np.argsort(pixels)
    return StoreRegion(core, order, pixels[ascending], levels[ascending])
