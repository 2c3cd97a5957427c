"""Blocks of JPEG: whether an image has them, and the image without the steps at their edges.

Strong compression keeps only the mean and the strongest contrasts of each block of 8 by 8 pixels.
A smooth sky becomes a staircase, and the corners of its steps look like spots. The grid is found in
the image itself, so it is also found in images that were turned over, or saved as PNG afterwards.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from starcat.arrays import Array
from starcat.frames.images.background import Grey

BLOCK_PX = 8
MIN_STEP_RATIO = 1.5
"""Mean step at the edges of blocks over that between other pixels, in an image with blocks."""


def without_block_edges(image: Grey | Array) -> Grey | None:
    """Return an image minus the median of each of its JPEG blocks; None if it has no blocks.

    Without their medians neighbouring blocks have no step between them. Stars that fill less than
    half of a block stand out as before. Leaving out the pixels at the edges would take nearly half
    of all pixels, and stars with them.
    """
    grey = np.asarray(image, dtype=np.float32)
    first_row, first_column = _first_edge(grey, axis=0), _first_edge(grey, axis=1)
    if first_row is None or first_column is None:
        return None
    height, width = grey.shape
    above = np.empty_like(grey)
    across = np.pad(
        np.arange(width), (-first_column % BLOCK_PX, (first_column - width) % BLOCK_PX), mode="edge"
    )
    starts = [0, *range(first_row or BLOCK_PX, height, BLOCK_PX), height]
    for first, last in pairwise(starts):
        strip = grey[first:last, across].reshape(last - first, -1, BLOCK_PX)
        middle = np.repeat(_medians(strip), BLOCK_PX)[-first_column % BLOCK_PX :][:width]
        np.subtract(grey[first:last], middle, out=above[first:last])
    return above


def _first_edge(grey: Grey, axis: int) -> int | None:
    """Return the first row or column, 0 to 7, that begins a block; None if there are none."""
    with np.errstate(invalid="ignore", over="ignore"):
        steps = np.abs(np.diff(grey, axis=axis))
    by_line = np.nan_to_num(steps, posinf=0.0).mean(axis=1 - axis, dtype=np.float64)
    if len(by_line) < 2 * BLOCK_PX:
        return None
    mean = np.array([by_line[first::BLOCK_PX].mean() for first in range(BLOCK_PX)])
    edge = int(mean.argmax())
    others = float(np.delete(mean, edge).mean())
    return (edge + 1) % BLOCK_PX if mean[edge] > MIN_STEP_RATIO * others else None


def _medians(strip: Grey) -> Grey:
    """Return the lower median of each block of a strip (rows, blocks, columns) without its NaN."""
    ordered = np.sort(np.moveaxis(strip, 1, 0).reshape(strip.shape[1], -1), axis=1)
    n_finite = np.isfinite(ordered).sum(axis=1)
    return np.asarray(ordered[np.arange(len(ordered)), np.maximum(n_finite - 1, 0) // 2])
