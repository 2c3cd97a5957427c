"""The search with numpy: one frame through a method and the verification, to its answer."""

from __future__ import annotations

from itertools import islice
from typing import Literal

from starcat.arrays import Array
from starcat.errors import ConfigError
from starcat.geometry.camera import Camera
from starcat.matcher.asking import Asking, as_asked
from starcat.matcher.budget import BudgetSpentError
from starcat.matcher.chance import MIN_STARS
from starcat.matcher.methods.table import METHODS
from starcat.matcher.observation import Observation
from starcat.matcher.prior import Prior, expected_near, search_near
from starcat.matcher.refusal import Refusal
from starcat.matcher.result import MatchResult, Origin, identified, unidentified
from starcat.matcher.verification import Agreement, BestOf, verify

CERTAIN = 1e-9
"""Largest false-match probability of an answer, unless another one is asked for.

Where more is allowed, a hundredth of it ends the search; else the best answer is taken.
"""


def certainty(matcher: Asking) -> float:
    """Return how low a false-match probability ends a search."""
    limit = matcher.max_false_match_probability
    return limit if limit <= CERTAIN else max(CERTAIN, 0.01 * limit)


def searched(
    matcher: Asking,
    frame: Array,
    camera: Camera,
    mag: Array | None,
    fov_error: float = 0.0,
    prior: Prior | None = None,
) -> MatchResult:
    """Identify a frame with numpy."""
    if matcher.database.image is not None:
        raise ConfigError(
            f"a frame of {len(frame)} centroids and this camera are beyond the C library, and "
            "an onboard image holds nothing for numpy; open the artifact that it is of"
        )
    observation = as_asked(matcher, frame, camera, mag, fov_error)
    origin: Origin = "lost_in_space" if prior is None else "tracking"
    if len(observation) < MIN_STARS:
        return unidentified("too_few_stars", observation, origin=origin)
    found, limit = _best(matcher, observation, prior)
    if found is None or found.false_match_probability > matcher.max_false_match_probability:
        why = refusal_of(found, limit, prior)
        return unidentified("no_match", observation, why, origin=origin)
    answer = identified(found, observation, matcher.database.star_id, origin)
    if prior is None:
        return answer
    return expected_near(prior, answer, camera, matcher.tolerance_px)


def _best(
    matcher: Asking, observation: Observation, prior: Prior | None
) -> tuple[Agreement | None, Literal["time", "steps"] | None]:
    """Return the first agreement that is certain, or the best one, and what ended the search.

    The best one is that which chance explains least, among those that are withheld too.
    """
    best = BestOf(certainty(matcher))
    propose = METHODS[matcher.method].propose
    whole_sky = islice(
        propose(observation, matcher.database, matcher.selection), matcher.max_batches
    )
    try:
        if prior is not None:
            search_near(prior, observation, matcher.database, best, whole_sky)
            return best.found, None
        for candidates in whole_sky:
            verify(candidates, observation, matcher.database, best)
            if best.is_certain:
                break
    except BudgetSpentError as spent:
        return best.found, spent.limit
    return best.found, None


def refusal_of(
    found: Agreement | None,
    limit: Literal["time", "steps"] | None,
    prior: Prior | None = None,
) -> Refusal:
    """Return why the best agreement, if there is one, is no answer."""
    if found is None or (prior is not None and found.chance >= 1.0):
        return Refusal(limit or ("no_candidate" if prior is None else "prior"))
    return Refusal(limit or found.withheld or "chance", found.n_matched, found.chance, found.share)
