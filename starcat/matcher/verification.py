"""Verification: whether an attitude explains a frame.

Every method's candidates come here. A candidate's attitude puts the database's stars on the
detector; the centroids that lie near one are its agreement, and the attitude is refined on
all of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcat.attitude import solve_wahba_svd
from starcat.matcher.candidates import Candidates
from starcat.matcher.chance import false_match_probability
from starcat.matcher.database import Database
from starcat.matcher.observation import Observation
from starcat.matcher.star_cells import StarCells, star_cells

Array = NDArray[np.float64]

MIN_STARS = 4
"""Three stars make an attitude; at least one more has to agree with it."""

MIN_SHARE = 0.4
"""An attitude has to explain this share of the centroids, or of the stars if they are fewer.

Stars crowd in clusters, where a part of them agrees with an attitude that is off.
"""

REACH = 1.5
"""Stars and centroids agree within this many tolerances: an attitude from few stars errs too."""

SCALE_DEVIATIONS = 3.0
"""Standard deviations from which on a difference of scale is none of chance."""

MAX_REFINEMENTS = 4
"""The matched stars rarely change after the first."""

AT_ONCE = 256
"""Candidates whose agreement is counted together."""


@dataclass(frozen=True)
class Agreement:
    """How well an attitude explains a frame.

    Attributes
    ----------
    matrix : ndarray of float64, shape (3, 3)
        Attitude refined on all matched stars, ``body = matrix @ icrs``.
    star_index : ndarray of int32, shape (N,)
        Row of each centroid's star, -1 where none.
    residual_rad : float
        Root mean square separation of the matched; NaN for too few.
    false_match_probability : float
        That chance agrees as well; 1 for too few.
    """

    matrix: Array
    star_index: NDArray[np.int32]
    residual_rad: float
    false_match_probability: float

    @property
    def n_matched(self) -> int:
        """Number of centroids with a star."""
        return int((self.star_index >= 0).sum())


def verify(
    candidates: Candidates,
    observation: Observation,
    database: Database,
    certain: float,
) -> Agreement | None:
    """Return the agreement of a batch of candidates that chance explains least.

    Parameters
    ----------
    candidates : Candidates
        A batch.
    observation : Observation
        The frame.
    database : Database
        The stars.
    certain : float
        The first agreement with a false-match probability this low ends the search.

    Returns
    -------
    Agreement or None
        None if there is no candidate. After the first one, those with more agreeing centroids
        are tried first.
    """
    best = None
    for first in range(0, len(candidates), AT_ONCE):
        part = candidates[first : first + AT_ONCE]
        for matrix in _worth_trying(part, observation, database):
            found = agree(matrix, observation, database)
            if best is None or found.false_match_probability < best.false_match_probability:
                best = found
            if best.false_match_probability <= certain:
                return best
    return best


def _worth_trying(
    candidates: Candidates, observation: Observation, database: Database
) -> Iterator[Array]:
    """Return the first attitude, then the others by how many centroids agree."""
    body, icrs = observation.body, database.directions
    yield solve_wahba_svd(body[candidates.centroids[0]], icrs[candidates.stars[0]])
    if len(candidates) > 1:
        matrices = solve_wahba_svd(body[candidates.centroids[1:]], icrs[candidates.stars[1:]])
        count = agreeing_centroids(matrices, observation, database)
        order = np.argsort(-count, kind="stable")
        yield from matrices[order[count[order] >= MIN_STARS]]


def agreeing_centroids(
    matrices: Array, observation: Observation, database: Database
) -> NDArray[np.int64]:
    """Count the centroids that attitudes put near a star, on the detector or just off it.

    Parameters
    ----------
    matrices : ndarray of float64, shape (K, 3, 3)
        Attitudes.
    observation : Observation
        The frame.
    database : Database
        The stars.

    Returns
    -------
    ndarray of int64, shape (K,)
        Centroids within reach of some star.
    """
    reach_rad = REACH * observation.tolerance_rad
    icrs = observation.body @ matrices
    near = database.derived(_cells, reach_rad).has_star(icrs.reshape(-1, 3), reach_rad)
    return np.asarray(near.reshape(len(matrices), -1).sum(axis=1))


def _cells(database: Database, reach_rad: float) -> StarCells:
    return star_cells(database.directions, reach_rad)


def agree(matrix: Array, observation: Observation, database: Database) -> Agreement:
    """Match the centroids of a frame with the stars that an attitude predicts.

    Parameters
    ----------
    matrix : ndarray of float64, shape (3, 3)
        Attitude to test, ``body = matrix @ icrs``.
    observation : Observation
        The frame.
    database : Database
        The stars.

    Returns
    -------
    Agreement
        After refinement on all stars that matched, until they no longer change. Each star has
        one centroid at most.
    """
    camera, body = observation.camera, observation.body
    near = np.flatnonzero(database.directions @ matrix[2] >= np.cos(camera.radius_rad))
    u = database.directions[near]
    before: NDArray[np.int64] = np.empty(0, dtype=np.int64)
    for _ in range(MAX_REFINEMENTS):
        predicted = camera.pixels_from_directions(u @ matrix.T)
        star, residual_px = _mutually_nearest(predicted, observation)
        matched = np.flatnonzero(star >= 0)
        if len(matched) < MIN_STARS or np.array_equal(star, before):
            break
        before = star
        matrix = solve_wahba_svd(body[matched], u[star[matched]])
    index = np.full(len(body), -1, dtype=np.int32)
    index[matched] = near[star[matched]]
    if len(matched) < MIN_STARS:
        return Agreement(matrix, index, math.nan, 1.0)
    seen = body[matched]
    difference = seen - u[star[matched]] @ matrix.T
    square = float(np.vdot(difference, difference)) / len(matched)
    stars = _within_reach_of_frame(predicted, observation)
    explained = len(matched) >= MIN_SHARE * min(len(body), stars)
    if not explained or _is_scaled(
        predicted[star[matched]], observation.centroids_px[matched], observation
    ):
        return Agreement(matrix, index, math.sqrt(square), 1.0)
    distance = residual_px[matched]
    chance = false_match_probability(
        float(distance @ distance),
        seen,
        len(body),
        stars,
        camera,
    )
    return Agreement(matrix, index, math.sqrt(square), chance)


def _within_reach_of_frame(predicted_px: Array, observation: Observation) -> int:
    """Count the stars that some centroid of the frame could agree with."""
    camera, reach_px = observation.camera, REACH * observation.tolerance_px
    size = np.array([camera.width_px, camera.height_px])
    near = np.abs(predicted_px - 0.5 * size) <= 0.5 * size + reach_px
    return int(near.all(axis=1).sum())


def _is_scaled(predicted_px: Array, centroids_px: Array, observation: Observation) -> bool:
    """Return whether the frame is plainly larger or smaller than the stars that it matches.

    Then the camera's focal length is wrong: the attitude may be right, but towards the edge
    stars are taken for their neighbours. Plainly is by more than `SCALE_DEVIATIONS`, and so
    much that the corner of the frame is off by more than the largest error of a centroid.
    """
    camera = observation.camera
    inner = predicted_px - predicted_px.sum(axis=0) / len(predicted_px)
    extent = float(np.vdot(inner, inner))
    offset = centroids_px - predicted_px
    excess = float(np.vdot(inner, offset)) / extent
    corner_px = 0.5 * math.hypot(camera.width_px, camera.height_px)
    if abs(excess) * corner_px <= observation.tolerance_px:
        return False
    left = offset - excess * inner
    left -= left.sum(axis=0) / len(left)
    variance = float(np.vdot(left, left)) / (2 * len(left) - 4) / extent
    return excess * excess > SCALE_DEVIATIONS**2 * variance


def _mutually_nearest(
    predicted_px: Array, observation: Observation
) -> tuple[NDArray[np.int64], Array]:
    """Return each centroid's star and its distance, if neither has a nearer one; -1 for none."""
    count = len(observation)
    if not len(predicted_px):
        return np.full(count, -1), np.full(count, np.inf)
    x, y = observation.centroids_px.T
    dx, dy = x[:, None] - predicted_px[:, 0], y[:, None] - predicted_px[:, 1]
    # Where the lens shows no star at all the distance is NaN, which is no minimum.
    square = np.fmin(dx * dx + dy * dy, np.inf)
    star, rows = square.argmin(axis=1), np.arange(count)
    nearest = square[rows, star]
    reach = (REACH * observation.tolerance_px) ** 2
    mutual = (square.argmin(axis=0)[star] == rows) & (nearest <= reach)
    return np.where(mutual, star, -1), np.sqrt(nearest)
