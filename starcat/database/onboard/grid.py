"""The grid of an onboard image: stars by bands of declination and cells of right ascension.

Bands are of equal height in z, so they hold equal parts of the sky. Only the upper
bound of the stars in the circle of a camera needs angles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Mask

MAX_CELLS = 2**20

BANDS_OF_A_FIELD = 8
"""Number of bands that the circle of a camera should cross: wider bands hold stars far from it."""

FACE_CELLS = 2
"""Cells along a side of a cube's face when the search for the fullest circle begins."""

FINENESS = 16
"""Cells are halved until their reach from the centre is the radius divided by this."""

MAX_PRODUCTS = 300_000
"""With more cells times stars than this, cells are processed one by one, each with its stars."""

MANY_CELLS = 32
"""With this number of full cells their upper bounds are computed before they are processed."""

BENT = 0.1
"""Relative margin of a cell's reach, so that its circle contains the circles of its parts."""

SLACK_RAD = 1e-5
"""Margin of the radius, for readers that compare in single precision."""

_CORNERS = np.array(list(product((-1.0, 1.0), repeat=2)))
_FACES = [sign * np.roll(np.eye(3), axis, axis=0) for axis, sign in product(range(3), (1.0, -1.0))]
"""The normal of each face of the cube, and the two axes in the face, by rows."""


@dataclass(frozen=True)
class CellGrid:
    """Numbers of bands and of the sectors of each."""

    bands: int  # 1 or more
    sectors: int

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return self.bands * self.sectors

    def cells(self, u: Array) -> NDArray[np.int64]:
        """Return the cells of directions."""
        band = np.floor((u[:, 2] + 1.0) / 2.0 * self.bands)
        sector = np.floor(quarter_turns(u) / 4.0 * self.sectors)
        band = np.minimum(np.maximum(band, 0.0), self.bands - 1)
        sector = np.minimum(sector, self.sectors - 1)
        return np.asarray(band * self.sectors + sector).astype(np.int64)


def quarter_turns(u: Array) -> Array:
    """Return a number from 0 to 4 that grows with right ascension, without trigonometry.

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
    turns: Array = np.where(second_or_third, 2.0 - t, np.where(fourth, 4.0 + t, t))
    return turns


def grid_for(n_stars: int, radius_rad: float, stars_per_cell: int = 1) -> CellGrid:
    """Return a grid with about ``stars_per_cell``, but not finer than is useful for a camera."""
    useful = math.ceil(BANDS_OF_A_FIELD / math.sin(min(radius_rad, 0.5 * math.pi)))
    largest = math.isqrt(MAX_CELLS // 2)
    bands = max(1, min(round(math.sqrt(n_stars / (2.0 * stars_per_cell))), useful, largest))
    return CellGrid(bands, 2 * bands)


def most_near(u: Array, radius_rad: float) -> int:
    """Return an upper bound of the stars within a radius of any direction.

    The sphere is divided into cells, squares on the faces of a cube. No circle about a direction
    of a cell holds more stars than the circle about its centre that is wider by the reach of the
    cell. Cells that can hold more than the largest number found so far are divided further.
    """
    unit = np.ascontiguousarray((u / np.sqrt(np.einsum("ij,ij->i", u, u))[:, None]).T)
    half = 1.0 / FACE_CELLS
    places = np.arange(-1.0 + half, 1.0, 2.0 * half)
    squares = np.array(list(product(places, repeat=2)))
    roots = []
    for face in _FACES:
        centres, reach_rad = _centres(face, squares, half)
        wide = _cosines(radius_rad + reach_rad)
        for n, (centre, least) in enumerate(zip(centres, wide, strict=True)):
            cosine = np.einsum("i,in->n", centre, unit)
            roots.append((face, squares[n : n + 1], np.flatnonzero(cosine >= least)))
    most = 0
    # The fullest first, because their count rules out most of the others.
    for face, square, near in sorted(roots, key=lambda root: -len(root[2])):
        if len(near) > most:
            most = _most_in(face, square, half, unit.take(near, axis=1), radius_rad, most)
    return most


def _most_in(
    face: Array, squares: Array, half: float, near: Array, radius_rad: float, most: int
) -> int:
    """Return an upper bound for the directions near one cell, or ``most`` if that is larger.

    ``near`` has one column per direction.
    """
    inner = _cosines(np.array(radius_rad))
    while True:
        half *= 0.5
        squares = (squares[:, None] + half * _CORNERS).reshape(-1, 2)
        centres, reach_rad = _centres(face, squares, half)
        # A product of matrices this small would start threads, which take longer.
        cosine = np.einsum("ki,in->kn", centres, near)
        is_near = cosine >= _cosines(radius_rad + reach_rad)[:, None]
        count = np.count_nonzero(is_near, axis=1)
        if reach_rad.max() * FINENESS <= radius_rad:
            return max(most, int(count.max()))
        most = max(most, int(np.count_nonzero(cosine >= inner, axis=1).max()))
        fuller = np.flatnonzero(count > most)
        if 4 * len(fuller) * near.shape[1] > MAX_PRODUCTS:
            bounds = count
            # The circles of larger cells hold too many stars, and few cells are tried faster.
            if reach_rad.max() <= radius_rad and len(fuller) >= MANY_CELLS:
                bounds[fuller] = _bounds(
                    face, squares[fuller], half, near, is_near[fuller], radius_rad, most
                )
            for n in fuller[np.argsort(-count[fuller], kind="stable")]:
                if bounds[n] > most:
                    square, stars = squares[n : n + 1], near.compress(is_near[n], axis=1)
                    most = _most_in(face, square, half, stars, radius_rad, most)
            return most
        if not len(fuller):
            return most
        squares = squares[fuller]


def _bounds(
    face: Array,
    squares: Array,
    half: float,
    near: Array,
    is_near: Mask,
    radius_rad: float,
    most: int,
) -> NDArray[np.int64]:
    """Return an upper bound of what `_most_in` finds in each cell, or ``most`` if that is larger.

    All cells are divided together, each with a list of the stars near it. Cells that cannot hold
    more than ``most`` are left out. No cell becomes smaller than the cells at which `_most_in` can
    end.
    """
    bounds = np.full(len(squares), most)
    root, (cell, star) = np.arange(len(squares)), np.nonzero(is_near)
    while True:
        half *= 0.5
        squares = (squares[:, None] + half * _CORNERS).reshape(-1, 2)
        centres, reach_rad = _centres(face, squares, half)
        # The circle of a cell does not quite contain the circles of its parts: cells are not flat.
        wide = _cosines(radius_rad + (1.0 + BENT) * reach_rad)
        children = 4 * cell[:, None] + np.arange(4)
        cosine = np.einsum("nki,in->nk", centres.reshape(-1, 4, 3)[cell], near.take(star, axis=1))
        pair, child = np.nonzero(cosine >= wide[children])
        cell, star = children[pair, child], star[pair]
        count, root = np.bincount(cell, minlength=len(squares)), np.repeat(root, 4)
        if reach_rad.min() * FINENESS <= radius_rad:
            np.maximum.at(bounds, root, count)
            return bounds
        is_fuller = count > most
        if not is_fuller.any():
            return bounds
        is_kept = is_fuller[cell]
        cell, star = (np.cumsum(is_fuller) - 1)[cell[is_kept]], star[is_kept]
        squares, root = squares[is_fuller], root[is_fuller]


def _cosines(radius_rad: Array) -> Array:
    return np.asarray(np.cos(np.minimum(radius_rad + SLACK_RAD, np.pi)))


def _centres(face: Array, squares: Array, half: float) -> tuple[Array, Array]:
    """Return the directions of the cells' centres, and the angles to their farthest corners."""
    places = np.concatenate([squares[:, None], squares[:, None] + half * _CORNERS], axis=1)
    v = face[0] + places @ face[1:]
    v /= np.sqrt(np.einsum("ijk,ijk->ij", v, v))[..., None]
    chord = v[:, 1:] - v[:, :1]
    farthest = np.sqrt(np.einsum("ijk,ijk->ij", chord, chord).max(axis=1))
    return np.ascontiguousarray(v[:, 0]), np.asarray(2.0 * np.arcsin(0.5 * farthest))
