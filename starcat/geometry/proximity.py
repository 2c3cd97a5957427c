"""Neighbours on the sky: nearest neighbours, and all pairs within a separation."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from starcat.arrays import Array, Directions
from starcat.geometry.sphere import chord_from_separation, separation
from starcat.threads import map_in_order

AT_ONCE = 50_000
"""Number of points whose neighbours a thread searches at once."""

SAMPLE = 1000
"""Number of stars from which the typical distance of neighbours is measured."""

MAX_NEAR = 8.0
"""All pairs are searched if a star has at most this many stars, on average, within the radius."""


def nearest_neighbours(directions: Directions, workers: int = 2) -> tuple[Array, NDArray[np.int64]]:
    """Return each star's nearest other star.

    Returns separations in radians, and rows. If several stars have the same separation, the first
    one is returned. N >= 2.
    """
    rows = np.arange(len(directions))
    chord, index = nearest_chords(directions, directions, rows, rows, workers)
    return separation_from_chord(chord), index


def nearest_chords(
    points: Directions,
    stars: Directions,
    itself: NDArray[np.int64],
    rank: NDArray[np.int64],
    workers: int = 1,
) -> tuple[Array, NDArray[np.int64]]:
    """Return the nearest star of each point that is not the point itself.

    ``itself`` is the row of the point in ``stars``, -1 if it is not a star. Of several stars at
    the same distance the star with the lowest rank is taken. If there is no other star, the chord
    is infinite and the row is the number of stars.
    """
    # A plain split by midpoints builds far faster and searches no slower on a sky of stars.
    tree = scipy.spatial.cKDTree(stars, leafsize=16, balanced_tree=False)
    best, index = np.full(len(points), np.inf), np.full(len(points), len(stars))
    if len(points) > 10 * SAMPLE and itself.min() >= 0:
        best, index = (values[itself] for values in _nearest_of_pairs(tree, stars, rank))
    rows = np.flatnonzero(np.isinf(best))
    count = 3  # nearly always a point finds itself, one star and, farther away, another
    while len(rows):
        chord, nearest = _nearest(tree, points[rows], count, workers)
        furthest = chord[:, -1].copy()
        chord[nearest == itself[rows, None]] = np.inf
        least = chord.min(axis=1)
        nearest = np.where(chord == least[:, None], nearest, len(stars))
        ranked = np.where(nearest < len(stars), np.append(rank, 0)[nearest], np.iinfo(np.int64).max)
        first = ranked.argmin(axis=1)
        best[rows], index[rows] = least, nearest[np.arange(len(rows)), first]
        # If the last star is at the same distance as the first, more stars can be at that distance.
        rows = rows[(furthest == least) & np.isfinite(furthest)]
        count = min(4 * count, len(stars) + 1)
    return best, index


def _nearest_of_pairs(
    tree: scipy.spatial.cKDTree, stars: Directions, rank: NDArray[np.int64]
) -> tuple[Array, NDArray[np.int64]]:
    """Return the nearest other star of most stars, which is faster than a search for each star.

    All pairs within a radius are computed; nine of ten stars have another star within it. For the
    tenth star, and for all if there are too many pairs, as in clusters, chords are infinite.
    """
    best, index = np.full(len(stars), np.inf), np.full(len(stars), len(stars))
    some = stars[np.random.default_rng(0).integers(len(stars), size=SAMPLE)]
    radius = float(np.quantile(_nearest(tree, some, 2, 0)[0][:, 1], 0.9))
    if tree.query_ball_point(some, radius, return_length=True).mean() > MAX_NEAR:
        return best, index
    pairs = tree.query_pairs(radius, output_type="ndarray")
    legs = (stars[pairs[:, 0]] - stars[pairs[:, 1]]) ** 2
    chord = np.sqrt(legs[:, 0] + legs[:, 1] + legs[:, 2])  # the same bits as the tree has
    lowest = np.full(len(stars), np.iinfo(np.int64).max)
    ways = (pairs[:, 0], pairs[:, 1]), (pairs[:, 1], pairs[:, 0])
    for star, _ in ways:
        np.minimum.at(best, star, chord)
    for star, other in ways:
        is_nearest = chord == best[star]
        np.minimum.at(lowest, star[is_nearest], rank[other[is_nearest]])
    for star, other in ways:
        is_first = (chord == best[star]) & (rank[other] == lowest[star])
        index[star[is_first]] = other[is_first]
    return best, index


def _nearest(
    tree: scipy.spatial.cKDTree, points: Directions, count: int, workers: int
) -> tuple[Array, NDArray[np.int64]]:
    """Return chords and rows of the nearest stars of each point.

    After an interrupt scipy's own threads would continue with freed memory. These threads are
    waited for.
    """
    parts = (points[first : first + AT_ONCE] for first in range(0, len(points), AT_ONCE))
    near = list(map_in_order(lambda part: tree.query(part, k=count), parts, workers))
    if not near:
        return np.empty((0, count)), np.empty((0, count), dtype=np.int64)
    chords, rows = zip(*near, strict=True)
    return np.concatenate(chords), np.concatenate(rows).astype(np.int64, copy=False)


def separation_from_chord(chord: Array) -> Array:
    """Return the separation of directions whose tips are a chord apart."""
    # Chord |u - v| and |u + v| are the legs of a right triangle over the diameter.
    # The chord of antipodes can be rounded above the diameter.
    other = np.sqrt(np.maximum(2.0 - chord, 0.0) * (2.0 + chord))
    return 2.0 * np.arctan2(chord, other)


def pairs_within(
    directions: Directions, max_separation_rad: float
) -> tuple[NDArray[np.int64], Array]:
    """Return all pairs of stars within a separation.

    Rows i < j, shape (M, 2), in order of (i, j), and separations, radians; the largest is
    included.
    """
    if len(directions) < 2:
        return np.empty((0, 2), dtype=np.int64), np.empty(0)
    # The search is a little wider than asked, and its result is trimmed by separation.
    radius = chord_from_separation(max_separation_rad) * (1.0 + 1e-9) + 1e-15
    near = scipy.spatial.cKDTree(directions).query_pairs(radius, output_type="ndarray")
    # Both rows are packed into one number, as sorting numbers is several times faster.
    key = np.sort((near[:, 0].astype(np.int64) << 32) | near[:, 1])
    pairs = np.stack([key >> 32, key & 0xFFFFFFFF], axis=-1)
    angle = separation(directions[pairs[:, 0]], directions[pairs[:, 1]])
    within = angle <= max_separation_rad
    return pairs[within], angle[within]
