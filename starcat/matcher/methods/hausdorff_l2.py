"""Identification by planar reference sets (S1): ratios of distances under a Hausdorff distance.

A reference star's feature is the set of its gnomonic distances from the centroids around it,
over the smallest of them; a star's comes from the product ``hausdorff_l2``. Ratios depend
neither on the camera's roll nor on its scale, but inherit the relative error of the divisor,
and all are wrong where the nearest neighbour is missing or false.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from starcat.arrays import Array, Rows
from starcat.matcher.database import Database
from starcat.matcher.methods.candidates import Candidates
from starcat.matcher.methods.consensus import neighbour_candidates
from starcat.matcher.methods.pairs import side_tolerance_rad
from starcat.matcher.methods.reference import by_reference, references, surroundings
from starcat.matcher.methods.reference_sets import (
    ReferenceSets,
    lowest,
    means_of_minima,
    reference_sets,
    within_reach,
)
from starcat.matcher.methods.triangle_order import TriangleOrder
from starcat.matcher.observation import Observation

PRODUCTS = ("hausdorff_l2",)

ROUNDS = ((1, 30), (2, 30), (3, 400))
"""How many of the nearest, of the frame and of a star, are tried as divisors, and how many of
the best stars of each pair of divisors become candidates, one round after the other."""


def candidates(
    observation: Observation, database: Database, selection: TriangleOrder
) -> Iterator[Candidates]:
    """Propose what a reference star and two of its neighbours are.

    Parameters
    ----------
    observation : Observation
        The frame.
    database : Database
        With the product ``hausdorff_l2``.
    selection : TriangleOrder
        Without effect: no triangles are chosen.

    Yields
    ------
    Candidates
        Three stars each; the reference star nearest to the centre of the frame first.

    Notes
    -----
    The bare method divides by the smallest distance and takes the best star. Here the best of
    many become candidates, and later rounds divide by the second and third smallest too, of
    the frame as of the star, so that the nearest may err, be false or be missing. Differences
    of ratios count in units of what they may err, and 1 at the most.

    References
    ----------
    Wang et al. 2020 (S1).
    """
    product = database.products["hausdorff_l2"]

    for divisors, count in ROUNDS:

        def propose(reference: int, divisors: int = divisors, count: int = count) -> Candidates:
            stars = likely_stars(observation, database, reference, divisors, count)
            return neighbour_candidates(reference, stars, product, observation, database)

        yield from by_reference(observation, propose)


def rank_stars(
    observation: Observation,
    database: Database,
    reference: int | None = None,
    *,
    count: int,
    w1: float = 1.0,
    w2: float = 0.0,
    m: float = 2.0,
    radius_rad: float | None = None,
) -> tuple[Rows, Array]:
    """Rank the stars for a reference star by the bare method.

    Parameters
    ----------
    observation : Observation
        The frame.
    database : Database
        With the product ``hausdorff_l2``.
    reference : int, optional
        Row of the observation; the nearest to the centre of the frame by default.
    count : int
        How many stars.
    w1, w2 : float
        Weights of the differences of ratios and of magnitudes. Magnitudes are those over the
        reference star's own, so that no zero point enters; unknown ones differ by 0.
    m : float
        Power of the differences.
    radius_rad : float, optional
        Only centroids this near to the reference star are compared, radians; by default the
        radius of the reference sets. Another one where the scale of the image is not known.

    Returns
    -------
    stars : ndarray of int, shape (count,)
        Rows of the database's stars, the best first; -1 where there are no more.
    scores : ndarray of float64, shape (count,)
        Mean over the centroids around the reference star, within the radius of the reference
        sets, of the smallest ``w1 |ratio difference|^m + w2 |magnitude difference|^m``;
        ``inf`` where there are no more.

    Notes
    -----
    Distances are tangents of separations, which takes the camera's focal length but lets the
    reference star be off the centre; from its distances in the image they would err in second
    order. The set's leading 0, the star itself, always meets its like and is left out.

    References
    ----------
    Wang et al. 2020 (S1), eqs. 9 and 12 to 15.
    """
    product = database.products["hausdorff_l2"]
    reference = int(references(observation)[0]) if reference is None else reference
    centroids, distance = _around(observation, database, reference, radius_rad)
    by_ratio = (w1 * np.abs(product["ratio"] - r) ** m for r in distance / distance[:1])
    by_mag = _magnitude_differences(observation, database, reference, centroids) if w2 else None
    differences = by_ratio if by_mag is None else map(lambda a, b: a + w2 * b**m, by_ratio, by_mag)
    stars, scores = lowest(means_of_minima(differences, product["star_offsets"])[None, :], count)
    return stars[0], scores[0]


def _magnitude_differences(
    observation: Observation, database: Database, reference: int, centroids: Rows
) -> Iterator[Array] | None:
    """Yield for each centroid how its magnitude differs from every neighbour's.

    Both are over that of the reference star. None where the frame has no magnitudes.
    """
    if observation.mag is None:
        return None
    product = database.products["hausdorff_l2"]
    fainter_of_star = database.mag[product["neighbour"]] - database.mag[product["star"]]
    fainter = observation.mag[centroids] - observation.mag[reference]
    return (
        np.zeros(len(fainter_of_star)) if np.isnan(each) else np.abs(fainter_of_star - each)
        for each in fainter
    )


def likely_stars(
    observation: Observation, database: Database, reference: int, divisors: int, count: int
) -> Rows:
    """Return the stars that a reference star is likely to be.

    Parameters
    ----------
    observation : Observation
        The frame.
    database : Database
        With the product ``hausdorff_l2``.
    reference : int
        Row of the observation.
    divisors : int
        How many of the nearest, of the frame and of each star, are divided by; 3 at the most.
    count : int
        How many stars for each pair of divisors.

    Returns
    -------
    ndarray of int, shape (K,)
        Rows of the database's stars, ascending.

    Notes
    -----
    Distances d err by e each, so d/d' errs by ``e/d' sqrt(1 + (d/d')^2)``: that is where a
    difference ceases to count for more.
    """
    _, distance = _around(observation, database, reference)
    error = side_tolerance_rad(observation)
    best = [np.empty(0, dtype=np.intp)]
    for divisor in range(min(divisors, len(distance) - 1)):
        ratio = np.delete(distance, divisor) / distance[divisor]
        reach = error / distance[divisor] * np.sqrt(1.0 + ratio * ratio)
        for sets in database.derived(_sets)[:divisors]:
            number, star, gain = within_reach(sets, ratio, reach)
            share = gain / reach[number]
            # One less the squared difference over the reach.
            agreement = np.bincount(star, share * (2.0 - share), len(sets))
            score = np.where(agreement > 0.0, -agreement, np.inf)
            best.append(lowest(score[None, :], count)[0][0])
    found = np.unique(np.concatenate(best))
    return found[found >= 0]


def _around(
    observation: Observation, database: Database, reference: int, radius_rad: float | None = None
) -> tuple[Rows, Array]:
    """Return centroids around one and their distances, if not 0, in focal lengths, ascending."""
    if radius_rad is None:
        radius_rad = database.products["hausdorff_l2"].numbers["radius_rad"]
    around = surroundings(observation, reference, radius_rad)
    apart = around.separation_rad > 0.0
    return around.centroids[apart], np.tan(around.separation_rad[apart])


def _sets(database: Database) -> tuple[ReferenceSets, ...]:
    """Return the stars' distances over the smallest, the second and the third smallest."""
    product = database.products["hausdorff_l2"]
    ratio, offsets = product["ratio"], product["star_offsets"]
    count = np.diff(offsets)
    found = []
    for divisor in range(max(divisors for divisors, _ in ROUNDS)):
        has = count > divisor
        members = np.repeat(has, count)
        smallest = ratio[offsets[:-1][has] + divisor]
        kept = np.where(has, count, 0)
        over = ratio[members] / np.repeat(smallest, count[has])
        found.append(reference_sets(over, np.concatenate([[0], np.cumsum(kept)])))
    return tuple(found)
