"""The K-vector: a range search over a sorted array without a binary search.

A straight line is laid over the sorted values; entry ``k`` of the vector counts the values
on or below the line at step ``k``. A range query evaluates the inverse line twice and reads
two entries. Works over any sorted array: separations, triangle areas, anything.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array


@dataclass(frozen=True)
class KVector:
    """A K-vector over a sorted array of values.

    Mortari and Neta 2000, "K-vector range searching techniques".
    """

    values: Array  # shape (n,): sorted, finite, ascending; duplicates are welcome
    # shape (n,): ``counts[i]`` is the number of values on or below ``intercept + slope * i``
    counts: NDArray[np.int32]
    # intercept, slope: the line, in the unit of the values; ``slope`` is 0 where n < 2
    intercept: float
    slope: float

    def range(self, low: float, high: float) -> slice:
        """Return a slice that holds every value in ``[low, high]``, and few others.

        The interval is closed, in the unit of the values. The slice is empty if the interval is
        empty, inverted or out of bounds, or if an end is NaN. At either end the slice has at most
        the values of one step of the line too many.
        """
        n = len(self.values)
        if n == 0 or not low <= high or high < self.values[0] or low > self.values[-1]:
            return slice(0, 0)
        if self.slope == 0.0:
            return slice(0, n)
        # The inverse of the line, clamped to its ends. Rounding can put either end a step too far
        # inside.
        first = math.floor(min(max((low - self.intercept) / self.slope, 0.0), n - 1.0))
        last = math.ceil(min(max((high - self.intercept) / self.slope, 0.0), n - 1.0))
        while first >= 0 and self.intercept + self.slope * first >= low:
            first -= 1
        while last < n and self.intercept + self.slope * last < high:
            last += 1
        start = int(self.counts[first]) if first >= 0 else 0
        stop = int(self.counts[last]) if last < n else n
        return slice(start, stop)

    def exact(self, low: float, high: float) -> slice:
        """Return the slice of the values in ``[low, high]`` and no others."""
        superset = self.range(low, high)
        part = self.values[superset]
        start = superset.start + int(np.searchsorted(part, low, side="left"))
        stop = superset.start + int(np.searchsorted(part, high, side="right"))
        return slice(start, max(start, stop))


def build_kvector(values: Array) -> KVector:
    """Build the K-vector of values; ValueError unless they are ascending and finite.

    It refers to the values and does not copy them.

    >>> index = build_kvector(np.array([0.1, 0.2, 0.2, 0.7]))
    >>> index.exact(0.15, 0.2)
    slice(1, 3, None)
    """
    if values.ndim != 1 or len(values) >= 2**31:
        raise ValueError(f"values have shape {values.shape}; expected (n,) with n < 2**31")
    n = len(values)
    if n and not (np.isfinite(values[[0, -1]]).all() and bool(np.all(values[1:] >= values[:-1]))):
        raise ValueError("values are not sorted ascending and finite: sort them first")
    if n < 2:
        counts = np.full(n, n, dtype=np.int32)
        return KVector(values, counts, float(values[0]) if n else 0.0, 0.0)
    # The line passes just below the first and just above the last value (xi in the paper).
    xi = float(np.spacing(max(abs(values[0]), abs(values[-1])))) * n
    intercept = float(values[0]) - xi
    slope = (float(values[-1]) + xi - intercept) / (n - 1)
    line = intercept + slope * np.arange(n)
    counts = np.searchsorted(values, line, side="right").astype(np.int32)
    return KVector(values, counts, intercept, slope)
