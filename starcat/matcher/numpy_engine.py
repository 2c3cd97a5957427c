"""The readable reference in numpy: one frame through a method and the verification."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from starcat.matcher.chance import MIN_STARS, log_attitudes_within
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.methods import triangle, votes
from starcat.matcher.methods.table import METHODS
from starcat.matcher.observation import Candidates, Frame, Observation, observe
from starcat.matcher.pose import fit_by_weights, focal_length_error_px
from starcat.matcher.prior import Prior, search_near
from starcat.matcher.refusal import Refusal, stated_facts
from starcat.matcher.result import MatchResult, Origin, no_match
from starcat.matcher.settings import Budget, BudgetSpentError, Limit, Settings, certainty
from starcat.matcher.shape import of_scale
from starcat.matcher.star_density import with_few_stars
from starcat.matcher.stars import ARCSEC
from starcat.matcher.verification import Agreement, BestOf, verify_candidates, verify_shaped

EFFORT_OF_PATTERN = {"triangle": 3, "pyramid": 9}
"""Effort of looking up a pattern, by method; a candidate costs one for each centroid of the frame.

``identify.c`` and ``triangles.c`` have the same efforts, so that both end at the same candidate.
"""

EFFORT_BEFORE_VOTES = 750
"""Effort of patterns before votes are counted."""

EFFORT_AFTER_VOTES = 1750
"""Effort of patterns with those after the votes, if there were enough references."""

EFFORT_OF_CROWDED = 60_000
"""The same in frames with so many centroids that the votes can miss their stars."""

EFFORT_OF_SHAPED = 50
"""Effort of looking up a triangle in frames of another shape."""

EFFORT_ON_SHAPES = 4000
"""Effort of triangles in frames of another shape, if no attitude with the stated one is certain."""


def solve(
    settings: Settings,
    database: MatcherDatabase,
    frame: Frame,
    fov_error: float = 0.0,
    prior: Prior | None = None,
) -> MatchResult:
    """Identify the stars of a frame, with a prior near it."""
    database.check_has_products(
        f"a frame of {len(frame)} centroids and this camera are beyond the C library, and an "
        "onboard image holds nothing for numpy"
    )
    observation = observe(
        frame,
        settings,
        fov_error=fov_error,
        budget=Budget(settings.max_steps, settings.time_limit_s),
    )
    best, limit = BestOf(certainty(settings)), None
    if prior is not None:
        camera, tolerance_px = frame.camera, settings.tolerance_px
        best.is_allowed = partial(prior.allows, camera=camera, tolerance_px=tolerance_px)
        turn_rad = prior.largest_turn_rad(camera, tolerance_px)
        observation = replace(observation, log_attitudes=log_attitudes_within(turn_rad))
    if len(observation) >= MIN_STARS:
        limit = _search(observation, database, prior, best)
    answer = result_of_search(best.agreement, observation, database, limit, prior)
    if answer.refusal is not None:
        why = with_few_stars(answer.refusal, database, frame.camera)
        answer = replace(answer, refusal=why)
    return answer


def proposals(observation: Observation, database: MatcherDatabase) -> Iterator[Candidates]:
    """Return the batches of candidates of the method of an observation's settings."""
    return METHODS[observation.settings.method].propose(observation, database)


def _search(
    observation: Observation, database: MatcherDatabase, prior: Prior | None, best: BestOf
) -> Limit | None:
    try:
        if prior is not None:
            whole_sky = proposals(observation, database)
            search_near(prior, observation, database, best, whole_sky)
            return None
        search_sky(observation, database, best)
        if observation.settings.method == "triangle" and not best.is_likely:
            shaped = triangle.shaped_candidates(observation, database)
            patterns = _Patterns(shaped, EFFORT_OF_SHAPED, len(observation))
            verify_shaped(patterns.within(EFFORT_ON_SHAPES), observation, database, best)
    except BudgetSpentError as spent:
        return spent.limit
    return None


def search_sky(observation: Observation, database: MatcherDatabase, best: BestOf) -> None:
    """Search without a prior attitude, with cheap methods first and thorough ones later.

    The patterns of the method come first. If the first ones do not solve the frame, votes follow
    (`starcat.matcher.methods.votes`), and then more patterns: many if the votes can miss the stars
    of the frame. The bound on false matches is the bound of the best agreement: it holds for all
    attitudes together, and does not depend on how many are tried.
    """
    proposed = proposals(observation, database)
    if not votes.can_vote(observation, database):
        _try(proposed, observation, database, best)
        return
    each = EFFORT_OF_PATTERN[observation.settings.method]
    patterns = _Patterns(proposed, each, len(observation))
    if _try(patterns.within(EFFORT_BEFORE_VOTES), observation, database, best):
        return
    needed = votes.references_needed(observation, database)
    is_crowded = needed > votes.MAX_REFERENCES
    references = votes.MIN_REFERENCES if is_crowded else max(votes.MIN_REFERENCES, needed)
    for reference in range(min(len(observation), references)):
        if best.is_likely:
            return
        proposed = votes.candidates(reference, observation, database)
        if _try(proposed, observation, database, best):
            return
    if not best.is_likely:
        effort = EFFORT_OF_CROWDED if is_crowded else EFFORT_AFTER_VOTES
        _try(patterns.within(effort), observation, database, best)


@dataclass
class _Patterns:
    """The candidates of a frame's patterns, which are tried in parts."""

    batches: Iterator[Candidates]
    of_pattern: int  # effort of looking one up
    of_candidate: int  # effort of trying a candidate
    looked_up: int = 0
    tried: int = 0
    untried: Candidates | None = None  # candidates that the previous part did not try

    def within(self, most: int) -> Iterator[Candidates]:
        """Yield the next candidates until the effort of the whole search is ``most``.

        The other candidates of the pattern at which it ends are left out.
        """
        while self.untried or self._effort(self.looked_up + 1, self.tried) < most:
            batch = self.untried or next(self.batches, None)
            if batch is None:
                return
            self.untried, self.looked_up = None, batch.looked_up
            numbers = np.asarray(batch.patterns)
            effort = self._effort(numbers, self.tried + np.arange(len(batch)))
            count = int(np.searchsorted(effort, most))
            self.tried += count
            if count:
                yield batch[:count]
            if count < len(batch):
                begun = numbers[count - 1] if count else 0
                self.untried = batch[count:][numbers[count:] > begun]
                return

    def _effort(self, looked_up: Any, tried: Any) -> Any:
        return self.of_pattern * looked_up + self.of_candidate * tried


def _try(
    proposed: Iterator[Candidates],
    observation: Observation,
    database: MatcherDatabase,
    best: BestOf,
) -> bool:
    """Try candidates until one is certain; return whether one is."""
    for candidates in proposed:
        verify_candidates(candidates, observation, database, best)
        if best.is_certain:
            break
    return best.is_certain


def result_of_search(
    agreement: Agreement | None,
    observation: Observation,
    database: MatcherDatabase,
    limit: Limit | None = None,
    prior: Prior | None = None,
) -> MatchResult:
    """Return the answer from the best agreement of a search, or the reason why it is withheld."""
    count = len(observation) + len(observation.dropped)
    origin: Origin = "lost_in_space" if prior is None else "tracking"
    best = None
    if agreement is not None and agreement.chance < 1.0:
        best = _answer_of(agreement, observation, database, origin)
        limit_of_answers = observation.settings.max_false_match_probability
        if agreement.withheld is None and agreement.chance <= limit_of_answers:
            return best
    noises = observation.settings.noise_px, observation.settings.noise_mag
    inputs = stated_facts(observation.mag is not None, *noises, bool(observation.dropped))
    why = replace(_refusal_of(agreement, observation, limit, prior), facts=inputs, candidate=best)
    return no_match(count, observation.dropped, why, origin=origin)


def _answer_of(
    agreement: Agreement, observation: Observation, database: MatcherDatabase, origin: Origin
) -> MatchResult:
    """Return the answer that an agreement is."""
    pose, matched = agreement.pose, agreement.matched
    stars = database.directions[agreement.star_index[matched]]
    sigma_px = None if observation.sigma_px is None else observation.sigma_px[matched]
    matrix, residual_rad = fit_by_weights(pose.body[matched], stars, sigma_px)
    error_px = None
    if observation.fov_error and not pose.shape.free:
        error_px = focal_length_error_px(
            pose.body[matched],
            pose.camera.focal_length_px,
            agreement.residual_rad,
            observation.settings.noise_px,
        )
    shape, camera = of_scale(pose.shape, pose.camera)
    return MatchResult(
        "identified",
        observation.in_frame(agreement.star_index),
        matrix,
        residual_rad * ARCSEC,
        agreement.chance,
        observation.dropped,
        camera,
        error_px,
        origin,
        shape=shape if shape.free else None,
    )


def _refusal_of(
    agreement: Agreement | None, observation: Observation, limit: Limit | None, prior: Prior | None
) -> Refusal:
    if len(observation) < MIN_STARS:
        return Refusal("too_few_stars")
    if agreement is None or (prior is not None and agreement.chance >= 1.0):
        return Refusal(limit or ("no_candidate" if prior is None else "prior"))
    return Refusal(
        limit or agreement.withheld or "chance",
        agreement.n_matched,
        agreement.chance,
        agreement.share,
        len(observation),
    )
