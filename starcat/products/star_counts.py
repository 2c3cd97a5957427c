"""Counts of a catalog's stars, on the sky and by magnitude, for cross-identification.

The counts of the parts of a catalog add up to those of the whole, in any order.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from starcat.arrays import Array, Directions
from starcat.geometry.sphere import saff_kuijlaars

Rows = NDArray[np.int64]

TILES = 3072  # number of pieces of the sky, 13 square degrees each, in which stars are counted

# The density of a tile is the mean over so many tiles around it, as one tile has few stars.
TILES_AVERAGED = 9

# Step of the distribution of magnitudes, and standard deviation of the kernel that smooths it;
# magnitudes.
MAG_BIN, MAG_SMOOTHING = 0.1, 0.5


class PositionsAndMagnitudes(Protocol):
    """What the odds need to know of a catalog."""

    @property
    def directions(self) -> Array:
        """ICRS unit vectors, shape (N, 3)."""

    @property
    def mag(self) -> Array:
        """Magnitudes, shape (N,); NaN where unknown."""

    @property
    def error_rad(self) -> Array | None:
        """Standard deviations of the positions, each axis."""


@dataclass(frozen=True)
class MagnitudeCounts:
    """How many stars have which magnitude."""

    lowest: int  # number of the first bin; bin k begins at ``k * MAG_BIN``
    counts: Rows  # shape (K,): stars of each bin; empty where no magnitude is known

    @classmethod
    def of(cls, mag: Array) -> MagnitudeCounts:
        """Count magnitudes; NaN where unknown."""
        known = mag[~np.isnan(mag)]
        if not len(known):
            return cls(0, np.empty(0, dtype=np.int64))
        place = np.floor(known / MAG_BIN).astype(np.int64)
        lowest = int(place.min())
        return cls(lowest, np.bincount(place - lowest))

    def __add__(self, other: MagnitudeCounts) -> MagnitudeCounts:
        """Return the counts of both."""
        if not len(self.counts) or not len(other.counts):
            return self if len(self.counts) else other
        lowest = min(self.lowest, other.lowest)
        end = max(each.lowest + len(each.counts) for each in (self, other))
        counts = np.zeros(end - lowest, dtype=np.int64)
        for each in (self, other):
            start = each.lowest - lowest
            counts[start : start + len(each.counts)] += each.counts
        return MagnitudeCounts(lowest, counts)

    def density(self, wanted: Array) -> Array:
        """Return the share of the stars per magnitude, smoothed; it integrates to 1."""
        reach = int(np.ceil(4.0 * MAG_SMOOTHING / MAG_BIN))
        counts = np.pad(self.counts, reach).astype(np.float64)
        kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * MAG_BIN / MAG_SMOOTHING) ** 2)
        whole = self.counts.sum() * MAG_BIN
        density = np.convolve(counts, kernel / kernel.sum(), mode="same") / whole
        middles = (self.lowest - reach + 0.5 + np.arange(len(density))) * MAG_BIN
        return np.asarray(np.interp(wanted, middles, density))


@dataclass(frozen=True)
class Census:
    """Counts of the stars of a catalog, or of a part of it."""

    tiles: Rows  # shape (TILES,): stars in each tile of the sky
    magnitudes: MagnitudeCounts  # stars by magnitude

    @classmethod
    def of(cls, stars: PositionsAndMagnitudes) -> Census:
        """Count the stars of a catalog, or of a part of it."""
        tiles = np.bincount(tiles_of(stars.directions), minlength=TILES)
        return cls(tiles, MagnitudeCounts.of(stars.mag))

    def __add__(self, other: Census) -> Census:
        """Return the counts of both."""
        return Census(self.tiles + other.tiles, self.magnitudes + other.magnitudes)

    @property
    def stars(self) -> int:
        """Number of stars counted."""
        return int(self.tiles.sum())

    def density(self) -> Array:
        """Return the number of stars per steradian around each tile, never 0.

        At least one star is counted.
        """
        total = np.maximum(self.tiles[_tiles()[1]].sum(axis=1).astype(np.float64), 1.0)
        return np.asarray(total / (TILES_AVERAGED * 4.0 * np.pi / TILES))


def tiles_of(directions: Directions) -> Rows:
    """Return the tiles of the sky that directions are in, 0 to ``TILES - 1``."""
    return np.asarray(_tiles()[0].query(directions)[1], dtype=np.int64)


@cache
def _tiles() -> tuple[cKDTree, Rows]:
    """Return a tree of the tiles' middles, and the tiles around each."""
    middles = saff_kuijlaars(TILES)
    tree = cKDTree(middles)
    return tree, np.asarray(tree.query(middles, k=TILES_AVERAGED)[1], dtype=np.int64)
