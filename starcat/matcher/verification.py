"""Verification: whether an attitude explains a frame.

Every method's candidates come here. A candidate's attitude puts the database's stars on the
detector; the centroids that lie near one are its agreement, and the attitude is refined on
all of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Deviations, Directions, Matrix, Pixels, Rows
from starcat.matcher.chance import INCOMPATIBLE, MIN_STARS, log_false_match_probability
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.observation import Candidates, Observation
from starcat.matcher.pose import (
    Pose,
    after_step,
    first_poses,
    fit,
    fit_shape,
    pose_at,
    scaled_directions,
    shaped,
    shaped_poses,
)
from starcat.matcher.settings import AGREEMENT, PAIRS, REACH
from starcat.matcher.shape import (
    FREE_TERMS,
    MODELS,
    N_TERMS,
    WIDER_RANGE,
    Normal,
    chance_of_gain,
    chance_of_ratio,
    corner_error_rad,
    derivatives,
    is_near_frame,
    largest_influence_rad,
    log_growth,
    margin_px,
    solve_normal,
)
from starcat.matcher.star_cells import cells_for, stars_in_cap
from starcat.matcher.stars import NOTABLE_DEVIATIONS

Withheld = Literal["share_of_frame", "scale"] | None

PLAIN_SHARE = 2.0 / 3.0
"""Least fraction of the frame that matches if no shape is tried (`Agreement.share`)."""

WIDER = (4.0, 2.0)
"""Reaches with which the fit of a shape begins, in this order, in units of the final reach."""

SHARE_OF_PLAIN = 0.9
"""Share of the false-match probability that is allotted to answers without a shape.

The other models of `MODELS` have equal shares of the rest."""

SHAPE_CHANCE = 1e-4
"""A frame has the shape that fits it best if noise lowers the residuals as much less often."""

LEAST_NOISE_PX = 1e-3
"""Noise below which residuals show no shape: stars of a database are rounded."""

SHAPE_STEPS = 2
"""Steps of the fit of a shape to stars that are known."""

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
    # Logarithm of the bound on the probability that chance agrees as well; 0 if fewer than
    # `MIN_STARS` match.
    log_chance: float
    # Fraction of the centroids, or of the stars of the frame if they are fewer, that match.
    share: float = 0.0
    withheld: Withheld = None  # why it is not an answer, even if chance is unlikely
    square_px2: float = math.nan  # sum of the squared residuals

    @property
    def chance(self) -> float:
        """Bound on the probability that chance agrees as well."""
        return math.exp(self.log_chance)

    @property
    def false_match_probability(self) -> float:
        """Bound on the probability that it is due to chance; 1 if it is withheld."""
        return 1.0 if self.withheld else self.chance

    def is_better_than(self, other: Agreement | None) -> bool:
        """Return whether chance explains it less; withheld agreements are compared too."""
        return other is None or self._rank < other._rank

    @property
    def _rank(self) -> tuple[float, float]:
        return 0.0 if self.withheld else self.log_chance, self.log_chance

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
    agreement: Agreement | None = None  # the agreement that chance explains least
    # Whether an attitude is within the error of a prior; None without a prior.
    is_allowed: Callable[[Matrix], bool] | None = None

    @property
    def is_certain(self) -> bool:
        """Whether the search is over."""
        return self.agreement is not None and self.agreement.false_match_probability <= self.certain

    @property
    def is_likely(self) -> bool:
        """Whether the attitude is known, although its stars may not make it certain."""
        return self.agreement is not None and self.agreement.false_match_probability <= LIKELY

    def offer(self, agreement: Agreement) -> None:
        """Keep an agreement if it is allowed and better than the best one so far."""
        is_allowed = self.is_allowed is None or self.is_allowed(agreement.pose.matrix)
        if is_allowed and agreement.is_better_than(self.agreement):
            self.agreement = agreement


def verify_candidates(
    candidates: Candidates,
    observation: Observation,
    database: MatcherDatabase,
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
        is_alone = best.agreement is None or (in_order and not observation.fov_error)
        for pose in _worth_trying(part, observation, database, is_alone):
            best.offer(agree(pose, observation, database, best.certain))
            if best.is_certain:
                return


def verify_shaped(
    batches: Iterator[Candidates], observation: Observation, database: MatcherDatabase, best: BestOf
) -> None:
    """Work out the agreements of triangles in frames of another shape until one is certain."""
    for candidates in batches:
        for pose in shaped_poses(candidates, observation, database.directions):
            refined = _refine(pose, observation, database, WIDER, free=FREE_TERMS)
            agreement = _agreement_of(refined, observation, FREE_TERMS, best.certain)
            if agreement.log_chance < 0.0:
                best.offer(_with_shape(agreement, observation, database, best.certain))
            if best.is_certain:
                return


def _worth_trying(
    candidates: Candidates, observation: Observation, database: MatcherDatabase, is_alone: bool
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
    matrices: Array,
    observation: Observation,
    database: MatcherDatabase,
    factors: Array | None = None,
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
    database: MatcherDatabase,
    certain: float,
    first: tuple[float, ...] = (),
) -> Agreement:
    """Match the centroids of a frame with the stars that an attitude predicts."""
    rough = ROUGH if observation.fov_error and not first else first
    agreement = _agreement_of(_refine(pose, observation, database, rough), observation, 0, certain)
    return _with_shape(agreement, observation, database, certain)


def _with_shape(
    agreement: Agreement, observation: Observation, database: MatcherDatabase, certain: float
) -> Agreement:
    """Return the agreement that chance explains least, with the stated camera or with a shape.

    The attitude of an agreement without a shape is right only if the frame has the shape that the
    camera says. If its residuals are small, it is, and no shape is tried.
    """
    if not agreement.log_chance < 0.0:
        return agreement
    best, pose = agreement, agreement.pose
    if _is_plain(best, observation, certain):
        return _checked(best, observation, database, is_plain=True)
    for free in MODELS:
        if free < agreement.pose.shape.free or (observation.fov_error and free == 1):
            continue
        if free and not pose.shape.free:
            pose = shaped(pose, observation)
        refined = _refine(pose, observation, database, WIDER, free=free)
        other = _agreement_of(refined, observation, free, certain)
        if other.log_chance < 0.0:
            pose = other.pose
        if other.is_better_than(best):
            best = other
    return _checked(best, observation, database)


def _is_plain(agreement: Agreement, observation: Observation, certain: float) -> bool:
    """Return whether an agreement is certain, with residuals of noise and most of the frame."""
    if agreement.false_match_probability > certain or agreement.share < PLAIN_SHARE:
        return False
    free = 2 * agreement.n_matched - 3 - agreement.pose.shape.free
    spread = (
        NOTABLE_DEVIATIONS * math.sqrt(2.0 * free)
        if observation.settings.noise_px is not None
        else 0.0
    )
    return agreement.square_px2 <= observation.noise_px**2 * (free + spread)


def _checked(
    agreement: Agreement,
    observation: Observation,
    database: MatcherDatabase,
    *,
    is_plain: bool = False,
) -> Agreement:
    """Return an agreement with the shape that its residuals show, or withheld.

    It is withheld if the matched stars do not determine the boresight to one tolerance, with the
    terms of a shape free within their ranges, or if a single star does so; if the terms are out of
    their ranges; or if fewer centroids match than the caller asks for. If it ``is_plain``, most of
    the frame agrees with the stated camera as noise does, and the boresight is the camera's.
    """
    if agreement.share < observation.settings.min_share:
        return replace(agreement, withheld="share_of_frame")
    stars = database.directions[agreement.star_index[agreement.matched]]
    whole = _fit_of(agreement, stars, N_TERMS, observation)
    if whole is not None and agreement.pose.shape.free < N_TERMS and whole.is_better:
        agreement = _of_shape(agreement, whole, stars, observation)
    free = agreement.pose.shape.free
    fit = _fit_of(agreement, stars, free if is_plain else max(FREE_TERMS, free), observation)
    if fit is None or not fit.error_rad <= REACH * observation.tolerance_rad:
        return replace(agreement, withheld="share_of_frame")
    is_outside = (np.abs(agreement.pose.shape.terms) > observation.widest_ranges).any()
    return replace(agreement, withheld="scale") if is_outside else agreement


@dataclass(frozen=True)
class _FitOfStars:
    """A step of a fit of an attitude and terms of a shape to the stars of an agreement."""

    pose: Pose  # before the step
    residual_px: Pixels
    normal: Normal
    is_better: bool  # whether the step lowers the residuals more than noise would
    error_rad: float  # standard error at the corners, or their turn if any one star is left out


def _fit_of(
    agreement: Agreement, stars: Directions, free: int, observation: Observation
) -> _FitOfStars | None:
    """Return a fit to the stars of an agreement; None if they determine none.

    Residuals are in units of the noise of their centroid.
    """
    matched = agreement.matched
    noise_px, is_stated = observation.noises_px(matched)
    pose = shaped(agreement.pose, observation)
    residual_px = pose.px[matched] - pose.camera.pixels_from_directions(stars @ pose.matrix.T)
    px = observation.centroids_px[matched]
    rows = derivatives(px, pose.body[matched], observation.camera, free) / noise_px[:, None, None]
    residual = residual_px / noise_px[:, None]
    half = observation.half_ranges
    normal = solve_normal(residual, rows, pose.shape.terms, half, 1.0)
    if normal is None:
        return None
    # The attitude was fitted without the noise of each centroid, which alone lowers the residuals.
    terms = agreement.pose.shape.free or int(observation.fov_error > 0.0)
    refit = solve_normal(residual, rows[:, :, : 3 + min(free, terms)], pose.shape.terms, half, 1.0)
    gain = normal.gain - (0.0 if refit is None else refit.gain)
    n_degrees, square = 2 * len(matched) - 3 - free, float(np.vdot(residual, residual))
    if is_stated:
        chance, factor = chance_of_gain(gain), 1.0
    else:
        least = len(matched) * (LEAST_NOISE_PX / float(noise_px.max())) ** 2
        most = max(square - normal.gain + gain, least)
        chance = chance_of_ratio(1.0 - gain / most, n_degrees) if n_degrees > 0 else 1.0
        factor = max(0.5, math.sqrt(square / max(1, n_degrees)))
    residual_after, camera = residual - rows @ normal.step, observation.camera
    influence = largest_influence_rad(residual_after, rows, normal.covariance, camera)
    error = max(corner_error_rad(normal.covariance, camera) * factor, influence)
    return _FitOfStars(pose, residual_px, normal, chance < SHAPE_CHANCE, error)


def _of_shape(
    agreement: Agreement, fit: _FitOfStars, stars: Directions, observation: Observation
) -> Agreement:
    """Return an agreement with the shape that fits its stars best."""
    other, matched = agreement, agreement.matched
    for _ in range(SHAPE_STEPS):
        pose = after_step(fit.pose, fit.normal.step, observation)
        if pose is None:
            return agreement
        other = replace(agreement, pose=pose)
        following = _fit_of(other, stars, N_TERMS, observation)
        if following is None:
            return agreement
        fit = following
    square_px2 = float(np.vdot(fit.residual_px, fit.residual_px))
    residual_rad = _residual_rad(fit.pose, matched, stars)
    return replace(other, square_px2=square_px2, residual_rad=residual_rad)


def _residual_rad(pose: Pose, matched: Rows, stars: Directions) -> float:
    """Return the root mean square separation of the matched centroids from their stars."""
    difference = pose.body[matched] - stars @ pose.matrix.T
    return math.sqrt(float(np.vdot(difference, difference)) / len(matched))


@dataclass(frozen=True)
class _Fit:
    """A pose, the stars around its field, and the star of each centroid."""

    pose: Pose
    near: Rows  # the stars around the field
    icrs: Directions
    deviations: Deviations | None  # of the magnitudes of all centroids and the stars ``near``
    predicted_px: Pixels  # the stars ``near`` as the pose puts them; NaN outside of the frame
    star: Rows  # row of ``near`` for each centroid, -1 without a star
    matched: Rows  # centroids with a star
    square_px: Array  # squared residual of each centroid, with that of its magnitude

    @cached_property
    def within(self) -> Rows:
        """Rows of ``near`` of the stars in the frame."""
        return np.flatnonzero(np.isfinite(self.predicted_px[:, 0]))


def _refine(
    pose: Pose,
    observation: Observation,
    database: MatcherDatabase,
    wider: tuple[float, ...] = (),
    free: int = 0,
) -> _Fit:
    """Refine a pose on all stars that match, first within wider reaches than the final one.

    With ``free`` terms of a shape; if that fit runs away, no centroid has a star.
    """
    radius_rad = pose.camera.radius_rad
    if observation.fov_error or free:
        # A corner is farther out than the margin on both axes: at most by the root of two.
        farther_px = 1.5 * margin_px(pose.shape.terms, pose.camera)
        radius_rad += farther_px / pose.camera.focal_length_px
        radius_rad *= 1.0 + FOCAL_MARGIN
    near = stars_in_cap(database, pose.matrix[2], radius_rad)
    observation.budget.spend(AGREEMENT * max(1, len(observation) * len(near) // PAIRS))
    u = database.directions[near]
    deviations = observation.deviations(database.mag[near])
    before: list[int] = []
    for step, factor in enumerate((*wider, *MAX_REFINEMENTS * (1.0,))):
        predicted = pose.camera.pixels_from_directions(u @ pose.matrix.T)
        reach_px = factor * REACH * observation.tolerance_px
        beyond_px = reach_px + margin_px(pose.shape.terms, pose.camera)
        predicted[~is_near_frame(predicted, pose.camera, beyond_px)] = np.nan
        star, square_px = _mutually_nearest(
            predicted, pose.px, reach_px, deviations, observation.noise_px
        )
        matched, after = (star >= 0).nonzero()[0], star.tolist()
        if len(matched) < MIN_STARS or (step >= len(wider) and after == before):
            break
        before = after
        if not free:
            pose = fit(pose, matched, u[star[matched]], observation)
            continue
        at_stars = predicted[star[matched]]
        fitted = fit_shape(pose, matched, at_stars, observation, free, observation.noise_px)
        if fitted is None:
            star, matched = np.full_like(star, -1), matched[:0]
            break
        pose = fitted
    return _Fit(pose, near, u, deviations, predicted, star, matched, square_px)


def _agreement_of(refined: _Fit, observation: Observation, free: int, certain: float) -> Agreement:
    """Return the agreement of a fit with the first ``free`` terms of a shape.

    The bound counts every choice of stars: until it is certain, the farthest star is left out
    while that lowers it.
    """
    pose, matched, square_px = refined.pose, refined.matched, refined.square_px
    log_chance = _log_chance(refined, matched, observation, free)
    while math.log(certain) < log_chance < 0.0:
        nearer = np.delete(matched, square_px[matched].argmax())
        log_chance_of_nearer = _log_chance(refined, nearer, observation, free)
        if not log_chance_of_nearer < log_chance:
            break
        matched, log_chance = nearer, log_chance_of_nearer
    index = np.empty(len(observation), dtype=np.int32)
    index.fill(-1)
    index[matched] = refined.near[refined.star[matched]]
    if len(matched) < MIN_STARS:
        return Agreement(pose, index, math.nan, 0.0)
    residual_rad = _residual_rad(pose, matched, refined.icrs[refined.star[matched]])
    share = len(matched) / max(1, min(len(refined.within), len(observation)))
    apart = pose.px[matched] - refined.predicted_px[refined.star[matched]]
    square_px2 = float(np.vdot(apart, apart))
    return Agreement(pose, index, residual_rad, log_chance, min(1.0, share), square_px2=square_px2)


def _log_chance(refined: _Fit, matched: Rows, observation: Observation, free: int) -> float:
    """Return the logarithm of the bound of the centroids of a fit that match, or of some.

    It is over the share of the probability that the model has.
    """
    if len(matched) < MIN_STARS or 2 * len(matched) <= 3 + free:
        return 0.0
    pose, within = refined.pose, refined.within
    px = observation.centroids_px[matched]
    unknowns = free or int(observation.fov_error > 0.0)
    half, terms = observation.half_ranges[:unknowns].copy(), pose.shape.terms
    growth = 0.0
    if free:
        growth = log_growth(px, terms, observation.camera)
        if abs(terms[0]) > half[0]:
            # The wider the range is, the smaller is its share of the probability.
            half[0] *= WIDER_RANGE
            growth += math.log(WIDER_RANGE)
    log_bound = log_false_match_probability(
        math.fsum(refined.square_px[matched].tolist()),
        derivatives(px, pose.body[matched], pose.camera, unknowns),
        len(observation),
        len(within),
        pose.camera,
        noise_px=observation.settings.noise_px,
        deviations=None if refined.deviations is None else refined.deviations[:, within],
        half_ranges=half,
        log_growth=growth,
        log_attitudes=observation.log_attitudes,
    )
    share = SHARE_OF_PLAIN if free == 0 else (1.0 - SHARE_OF_PLAIN) / (len(MODELS) - 1)
    return min(0.0, log_bound - math.log(share))


def _mutually_nearest(
    predicted_px: Array, px: Pixels, reach_px: float, deviations: Deviations | None, noise_px: float
) -> tuple[Rows, Array]:
    """Return the star of each centroid, -1 without a star, and the squared residuals.

    A centroid has a star if each of the two is the nearest to the other, within reach, among
    those whose magnitudes are compatible. The deviation of a magnitude is a residual too, in units
    of the noise of a place.
    """
    count = len(px)
    if not len(predicted_px):
        return np.full(count, -1), np.full(count, np.inf)
    offset = px[:, None] - predicted_px
    offset *= offset
    square = offset[..., 0]
    square += offset[..., 1]
    # The distance is NaN where the lens forms no image of a star; it must not be the minimum.
    np.copyto(square, np.inf, where=~(square <= reach_px * reach_px))
    if deviations is not None:
        square += noise_px**2 * np.square(deviations, dtype=np.float64)
        square[deviations == INCOMPATIBLE] = np.inf
    star, rows = square.argmin(axis=1), np.arange(count)
    nearest = square[rows, star]
    mutual = (square.argmin(axis=0)[star] == rows) & np.isfinite(nearest)
    return np.where(mutual, star, -1), nearest
