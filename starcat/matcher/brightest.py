"""The centroids of a frame that are searched: the brightest, if there are too many."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Pixels, Rows
from starcat.matcher.observation import (
    Dropped,
    Frame,
    Frames,
    known_magnitudes,
    unusable,
    without_repeats,
)
from starcat.matcher.result import MatchResult

MAX_CENTROIDS = 512
"""Largest number of centroids of a frame that are searched, also by the C library."""


@dataclass(frozen=True)
class Brightest:
    """The centroids of a frame that are searched, and their whole frame."""

    whole: Frame
    rows: Rows  # rows of the whole frame that are searched, ascending
    dropped: Dropped  # centroids of the whole frame that are not used

    @property
    def frame(self) -> Frame:
        """The centroids that are searched, as a frame."""
        return self.whole.at(self.rows)

    def answer_of(self, searched: MatchResult) -> MatchResult:
        """Return the answer to the whole frame from the answer to its searched part.

        Centroids that were not searched have no star: in a frame with this many centroids some
        lie near any star by chance.
        """
        star_index = np.full(len(self.whole), -1, dtype=np.int32)
        star_index[self.rows] = searched.star_index
        why = searched.refusal
        if why is not None and why.candidate is not None:
            why = replace(why, candidate=self.answer_of(why.candidate))
        return replace(
            searched,
            star_index=star_index,
            dropped=self.dropped,
            frame=self.whole,
            refusal=why,
            n_not_searched=len(self.whole) - len(self.rows) - len(self.dropped),
        )


def brightest_of(frame: Frame) -> Brightest:
    """Return the centroids of a frame that are searched: at most `MAX_CENTROIDS`."""
    px = frame.centroids_px
    inside = frame.camera.contains(px)
    rows = np.flatnonzero(inside)
    dropped = [] if len(rows) == len(px) else unusable(px, inside)
    hashes = _hash(px[rows])
    mag = np.zeros(len(rows))
    if frame.mag is not None:
        mag = np.nan_to_num(known_magnitudes(frame.mag)[rows], nan=np.inf)
    # Centroids at exactly the same place count once. Few frames have any, so it is nearly always
    # enough to sort twice as many centroids as are needed.
    for count in (2 * MAX_CENTROIDS, len(rows)):
        first = _first(mag, hashes, count)
        distinct, repeats = without_repeats(rows[first], px)
        if len(distinct) >= MAX_CENTROIDS:
            break
    return Brightest(frame, np.sort(distinct[:MAX_CENTROIDS]), (*dropped, *repeats))


def brightest_of_frames(frames: Frames) -> tuple[Frames, dict[int, Brightest]]:
    """Return frames with the centroids that are searched, and those frames that had more."""
    counts = np.diff(frames.starts)
    crowded = {int(n): brightest_of(frames[int(n)]) for n in np.flatnonzero(counts > MAX_CENTROIDS)}
    if not crowded:
        return frames, {}
    is_kept = np.ones(len(frames.centroids_px), dtype=bool)
    for n, part in crowded.items():
        is_kept[frames.starts[n] : frames.starts[n + 1]] = False
        is_kept[frames.starts[n] + part.rows] = True
        counts[n] = len(part.rows)
    mag, sigma = frames.mag, frames.sigma_px
    searched = replace(
        frames,
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        centroids_px=frames.centroids_px[is_kept],
        mag=None if mag is None else mag[is_kept],
        sigma_px=None if sigma is None else sigma[is_kept],
    )
    return searched, crowded


def _first(mag: Array, hashes: NDArray[np.uint64], count: int) -> Rows:
    """Return the brightest rows, in order, including all that are as bright as the last one."""
    near = np.arange(len(mag))
    for key in (mag, hashes):
        if len(near) > count:
            values = key[near]
            near = near[values <= np.partition(values, count - 1)[count - 1]]
    return near[np.lexsort((hashes[near], mag[near]))]


def _hash(px: Pixels) -> NDArray[np.uint64]:
    """Return a hash of each pair of coordinates (the mixing function of splitmix64)."""
    x, y = np.ascontiguousarray((px + 0.0).T).view(np.uint64)  # -0.0 becomes 0.0
    return _mixed(_mixed(x) + y)


def _mixed(z: NDArray[np.uint64]) -> NDArray[np.uint64]:
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(z ^ (z >> np.uint64(31)))
