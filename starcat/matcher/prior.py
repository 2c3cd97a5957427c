"""A prior attitude: what is known of an attitude before the frame is looked at.

Only the stars near the prediction are compared with the frame. The verification of what they
propose is that of any other method.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from starcat.arrays import Array
from starcat.errors import ConfigError
from starcat.geometry.attitude import matrix_from_quaternion, turn_between
from starcat.geometry.camera import Camera
from starcat.matcher.around import stars_around
from starcat.matcher.database import Database
from starcat.matcher.methods import nearby
from starcat.matcher.methods.candidates import Candidates
from starcat.matcher.observation import Observation
from starcat.matcher.pose import Pose
from starcat.matcher.refusal import Refusal
from starcat.matcher.result import MatchResult, withheld
from starcat.matcher.verification import REACH, BestOf, agree, verify

WIDEST_PRIOR_DEG = 20.0
"""Largest error of a prior attitude."""

CLOSE = 8.0
"""Error of a prior up to which each centroid is taken for the star predicted nearest to it, in
units of the largest error of a centroid."""


@dataclass(frozen=True)
class Prior:
    """A prior attitude.

    Attributes
    ----------
    q_body_from_icrs : ndarray of float64, shape (4,)
        Attitude, unit, scalar last.
    error_rad : float
        Largest error, as an angle of rotation.
    """

    q_body_from_icrs: Array
    error_rad: float


def prior_of(quaternion: ArrayLike | None, error_deg: float | None) -> Prior | None:
    """Return a prior attitude from what a caller states."""
    if quaternion is None and error_deg is None:
        return None
    if quaternion is None or error_deg is None:
        missing = "prior" if quaternion is None else "prior_error_deg"
        raise ConfigError(
            f"{missing} is missing; give prior and prior_error_deg, or neither", key=missing
        )
    q = np.asarray(quaternion, dtype=np.float64)
    square = float(q @ q) if q.shape == (4,) else math.nan
    if not 0.0 < square < math.inf:
        text = f"prior is {q.tolist()}; expected a quaternion, four finite numbers, not all 0"
        raise ConfigError(text, key="prior", value=quaternion)
    if not 0.0 < error_deg <= WIDEST_PRIOR_DEG:
        raise ConfigError(
            f"prior_error_deg is {error_deg}; expected above 0, at most {WIDEST_PRIOR_DEG:g}",
            key="prior_error_deg",
            value=error_deg,
        )
    return Prior(q / math.sqrt(square), math.radians(error_deg))


def search_near(
    prior: Prior,
    observation: Observation,
    database: Database,
    best: BestOf,
    whole_sky: Iterator[Candidates],
) -> None:
    """Work out the agreements near a prior attitude until one is certain."""
    matrix = matrix_from_quaternion(prior.q_body_from_icrs)
    camera, tolerance_rad = observation.camera, observation.tolerance_rad
    # A tracked camera is near its last place, where the stars are at hand.
    sky = stars_around(database)
    sky.keep(matrix[2], camera.radius_rad)
    error_px = prior.error_rad * camera.focal_length_px
    if error_px <= CLOSE * observation.tolerance_px and not observation.fov_error:
        wide = 1.0 + error_px / (REACH * observation.tolerance_px)
        pose = Pose(matrix, camera, observation.body)
        best.found = agree(pose, observation, database, best.certain, (wide,))
        if best.is_certain:
            return
    reach_rad = prior.error_rad + REACH * tolerance_rad
    # A wrong focal length moves directions along their distance from the axis.
    reach_rad += observation.fov_error / (1.0 - observation.fov_error) * camera.radius_rad
    near, _ = sky.near(matrix[2], min(math.pi, camera.radius_rad + reach_rad))
    predicted = observation.body @ matrix
    if observation.fov_error or len(near) > nearby.MOST_STARS:
        found = whole_sky
    else:
        found = nearby.candidates(observation, database, predicted, near, reach_rad)
    for candidates in found:
        stars = database.directions[candidates.stars]
        along = np.einsum("kni,kni->kn", predicted[candidates.centroids], stars)
        is_near = (along >= math.cos(min(math.pi, reach_rad))).all(axis=1)
        verify(candidates[is_near], observation, database, best)
        if best.is_certain:
            return


def expected_near(
    prior: Prior, answer: MatchResult, camera: Camera, tolerance_px: float
) -> MatchResult:
    """Return an answer if its attitude is as near to the prior as that says."""
    if answer.ok:
        prior_q, found_q = prior.q_body_from_icrs.tolist(), answer.q_body_from_icrs.tolist()
        slack_rad = turn_of_noise_rad(camera, tolerance_px)
        if math.hypot(*turn_between(prior_q, found_q)) > prior.error_rad + slack_rad:
            return withheld(answer, Refusal("prior"))
    return answer


def turn_of_noise_rad(camera: Camera, tolerance_px: float) -> float:
    """Return the angle that the errors of centroids may turn a frame by."""
    return 2.0 * tolerance_px / min(camera.width_px, camera.height_px)
