"""A second attitude in a frame: a ghost, a smear or a double exposure shows the same stars twice.

Either of the two patterns is a sky, and no frame says which one is the camera's. The second one is
looked for if many of the centroids without a star have the same offset from centroids with a star.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from starcat.arrays import Pixels, Rows
from starcat.matcher.chance import MIN_STARS
from starcat.matcher.result import MatchResult
from starcat.matcher.settings import REACH

LEAST_PART = 0.5
"""Least number of centroids without a star, and of those with one offset, over the stars."""


def rows_of_second_pattern(
    answer: MatchResult, centroids_px: Pixels, tolerance_px: float
) -> Rows | None:
    """Return the centroids without a star if many have one offset from the others; else None."""
    n_without = answer.star_index.tolist().count(-1)  # faster than an array, for every answer
    n_stars = len(answer.star_index) - n_without
    least = max(MIN_STARS, math.ceil(LEAST_PART * n_stars))
    if n_without < least:
        return None
    has_star = answer.star_index >= 0
    stars = np.flatnonzero(has_star)
    has_star[[row for row, _ in answer.dropped]] = True  # not usable
    rows = np.flatnonzero(~has_star)
    if len(rows) < least:
        return None
    reach_px = 2.0 * REACH * tolerance_px
    is_second = _have_one_offset(centroids_px[rows], centroids_px[stars], reach_px, least)
    return rows if is_second else None


def with_second_attitude(answer: MatchResult, rows: Rows, other: MatchResult) -> MatchResult:
    """Return an answer with the answer to the centroids of some rows by themselves."""
    if not other.ok:
        return answer
    star_index = np.full(len(answer.star_index), -1, dtype=np.int32)
    star_index[rows] = other.star_index
    whole = replace(other, star_index=star_index, frame=answer.frame, dropped=answer.dropped)
    return replace(answer, other=whole)


def _have_one_offset(loose: Pixels, matched: Pixels, reach_px: float, least: int) -> bool:
    """Return whether many centroids have the same offset from one of the others."""
    offset = (loose[:, None] - matched).reshape(-1, 2)
    # Cells of twice the reach, in four grids: one of them has an offset and all within the reach.
    for shift in ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5)):
        cell = np.floor(offset / (2.0 * reach_px) + shift).astype(np.int64)
        _, count = np.unique(cell, axis=0, return_counts=True)
        if count.max() >= least:
            return True
    return False
