"""The parts of a product: columns with the names of its schema, and the matcher's indices.

Every product function returns a frozen dataclass whose attributes carry the names of the
schema's columns; a ragged column is a `Ragged`. Arrays that only a matcher needs (a K-vector, a
look-up table, the first row of each star) are in the attribute ``index``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.geometry.kvector import KVector


@dataclass(frozen=True)
class Ragged:
    """One list per row: row n has the list ``values[offsets[n]:offsets[n + 1]]``."""

    offsets: NDArray[np.int64]
    values: NDArray[Any]


@dataclass(frozen=True)
class Index:
    """Arrays and numbers in addition to a product's columns, stored only in the HDF5 file."""

    datasets: dict[str, NDArray[Any]] = field(default_factory=dict)
    attributes: dict[str, float] = field(default_factory=dict)  # names include units


def kvector_index(kvector: KVector) -> Index:
    """Return a K-vector as an index: its counts, intercept and slope."""
    line = {"kvector_intercept": kvector.intercept, "kvector_slope": kvector.slope}
    return Index({"kvector_counts": kvector.counts}, line)


def row_offsets(key: NDArray[np.integer[Any]], count: int) -> NDArray[np.int64]:
    """Return where the rows of each key begin in a table sorted by it.

    The rows of key n, from 0 to ``count - 1``, are ``offsets[n]:offsets[n + 1]``.

    >>> row_offsets(np.array([0, 0, 2]), 3)
    array([0, 2, 2, 3])
    """
    return np.searchsorted(key, np.arange(count + 1), side="left").astype(np.int64)


def sorted_unique(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the distinct keys in order.

    Sorting whole and dropping repeats is faster here than hashing.

    >>> sorted_unique(np.array([3, 1, 3]))
    array([1, 3])
    """
    ordered = np.sort(keys)
    fresh = np.ones(len(ordered), dtype=bool)
    np.not_equal(ordered[1:], ordered[:-1], out=fresh[1:])
    return np.asarray(ordered[fresh])


def stable_order(labels: NDArray[np.integer[Any]], count: int) -> NDArray[np.int64]:
    """Return the order that groups rows by a small label and keeps them in order within it.

    As a stable argsort of labels from 0 to ``count - 1``, in time linear in their number: 16
    bits at a time, which numpy sorts by counting.

    >>> stable_order(np.array([1, 0, 1]), 2)
    array([1, 0, 2])
    """
    order = np.argsort((labels & 0xFFFF).astype(np.uint16), kind="stable")
    shift = 16
    while count > 1 << shift:
        digits = ((labels >> shift) & 0xFFFF).astype(np.uint16)
        order = order[np.argsort(digits[order], kind="stable")]
        shift += 16
    return order


def inverted_lists(
    name: str, row: NDArray[np.int64], cell: NDArray[np.int64], rows: int, count: int
) -> tuple[Ragged, dict[str, NDArray[Any]]]:
    """Return the occupied cells (or rings) of each row, and the rows of each of ``count`` cells."""
    row, cell = np.divmod(sorted_unique(row * count + cell), count)
    order = stable_order(cell, count)
    lookup: dict[str, NDArray[Any]] = {
        f"{name}_offsets": row_offsets(cell[order], count),
        f"{name}_rows": row[order].astype(np.int32),
    }
    return Ragged(row_offsets(row, rows), cell.astype(np.int32)), lookup
