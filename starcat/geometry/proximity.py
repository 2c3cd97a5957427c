"""Who is near whom on the sky: nearest neighbours, and all pairs within a separation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from starcat.geometry.sphere import chord_from_separation, separation


def nearest_neighbours(
    directions: NDArray[np.float64], workers: int = 2
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return each star's nearest other star.

    Parameters
    ----------
    directions : ndarray of float64, shape (N, 3)
        ICRS unit vectors, N >= 2.
    workers : int, default 2
        Threads; the result is the same for any number.

    Returns
    -------
    separation_rad : ndarray of float64, shape (N,)
        Great-circle separation.
    index : ndarray of int64, shape (N,)
        Row of the neighbour; of several at the same separation the first.
    """
    rows = np.arange(len(directions))
    chord, index = nearest_chords(directions, directions, rows, rows, workers)
    return separation_from_chord(chord), index


def nearest_chords(
    points: NDArray[np.float64],
    stars: NDArray[np.float64],
    itself: NDArray[np.int64],
    rank: NDArray[np.int64],
    workers: int = 1,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the nearest star of each point that is not the point itself.

    Parameters
    ----------
    points : ndarray of float64, shape (M, 3)
        ICRS unit vectors.
    stars : ndarray of float64, shape (N, 3)
        Where the neighbours are looked for.
    itself : ndarray of int64, shape (M,)
        Row of ``stars`` that is the point; -1 where none is.
    rank : ndarray of int64, shape (N,)
        Of several stars at the same distance, that of the lowest rank is taken.
    workers : int, default 1
        Threads.

    Returns
    -------
    chord : ndarray of float64, shape (M,)
        Length of the chord between the two; infinite where there is no other star.
    index : ndarray of int64, shape (M,)
        Row of ``stars``; their number where there is none.
    """
    # A plain split by midpoints builds far faster and searches no slower on a sky of stars.
    tree = cKDTree(stars, leafsize=16, balanced_tree=False)
    near = tree.query(points, k=3, workers=workers)
    chord, found = np.asarray(near[0]), np.asarray(near[1], dtype=np.int64)
    # Nearly always a point finds itself, one star and, farther away, another.
    best, index = chord[:, 1].copy(), found[:, 1].copy()
    rows = np.flatnonzero((found[:, 0] != itself) | ~(chord[:, 2] > chord[:, 1]))
    count = 3
    while len(rows):
        near = tree.query(points[rows], k=count, workers=workers)
        chord, found = np.asarray(near[0]), np.asarray(near[1], dtype=np.int64)
        furthest = chord[:, -1].copy()
        chord[found == itself[rows, None]] = np.inf
        least = chord.min(axis=1)
        found = np.where(chord == least[:, None], found, len(stars))
        ranked = np.where(found < len(stars), np.append(rank, 0)[found], np.iinfo(np.int64).max)
        first = ranked.argmin(axis=1)
        best[rows], index[rows] = least, found[np.arange(len(rows)), first]
        # Where the last of those found is as near as the first, more may be.
        rows = rows[(furthest == least) & np.isfinite(furthest)]
        count = min(4 * count, len(stars) + 1)
    return best, index


def separation_from_chord(chord: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the separation of directions whose tips are a chord apart.

    Parameters
    ----------
    chord : ndarray of float64, shape (N,)
        0 to 2.

    Returns
    -------
    ndarray of float64, shape (N,)
        Radians.
    """
    # Chord |u - v| and |u + v| are the legs of a right triangle over the diameter.
    # The chord of antipodes may be rounded above the diameter.
    other = np.sqrt(np.maximum(2.0 - chord, 0.0) * (2.0 + chord))
    return 2.0 * np.arctan2(chord, other)


def pairs_within(
    directions: NDArray[np.float64], max_separation_rad: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return all pairs of stars within a separation.

    Parameters
    ----------
    directions : ndarray of float64, shape (N, 3)
        ICRS unit vectors.
    max_separation_rad : float
        Largest separation, radians, itself included.

    Returns
    -------
    pairs : ndarray of int64, shape (M, 2)
        Rows i < j, in order of (i, j).
    separation_rad : ndarray of float64, shape (M,)
        Their separations.
    """
    if len(directions) < 2:
        return np.empty((0, 2), dtype=np.int64), np.empty(0)
    # The search is a little wider than asked, and its result is trimmed by separation.
    radius = chord_from_separation(max_separation_rad) * (1.0 + 1e-9) + 1e-15
    found = cKDTree(directions).query_pairs(radius, output_type="ndarray")
    # Both rows are packed into one number, as sorting numbers is several times faster.
    key = np.sort((found[:, 0].astype(np.int64) << 32) | found[:, 1])
    pairs = np.stack([key >> 32, key & 0xFFFFFFFF], axis=-1)
    angle = separation(directions[pairs[:, 0]], directions[pairs[:, 1]])
    within = angle <= max_separation_rad
    return pairs[within], angle[within]
