"""Ways to answer a frame: the matcher as it is, or a paper's method without verification."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from starcat.arrays import Array, Rows
from starcat.evaluation.bare_methods import (
    name_by_points,
    name_by_separations,
    rank_by_ratios,
)
from starcat.geometry.camera import Camera
from starcat.matcher.database import Database
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods.consensus import references
from starcat.matcher.methods.hausdorff import rank_by_points
from starcat.matcher.observation import Observation, as_frame, observe
from starcat.matcher.result import MatchResult, no_match

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
