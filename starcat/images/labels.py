"""Where names go beside the marks of a picture, so that none covers another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from starcat.arrays import Array

_DIRECTIONS = ((1, 0), (-1, 0), (1, -1), (1, 1), (-1, -1), (-1, 1), (0, -1), (0, 1))
"""Right, left, the four diagonals, above, below: the order of preference."""


def place_labels(
    centres: Array,
    radii: Array,
    sizes: Array,
    wanted: Sequence[int],
    frame: tuple[float, float],
    taken: Array,
) -> dict[int, tuple[float, float]]:
    """Place labels beside round marks, one after the other, each where it covers nothing.

    Examples
    --------
    >>> import numpy as np
    >>> two = np.array([[10.0, 50.0], [95.0, 50.0]])
    >>> place_labels(two, np.full(2, 3.0), np.full((2, 2), 8.0), [0, 1], (100.0, 100.0),
    ...              np.empty((0, 4)))
    {0: (15.0, 46.0), 1: (82.0, 46.0)}
    """
    marks = np.concatenate([centres - radii[:, None], centres + radii[:, None]], axis=1)
    blocked = np.concatenate([marks, taken])
    placed = {}
    for mark in wanted:
        others = np.delete(blocked, mark, axis=0)
        for direction in _DIRECTIONS:
            box = _box(centres[mark], float(radii[mark]), sizes[mark], direction)
            is_inside = min(box[0], box[1], frame[0] - box[2], frame[1] - box[3]) >= 0.0
            if is_inside and not _overlaps(box, others):
                placed[mark] = (float(box[0]), float(box[1]))
                blocked = np.concatenate([blocked, box[None]])
                break
    return placed


def _box(centre: Array, radius: float, size: Array, direction: tuple[int, int]) -> Array:
    """Return the label's box on one side of its mark."""
    step = np.array(direction, dtype=np.float64)
    gap = radius + 2.0 if 0 in direction else 0.8 * radius
    middle = centre + step * (gap + 0.5 * size)
    return np.concatenate([middle - 0.5 * size, middle + 0.5 * size])


def _overlaps(box: Array, others: Array) -> bool:
    apart = (others[:, :2] >= box[2:]).any(axis=1) | (others[:, 2:] <= box[:2]).any(axis=1)
    return not apart.all()
