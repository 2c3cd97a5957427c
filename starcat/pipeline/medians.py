"""Medians of numbers that lie in many files, exact, a file at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.storage.atomic import whole_file

Keys = NDArray[np.uint64]

_STEP_BITS = 16
_CHUNK = 1 << 20


def write_numbers(values: Array, path: Path) -> None:
    """Write numbers to a file that `median_of` reads."""
    with whole_file(path) as partial:
        partial.write_bytes(np.ascontiguousarray(values, dtype="<f8").tobytes())


def median_of(paths: Sequence[Path]) -> tuple[int, float | None]:
    """Return how many numbers files have, and the median of all.

    Notes
    -----
    The bits of a float, its sign inverted, are a number in the same order. The median's are found
    16 at a time, highest first, by counting in four passes those that begin alike.
    """
    count = sum(path.stat().st_size for path in paths) // 8
    if not count:
        return 0, None
    lower, upper = _ranked(paths, (count - 1) // 2), _ranked(paths, count // 2)
    return count, lower if count % 2 else (lower + upper) / 2.0


def _ranked(paths: Sequence[Path], rank: int) -> float:
    """Return the number that so many are before in ascending order."""
    start = 0
    for shift in range(64 - _STEP_BITS, -1, -_STEP_BITS):
        counts = np.zeros(1 << _STEP_BITS, dtype=np.int64)
        for keys in _keys(paths):
            here = keys if shift + _STEP_BITS == 64 else keys[keys >> (shift + _STEP_BITS) == start]
            step = (here >> np.uint64(shift)) & np.uint64((1 << _STEP_BITS) - 1)
            counts += np.bincount(step.astype(np.int64), minlength=len(counts))
        before = np.cumsum(counts)
        found = int(np.searchsorted(before, rank, side="right"))
        rank -= int(before[found] - counts[found])
        start = start << _STEP_BITS | found
    bits = start ^ (1 << 63) if start >> 63 else start ^ ((1 << 64) - 1)
    return float(np.array([bits], dtype=np.uint64).view(np.float64)[0])


def _keys(paths: Sequence[Path]) -> Iterator[Keys]:
    """Yield the numbers as integers that are in the same order."""
    for path in paths:
        with path.open("rb") as file:
            while data := file.read(8 * _CHUNK):
                bits = np.frombuffer(data, dtype="<u8").astype(np.uint64)
                is_negative = bits >> np.uint64(63) == 1
                yield np.where(is_negative, ~bits, bits | np.uint64(1 << 63))
