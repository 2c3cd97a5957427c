"""The grid of an onboard image: stars by bands of declination and cells of right ascension.

Bands are of equal height in z, so they hold equal parts of the sky. Nothing here needs an angle
but the upper bound of the stars that a camera can have in its circle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_CELLS = 2**20

BANDS_OF_A_FIELD = 8
"""So many bands the circle of a camera should cross: fewer hold stars that are not near it."""

FACE_CELLS = 8
"""Cells along a side of a cube's face when the search for the fullest circle begins."""

LEVELS = 6
"""So often a cell is halved at the most."""

MAX_PRODUCTS = 50_000_000
"""Work of the search that is not exceeded by halving cells: cells times stars."""

CHUNK = 1_000_000
"""Products that are held at a time."""

SLACK_RAD = 1e-5
"""The radius is so much larger, for who compares in single precision."""


@dataclass(frozen=True)
class Grid:
    """Numbers of bands and of the sectors of each.

    Attributes
    ----------
    bands, sectors : int
        1 or more.
    """

    bands: int
    sectors: int

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return self.bands * self.sectors

    def cells(self, u: Array) -> NDArray[np.int64]:
        """Return the cells of directions.

        Parameters
        ----------
        u : ndarray of float64, shape (N, 3)
            ICRS directions.

        Returns
        -------
        ndarray of int64, shape (N,)
            Band times sectors plus sector.
        """
        band = np.floor((u[:, 2] + 1.0) / 2.0 * self.bands)
        sector = np.floor(quarter_turns(u) / 4.0 * self.sectors)
        band = np.minimum(np.maximum(band, 0.0), self.bands - 1)
        sector = np.minimum(sector, self.sectors - 1)
        return np.asarray(band * self.sectors + sector).astype(np.int64)

    def offsets(self, cells: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the row of the first star of each cell.

        Parameters
        ----------
        cells : ndarray of int64, shape (N,)
            Ascending.

        Returns
        -------
        ndarray of int64, shape (n_cells + 1,)
            The last entry is the number of stars.
        """
        return np.searchsorted(cells, np.arange(self.n_cells + 1), side="left").astype(np.int64)


def quarter_turns(u: Array) -> Array:
    """Return a number that grows with right ascension, from 0 to 4, without an angle.

    Parameters
    ----------
    u : ndarray of float64, shape (N, 3)
        ICRS directions.

    Returns
    -------
    ndarray of float64, shape (N,)
        0, 1, 2, 3 at right ascension 0, 90, 180, 270 deg; 0 at a pole.

    Examples
    --------
    >>> quarter_turns(np.array([[1.0, 0, 0], [0, 1, 0], [-1, -1, 0], [0, 0, 1]]))
    array([0. , 1. , 2.5, 0. ])
    """
    x, y = u[:, 0], u[:, 1]
    length = np.abs(x) + np.abs(y)
    t = np.divide(y, length, out=np.zeros(len(u)), where=length > 0.0)
    second_or_third = ((x <= 0.0) & (y > 0.0)) | (x < 0.0)
    fourth = (x >= 0.0) & (y < 0.0)
    return np.where(second_or_third, 2.0 - t, np.where(fourth, 4.0 + t, t))


def grid_for(n_stars: int, radius_rad: float) -> Grid:
    """Return a grid of about as many cells as stars, but no finer than a camera has use for.

    Parameters
    ----------
    n_stars : int
        Stars.
    radius_rad : float
        Angle from the camera's axis to a corner, radians.

    Returns
    -------
    Grid
        Twice as many sectors as bands, so that cells at the equator are about square.
    """
    useful = math.ceil(BANDS_OF_A_FIELD / math.sin(min(radius_rad, 0.5 * math.pi)))
    largest = math.isqrt(MAX_CELLS // 2)
    bands = max(1, min(round(math.sqrt(n_stars / 2.0)), useful, largest))
    return Grid(bands, 2 * bands)


def most_near(u: Array, radius_rad: float) -> int:
    """Return an upper bound of the stars within a radius of any direction.

    Parameters
    ----------
    u : ndarray of float64, shape (N, 3)
        ICRS directions of the stars.
    radius_rad : float
        Radians.

    Returns
    -------
    int
        Never too small; too large by the stars of a ring of a fortieth of the radius or less,
        unless the stars are so many that the search is ended before.

    Notes
    -----
    The sphere is divided into cells of the faces of a cube. No circle about a direction of a cell
    holds more stars than the circle about its centre that is wider by the cell's half diagonal.
    Only cells that may hold more than what a circle was found to hold are halved.
    """
    if not len(u):
        return 0
    unit = u / np.sqrt(np.einsum("ij,ij->i", u, u))[:, None]
    cells, half = _first_cells()
    found = 0
    for level in range(LEVELS + 1):
        centres, reach_rad = _centres(cells, half)
        inner, outer = _counts(unit, centres, radius_rad + SLACK_RAD, reach_rad)
        found = max(found, inner)
        fuller = cells[outer > found]
        if level == LEVELS or 4 * len(fuller) * len(u) > MAX_PRODUCTS:
            break
        half *= 0.5
        steps = np.array([(0.0, a * half, b * half) for a, b in product((-1.0, 1.0), repeat=2)])
        cells = (fuller[:, None] + steps).reshape(-1, 3)
    return max(found, int(outer.max(initial=0)))


def _first_cells() -> tuple[Array, float]:
    """Return face, u and v of the first cells' centres, and half of their side."""
    half = 1.0 / FACE_CELLS
    places = np.arange(-1.0 + half, 1.0, 2.0 * half)
    return np.array(list(product(range(6), places, places))), half


def _centres(cells: Array, half: float) -> tuple[Array, Array]:
    """Return the directions of the cells' centres, and the angles to their farthest corners."""
    centres = _directions(cells)
    reach = np.zeros(len(cells))
    for a, b in product((-half, half), repeat=2):
        chord = np.linalg.norm(_directions(cells + (0.0, a, b)) - centres, axis=1)
        reach = np.maximum(reach, 2.0 * np.arcsin(0.5 * chord))
    return centres, reach


def _directions(cells: Array) -> Array:
    face = cells[:, 0].astype(np.int64)
    axis, rows = face // 2, np.arange(len(cells))
    v = np.empty((len(cells), 3))
    v[rows, axis] = np.where(face % 2, -1.0, 1.0)
    v[rows, (axis + 1) % 3], v[rows, (axis + 2) % 3] = cells[:, 1], cells[:, 2]
    return np.asarray(v / np.linalg.norm(v, axis=1)[:, None])


def _counts(
    u: Array, centres: Array, radius_rad: float, reach_rad: Array
) -> tuple[int, NDArray[np.int64]]:
    """Return the fullest circle about a centre, and the stars of each circle with its reach."""
    fullest, outer = 0, np.zeros(len(centres), dtype=np.int64)
    wide = np.cos(np.minimum(radius_rad + reach_rad, np.pi))
    step = max(1, CHUNK // len(u))
    for start in range(0, len(centres), step):
        part = slice(start, start + step)
        cosine = centres[part] @ u.T
        outer[part] = np.count_nonzero(cosine >= wide[part, None], axis=1)
        within = np.count_nonzero(cosine >= np.cos(min(radius_rad, np.pi)), axis=1)
        fullest = max(fullest, int(within.max(initial=0)))
    return fullest, outer
