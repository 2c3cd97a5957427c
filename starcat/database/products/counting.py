"""Estimates of the size of a product, counted around some of the stars, without making it.

Neighbours are counted, not found, and the triangles that several fields share are known from some
of the triangles; so this takes a moment where making the products takes minutes.
"""

from __future__ import annotations

import numpy as np
import scipy

from starcat.arrays import Array, Directions
from starcat.database.products.tiling import FieldStars
from starcat.geometry.sphere import chord_from_separation

SAMPLE = 2000
"""Number of stars around which neighbours are counted, and of triangles whose fields are."""

MAX_IN_TREE, MAX_MET = 500_000, 20_000_000
"""Largest numbers of stars in the tree and of neighbours that are visited; if there are more, only
some stars are searched, which loses little accuracy."""

QUANTILES = 64
"""Number of quantiles that represent the neighbours of all stars when cells are counted."""


class Neighbourhoods:
    """Numbers of neighbours around some of the stars, counted once for each radius."""

    def __init__(self, directions: Directions) -> None:
        """Take the directions of all stars, shape (N, 3)."""
        self._directions = directions
        self._some = directions[:: -(-len(directions) // SAMPLE)]
        self._counts: dict[float, Array] = {}
        self._trees: dict[int, scipy.spatial.cKDTree] = {}

    def within(self, radius_rad: float) -> Array:
        """Return the number of neighbours of some stars within a radius, shape (M,)."""
        if radius_rad not in self._counts:
            self._counts[radius_rad] = self._count(radius_rad)
        return self._counts[radius_rad]

    def total(self, radius_rad: float) -> float:
        """Return about how many neighbours all stars together have within a radius."""
        return float(len(self._directions) * self.within(radius_rad).mean())

    def _count(self, radius_rad: float) -> Array:
        count, some = len(self._directions), self._some
        # Wide circles hold so many stars that a sample of them is enough.
        share = 0.5 * (1.0 - np.cos(min(radius_rad, np.pi)))
        thinning = 1 + int(count * max(share * len(some) / MAX_MET, 1.0 / MAX_IN_TREE))
        if thinning not in self._trees:
            self._trees[thinning] = scipy.spatial.cKDTree(self._directions[::thinning])
        chord = float(chord_from_separation(min(radius_rad, np.pi)))
        near = self._trees[thinning].query_ball_point(some, chord, return_length=True)
        # Every star finds itself, in a tree of all of them.
        return np.asarray(np.maximum(thinning * near - 1.0, 0.0))


def distinct_cells(around: Array, share: Array) -> float:
    """Return how many cells the neighbours of a star occupy in the mean.

    ``share`` is the part of all neighbours that is in each cell; one number stands for as many
    equal cells as make a whole.
    """
    middle = (np.arange(QUANTILES) + 0.5) / QUANTILES
    count = np.quantile(around, middle)[:, None]
    weight = np.round(1.0 / share) if len(share) == 1 else 1.0
    with np.errstate(divide="ignore"):
        occupied = -np.expm1(count * np.log1p(-np.minimum(share, 1.0)))
    return float((weight * np.where(count > 0.0, occupied, 0.0)).sum(axis=1).mean())


def count_triangles(fields: FieldStars, stars: int, brightest: int) -> tuple[float, float]:
    """Return the triangles of all fields, and about how many of them are distinct.

    One that t fields have is counted t times, so the distinct ones are all times the mean of 1/t.
    """
    offsets, star = fields.brightest(brightest)
    size = np.diff(offsets)
    each = size * (size - 1) * (size - 2) // 6
    records = int(each.sum())
    if not records:
        return 0.0, 0.0
    ones = np.ones(len(star), dtype=np.int32)
    of_field = scipy.sparse.csr_array((ones, star, offsets), shape=(len(size), stars))
    of_star = of_field.T.tocsr()
    generator = np.random.default_rng(0)
    field = generator.choice(len(size), SAMPLE, p=each / records)
    drawn = generator.random((SAMPLE, size.max()))
    drawn[np.arange(size.max()) >= size[field, None]] = 2.0  # no star of the field
    members = np.argsort(drawn, axis=1)[:, :3]
    i, j, k = star[offsets[field][:, None] + members].T
    shared = of_star[i].multiply(of_star[j]).multiply(of_star[k]).sum(axis=1)
    return float(records), float(records * np.mean(1.0 / np.asarray(shared).ravel()))
