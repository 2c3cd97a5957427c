"""Chains: candidates of several frames that confirm each other.

A frame whose best attitude chance could explain has no answer, but a candidate. If the next frame
has a candidate where the first one and the motion of the camera predict it, both are a chain, which
is an answer if its joint bound is below the limit.

A second frame of the same stars is no second proof: a false attitude that agrees with the spots of
one frame agrees with the same spots, a moment later, again. Only spots that no earlier frame of the
chain has are counted: stars that came into the field, or were not detected before. A spot is the
spot of an earlier frame if both attitudes put it at the same place of the sky.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from starcat.arrays import Array, Directions
from starcat.matcher.chance import (
    LOG_ALL_ATTITUDES,
    FrameEvidence,
    evidence_of_frame,
    joint_false_match_probability,
    rate_of_magnitudes,
)
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.observation import observe
from starcat.matcher.result import MatchResult
from starcat.matcher.settings import REACH, Settings
from starcat.matcher.shape import derivatives, is_near_frame
from starcat.matcher.star_cells import stars_in_cap

SAME_SPOT = 2.0
"""Largest distance of spots that count as one, in reaches: either of them can be off by a reach."""


@dataclass(frozen=True)
class Chain:
    """Candidates of successive frames, each near the prediction of those before it."""

    answer: MatchResult  # candidate of the last frame
    first: int  # number of the first frame
    last: int  # number of the last frame
    spots: Directions  # spots of all frames on the sky, as the candidates put them; shape (N, 3)
    evidence: tuple[FrameEvidence, ...]  # of each frame, from the spots that are new in it

    @property
    def false_match_probability(self) -> float:
        """Bound on the probability that chance agrees as well with any such chain.

        Every chain that ends with a frame has a share of the probability: 2^-k if it begins k
        frames before, divided by the number of choices of frames between. All shares add up to 1.
        """
        if len(self.evidence) == 1:
            return self.answer.false_match_probability
        share = 2.0 ** (1 - 2 * (self.last - self.first))
        return min(1.0, joint_false_match_probability(self.evidence) / share)

    @property
    def confirmed(self) -> MatchResult:
        """The candidate of the last frame as an answer, with the joint bound."""
        chance = self.false_match_probability
        return replace(self.answer, false_match_probability=chance, origin="tracking")


def chain_of(
    candidate: MatchResult, number: int, settings: Settings, database: MatcherDatabase
) -> Chain | None:
    """Return a chain of one frame; None if a focal length or a shape was fitted in it."""
    return _linked(candidate, number, settings, database, None, LOG_ALL_ATTITUDES)


def extended(
    chain: Chain,
    candidate: MatchResult,
    number: int,
    settings: Settings,
    database: MatcherDatabase,
    log_attitudes: float,
) -> Chain | None:
    """Return a chain with the candidate of one more frame; None if it confirms nothing.

    ``log_attitudes`` is the logarithm of the volume of the attitudes that are predicted.
    """
    return _linked(candidate, number, settings, database, chain, log_attitudes)


def _linked(
    candidate: MatchResult,
    number: int,
    settings: Settings,
    database: MatcherDatabase,
    before: Chain | None,
    log_attitudes: float,
) -> Chain | None:
    frame = candidate.frame
    if frame is None or candidate.shape is not None or candidate.focal_length_error_px is not None:
        return None
    seen, matrix, camera = observe(frame, settings), candidate.matrix, frame.camera
    on_sky = seen.body @ matrix
    is_new = np.ones(len(seen), dtype=bool)
    log_area = math.log(camera.width_px * camera.height_px)
    if before is not None:
        reach_px = SAME_SPOT * REACH * seen.tolerance_px
        there = before.spots[before.spots @ matrix[2] > math.cos(1.5 * camera.radius_rad)]
        apart = seen.centroids_px[:, None] - camera.pixels_from_directions(there @ matrix.T)
        square = np.einsum("nki,nki->nk", apart, apart)
        is_new = ~(square <= reach_px * reach_px).any(axis=1)
        covered = len(there) * math.pi * reach_px * reach_px / math.exp(log_area)
        if covered >= 0.5:  # there is no room for new spots
            return None
        log_area += math.log1p(-covered)
    star = candidate.star_index[seen.rows]
    matched = np.flatnonzero((star >= 0) & is_new)
    near = stars_in_cap(database, matrix[2], camera.radius_rad)
    star_px = camera.pixels_from_directions(database.directions[near] @ matrix.T)
    near = near[is_near_frame(star_px, camera, REACH * seen.tolerance_px)]
    deviations = seen.deviations(database.mag[near])
    u = database.directions[star[matched]]
    residual = seen.centroids_px[matched] - camera.pixels_from_directions(u @ matrix.T)
    square_px = float(np.vdot(residual, residual))
    of_stars = seen.deviations(database.mag[star[matched]])
    if of_stars is not None:
        square_px += seen.noise_px**2 * float(np.square(of_stars[matched].diagonal()).sum())
    evidence = evidence_of_frame(
        square_px,
        derivatives(seen.centroids_px[matched], seen.body[matched], camera, 0),
        int(is_new.sum()),
        len(near),
        log_area,
        log_attitudes,
        0.0 if settings.noise_mag is None else rate_of_magnitudes(settings.noise_px),
        None if deviations is None else deviations[is_new],
    )
    if evidence is None:
        return None
    earlier: Array = np.empty((0, 3)) if before is None else before.spots
    return Chain(
        candidate,
        number if before is None else before.first,
        number,
        np.concatenate([earlier, on_sky]),
        (*(() if before is None else before.evidence), evidence),
    )
