"""Ways to answer a frame: the matcher as it is, or a paper's bare method without verification."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from starcat.arrays import Array, Rows
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import separation
from starcat.matcher.database import Database
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods.consensus import references
from starcat.matcher.methods.hausdorff import (
    distances_around,
    lowest,
    means_of_minima,
    rank_by_points,
    rank_by_separations,
)
from starcat.matcher.observation import Observation, as_frame, observe
from starcat.matcher.result import MatchResult, no_match

LIMIT_PX = 12.0
"""Mean L1 distance up to which the baseline of S1 accepts its best star."""


def name_by_separations(
    observation: Observation, database: Database, cap_rad: float | None = None
) -> Rows:
    """Name centroids as S5 does: the best star each, then the field of view.

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
    if cap_rad is None:
        stars, scores = rank_by_full_differences(observation, database, count=1)
    else:
        stars, scores = rank_by_separations(observation, database, cap_rad=cap_rad, count=1)
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


def rank_by_full_differences(
    observation: Observation, database: Database, *, count: int
) -> tuple[Rows, Array]:
    """Rank the stars as `rank_by_separations`, with differences of any size."""
    product = database.products["hausdorff_angular"]
    apart, values = observation.separation_rad, product["separation_rad"]
    near = apart <= product.numbers["radius_rad"]
    np.fill_diagonal(near, val=False)
    scores = [
        means_of_minima((np.abs(values - one) for one in row[within]), product["star_offsets"])
        for row, within in zip(apart, near, strict=True)
    ]
    return lowest(np.array(scores).reshape(len(apart), -1), count)


def rank_by_ratios(
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
    centroids, distance = distances_around(observation, database, reference, radius_rad)
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


def name_by_points(observation: Observation, database: Database, limit_px: float = LIMIT_PX) -> int:
    """Name the reference star nearest to the centre of the frame, as the baseline of S1 does.

    -1 where the best star is farther than the limit, or there is none.

    Notes
    -----
    On frames of 6 and of 12 deg of SAO stars with 0.5 px of noise the right star is 1 px away
    upright, 11 px at 1.5 deg of roll, 15 px at 2 deg and 21 px at a scale of 1.05: the
    default fails where S1, which states no limit, sees its baseline fail. Without a limit the
    right star stays the best one for most frames up to 8 deg of roll or a scale of 1.1.
    """
    stars, scores = rank_by_points(observation, database, count=1)
    return int(stars[0]) if scores[0] * observation.camera.focal_length_px <= limit_px else -1


Name = Callable[[Observation, Database], Rows]
Answerer = Callable[[Matcher, Array, Camera, "Array | None"], MatchResult]

CAP_PX = 3.0
"""What a difference counts at the most, in the capped form of S5's distance."""


def with_matcher(
    matcher: Matcher, centroids_px: Array, camera: Camera, mag: Array | None
) -> MatchResult:
    """Answer as starcat does: ranked candidates and the shared verification."""
    return matcher.identify(centroids_px, camera, magnitudes=mag)


def bare(name: Name) -> Answerer:
    """Return the answer of a method that only names stars."""

    def answer(
        matcher: Matcher, centroids_px: Array, camera: Camera, mag: Array | None
    ) -> MatchResult:
        observation = observe(as_frame(centroids_px, camera, mag), matcher)
        none = no_match(len(centroids_px), observation.dropped)
        if len(observation) < 2:
            return none
        named = name(observation, matcher.database).astype(np.int32)
        return replace(none, star_index=observation.in_frame(named))

    return answer


def _angular(observation: Observation, database: Database) -> Rows:
    return name_by_separations(observation, database)


def _angular_capped(observation: Observation, database: Database) -> Rows:
    cap_rad = CAP_PX / observation.camera.focal_length_px
    return name_by_separations(observation, database, cap_rad)


def _l2(observation: Observation, database: Database) -> Rows:
    # This is the circle inside the frame, whatever the scale may be.
    reach = 0.5 * min(observation.camera.width_px, observation.camera.height_px)
    radius_rad = float(np.arctan(reach / observation.camera.focal_length_px))
    stars, _ = rank_by_ratios(observation, database, count=1, radius_rad=radius_rad)
    return _reference_alone(observation, stars)


def _l1(observation: Observation, database: Database) -> Rows:
    stars, _ = rank_by_points(observation, database, count=1)
    return _reference_alone(observation, stars)


def _l1_limited(observation: Observation, database: Database) -> Rows:
    named = name_by_points(observation, database)
    return _reference_alone(observation, np.array([named], dtype=np.intp))


def _reference_alone(observation: Observation, stars: Rows) -> Rows:
    named = np.full(len(observation), -1, dtype=np.intp)
    named[references(observation)[0]] = stars[0]
    return named


ANSWERS: dict[str, Answerer] = {
    "matcher": with_matcher,
    "S5 mean of minima": bare(_angular),
    "S5 capped": bare(_angular_capped),
    "S1 L2": bare(_l2),
    "S1 L1": bare(_l1),
    "S1 L1 limited": bare(_l1_limited),
}
"""Ways to answer, by the name that an experiment gives."""
