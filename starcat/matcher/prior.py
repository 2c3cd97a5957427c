"""A prior attitude: the attitude that is expected before the frame is looked at.

Only the stars near the prediction are compared with the frame. A centroid, the anchor, can be any
star near its predicted place; each of these stars, with another centroid, makes a candidate. The
candidates are verified as those of any other method are.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from starcat.arguments import numbers_of
from starcat.arrays import Array, Directions, Matrix, Rows
from starcat.errors import ConfigError
from starcat.geometry.attitude import matrix_from_quaternion
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import directions_from_radec, separation
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.observation import Candidates, Observation
from starcat.matcher.options import check_prior_has_error, checked_option
from starcat.matcher.pose import Pose
from starcat.matcher.refusal import Refusal
from starcat.matcher.result import MatchResult, no_match
from starcat.matcher.settings import LOOKUP, REACH
from starcat.matcher.shape import is_near_frame
from starcat.matcher.star_cells import stars_in_cap
from starcat.matcher.verification import BestOf, agree, verify_candidates

CLOSE = 8.0
"""Error of a prior up to which each centroid is taken for the star predicted nearest to it, in
units of the largest error of a centroid."""

MAX_ANCHORS = 16
"""Number of centroids that are compared with the stars near their predicted places."""

MAX_STARS = 1500
"""Stars around a prior attitude; with more of them, looking up patterns is quicker."""

WIDEST_RAD = math.acos(0.01)
"""Largest angle from the axis at which stars are predicted on the detector."""


@dataclass(frozen=True)
class Prior:
    """A prior attitude, unit, and its largest error as an angle of rotation."""

    q_body_from_icrs: Array
    error_rad: float

    def largest_turn_rad(self, camera: Camera, tolerance_px: float) -> float:
        """Return the largest angle from the prior to an attitude that is an answer."""
        return self.error_rad + turn_of_noise_rad(camera, tolerance_px)

    def allows(self, matrix: Matrix, camera: Camera, tolerance_px: float) -> bool:
        """Return whether an attitude is within the error of the prior."""
        apart = matrix - matrix_from_quaternion(self.q_body_from_icrs)
        # Attitudes that differ by an angle have the distance sqrt(8) sin(angle / 2).
        most = math.sin(0.5 * self.largest_turn_rad(camera, tolerance_px))
        return float(np.vdot(apart, apart)) <= 8.0 * most * most


@dataclass(frozen=True)
class BoresightPrior:
    """A prior direction of the boresight, unit, and its largest error; the roll is unknown."""

    direction: Array
    error_rad: float

    def checked(self, answer: MatchResult) -> MatchResult:
        """Return an answer, or a candidate, if its boresight is within the error of the prior."""
        why = answer.refusal
        best = answer if why is None else why.candidate
        if best is None or separation(best.matrix[2], self.direction) <= self.error_rad:
            return answer
        if why is not None:
            return replace(answer, refusal=replace(why, candidate=None))
        return _withheld(answer)


def _withheld(answer: MatchResult) -> MatchResult:
    names = ("origin", "time_s", "frame", "database", "noise_px", "n_not_searched")
    facts = {name: getattr(answer, name) for name in names}
    return no_match(len(answer.star_index), answer.dropped, Refusal("prior"), **facts)


class HasQuaternion(Protocol):
    """A scipy ``Rotation``, of which ``apply`` converts ICRS into camera components."""

    def inv(self) -> Any:
        """Return the inverse rotation."""

    def as_quat(self) -> Any:
        """Return the quaternion in the convention of scipy."""


class HasIcrs(Protocol):
    """A ``SkyCoord`` of astropy."""

    @property
    def icrs(self) -> Any:
        """Return the direction in ICRS."""


PriorLike = ArrayLike | HasQuaternion | HasIcrs
"""Types that a caller can give as a prior: an attitude, or the direction of the boresight."""


def prior_of(prior: PriorLike | None, error_deg: float | None) -> Prior | BoresightPrior | None:
    """Return a prior from the caller's arguments."""
    check_prior_has_error("prior", prior, error_deg)
    if prior is None or error_deg is None:
        return None
    expected: Any = prior
    if hasattr(expected, "icrs"):
        direction = _direction_of(expected.icrs)
        error_deg = checked_option("prior_error_deg", error_deg)
        return BoresightPrior(direction, math.radians(error_deg))
    if hasattr(expected, "as_quat"):
        expected = expected.inv().as_quat()
    q = numbers_of("prior", expected, "(4,)")
    parts = q.tolist() if q.shape == (4,) else [math.nan]
    largest = max(map(abs, parts))
    if not (all(map(math.isfinite, parts)) and largest > 0.0):
        text = "expected a quaternion, four finite numbers, not all 0"
        raise ConfigError(text, parameter="prior", value=q.tolist())
    error_deg = checked_option("prior_error_deg", error_deg)
    # The length carries no meaning, and the length of four times 1e308 would overflow.
    scaled = [math.ldexp(part, -math.frexp(largest)[1]) for part in parts]
    length = math.hypot(*scaled)
    return Prior(np.array([part / length for part in scaled]), math.radians(error_deg))


def _direction_of(coordinate: Any) -> Array:
    ra, dec = (np.asarray(angle.deg, dtype=np.float64) for angle in (coordinate.ra, coordinate.dec))
    if ra.shape or not (np.isfinite(ra) and np.isfinite(dec)):
        raise ConfigError(
            f"a SkyCoord of shape {ra.shape}; expected one finite direction", parameter="prior"
        )
    return directions_from_radec(ra, dec)


def search_near(
    prior: Prior,
    observation: Observation,
    database: MatcherDatabase,
    best: BestOf,
    whole_sky: Iterator[Candidates],
) -> None:
    """Work out the agreements near a prior attitude until one is certain."""
    matrix = matrix_from_quaternion(prior.q_body_from_icrs)
    camera = observation.camera
    error_px = prior.error_rad * camera.focal_length_px
    if error_px <= CLOSE * observation.tolerance_px and not observation.fov_error:
        wide = 1.0 + error_px / (REACH * observation.tolerance_px)
        pose = Pose(matrix, camera, observation.body, observation.centroids_px)
        best.offer(agree(pose, observation, database, best.certain, (wide,)))
        if best.is_certain:
            return
    reach_rad = prior.error_rad + REACH * observation.tolerance_rad
    # A wrong focal length moves directions along their distance from the axis.
    reach_rad += observation.fov_error / (1.0 - observation.fov_error) * camera.radius_rad
    radius_rad = camera.radius_rad + prior.error_rad
    near = stars_in_cap(database, matrix[2], min(math.pi, radius_rad))
    if observation.fov_error or len(near) > MAX_STARS or radius_rad > WIDEST_RAD:
        batches = _as_predicted(whole_sky, database, observation.body @ matrix, reach_rad)
    else:
        batches = anchored_pairs(observation, database, near, matrix, prior.error_rad)
    for candidates in batches:
        verify_candidates(candidates, observation, database, best, in_order=False)
        if best.is_certain:
            return


def _as_predicted(
    whole_sky: Iterator[Candidates],
    database: MatcherDatabase,
    predicted: Directions,
    reach_rad: float,
) -> Iterator[Candidates]:
    """Yield the candidates with all stars up to ``reach_rad`` from their predicted directions."""
    least = math.cos(min(math.pi, reach_rad))
    for candidates in whole_sky:
        stars = database.directions[candidates.stars]
        along = np.einsum("kni,kni->kn", predicted[candidates.centroids], stars)
        yield candidates[(along >= least).all(axis=1)]


def anchored_pairs(
    observation: Observation,
    database: MatcherDatabase,
    near: Rows,
    matrix: Matrix,
    error_rad: float,
) -> Iterator[Candidates]:
    """Propose the stars of two centroids, as the C library does, one batch for each two centroids.

    The anchor can be any star near its predicted place, the nearest first. The star of the other
    centroid is the one nearest to the place that the anchor then implies, among stars at the
    observed distance from the star of the anchor. The other centroid is the one farthest from the
    anchor, which determines the attitude best; as that can be a false spot, the next centroid in
    order is used too.
    """
    camera, px, count = observation.camera, observation.centroids_px, len(observation)
    reach_px = REACH * observation.tolerance_px
    # An angle moves the image of a direction far off the axis by more than of one on the axis.
    turn = error_rad / math.cos(camera.radius_rad + error_rad) ** 2
    shift_px = turn * camera.focal_length_px + reach_px
    star_px = camera.pixels_from_directions(database.directions[near] @ matrix.T)
    within = is_near_frame(star_px, camera, shift_px)
    near, star_px = near[within], star_px[within]
    stars = database.directions[near]
    compatible = observation.compatible(database.mag[near])
    if compatible is None:
        compatible = np.ones((count, len(near)), dtype=bool)
    for anchor in range(min(count, MAX_ANCHORS)):
        square = _squares(star_px - px[anchor])
        first = np.flatnonzero((square <= shift_px * shift_px) & compatible[anchor])
        first = first[np.argsort(square[first], kind="stable")]
        apart_px = _squares(px - px[anchor])
        for other in dict.fromkeys((int(apart_px.argmax()), (anchor + 1) % count)):
            observation.budget.spend(LOOKUP)
            if not len(first):
                continue
            place_px = star_px[first] + (px[other] - px[anchor])
            # A wrong attitude turns the two against each other by no more than their distance.
            slack_px = 2.0 * (reach_px + turn * math.sqrt(float(apart_px[other])))
            square = _squares(place_px[:, None] - star_px)
            chord = np.sqrt(_squares(stars[first][:, None] - stars))
            error = 2.0 * np.arcsin(0.5 * chord) - observation.separation_rad[anchor, other]
            fits = (np.abs(error) <= observation.side_tolerance_rad) & compatible[other]
            np.copyto(square, math.inf, where=~(fits & (square <= slack_px * slack_px)))
            second = square.argmin(axis=1)
            rows = np.flatnonzero(np.isfinite(square[np.arange(len(first)), second]))
            if len(rows):
                pairs = near[np.column_stack([first[rows], second[rows]])]
                yield Candidates(np.full(pairs.shape, [anchor, other]), pairs)


def _squares(offset: Array) -> Array:
    """Return the squared lengths of vectors in the last axis."""
    return np.asarray(np.einsum("...i,...i->...", offset, offset))


def turn_of_noise_rad(camera: Camera, tolerance_px: float) -> float:
    """Return the largest angle by which the errors of centroids turn a frame."""
    return 2.0 * tolerance_px / min(camera.width_px, camera.height_px)
