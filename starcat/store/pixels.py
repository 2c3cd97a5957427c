"""HEALPix pixels: where a star lies, what borders on a pixel, and pixels as partitions.

All numbers are nested. Every star of a store has its pixel of order 29 (0.4 mas), of which the
number at a lower order is a prefix.

References
----------
Gorski et al. 2005, ApJ 622, 759 (HEALPix); HATS 1.0, IVOA Note.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.errors import ConfigError
from starcat.version import install_command

MAX_ORDER = 29
HEALPIX_COLUMN = "_healpix_29"
_PIXELS_A_FOLDER = 10_000

Pixels = NDArray[np.int64]


@dataclass(frozen=True, order=True)
class Pixel:
    """A pixel of the sky, as a partition covers it.

    Attributes
    ----------
    order, number : int
        Nested HEALPix.

    Examples
    --------
    >>> Pixel(6, 41234).path.as_posix()
    'Norder=6/Dir=40000/Npix=41234.parquet'
    >>> Pixel(1, 5).first, Pixel(1, 5).end == Pixel(1, 6).first
    (360287970189639680, True)
    """

    order: int
    number: int

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
        """Return the pixels of another order that it has a part in.

        Parameters
        ----------
        order : int
            Any.

        Returns
        -------
        ndarray of int64, shape (N,)
            Ascending: those within it, or the one that it lies in.
        """
        if order <= self.order:
            return np.array([self.number >> 2 * (self.order - order)], dtype=np.int64)
        shift = 2 * (order - self.order)
        return np.arange(self.number << shift, (self.number + 1) << shift, dtype=np.int64)


def healpix_29(ra_deg: NDArray[np.float64], dec_deg: NDArray[np.float64]) -> Pixels:
    """Return the nested HEALPix pixels of order 29 that positions lie in.

    Parameters
    ----------
    ra_deg, dec_deg : ndarray of float64, shape (N,)
        Positions, degrees, finite.

    Returns
    -------
    ndarray of int64, shape (N,)
        Pixels as LSDB computes them, which uses the same library.

    Raises
    ------
    ConfigError
        If cdshealpix is not installed.
    """
    from astropy import units
    from astropy.coordinates import Latitude, Longitude

    if not len(ra_deg):
        return np.empty(0, dtype=np.int64)
    pixels: Any = _nested().lonlat_to_healpix(
        Longitude(ra_deg, units.deg), Latitude(dec_deg, units.deg), MAX_ORDER
    )
    return np.asarray(pixels, dtype=np.int64)


def border_of(pixel: Pixel, width_rad: float) -> tuple[int, Pixels]:
    """Return small pixels around a pixel that hold everything within a distance of it.

    Parameters
    ----------
    pixel : Pixel
        The pixel.
    width_rad : float
        The distance, radians.

    Returns
    -------
    order : int
        Order of the small pixels, at least that of the pixel.
    pixels : ndarray of int64, shape (N,)
        Ascending; none is part of the pixel.

    Notes
    -----
    A ring of pixels no narrower than the distance. Where the pixel itself is narrower than that,
    rings of pixels of its own order are laid around it until they are wide enough.
    """
    order = border_order(width_rad)
    if order >= pixel.order:
        depth = order - pixel.order
        ring = _nested().external_neighbours(np.array([pixel.number]), pixel.order, depth)
        return order, _valid(*ring)
    return pixel.order, _rings(pixel, width_rad)


def neighbours_of(pixels: Pixels, order: int) -> Pixels:
    """Return the pixels that touch others, at an edge or a corner.

    Parameters
    ----------
    pixels : ndarray of int64, shape (N,)
        Pixels of one order.
    order : int
        That order.

    Returns
    -------
    ndarray of int64, shape (M,)
        Ascending; pixels given are among them where they touch each other.
    """
    around = np.unique(np.asarray(_nested().neighbours(pixels, order), dtype=np.int64))
    return around[around >= 0]


def border_order(width_rad: float) -> int:
    """Return the highest order of which no pixel is narrower than a width.

    Parameters
    ----------
    width_rad : float
        Radians.

    Returns
    -------
    int
        0 to 29; 0 also where no order has pixels that wide.
    """
    widths = least_width_rad(np.arange(MAX_ORDER + 1))
    return max(0, int(np.searchsorted(-widths, -width_rad, side="right")) - 1)


def least_width_rad(order: NDArray[np.integer[Any]]) -> NDArray[np.float64]:
    """Return a width that no pixel of an order falls short of.

    Parameters
    ----------
    order : ndarray of int, shape (N,)
        Orders.

    Returns
    -------
    ndarray of float64, shape (N,)
        Radians: 0.45 times the square root of a pixel's area. The narrowest pixels, near the
        poles, have 0.480 of it between opposite edges (all pixels of orders 0 to 8 measured).
    """
    side = np.sqrt(np.pi / 3.0) / 2.0 ** np.asarray(order, dtype=np.float64)
    return np.asarray(0.45 * side)


def _rings(pixel: Pixel, width_rad: float) -> Pixels:
    count = int(np.ceil(width_rad / least_width_rad(np.array([pixel.order]))[0]))
    found = np.array([pixel.number], dtype=np.int64)
    edge = found
    for _ in range(count):
        edge = np.setdiff1d(neighbours_of(edge, pixel.order), found)
        found = np.union1d(found, edge)
        if not len(edge):
            break
    return np.asarray(found[found != pixel.number])


def _valid(edges: Any, corners: Any) -> Pixels:
    both = np.concatenate([np.ravel(edges), np.ravel(corners)]).astype(np.int64)
    return np.unique(both[both >= 0])


@cache
def _nested() -> Any:
    try:
        from cdshealpix import nested
    except ImportError as error:
        raise ConfigError(
            f"HATS needs the package cdshealpix, which is not installed; {install_command('hats')}"
        ) from error
    return nested
