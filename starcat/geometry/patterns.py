"""Star patterns: the area of a triangle, and the numbering of neighbours about a star.

Products number the neighbours of every star of the catalog; the matcher numbers the neighbours of a
centroid in a frame. They match only if both are numbered alike, so each rule is here only once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from starcat.arrays import Array

Whole = NDArray[np.int64]


def bin_of(
    angle_rad: ArrayLike,
    separation_rad: ArrayLike,
    angle_bin_rad: float,
    separation_bin_rad: float,
    n_angle_bins: int,
    n_separation_bins: int,
) -> Whole:
    """Return the bins of successive angles and separations in the look-up table.

    ``angle bin * n_separation_bins + separation bin``. A bin includes its lower end and not its
    upper end; the last bin includes all values above.

    >>> bin_of([0.0, 1.0, 9.0], [0.3, 0.1, 0.9], 1.0, 0.2, 3, 2)
    array([1, 2, 5])
    """
    angle, apart = np.asarray(angle_rad, np.float64), np.asarray(separation_rad, np.float64)
    a = np.minimum(np.floor(angle / angle_bin_rad), n_angle_bins - 1)
    s = np.minimum(np.floor(apart / separation_bin_rad), n_separation_bins - 1)
    return np.asarray(a * n_separation_bins + s).astype(np.int64)


def cell_of(x: ArrayLike, y: ArrayLike, radius_rad: float, cells_per_side: int) -> Whole:
    """Return the numbers of the cells of a square grid about a star.

    Gnomonic coordinates about the star in focal lengths, x towards the alignment star and y
    counter-clockwise of it on the sky as seen; the grid spans ``-tan(radius)`` to
    ``tan(radius)``. The number is ``row * cells_per_side + column``, rows along y, both upwards
    from 0. A cell includes its lower edges and not its upper ones; points outside of the grid
    belong to the cells at its edge.

    >>> cell_of([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], np.pi / 4.0, 2)
    array([0, 3, 3])
    """
    reach = np.tan(radius_rad)

    def step(value: ArrayLike) -> Whole:
        part = (np.asarray(value, dtype=np.float64) + reach) / (2.0 * reach)
        cell = np.floor(part * cells_per_side).astype(np.int64)
        return np.asarray(np.clip(cell, 0, cells_per_side - 1))

    return step(y) * cells_per_side + step(x)


def ring_of(separation_rad: ArrayLike, radius_rad: float, rings: int) -> Whole:
    """Return the rings that separations fall in.

    From 0, the innermost. A ring includes its inner end and not its outer end; the last ring
    includes all larger separations.

    >>> ring_of([0.0, 0.5, 0.99, 1.0], 1.0, 2)
    array([0, 1, 1, 1])
    """
    part = np.asarray(separation_rad, dtype=np.float64) / radius_rad
    return np.minimum(np.floor(part * rings), rings - 1).astype(np.int64)


def sector_of(turn_rad: ArrayLike, sectors: int) -> Whole:
    """Return the sectors that angles from the nearest neighbour fall in.

    Position angle minus the nearest neighbour's, where sector 0 begins, counter-clockwise.

    >>> sector_of(np.radians([0.0, 95.0, -5.0]), 4)
    array([0, 1, 3])
    """
    part = np.mod(turn_rad, 2.0 * np.pi) / (2.0 * np.pi)
    return np.minimum(np.floor(part * sectors), sectors - 1).astype(np.int64)


def cyclic_shifts(pattern: Whole | int, sectors: int) -> Whole:
    """Return all cyclic shifts of bit patterns.

    Bit s stands for sector s; the first axis of the result has the shifts. The product ``radial``
    keeps the smallest shift: patterns that differ by a rotation have the same smallest shift.

    >>> cyclic_shifts(0b0011, 4).tolist()
    [3, 9, 12, 6]
    """
    shift = np.arange(sectors).reshape(-1, *[1] * np.ndim(pattern))
    every = (1 << sectors) - 1
    return np.asarray((pattern >> shift) | ((pattern << (sectors - shift)) & every))


def triangle_area(a: Array, b: Array, c: Array) -> Array:
    """Return the area of plane triangles from their sides in any order; 0 if they do not close.

    Heron's formula in the order of operations of Kahan 2014, which keeps its digits for
    needle-like triangles.

    >>> triangle_area(np.array([3.0]), np.array([5.0]), np.array([4.0]))
    array([6.])
    """
    # Comparisons sort three numbers four times as fast as np.sort does along so short an axis.
    low, high = np.minimum(a, b), np.maximum(a, b)
    short, middle = np.minimum(low, c), np.maximum(low, c)
    middle, long = np.minimum(middle, high), np.maximum(middle, high)
    product = (
        (long + (middle + short))
        * (short - (long - middle))
        * (short + (long - middle))
        * (long + (middle - short))
    )
    return np.asarray(0.25 * np.sqrt(np.maximum(product, 0.0)))
