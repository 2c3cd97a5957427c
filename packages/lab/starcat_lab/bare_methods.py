"""Ways to answer a frame: the real matcher, or a paper's bare method without verification."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from starcat.arrays import Array, Rows
from starcat.geometry import Camera, separation
from starcat.matcher import (
    Matcher,
    MatcherDatabase,
    MatchResult,
    Observation,
    as_frame,
    distances_around,
    lowest,
    means_of_minima,
    no_match,
    observe,
    rank_by_points,
    rank_by_separations,
    references,
)

LIMIT_PX = 12.0
"""Mean L1 distance up to which the baseline of S1 accepts its best star."""

CAP_PX = 3.0
"""Largest contribution of one difference, in the capped form of S5's distance."""


def name_by_separations(
    observation: Observation, database: MatcherDatabase, cap_rad: float | None = None
) -> Rows:
    """Name centroids by S5's method: best star of each, then the field of view; -1 without a name.

    If two centroids get the same star, neither keeps the name. Of the other names, only those are
    kept whose stars fit into one field of view, no two of them farther apart than its diagonal.
    This set grows from the name that has the most others within that distance, which finds the
    largest set if most names are right. No attitude is checked. A difference counts as at most
    ``cap_rad``.
    """
    if cap_rad is None:
        stars, scores = rank_by_full_differences(observation, database, count=1)
    else:
        stars, scores = rank_by_separations(observation, database, cap_rad=cap_rad, count=1)
    star, score = stars[:, 0], scores[:, 0]
    order = np.argsort(score, kind="stable")
    order = order[star[order] >= 0]
    _, first_index, times = np.unique(star[order], return_index=True, return_counts=True)
    order = order[np.sort(first_index[times == 1])]
    u = database.directions[star[order]]
    fits = separation(u[:, None, :], u[None, :, :]) <= observation.camera.diagonal_rad
    is_named = np.ones(len(order), dtype=bool)
    for row in np.argsort(-fits.sum(axis=1), kind="stable"):
        if is_named[row]:
            is_named &= fits[row]
    named = np.full(len(observation), -1, dtype=np.intp)
    named[order[is_named]] = star[order[is_named]]
    return named


def rank_by_full_differences(
    observation: Observation, database: MatcherDatabase, *, count: int
) -> tuple[Rows, Array]:
    """Rank the stars like `rank_by_separations`, with differences of any size."""
    product = database.products["hausdorff_angular"]
    apart, values = observation.separation_rad, product["separation_rad"]
    near = apart <= product.numbers["radius_rad"]
    np.fill_diagonal(near, val=False)
    scores = [
        means_of_minima(
            (np.abs(values - measured_rad) for measured_rad in row[within]), product["star_offsets"]
        )
        for row, within in zip(apart, near, strict=True)
    ]
    return lowest(np.array(scores).reshape(len(apart), -1), count)


def rank_by_ratios(
    observation: Observation,
    database: MatcherDatabase,
    reference: int | None = None,
    *,
    count: int,
    radius_rad: float | None = None,
) -> tuple[Rows, Array]:
    """Rank the stars for a reference star, by default the nearest to the centre, by S1's method.

    Returns rows of stars, shape (count,), the best first, -1 if there are no more; and scores: the
    mean over the centroids around the reference star of the smallest squared difference of ratios,
    ``inf`` if there are no more. The radius is by default the radius of the reference sets.

    Distances are tangents of separations. This takes the camera's focal length, but the reference
    star can be off the centre; distances in the image would then have errors of second order. The
    set's leading 0, the star itself, always matches its like and is left out.

    Wang et al. 2020 (S1), eqs. 9 and 12 to 15.
    """
    product = database.products["hausdorff_l2"]
    reference = int(references(observation)[0]) if reference is None else reference
    distance = distances_around(observation, database, reference, radius_rad)
    differences = ((product["ratio"] - r) ** 2 for r in distance / distance[:1])
    stars, scores = lowest(means_of_minima(differences, product["star_offsets"])[None, :], count)
    return stars[0], scores[0]


def name_by_points(
    observation: Observation, database: MatcherDatabase, limit_px: float = LIMIT_PX
) -> int:
    """Name the reference star nearest to the centre of the frame, by the baseline of S1.

    -1 if the best star is farther than the limit, or if there is none. On frames of 6 and of 12 deg
    of SAO stars with 0.5 px of noise the right star is 1 px away upright, 11 px at 1.5 deg of roll,
    15 px at 2 deg and 21 px at a scale of 1.05: the default fails where S1, which states no limit,
    sees its baseline fail. Without a limit the right star stays the best one for most frames up to
    8 deg of roll or a scale of 1.1.
    """
    stars, scores = rank_by_points(observation, database, count=1)
    return int(stars[0]) if scores[0] * observation.camera.focal_length_px <= limit_px else -1


Name = Callable[[Observation, MatcherDatabase], Rows]
Answerer = Callable[[Matcher, Array, Camera, "Array | None"], MatchResult]


def with_matcher(
    matcher: Matcher, centroids_px: Array, camera: Camera, mag: Array | None
) -> MatchResult:
    """Answer by starcat's own method: ranked candidates and the shared verification."""
    return matcher.identify(centroids_px, camera, mag=mag)


def bare(name: Name) -> Answerer:
    """Return the answer of a method that only names stars."""

    def answer(
        matcher: Matcher, centroids_px: Array, camera: Camera, mag: Array | None
    ) -> MatchResult:
        observation = observe(as_frame(centroids_px, camera, mag), matcher.settings)
        none = no_match(len(centroids_px), observation.dropped)
        if len(observation) < 2:
            return none
        named = name(observation, matcher.database).astype(np.int32)
        return replace(none, star_index=observation.in_frame(named))

    return answer


def _angular_capped(observation: Observation, database: MatcherDatabase) -> Rows:
    cap_rad = CAP_PX / observation.camera.focal_length_px
    return name_by_separations(observation, database, cap_rad)


def _l2(observation: Observation, database: MatcherDatabase) -> Rows:
    # This is the circle inside the frame, for any scale.
    reach = 0.5 * min(observation.camera.width_px, observation.camera.height_px)
    radius_rad = float(np.arctan(reach / observation.camera.focal_length_px))
    stars, _ = rank_by_ratios(observation, database, count=1, radius_rad=radius_rad)
    return _reference_alone(observation, int(stars[0]))


def _l1(limit_px: float) -> Name:
    return lambda observation, database: _reference_alone(
        observation, name_by_points(observation, database, limit_px)
    )


def _reference_alone(observation: Observation, star: int) -> Rows:
    named = np.full(len(observation), -1, dtype=np.intp)
    named[references(observation)[0]] = star
    return named


ANSWERS: dict[str, Answerer] = {
    "matcher": with_matcher,
    "S5 mean of minima": bare(name_by_separations),
    "S5 capped": bare(_angular_capped),
    "S1 L2": bare(_l2),
    "S1 L1": bare(_l1(math.inf)),
    "S1 L1 limited": bare(_l1(LIMIT_PX)),
}
"""Ways to answer, by the name that an experiment uses."""
