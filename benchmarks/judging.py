"""Whether an answer is right, and all agreements that a search comes to.

An answer is wrong if it puts a star anywhere in the frame farther from its place than the
tolerance, and than five times the error that the true noise of the matched spots makes there (and
than half of the jump, where the sky moved between two exposures); or if more than one and more than
5 % of the named spots are farther from where the true attitude puts their star than the matcher's
reach and that error. In a frame without a true sky every answer is wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from false_frames import Array, Scene, Trial
from numpy.typing import NDArray

from starcat.geometry.camera import Camera
from starcat.matcher.matcher import Matcher
from starcat.matcher.numpy_engine import result_of_search, search_sky
from starcat.matcher.observation import as_frame, observe
from starcat.matcher.result import MatchResult
from starcat.matcher.settings import REACH, Budget, BudgetSpentError, Limit, certainty
from starcat.matcher.shape import (
    NO_SHAPE,
    Shape,
    derivatives,
    of_scale,
    shape_covariance,
    undone_px,
)
from starcat.matcher.verification import Agreement, BestOf

Rows = NDArray[np.integer]
Verdict = Literal["right", "no sky", "attitude", "names"]

DEVIATIONS = 5.0
"""Errors of an attitude that noise is allowed to make, in standard deviations."""

MIN_NOISE_PX = 0.01
"""Noise that an attitude is allowed at least: of rounding, and of a lens drawn by a formula."""

WRONG_NAMES = 0.05
"""Share of the named spots that may have another name."""

NOTABLE = 0.1
"""Agreements with a smaller probability of chance than this are recorded."""


def judge(
    trial: Trial, scene: Scene, matrix: Array, fitted: Camera | None, rows: Rows, stars: Rows,
    tolerance_px: float, shape: Shape = NO_SHAPE,
) -> Verdict:  # fmt: skip
    """Return whether an attitude and the stars of some spots are right, or what is wrong.

    If neither a focal length nor a shape was ``fitted``, only the attitude is judged.
    """
    true_camera = trial.camera or scene.camera
    camera, shown = (scene.camera, scene.camera) if fitted is None else (fitted, true_camera)
    error_px = DEVIATIONS * attitude_error_px(
        trial.centroids_px[rows], camera, max(trial.noise_px, MIN_NOISE_PX), shape
    )
    verdict: Verdict = "attitude" if trial.attitudes else "no sky"
    for truth in trial.attitudes:
        off_px = distance_px(matrix, camera, truth, shown, shape) - 0.5 * trial.jump_px
        if off_px > max(tolerance_px, error_px):
            continue
        place = true_camera.pixels_from_directions(scene.database.directions[stars] @ truth.T)
        apart_px = np.hypot(*(place - trial.centroids_px[rows]).T)
        wrong = int(np.sum(~(apart_px <= REACH * tolerance_px + error_px)))
        if wrong <= max(1.0, WRONG_NAMES * len(rows)):
            return "right"
        verdict = "names"
    return verdict


def _lattice(camera: Camera) -> Array:
    x, y = (np.linspace(0.0, side, 5) for side in (camera.width_px, camera.height_px))
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


def distance_px(
    matrix: Array, camera: Camera, truth: Array, true_camera: Camera, shape: Shape = NO_SHAPE
) -> float:
    """Return the largest distance in the frame between where two attitudes put a star."""
    px = _lattice(camera)
    there = camera.directions_from_pixels(undone_px(px, shape.terms, camera)) @ matrix @ truth.T
    if (there[:, 2] <= 0.0).any():
        return math.inf
    return float(np.hypot(*(true_camera.pixels_from_directions(there) - px).T).max())


def attitude_error_px(px: Array, camera: Camera, noise_px: float, shape: Shape = NO_SHAPE) -> float:
    """Return the standard deviation of a star's place by the noise of matched spots, at most."""
    places = _lattice(camera)
    if shape.free:
        of_fit = shape_covariance(px, np.full(len(px), noise_px), camera, shape)
        body = camera.directions_from_pixels(undone_px(places, shape.terms, camera))
        moved = derivatives(places, body, camera, shape.free)
        of_place = np.einsum("nij,jk,nik->n", moved, of_fit, moved)
        return math.sqrt(float(of_place.max())) if np.isfinite(of_place).all() else math.inf
    u, v = (camera.directions_from_pixels(one) for one in (px, places))
    information = len(u) * np.eye(3) - u.T @ u
    if np.linalg.cond(information) > 1e12:
        return math.inf
    covariance = np.linalg.inv(information)
    square = np.trace(covariance) - np.einsum("ni,ij,nj->n", v, covariance, v)
    return noise_px * math.sqrt(float(square.max()))


def judge_answer(
    answer: MatchResult, trial: Trial, scene: Scene, tolerance_px: float
) -> Verdict | None:
    """Return whether an answer is right; None if there is no answer."""
    if not answer.ok:
        return None
    rows = np.flatnonzero(answer.star_index >= 0)
    fitted = answer.camera if answer.focal_length_error_px is not None else None
    stars, shape = answer.star_index[rows], answer.shape or NO_SHAPE
    return judge(trial, scene, answer.matrix, fitted, rows, stars, tolerance_px, shape)


@dataclass
class AllOf(BestOf):
    """The agreements of a search that chance hardly explains, and the best one."""

    notable: list[Agreement] = field(default_factory=list)
    is_endless: bool = False  # the search goes on when an agreement is certain

    @property
    def is_certain(self) -> bool:
        """Whether the search is over."""
        return not self.is_endless and super().is_certain

    @property
    def is_likely(self) -> bool:
        """Whether the attitude is known."""
        return not self.is_endless and super().is_likely

    def offer(self, agreement: Agreement) -> None:
        """Keep an agreement."""
        if agreement.chance < NOTABLE:
            self.notable.append(agreement)
        super().offer(agreement)


@dataclass(frozen=True)
class Notable:
    """An agreement that chance hardly explains."""

    verdict: Verdict
    log10_chance: float
    share: float | None  # explained share of the frame, if known
    n_matched: int
    n_spots: int
    withheld: str | None  # why it is no answer


def search(
    trial: Trial, scene: Scene, matcher: Matcher, fov_error: float, steps: float, *,
    is_endless: bool,
) -> tuple[MatchResult, list[Notable]]:  # fmt: skip
    """Search a frame with numpy; return the answer and the best agreement of each verdict."""
    frame = as_frame(trial.centroids_px, scene.camera, trial.mag)
    settings = matcher.settings
    seen = observe(frame, settings, fov_error=fov_error, budget=Budget(steps))
    best = AllOf(certainty(settings), is_endless=is_endless)
    limit: Limit | None = None
    try:
        search_sky(seen, scene.database, best)
    except BudgetSpentError as spent:
        limit = spent.limit
    found: dict[Verdict, Notable] = {}
    for one in sorted(best.notable, key=lambda agreement: agreement.chance):
        stars = one.star_index[one.matched]
        shape, camera = of_scale(one.pose.shape, one.pose.camera)
        fitted = camera if fov_error or shape.free else None
        verdict = judge(
            trial, scene, one.pose.matrix, fitted, seen.rows[one.matched], stars,
            settings.tolerance_px, shape,
        )  # fmt: skip
        log10 = math.log10(max(one.chance, 1e-300))
        found.setdefault(
            verdict, Notable(verdict, log10, one.share, len(stars), len(seen), one.withheld)
        )
    return result_of_search(best.agreement, seen, matcher.database, limit), list(found.values())
