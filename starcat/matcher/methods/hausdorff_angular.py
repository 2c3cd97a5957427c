"""Identification by angular reference sets (S5): separations under a Hausdorff distance.

A centroid's feature is the set of its separations from the others, a star's the set of its
separations from its neighbours, product ``hausdorff_angular``. Every centroid is named after the
stars whose sets are nearest in the mean. `consensus` then finds the names that agree with each
other.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from starcat.arrays import Array, Rows
from starcat.geometry.sphere import separation
from starcat.matcher.budget import LOOKUP
from starcat.matcher.database import Database
from starcat.matcher.methods.candidates import Candidates
from starcat.matcher.methods.consensus import consistent_candidates, neighbour_candidates
from starcat.matcher.methods.pairs import side_tolerance_rad
from starcat.matcher.methods.reference import by_reference
from starcat.matcher.methods.reference_sets import (
    ReferenceSets,
    lowest,
    reference_sets,
    smallest_differences,
    within_reach,
)
from starcat.matcher.methods.triangle_order import TriangleOrder
from starcat.matcher.observation import Observation

PRODUCTS = ("hausdorff_angular",)

FIRST_ROUND = (16, 5)
"""Number of the first centroids that take part, and number of names that each of them gets."""

SECOND_ROUND = (64, 100)
"""The same two numbers of a second round, where the names of the first one do not agree."""

_AT_ONCE = 1 << 22
"""Numbers held at the same time while observed separations are compared with all stars."""


def candidates(
    observation: Observation, database: Database, selection: TriangleOrder
) -> Iterator[Candidates]:
    """Propose names of centroids that agree with each other.

    Parameters
    ----------
    observation : Observation
        The frame.
    database : Database
        With the product ``hausdorff_angular``.
    selection : TriangleOrder
        Without effect: no triangles are chosen.

    Yields
    ------
    Candidates
        The first ones are names of several centroids that agree with each other. Then follow,
        for each centroid and many more names, those whose neighbours agree.

    Notes
    -----
    The bare method counts every difference in full, so that one false or missing star outweighs
    all that agree. Here a difference counts as `side_tolerance_rad` at the most.

    References
    ----------
    Rotation-invariant feature with modified Hausdorff distance (S5).
    """
    cap_rad = side_tolerance_rad(observation)
    first, count = FIRST_ROUND
    stars, _ = rank_stars(observation, database, cap_rad=cap_rad, count=count, first=first)
    yield from consistent_candidates(stars, observation, database)
    first, count = SECOND_ROUND
    stars, _ = rank_stars(observation, database, cap_rad=cap_rad, count=count, first=first)
    product = database.products["hausdorff_angular"]

    def propose(reference: int) -> Candidates:
        named = stars[reference] if reference < first else stars[0, :0]
        return neighbour_candidates(reference, named[named >= 0], product, observation, database)

    yield from by_reference(observation, propose)


def rank_stars(
    observation: Observation,
    database: Database,
    *,
    cap_rad: float | None,
    count: int,
    first: int | None = None,
) -> tuple[Rows, Array]:
    """Rank the stars for every centroid by the directed, averaged Hausdorff distance.

    Parameters
    ----------
    observation : Observation
        The frame.
    database : Database
        With the product ``hausdorff_angular``.
    cap_rad : float or None
        Largest value that a difference counts as, radians; None for no limit, as in the paper.
    count : int
        Number of stars to return for each centroid.
    first : int, optional
        Number of the first centroids to use; all by default.

    Returns
    -------
    stars : ndarray of int, shape (N, count)
        Rows of the database's stars, the nearest set first; -1 where there are no more.
    scores : ndarray of float64, shape (N, count)
        Mean of the smallest differences from a member of the set, over those separations of the
        centroid from others that lie within the radius of the reference sets; radians, ``inf``
        where there are no more. A centroid without such separations has no stars.

    References
    ----------
    Rotation-invariant feature with modified Hausdorff distance (S5).
    """
    product = database.products["hausdorff_angular"]
    sets = database.derived(_sets)
    apart = observation.separation_rad[:first, :first]
    near = np.triu(apart <= product.numbers["radius_rad"], 1)
    a, b = np.nonzero(near)
    total = np.zeros((len(apart), len(sets)))
    at_once = max(1, _AT_ONCE // max(1, len(sets)))
    for start in range(0, len(a), at_once):
        pairs = slice(start, start + at_once)
        observation.budget.spend(LOOKUP * len(a[pairs]))
        _add(total, sets, apart, a[pairs], b[pairs], cap_rad)
    used = near.sum(axis=0) + near.sum(axis=1)
    with np.errstate(invalid="ignore"):
        return lowest(total / used[:, None], count)


def _add(
    total: Array, sets: ReferenceSets, apart: Array, a: Rows, b: Rows, cap_rad: float | None
) -> None:
    """Add the smallest differences of pairs of centroids to both centroids' totals."""
    if cap_rad is None:
        difference = smallest_differences(sets, apart[a, b])
        for i, j, row in zip(a, b, difference, strict=True):
            total[i] += row
            total[j] += row
        return
    number, star, gain = within_reach(sets, apart[a, b], np.full(len(a), cap_rad))
    for end in (a, b):
        place = end[number] * len(sets) + star
        total -= np.bincount(place, gain, total.size).reshape(total.shape)
        total += cap_rad * np.bincount(end, minlength=len(total))[:, None]


def identify_bare(
    observation: Observation, database: Database, cap_rad: float | None = None
) -> Rows:
    """Name centroids as the paper does: the best star each, then the field of view.

    Parameters
    ----------
    observation : Observation
        The frame.
    database : Database
        With the product ``hausdorff_angular``.
    cap_rad : float, optional
        Largest value that a difference counts as, radians; no limit by default.

    Returns
    -------
    ndarray of int, shape (N,)
        Row of each centroid's star, -1 where it has none or was taken for an outlier.

    Notes
    -----
    Where two centroids are named after the same star, neither keeps the name. Among the other
    names, those are kept that fit into one field of view, with no two stars farther apart than
    its diagonal. This set grows from the name that has the most others within that distance,
    which finds the largest set wherever most names are right. No attitude is checked.

    References
    ----------
    Rotation-invariant feature with modified Hausdorff distance (S5), the field-of-view
    constraint.
    """
    stars, scores = rank_stars(observation, database, cap_rad=cap_rad, count=1)
    star, score = stars[:, 0], scores[:, 0]
    order = np.argsort(score, kind="stable")
    order = order[star[order] >= 0]
    _, place, times = np.unique(star[order], return_index=True, return_counts=True)
    order = order[np.sort(place[times == 1])]
    u = database.directions[star[order]]
    fits = separation(u[:, None, :], u[None, :, :]) <= observation.camera.diagonal_rad
    kept = np.ones(len(order), dtype=bool)
    for row in np.argsort(-fits.sum(axis=1), kind="stable"):
        if kept[row]:
            kept &= fits[row]
    named = np.full(len(observation), -1, dtype=np.intp)
    named[order[kept]] = star[order[kept]]
    return named


def _sets(database: Database) -> ReferenceSets:
    product = database.products["hausdorff_angular"]
    return reference_sets(product["separation_rad"], product["star_offsets"])
