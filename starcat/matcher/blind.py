"""Frames of a camera of which only a range of fields of view is known.

Each level of the database serves a part of the range, with its own stars and triangles; within
that part the focal length is found with the attitude. All levels are searched together, a batch
of candidates from each in turn, until one agreement is certain.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice, pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.errors import ConfigError
from starcat.geometry.camera import Camera
from starcat.matcher.asking import Asking, as_asked, check_scale_free
from starcat.matcher.budget import Budget, BudgetSpentError
from starcat.matcher.chance import MIN_STARS
from starcat.matcher.levels import Level, levels
from starcat.matcher.methods.candidates import Candidates
from starcat.matcher.methods.table import METHODS
from starcat.matcher.methods.triangle_order import DEFAULT, TriangleOrder
from starcat.matcher.observation import WIDEST_FOV_ERROR, Observation
from starcat.matcher.pose import first_poses, pose_at
from starcat.matcher.result import MatchResult, identified, unidentified
from starcat.matcher.searching import certainty, refusal_of
from starcat.matcher.verification import AT_ONCE, Agreement, BestOf, agree, agreeing_centroids

MOST_CENTROIDS = 40
"""Brightest centroids of a frame that are compared with a level, which has about 20 stars a field
of its size, and 40 a frame that is wider by half."""

BRIGHTEST = TriangleOrder(most_centroids=10)
"""Triangles where magnitudes are known: those of the stars that a level's triangles are of."""

BY_CHANCE = 1.0
"""Candidates of a batch that are worked out although they agree by chance, on average."""

_OWN = 3
"""Centroids of a candidate, which its attitude was computed from."""

BEYOND = 1.25
"""Factor by which the outer levels serve focal lengths beyond those that they are made for: a
frame of other proportions than the camera's has another width for the same area."""


@dataclass(frozen=True)
class Part:
    """A part of a range of focal lengths, and the level that serves it.

    Attributes
    ----------
    level : Level
        Stars and triangles.
    low_px, high_px : float
        Ends, pixels.
    """

    level: Level
    low_px: float
    high_px: float

    @property
    def focal_length_px(self) -> float:
        """The middle, of which both ends are the same factor away."""
        return math.sqrt(self.low_px * self.high_px)

    @property
    def fov_error(self) -> float:
        """Largest relative error of the middle."""
        return 1.0 - math.sqrt(self.low_px / self.high_px)


@dataclass(frozen=True)
class _Search:
    """One part's frame, its candidates, and the best that came of them."""

    part: Part
    whole: Observation
    used: Observation
    best: BestOf


def parts_of_range(
    known: Sequence[Level], camera: Camera, fov_deg: tuple[float, float]
) -> list[Part]:
    """Return the parts of a range of fields of view."""
    narrow_deg, wide_deg = (float(angle) for angle in fov_deg)
    if not 0.0 < narrow_deg < wide_deg < 180.0:
        raise ConfigError(
            f"fov_deg is {narrow_deg:g} to {wide_deg:g}; expected two fields of view between 0 "
            "and 180 deg, the narrower one first",
            key="fov_deg",
            value=fov_deg,
        )
    low_px, high_px = (_focal_px(camera, angle) for angle in (wide_deg, narrow_deg))
    ends = [level.focal_length_px(camera) for level in known]
    ends.append(ends[-1] ** 2 / ends[-2])
    if high_px > ends[0] * BEYOND or low_px < ends[-1] / BEYOND:
        reach = [2.0 * math.degrees(math.atan(0.5 * camera.width_px / end)) for end in ends]
        raise ConfigError(
            f"fov_deg is {narrow_deg:g} to {wide_deg:g}; the levels of {known[0].database.name} "
            f"serve {reach[0]:.4g} to {reach[-1]:.4g} deg across a frame of {camera.width_px} x "
            f"{camera.height_px} px. Give a range within these, or build for a wider one",
            key="fov_deg",
            value=fov_deg,
        )
    ends[0], ends[-1] = ends[0] * BEYOND, ends[-1] / BEYOND
    parts = [
        Part(level, max(low_px, low), min(high_px, high))
        for level, (high, low) in zip(known, pairwise(ends), strict=True)
    ]
    return [part for part in reversed(parts) if part.low_px < part.high_px]


def _focal_px(camera: Camera, fov_x_deg: float) -> float:
    return 0.5 * camera.width_px / math.tan(math.radians(0.5 * fov_x_deg))


def identify_blind(
    matcher: Asking,
    centroids_px: Array,
    camera: Camera,
    mag: Array | None,
    fov_deg: tuple[float, float],
) -> MatchResult:
    """Identify a frame of a camera of which only a range of fields of view is known.

    Notes
    -----
    The false-match probability of an answer is that of its level times the number of levels that
    were searched. The bound of one level counts all attitudes and all focal lengths of its part
    of the range (`false_match_probability`), with the number of its own stars in the frame. The
    parts cover the whole range and do not overlap, and the probability that chance agrees in
    any of K parts is at most the sum of those in each. So no answer is given in any of them
    whose bound is above the limit divided by K. Only the brightest of many spots are compared;
    which these are does not depend on where in the frame they lie, so that the bound holds for
    them as for a frame that has no others.
    """
    parts = _checked_parts(matcher, camera, fov_deg)
    budget = Budget(matcher.max_steps, matcher.time_limit_s)
    searches = [
        _begun(part, matcher, camera, centroids_px, mag, budget, certainty(matcher) / len(parts))
        for part in parts
    ]
    whole = searches[0].whole
    if len(whole) < MIN_STARS:
        return unidentified("too_few_stars", whole)
    limit = _run(searches, matcher)
    done = [search for search in searches if search.best.found is not None]
    if not done:
        return unidentified("no_match", whole, refusal_of(None, limit))
    first = done[0]
    for other in done[1:]:
        if other.best.found is not None and other.best.found.is_better_than(first.best.found):
            first = other
    found = _of_the_artifact(first, len(parts))
    if found.false_match_probability > matcher.max_false_match_probability:
        return unidentified("no_match", whole, refusal_of(found, limit))
    return identified(found, first.whole, matcher.database.star_id)


def _checked_parts(matcher: Asking, camera: Camera, fov_deg: tuple[float, float]) -> list[Part]:
    if matcher.database.image is not None:
        raise ConfigError(
            "an onboard image serves one field of view; open the artifact that it is of", key="fov"
        )
    check_scale_free(matcher)
    return parts_of_range(levels(matcher.database), camera, fov_deg)


def _begun(
    part: Part,
    matcher: Asking,
    camera: Camera,
    centroids_px: Array,
    mag: Array | None,
    budget: Budget,
    certain: float,
) -> _Search:
    """Return the search of one part before its first candidate."""
    eye = Camera(camera.width_px, camera.height_px, part.focal_length_px)
    error = min(part.fov_error, WIDEST_FOV_ERROR)
    whole = as_asked(matcher, centroids_px, eye, mag, error, budget)
    used = whole
    if whole.mag is not None and len(whole) > MOST_CENTROIDS:
        used = replace(
            whole,
            rows=whole.rows[:MOST_CENTROIDS],
            centroids_px=whole.centroids_px[:MOST_CENTROIDS],
            body=whole.body[:MOST_CENTROIDS],
            mag=whole.mag[:MOST_CENTROIDS],
        )
    return _Search(part, whole, used, BestOf(certain))


def _run(searches: Sequence[_Search], matcher: Asking) -> Literal["time", "steps"] | None:
    """Search a batch of each part in turn, and return the limit that ended it."""
    waiting = [(search, _steps(search, matcher)) for search in searches]
    try:
        while waiting:
            left = []
            for search, steps in waiting:
                if next(steps, None) is None:
                    continue
                if search.best.is_certain:
                    return None
                left.append((search, steps))
            waiting = left
    except BudgetSpentError as spent:
        return spent.limit
    return None


def _steps(search: _Search, matcher: Asking) -> Iterator[bool]:
    """Verify a batch of candidates each time that the next value is asked for."""
    selection = matcher.selection
    if selection == DEFAULT and search.used.mag is not None:
        selection = BRIGHTEST
    propose, database = METHODS[matcher.method].propose, search.part.level.database
    proposals = propose(search.used, database, selection)
    for candidates in islice(proposals, matcher.max_batches):
        _verify(candidates, search)
        yield True


def _verify(candidates: Candidates, search: _Search) -> None:
    """Work out the agreements of the candidates that stand out, until one is certain.

    Each level has thousands of candidates for a frame, nearly all of them false. Beside its own
    three, each has as many agreeing centroids as chance brings near stars: a Poisson variate,
    whose mean is that of the batch. Those are worked out that hardly any of the batch reaches.
    """
    frame, database = search.used, search.part.level.database
    matrices, factors, counts = [], [], []
    for first in range(0, len(candidates), AT_ONCE):
        part = candidates[first : first + AT_ONCE]
        frame.budget.spend(len(part))
        turned, scaled = first_poses(part, frame, database.directions)
        matrices.append(turned)
        factors.append(scaled)
        counts.append(agreeing_centroids(turned, frame, database, scaled))
    count = np.concatenate(counts)
    order = np.argsort(-count, kind="stable")
    for row in order[count[order] >= _standing_out(count)].tolist():
        batch, place = divmod(row, AT_ONCE)
        pose = pose_at(matrices[batch][place], float(factors[batch][place]), frame)
        search.best.offer(agree(pose, frame, database, search.best.certain))
        if search.best.is_certain:
            return


def _standing_out(count: NDArray[np.int64]) -> int:
    """Return how many centroids agree with no more than `BY_CHANCE` of some false candidates."""
    mean = float(np.maximum(count - _OWN, 0).mean())
    expected, term, more = float(len(count)), math.exp(-mean), 0
    while expected > BY_CHANCE:
        expected -= len(count) * term
        more += 1
        term *= mean / more
    return max(MIN_STARS, _OWN + more)


def _of_the_artifact(search: _Search, parts: int) -> Agreement:
    """Return the best agreement with rows of the artifact, and the chance of all parts."""
    found = search.best.found
    if found is None:
        raise ValueError("a search that came to nothing has no agreement")
    index = np.full(len(search.whole), -1, dtype=np.int32)
    has_star = np.flatnonzero(found.star_index >= 0)
    index[has_star] = search.part.level.rows[found.star_index[has_star]]
    return replace(found, star_index=index, chance=min(1.0, parts * found.chance))
