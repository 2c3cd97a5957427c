"""Frames as the methods of the matcher see them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from numpy.typing import ArrayLike

from starcat.geometry.camera import Camera
from starcat.matcher import observation
from starcat.matcher.database import Database
from starcat.matcher.settings import Budget, Settings, TriangleOrder
from starcat.simulation.simulate import Noise, SimulatedFrame, simulate_frames


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
    database: Database, count: int, noise: Noise | None = None, seed: int = 3
) -> list[SimulatedFrame]:
    """Return frames of the stars of a database, with its camera."""
    u, camera = database.directions, database.camera
    return list(simulate_frames(u, camera, count, noise or Noise(), seed, database.mag))


def with_selection(seen: observation.Observation, **order: Any) -> observation.Observation:
    """Return an observation whose triangles come in another order."""
    chosen = replace(seen.settings, selection=TriangleOrder(**order))
    return replace(seen, settings=chosen)
