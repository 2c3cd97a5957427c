"""The epoch of a database as numbers: one Julian year, or the two years of a span."""

from __future__ import annotations

from typing import Any


def ends_of(epoch_jyear: Any) -> tuple[float, float]:
    """Return the first and the last year of an epoch or span."""
    begin, end = epoch_jyear if isinstance(epoch_jyear, list | tuple) else [epoch_jyear] * 2
    return float(begin), float(end)


def middle_of(epoch_jyear: Any) -> float:
    """Return the year of the positions of an epoch or span."""
    begin, end = ends_of(epoch_jyear)
    return begin + 0.5 * (end - begin)
