"""The plan of a store: which pixels are its partitions, decided by counts of stars alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from starcat.errors import ConfigError
from starcat.store.pixels import Pixel, Pixels

MAX_ROWS = 500_000
"""Stars of a partition at most: a worker finishes one in some 400 MB."""

_ROWS_A_BATCH = 8_192
_SPILL_ORDERS = (2, 6)


def partition_pixels(
    pixels: Pixels, counts: NDArray[np.int64], order: int, max_rows: int, name: str
) -> tuple[Pixel, ...]:
    """Return the largest pixels that hold no more stars than allowed and cover all of them.

    Examples
    --------
    >>> partition_pixels(np.array([0, 1, 40]), np.array([5, 5, 3]), 2, 5, "some")
    (Pixel(order=2, number=0), Pixel(order=2, number=1), Pixel(order=0, number=2))
    """
    chosen: list[Pixel] = []
    for level in range(order + 1):
        parent, first = np.unique(pixels >> 2 * (order - level), return_index=True)
        if not len(parent):
            break
        total = np.add.reduceat(counts, first)
        fits = total <= max_rows
        chosen += [Pixel(level, number) for number in parent[fits].tolist()]
        left = ~np.repeat(fits, np.diff([*first, len(pixels)]))
        pixels, counts = pixels[left], counts[left]
    if len(pixels):
        raise ConfigError(
            f"{name}: {counts.max()} stars are in one place, more than the {max_rows} that a "
            "partition may hold; allow more with --max-partition-rows"
        )
    return tuple(sorted(chosen, key=lambda pixel: pixel.first))


def spill_order(rows: int) -> int:
    """Return the order of the coarse pixels that runs have batches of."""
    least, most = _SPILL_ORDERS
    return next((k for k in range(least, most) if rows <= 12 * 4**k * _ROWS_A_BATCH), most)
