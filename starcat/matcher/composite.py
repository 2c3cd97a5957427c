"""Composites: the spots of successive frames without an answer, put together.

Two frames of the same sky have stars in common, and differ by a turn of the camera. The turn is
found from the spots alone: two spots of each frame with the same separation give a turn, and the
turn that puts the most spots on each other is taken. The composite has the spots of all its frames
in the camera frame of the last one. A spot that was seen again has the mean of its places, so the
composite has more stars than a frame, and more accurate ones.

No star of the database is looked at for this. So the places of a composite are random if those of
its frames are, also if the same false spots are in each of them, and the bound on a false match is
that of a frame with these spots (`starcat.matcher.chance`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Directions, Matrix, Pixels, Rows
from starcat.geometry.attitude import solve_wahba_svd
from starcat.geometry.camera import Camera
from starcat.matcher.brightest import MAX_CENTROIDS
from starcat.matcher.observation import Observation
from starcat.matcher.prior import turn_of_noise_rad

SAME_SPOT = math.sqrt(2.0)
"""Largest distance of two places of a spot, in tolerances: each of them has an error."""

MOST_SEEDS = 24
"""Number of spots of a frame, and of a composite, from which turns are found."""

LEAST_SHARED = 3
"""Smallest number of spots that two frames share: two of them determine the turn."""

MOST_SEEN = 1000
"""Largest number of frames in the mean of the places of a spot."""


@dataclass(frozen=True)
class Composite:
    """Spots of successive frames, in the camera frame of the last one.

    Those of the last frame are first: the brightest, or without magnitudes the nearest to the
    centre, so that the first ones of two frames are the same stars.
    """

    body: Directions
    mag: Array  # of the last frame that has the spot, NaN if not known
    seen: NDArray[np.int64]  # number of frames that have it; 0: one, which is not the last one

    def __len__(self) -> int:
        return len(self.body)

    def pixels(self, camera: Camera) -> tuple[Pixels, Array]:
        """Return the places and the magnitudes of the spots that are in the frame of a camera."""
        px = camera.pixels_from_directions(self.body)
        inside = camera.contains(px)
        return px[inside], self.mag[inside]


def composite_of(frame: Observation) -> Composite:
    """Return a composite of one frame."""
    count = len(frame)
    mag = np.full(count, np.nan) if frame.mag is None else frame.mag
    return Composite(frame.body, mag, np.ones(count, dtype=int))


def joined(before: Composite, frame: Observation, turn_rad: float) -> Composite | None:
    """Return a composite with one more frame.

    The camera may have turned by ``turn_rad`` and what noise adds to it. None if fewer than
    `LEAST_SHARED` spots are at the same places after each such turn.
    """
    new, old = composite_of(frame), before.body
    turn = _likeliest_turn(old[:MOST_SEEDS], new.body[:MOST_SEEDS], frame, turn_rad)
    if turn is None:
        return None
    spots, again = _shared(old, new.body @ turn.T, frame)
    if len(np.unique(again)) < LEAST_SHARED:
        return None
    turn = solve_wahba_svd(old[spots], new.body[again])
    spots, again = _shared(old, new.body @ turn.T, frame)
    if len(np.unique(again)) < LEAST_SHARED:
        return None
    return _merged(before, new, turn, spots, again, frame.camera.radius_rad)


def _likeliest_turn(
    old: Directions, new: Directions, frame: Observation, turn_rad: float
) -> Matrix | None:
    """Return the turn that puts the most new spots on old ones, of those that two spots give.

    It converts directions in the camera frame of the new spots into that of the old ones.
    """
    limit_rad = SAME_SPOT * frame.tolerance_rad
    most_rad = turn_rad + turn_of_noise_rad(frame.camera, frame.tolerance_px)
    i, j = np.nonzero(_squared_chords(old, new) <= (most_rad + limit_rad) ** 2)
    first, second = np.triu_indices(len(i), 1)
    old_sides, new_sides = (np.sqrt(_squared_chords(body, body)) for body in (old, new))
    apart = old_sides[i[first], i[second]] - new_sides[j[first], j[second]]
    is_pair = (i[first] != i[second]) & (j[first] != j[second])
    is_pair &= np.abs(apart) <= SAME_SPOT * frame.side_tolerance_rad
    pairs = np.stack([first[is_pair], second[is_pair]], axis=1)
    turns = solve_wahba_svd(old[i[pairs]], new[j[pairs]])
    turns = turns[np.trace(turns, axis1=1, axis2=2) >= 1.0 + 2.0 * math.cos(most_rad)]
    if not len(turns):
        return None
    square = _squared_chords(new @ turns.swapaxes(1, 2), old).min(axis=1)
    return np.asarray(turns[np.minimum(square, limit_rad**2).sum(axis=1).argmin()])


def _shared(old: Directions, turned: Directions, frame: Observation) -> tuple[Rows, Rows]:
    """Return the rows of the old spots that are seen again, and of the new spot nearest to each."""
    square = _squared_chords(old, turned)
    nearest = square.argmin(axis=1)
    is_near = square.min(axis=1) <= (SAME_SPOT * frame.tolerance_rad) ** 2
    return np.flatnonzero(is_near), nearest[is_near]


def _merged(
    before: Composite, new: Composite, turn: Matrix, spots: Rows, again: Rows, radius_rad: float
) -> Composite:
    """Return the new spots in their order, and then the old ones that are kept.

    An old spot that is not seen again is dropped if it was seen once, before the last frame, or is
    out of the field, or beyond the number of centroids that are searched.
    """
    again, first = np.unique(again, return_index=True)
    seen, body = new.seen.copy(), new.body.copy()
    seen[again] = np.minimum(np.maximum(before.seen[spots[first]], 1) + 1, MOST_SEEN)
    mean = before.body[spots[first]]
    mean += (new.body[again] @ turn.T - mean) / seen[again, None]
    body[again] = mean / np.linalg.norm(mean, axis=1)[:, None] @ turn
    old = before.body @ turn
    is_kept = (before.seen > 0) & (old[:, 2] >= math.cos(radius_rad))
    is_kept[spots] = False
    is_kept[np.flatnonzero(is_kept)[max(0, MAX_CENTROIDS - len(new)) :]] = False
    return Composite(
        np.concatenate([body, old[is_kept]]),
        np.concatenate([new.mag, before.mag[is_kept]]),
        np.concatenate([seen, np.where(before.seen == 1, 0, before.seen)[is_kept]]),
    )


def _squared_chords(a: Array, b: Array) -> Array:
    """Return the squared distances of directions: shape (..., N, M) of (..., N, 3) and (M, 3)."""
    return np.asarray(sum((a[..., :, None, axis] - b[:, axis]) ** 2 for axis in range(3)))
