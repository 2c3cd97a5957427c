"""Regions of the sky that grow: a pixel, and rings of pixels around it.

What lies within one hop of a place in a region lies in the region with one ring more, so that a
chain of stars, each within a hop of the next, can be followed across the borders of partitions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcat.store.pixels import (
    MAX_ORDER,
    Pixel,
    Pixels,
    border_of,
    border_order,
    least_width_rad,
    neighbours_of,
)

FINEST_RINGS = 8
"""Orders that the pixels of the rings may be above that of the pixel within: 1024 or so a ring."""

WHOLE_SKY = ((0, 12 << 2 * MAX_ORDER),)

Levels = NDArray[np.int64]


@dataclass(frozen=True)
class Region:
    """A pixel and the rings around it."""

    core: Pixel | None  # the pixel in the middle; None for the whole sky
    order: int  # order of the rings' pixels
    pixels: Pixels  # shape (N,): pixels of the rings, ascending
    levels: Levels  # shape (N,): number of the ring that each is in, from 1

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

    def level_of(self, pixels: Pixels) -> Levels:
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


def region_around(pixel: Pixel, hop_rad: float, rings: int) -> Region:
    """Return the region with so many rings around a pixel."""
    widest, finest = least_width_rad(np.array([0, min(pixel.order + FINEST_RINGS, MAX_ORDER)]))
    nothing = np.empty(0, dtype=np.int64)
    if not hop_rad <= widest:
        return Region(None, 0, nothing, nothing)
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
    return Region(core, order, pixels[ascending], levels[ascending])
