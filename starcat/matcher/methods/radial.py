"""Identification by radial and cyclic patterns (Zhang et al. 2008): rings and sectors.

The rings around a centroid that have a neighbour in are compared with those of every star,
then the sectors, as a cycle without a beginning. That names single stars and tells no
direction: which names agree with each other, consensus says. Needs the product ``radial``.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Rows
from starcat.geometry.patterns import cyclic_shifts, ring_of, sector_of
from starcat.matcher.budget import LOOKUP
from starcat.matcher.database import Database, ProductArrays
from starcat.matcher.methods.candidates import Candidates
from starcat.matcher.methods.consensus import consistent_candidates
from starcat.matcher.methods.reference import Surroundings, references, rows_between, surroundings
from starcat.matcher.methods.triangle_order import TriangleOrder
from starcat.matcher.observation import Observation

PRODUCTS = ("radial",)

ROUNDS = ((3, 16), (12, 32), (48, 64))
"""How many centroids are compared, from the centre, and how many names each of them gets."""

MOST_PAIRS = 200
"""Pairs of names proposed in a round at the most."""

COMPARED = 2
"""Sectors are compared for this many times as many stars as are wanted."""

TOUCHED = 0.5
"""Weight of a ring without a centroid that a centroid's tolerance touches."""

SECTORS = 0.2
"""Weight of the sectors beside the rings."""


def candidates(
    observation: Observation, database: Database, selection: TriangleOrder
) -> Iterator[Candidates]:
    """Propose names of centroids that agree with each other.

    Parameters
    ----------
    observation : Observation
        The frame.
    database : Database
        With the product ``radial``.
    selection : TriangleOrder
        Without effect: no triangles are chosen.

    Yields
    ------
    Candidates
        First of the few centroids nearest to the centre of the frame and their best names,
        then of more centroids and names.

    References
    ----------
    Zhang, Wei and Jiang 2008, "Full-sky autonomous star identification based on radial and
    cyclic features of star pattern", Image and Vision Computing 26, 891.
    """
    order = references(observation)
    names = np.full((len(observation), ROUNDS[-1][1]), -1, dtype=np.intp)
    done = 0
    for first, most in ROUNDS:
        for reference in order[done:first]:
            observation.budget.spend(LOOKUP)
            stars, _ = rank_stars(observation, database, int(reference), most=names.shape[1])
            names[reference, : len(stars)] = stars
        done = first
        yield from consistent_candidates(names[:, :most], observation, database, MOST_PAIRS)


def rank_stars(
    observation: Observation, database: Database, reference: int, *, most: int = ROUNDS[-1][1]
) -> tuple[Rows, Array]:
    """Rank the stars that a reference star may be by the rings and sectors in common.

    Parameters
    ----------
    observation : Observation
        The frame.
    database : Database
        With the product ``radial``.
    reference : int
        Row of the observation.
    most : int
        How many stars at the most.

    Returns
    -------
    stars : ndarray of int, shape (K,)
        Rows of the database's stars, the best first. None without a neighbour.
    scores : ndarray of float64, shape (K,)
        Twice the weight of the rings in common over the weight of the rings of both, 0 to 1,
        less `SECTORS` times the share of the sectors of both that differ.

    Notes
    -----
    Centroids err: a ring that only a tolerance touches counts half. The cyclic pattern as the
    smallest of its shifts changes altogether with one sector, so the sectors are compared in
    all positions and the best counts.

    References
    ----------
    Zhang, Wei and Jiang 2008; the best star of the reference star nearest to the centre is
    the method's own answer.
    """
    product = database.products["radial"]
    around = surroundings(observation, reference, product.numbers["radius_rad"])
    if not len(around):
        return np.zeros(0, dtype=np.intp), np.zeros(0)
    score = _rings_in_common(around, observation.tolerance_rad, product)
    compared = min(COMPARED * most, len(score))
    rows = np.argpartition(-score, compared - 1)[:compared]
    sectors = int(product.numbers["sectors"])
    pattern = sector_pattern(around.position_angle_rad, sectors)
    total = score[rows] - SECTORS * _difference(pattern, product["sector_pattern"][rows], sectors)
    order = np.lexsort((rows, -total))[:most]
    return product["star"][rows[order]].astype(np.intp), total[order]


def _rings_in_common(around: Surroundings, tolerance_rad: float, product: ProductArrays) -> Array:
    """Return the share of the rings of both that every star has in common with an observation."""
    radius_rad, rings = product.numbers["radius_rad"], int(product.numbers["rings"])
    apart = around.separation_rad
    weight = np.zeros(rings)
    for touched in (np.maximum(apart - tolerance_rad, 0.0), apart + tolerance_rad):
        weight[ring_of(touched, radius_rad, rings)] = TOUCHED
    weight[ring_of(apart, radius_rad, rings)] = 1.0
    ring = np.flatnonzero(weight)
    offsets = product["ring_offsets"]
    run, entry = rows_between(offsets[ring], offsets[ring + 1])
    rows = product["ring_rows"][entry]
    common = np.bincount(rows, weight[ring][run], minlength=len(product["star"]))
    return np.asarray(2.0 * common / (weight.sum() + np.diff(product["rings_offsets"])))


def sector_pattern(position_angle_rad: Array, sectors: int) -> int:
    """Return the sectors around a star that have a neighbour in.

    Parameters
    ----------
    position_angle_rad : ndarray of float64, shape (n,)
        Angles of the neighbours, counter-clockwise, the nearest one first.
    sectors : int
        Their number.

    Returns
    -------
    int
        Bit s for sector s; they are counted from the nearest neighbour.

    Examples
    --------
    >>> bin(sector_pattern(np.radians([10.0, 105.0, 5.0]), 4))
    '0b1011'
    """
    sector = sector_of(position_angle_rad - position_angle_rad[0], sectors)
    return int(np.bitwise_or.reduce(1 << sector))


def _difference(pattern: int, others: NDArray[np.int32], sectors: int) -> Array:
    """Return the share of the sectors of both that differ, in the position where fewest do."""
    turned = cyclic_shifts(pattern, sectors)
    differ = np.bitwise_count(turned[:, None] ^ others.astype(np.int64)).min(axis=0)
    return np.asarray(differ / (pattern.bit_count() + np.bitwise_count(others)))
