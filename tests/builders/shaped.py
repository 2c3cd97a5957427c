"""Frames of another shape than the camera's, and frames of a camera that turns during readout."""

from __future__ import annotations

import numpy as np

from starcat.geometry.attitude import after_turn, matrix_from_quaternion, quaternion_from_matrix
from starcat.geometry.camera import Camera
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.shape import N_TERMS, undone_px
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame, Sky, simulate_frame

ROUNDS = 12
"""Rounds of an iteration, each of which lowers the error to a tenth."""


def sky_of_stars(database: MatcherDatabase) -> Sky:
    """Return the stars of a database as a sky to simulate frames of."""
    stars = np.arange(len(database.mag), dtype=np.int32)
    return Sky(database.directions, database.mag, stars)


def terms_of(**terms: float) -> np.ndarray:
    """Return the terms of a shape by their names."""
    names = ("scale", "radial", "stretch", "shear", "tilt_x", "tilt_y")
    assert len(names) == N_TERMS
    return np.array([terms.pop(name, 0.0) for name in names])


def shaped_px(px: np.ndarray, terms: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the centroids whose places are ``px`` after their shape is undone."""
    found = px
    for _ in range(ROUNDS):
        found = found + px - undone_px(found, terms, camera)
    return found


def turned_by(matrix: np.ndarray, turn_rad: np.ndarray) -> np.ndarray:
    """Return an attitude after a small turn about the axes of the camera."""
    x, y, z = turn_rad.tolist()
    return matrix_from_quaternion(np.array(after_turn(quaternion_from_matrix(matrix), (x, y, z))))


def slewed_frame(
    sky: Sky,
    camera: Camera,
    matrix: np.ndarray,
    rate_rad_s: np.ndarray,
    noise: Noise,
    generator: np.random.Generator,
) -> SimulatedFrame:
    """Simulate a frame whose rows are exposed one after the other while the camera turns.

    ``matrix`` is the attitude at the time of the middle row. Stars are simulated without a shape,
    and moved to where they are when their row is exposed.
    """
    assert camera.readout_s is not None
    frame = simulate_frame(sky, camera, matrix, noise, generator)
    icrs = camera.directions_from_pixels(frame.centroids_px) @ matrix
    px = frame.centroids_px
    for _ in range(ROUNDS):
        time_s = camera.readout_s * (px[:, 1] / camera.height_px - 0.5)
        body = [turned_by(matrix, rate_rad_s * t) @ u for t, u in zip(time_s, icrs, strict=True)]
        px = camera.pixels_from_directions(np.array(body))
    inside = camera.contains(px)
    return SimulatedFrame(
        matrix, px[inside], frame.star_index[inside], frame.mag[inside], frame.is_false[inside]
    )
