"""Frames as the methods of the matcher see them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from starcat.geometry.camera import Camera
from starcat.matcher import observation
from starcat.matcher.c_engine import is_compiled
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.pose import pose_at
from starcat.matcher.result import MatchResult
from starcat.matcher.settings import Budget, Settings, TriangleOrder
from starcat.matcher.verification import Agreement, agree
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame, simulate_frames


def observe(
    centroids_px: ArrayLike,
    camera: Camera,
    tolerance_px: float,
    magnitudes: ArrayLike | None = None,
    *,
    fov_error: float = 0.0,
    budget: Budget | None = None,
    **settings: Any,
) -> observation.Observation:
    """Return what a method sees of a frame."""
    frame = observation.as_frame(centroids_px, camera, magnitudes)
    chosen = Settings(tolerance_px=tolerance_px, **settings)
    return observation.observe(frame, chosen, fov_error=fov_error, budget=budget)


def frames_of(
    database: MatcherDatabase, count: int, noise: Noise | None = None, seed: int = 3
) -> list[SimulatedFrame]:
    """Return frames of the stars of a database, with its camera."""
    u, camera = database.directions, database.camera
    return list(simulate_frames(u, camera, count, noise or Noise(), seed, database.mag))


def with_selection(seen: observation.Observation, **order: Any) -> observation.Observation:
    """Return an observation whose triangles come in another order."""
    chosen = replace(seen.settings, selection=TriangleOrder(**order))
    return replace(seen, settings=chosen)


def assert_same(found: MatchResult, expected: MatchResult, log_error: float = 0.02) -> None:
    """Check that two matchers give the same answer to a frame."""
    assert found.status == expected.status
    assert found.star_index.tolist() == expected.star_index.tolist()
    assert found.star_ids.tolist() == expected.star_ids.tolist()
    assert found.dropped == expected.dropped
    assert found.n_matched == expected.n_matched
    close = {"rtol": 1e-9, "atol": 1e-9, "equal_nan": True}
    np.testing.assert_allclose(found.q_body_from_icrs, expected.q_body_from_icrs, **close)
    # An image has directions that are rounded to 5e-5 arcsec; the bound is a power of residuals.
    np.testing.assert_allclose(found.residual_arcsec, expected.residual_arcsec, atol=1e-4)
    chance = np.log([found.false_match_probability, expected.false_match_probability])
    assert chance[0] == pytest.approx(chance[1], abs=log_error)


needs_c = pytest.mark.skipif(not is_compiled(), reason="starcat was installed without a C compiler")
"""Marks a test of the matcher in C."""

ENGINES = ["numpy", *(["c"] if is_compiled() else [])]

both_engines = pytest.mark.parametrize("engine", ["numpy", pytest.param("c", marks=needs_c)])

few_in_numpy = pytest.mark.parametrize(
    ("engine", "count"),
    [
        ("numpy", 20),
        pytest.param("numpy", 40, marks=pytest.mark.slow),
        pytest.param("c", 40, marks=needs_c),
    ],
)
"""Runs a test of many frames with both engines; numpy has fewer of them in ``make test``."""


def agreement_of(
    matrix: np.ndarray,
    seen: observation.Observation,
    database: MatcherDatabase,
    certain: float = 1.0,
) -> Agreement:
    """Return the agreement of an attitude with the focal length that is given."""
    return agree(pose_at(matrix, 1.0, seen), seen, database, certain)


ARCSEC = 3600.0 * math.degrees(1.0)
"""Arc seconds of a radian."""


def error_arcsec(found: MatchResult, truth: np.ndarray) -> np.ndarray:
    """Return the small angles about x, y and z from the true attitude to the attitude found."""
    turn = found.matrix @ truth.T
    skew = 0.5 * (turn - turn.T)
    return ARCSEC * np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
