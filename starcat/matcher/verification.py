"""Verification: whether an attitude explains a frame.

Every method's candidates come here. A candidate's attitude puts the database's stars on the
detector; the centroids that lie near one are its agreement, and the attitude is refined on
all of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Directions, Mask, Pixels, Rows
from starcat.matcher.chance import MIN_STARS, false_match_probability
from starcat.matcher.database import Database
from starcat.matcher.observation import Candidates, Observation
from starcat.matcher.pose import (
    Pose,
    determines_frame,
    explained_fraction,
    first_poses,
    fit,
    is_deformed,
    pose_at,
    scaled_directions,
)
from starcat.matcher.settings import AGREEMENT, MIN_SHARE, PAIRS, REACH
from starcat.matcher.star_cells import cells_for, stars_in_cap

Withheld = Literal["share_of_frame", "scale"] | None

SURE_SHARE = 2.0 / 3.0
"""An attitude that explains a smaller share is refined again, with the reaches of `WIDER`."""

FIRM_CHANCE = 1e-14
"""Largest chance of an agreement that need not explain any share of the frame, because its stars
determine all of it."""

OTHER_SCALES = 0.05
"""Largest relative error of the focal length that is looked for if an agreement's stars do not
exclude it."""

WIDER = (4.0, 2.0)
"""Reaches of that second refinement, in this order, in units of the final reach."""

NARROWER = (0.5, 0.25, 0.125)
"""Smaller reaches that are tried if an agreement is not certain, in units of the final reach."""

OVER_CHANCE = 2.0
"""A smaller reach is tried if it holds this many times the centroids that its area would have by
chance."""

MISSES = 0.45
"""Largest number of near misses beyond those due to chance, over the number of matched stars."""

MISS_REACH = 8.0
"""Largest distance of a near miss from its star, in units of the final reach."""

RIVAL_REACH = 4.0
"""A centroid without a star competes for a star of another centroid if it is this near to it; in
units of the final reach."""

ROUNDING = 1e-4
"""Largest relative difference of probabilities that differ only by rounding."""

ROUGH = (2.0,)
"""Reach of a first refinement if the focal length is fitted too, in units of the final reach:
three stars determine it less accurately than the attitude."""

FOCAL_MARGIN = 0.02
"""Margin around a frame whose focal length is fitted, in which stars are searched too."""

MAX_REFINEMENTS = 4
"""Largest number of refinements; after the first one the matched stars rarely change."""

LIKELY = 1e-3
"""False-match probability below which no other attitude is looked for with votes."""

AT_ONCE = 256
"""Number of candidates whose agreeing centroids are counted together."""


@dataclass(frozen=True)
class Agreement:
    """How well an attitude explains a frame."""

    # Attitude refined on all matched stars, and the camera with the focal length that goes with
    # it.
    pose: Pose
    star_index: NDArray[np.int32]  # row of each centroid's star, -1 without one; shape (N,)
    # Root mean square separation of the matched centroids from their stars; NaN if fewer than
    # `MIN_STARS` match.
    residual_rad: float
    # Bound on the probability that chance agrees as well; 1 if fewer than `MIN_STARS` match.
    chance: float
    # Share of the frame that it explains; 1 if chance explains it, as the share is not used then.
    share: float = 1.0
    withheld: Withheld = None  # why it is not an answer, even if chance is unlikely
    is_firm: bool = True  # its stars alone determine the whole frame

    @property
    def false_match_probability(self) -> float:
        """Bound on the probability that it is due to chance; 1 if it is withheld."""
        return 1.0 if self.withheld else self.chance

    def is_better_than(self, other: Agreement | None) -> bool:
        """Return whether chance explains it less; withheld agreements are compared too.

        The probability of hundreds of stars can be too small for a number: then more are better.
        """
        return other is None or self._rank < other._rank

    @property
    def _rank(self) -> tuple[float, float, int]:
        return self.false_match_probability, self.chance, 0 if self.chance else -self.n_matched

    @property
    def matched(self) -> Rows:
        """Rows of the centroids with a star."""
        return np.flatnonzero(self.star_index >= 0)

    @property
    def n_matched(self) -> int:
        """Number of centroids with a star."""
        return int(np.count_nonzero(self.star_index >= 0))


@dataclass
class BestOf:
    """The best agreement that a search has found so far."""

    certain: float  # a false-match probability as low as this ends the search
    found: Agreement | None = None  # the agreement that chance explains least

    @property
    def is_certain(self) -> bool:
        """Whether the search is over."""
        return self.found is not None and self.found.false_match_probability <= self.certain

    @property
    def is_likely(self) -> bool:
        """Whether the attitude is known, although its stars may not make it certain."""
        return self.found is not None and self.found.false_match_probability <= LIKELY

    def offer(self, found: Agreement) -> None:
        """Keep an agreement if it is better than the best one so far."""
        if found.is_better_than(self.found):
            self.found = found


def verify_candidates(
    candidates: Candidates,
    observation: Observation,
    database: Database,
    best: BestOf,
    *,
    in_order: bool = True,
) -> None:
    """Work out the agreements of a batch of candidates until one is certain.

    With ``in_order`` the first candidate is the likeliest, and is tried before the others are
    counted. If the focal length is not known, there are too many candidates for that. The first
    candidate of a search is always tried, so that the reason of a refusal is right.
    """
    for first in range(0, len(candidates), AT_ONCE):
        part = candidates[first : first + AT_ONCE]
        is_alone = best.found is None or (in_order and not observation.fov_error)
        for pose in _worth_trying(part, observation, database, is_alone):
            best.offer(agree(pose, observation, database, best.certain))
            if best.is_certain:
                return


def _worth_trying(
    candidates: Candidates, observation: Observation, database: Database, is_alone: bool
) -> Iterator[Pose]:
    """Yield the first pose by itself if ``is_alone``, then all poses that can agree."""
    observation.budget.spend(len(candidates))
    alone = 0
    if len(candidates) == 1 or is_alone:
        matrices, factors = first_poses(candidates[:1], observation, database.directions)
        yield pose_at(matrices[0], float(factors[0]), observation)
        alone = 1
    if len(candidates) > alone:
        matrices, factors = first_poses(candidates[alone:], observation, database.directions)
        count = agreeing_centroids(matrices, observation, database, factors)
        for row in np.flatnonzero(count >= MIN_STARS).tolist():
            yield pose_at(matrices[row], float(factors[row]), observation)


def agreeing_centroids(
    matrices: Array, observation: Observation, database: Database, factors: Array | None = None
) -> Rows:
    """Count the centroids that attitudes put near a star, on the detector or just off it."""
    reach_rad = REACH * observation.tolerance_rad
    body = observation.body
    if observation.fov_error and factors is not None:
        reach_rad *= ROUGH[0]
        body = scaled_directions(body, factors)
    icrs = body @ matrices
    near = cells_for(database, reach_rad).has_star(icrs.reshape(-1, 3), reach_rad)
    return np.asarray(near.reshape(len(matrices), -1).sum(axis=1))


def agree(
    pose: Pose,
    observation: Observation,
    database: Database,
    certain: float = 1.0,
    first: tuple[float, ...] = (),
) -> Agreement:
    """Match the centroids of a frame with the stars that an attitude predicts."""
    rough = ROUGH if observation.fov_error and not first else first
    refined = _refine(pose, observation, database, rough)
    found = _agreement_of(refined, observation)
    if found.false_match_probability < 1.0:
        # A false spot beside a star far from the others can turn the attitude so that it is the
        # nearest to the star itself. The star's own spot then has no star, and fits better.
        for rival, centroid in _rivals(refined, observation):
            other = _with_rival(found, rival, centroid, observation, database)
            # The fit can lead back to its start; a difference by rounding is not progress.
            if other.false_match_probability < (1.0 - ROUNDING) * found.false_match_probability:
                found = other
                break
    if found.false_match_probability > certain:
        found = _within_less(found, refined, observation, database)
    if found.share < SURE_SHARE:
        # This agreement is not due to chance, although much of the frame is unexplained. One or
        # two wrong stars at the edge of a cluster may have spoilt an attitude that is nearly
        # right, and a search within wider reaches replaces them.
        wider = _agreement_of(_refine(found.pose, observation, database, WIDER), observation)
        if wider.is_better_than(found):
            found = wider
    is_doubtful = found.share < SURE_SHARE or not found.is_firm
    if found.false_match_probability < 1.0 and is_doubtful and not observation.fov_error:
        return _at_own_scale(found, observation, database)
    return found


def _at_own_scale(found: Agreement, observation: Observation, database: Database) -> Agreement:
    """Withhold an agreement if the frame agrees better with another focal length."""
    free = replace(observation, fov_error=OTHER_SCALES)
    scaled = _agreement_of(_refine(found.pose, free, database, ROUGH), free)
    factor = scaled.pose.camera.focal_length_px / observation.camera.focal_length_px
    corner_px = abs(factor - 1.0) * math.hypot(*observation.camera.middle_px)
    if scaled.chance < found.chance and corner_px > observation.tolerance_px:
        return replace(found, withheld="scale")
    return found


def _within_less(
    found: Agreement, refined: _Fit, observation: Observation, database: Database
) -> Agreement:
    """Return the best agreement within smaller reaches.

    They are tried if more centroids are near their stars than chance would bring there. The
    tolerance is the largest error that is allowed. If centroids are more accurate, chance puts
    more false stars than true ones within its reach in a crowded frame. The bound holds for
    every number of matched stars, so it can be taken at the best number.
    """
    square_px, count = refined.square_px[refined.matched], len(refined.matched)
    for k, factor in enumerate(NARROWER):
        near = int(np.sum(square_px <= (factor * REACH * observation.tolerance_px) ** 2))
        if near < MIN_STARS or near < OVER_CHANCE * factor * factor * count:
            continue
        narrow = _refine(found.pose, observation, database, NARROWER[:k], factor)
        other = _agreement_of(narrow, observation)
        if other.is_better_than(found):
            found = other
    return found


def _rivals(refined: _Fit, observation: Observation) -> list[tuple[int, int]]:
    """Return centroids without a star, each with the centroid that took its nearest star."""
    loose, matched = (refined.star < 0).nonzero()[0], refined.matched
    reach_px = RIVAL_REACH * REACH * observation.tolerance_px
    if not len(loose) or not len(matched) or refined.square_px[loose].min() >= reach_px * reach_px:
        return []
    star = refined.star[matched]
    offset = observation.centroids_px[loose][:, None] - refined.predicted_px[star]
    offset *= offset
    square = offset[..., 0] + offset[..., 1]
    nearest = square.argmin(axis=1)
    near = square[np.arange(len(loose)), nearest] < reach_px * reach_px
    if refined.compatible is not None:
        near &= refined.compatible[loose, star[nearest]]
    return list(zip(loose[near].tolist(), matched[nearest[near]].tolist(), strict=True))


def _with_rival(
    found: Agreement, rival: int, centroid: int, observation: Observation, database: Database
) -> Agreement:
    index = found.star_index.copy()
    index[rival], index[centroid] = index[centroid], -1
    matched = np.flatnonzero(index >= 0)
    pose = fit(found.pose, matched, database.directions[index[matched]], observation)
    return _agreement_of(_refine(pose, observation, database), observation)


@dataclass(frozen=True)
class _Fit:
    """A pose, the stars around its field, and the star of each centroid."""

    pose: Pose
    near: Rows  # the stars around the field
    icrs: Directions
    compatible: Mask | None
    predicted_px: Pixels  # the stars ``near`` as the pose puts them
    star: Rows  # row of ``near`` for each centroid, -1 without a star
    matched: Rows  # centroids with a star
    square_px: Array
    last: float  # the last reach, in units of the final one


def _refine(
    pose: Pose,
    observation: Observation,
    database: Database,
    wider: tuple[float, ...] = (),
    last: float = 1.0,
) -> _Fit:
    """Refine a pose on all stars that match, first within other reaches than the last one."""
    radius_rad = pose.camera.radius_rad
    if observation.fov_error:
        radius_rad *= 1.0 + FOCAL_MARGIN
    near = stars_in_cap(database, pose.matrix[2], radius_rad)
    observation.budget.spend(AGREEMENT * max(1, len(observation) * len(near) // PAIRS))
    u = database.directions[near]
    compatible = observation.compatible(database.mag[near])
    before: list[int] = []
    for step, factor in enumerate((*wider, *MAX_REFINEMENTS * (last,))):
        predicted = pose.camera.pixels_from_directions(u @ pose.matrix.T)
        reach_px = factor * REACH * observation.tolerance_px
        star, square_px = _mutually_nearest(predicted, observation, reach_px, compatible)
        matched, after = (star >= 0).nonzero()[0], star.tolist()
        if len(matched) < MIN_STARS or (step >= len(wider) and after == before):
            break
        before = after
        pose = fit(pose, matched, u[star[matched]], observation)
    return _Fit(pose, near, u, compatible, predicted, star, matched, square_px, last)


def _agreement_of(refined: _Fit, observation: Observation) -> Agreement:
    pose, matched, star = refined.pose, refined.matched, refined.star[refined.matched]
    index = np.empty(len(observation), dtype=np.int32)
    index.fill(-1)
    index[matched] = refined.near[star]
    if len(matched) < MIN_STARS:
        return Agreement(pose, index, math.nan, 1.0)
    seen = pose.body[matched]
    difference = seen - refined.icrs[star] @ pose.matrix.T
    residual_rad = math.sqrt(float(np.vdot(difference, difference)) / len(matched))
    within = _within_reach_of_frame(refined.predicted_px, observation)
    square_px = math.fsum(refined.square_px[matched].tolist())
    chance = false_match_probability(
        square_px,
        seen,
        len(observation),
        len(within),
        pose.camera,
        noise_px=observation.settings.noise_px,
        compatible=None if refined.compatible is None else refined.compatible[:, within],
        log_scales=-2.0 * math.log1p(-observation.fov_error),
    )
    share = 1.0
    if chance < 1.0 and len(matched) < len(within):
        stars = refined.icrs[within] @ pose.matrix.T
        enough = max(SURE_SHARE, observation.settings.min_share)
        share = explained_fraction(seen, stars, residual_rad, pose, observation, enough)
    withheld: Withheld = None
    is_firm = True
    if chance < 1.0:
        is_firm = determines_frame(seen, residual_rad, pose, observation, refined.last)
        asked = observation.settings.min_share
        is_free = is_firm and chance <= FIRM_CHANCE and asked <= MIN_SHARE
        if share < asked and not is_free:
            withheld = "share_of_frame"
        elif is_deformed(
            refined.predicted_px[star],
            observation.centroids_px[matched],
            pose.camera,
            refined.last * observation.tolerance_px,
            is_partial=share < SURE_SHARE,
        ) or (share < SURE_SHARE and _has_near_misses(refined, within, observation)):
            withheld = "scale"
    return Agreement(pose, index, residual_rad, chance, share, withheld, is_firm)


def _has_near_misses(refined: _Fit, within: Rows, observation: Observation) -> bool:
    """Return whether centroids without a star are close to stars without a centroid.

    They must exceed the share `MISSES` of the matched centroids plus twice the number by chance.
    Then the frame has another shape than the camera: stars match in one part of the frame, and
    miss next to that part.
    """
    loose = np.flatnonzero(refined.star < 0)
    free = np.setdiff1d(within, refined.star[refined.matched])
    offset = observation.centroids_px[loose][:, None] - refined.predicted_px[free]
    offset *= offset
    square = offset[..., 0] + offset[..., 1]
    pairs = square.size
    reach = (MISS_REACH * REACH * refined.last * observation.tolerance_px) ** 2
    near = square <= reach
    if refined.compatible is not None:
        compatible = refined.compatible[np.ix_(loose, free)]
        pairs, near = int(compatible.sum()), near & compatible
    camera = observation.camera
    by_chance = pairs * math.pi * reach / (camera.width_px * camera.height_px)
    misses = min(int(near.any(axis=0).sum()), int(near.any(axis=1).sum()))
    return misses > MISSES * len(refined.matched) + 2.0 * by_chance


def _within_reach_of_frame(predicted_px: Array, observation: Observation) -> Rows:
    camera, reach_px = observation.camera, REACH * observation.tolerance_px
    near = np.abs(predicted_px - camera.middle_px) <= camera.middle_px + reach_px
    return (near[:, 0] & near[:, 1]).nonzero()[0]


def _mutually_nearest(
    predicted_px: Array, observation: Observation, reach_px: float, compatible: Mask | None
) -> tuple[Rows, Array]:
    """Return the star of each centroid, -1 without a star, and the squared distances.

    A centroid has a star if each of the two is the nearest to the other, within reach, among
    those whose magnitudes are compatible.
    """
    count = len(observation)
    if not len(predicted_px):
        return np.full(count, -1), np.full(count, np.inf)
    offset = observation.centroids_px[:, None] - predicted_px
    offset *= offset
    square = offset[..., 0]
    square += offset[..., 1]
    # The distance is NaN where the lens forms no image of a star; it must not be the minimum.
    np.fmin(square, np.inf, out=square)
    if compatible is not None:
        square[~compatible] = np.inf
    star, rows = square.argmin(axis=1), np.arange(count)
    nearest = square[rows, star]
    mutual = (square.argmin(axis=0)[star] == rows) & (nearest <= reach_px * reach_px)
    return np.where(mutual, star, -1), nearest
