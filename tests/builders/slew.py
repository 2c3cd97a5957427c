"""Frames of a camera that turns, at a rate that changes slowly, and sometimes jumps."""

from __future__ import annotations

import math
from collections.abc import Container, Iterator

import numpy as np

from starcat.geometry.attitude import (
    after_turn,
    matrix_from_quaternion,
    quaternion_from_matrix,
    random_attitudes,
    turn_between,
)
from starcat.matcher.database import MatcherDatabase
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame, Sky, simulate_frame

JUMP_RAD = 0.7
"""Angle of a jump, 40 deg."""

RATES_DEG = (0.1, 2.0)
"""Slowest and fastest turn from a frame to the next."""

SHARE = 0.02
"""Largest change of the rate from a frame to the next, as a share of it."""


def wrong_by(matrix: np.ndarray, angle_rad: float, generator: np.random.Generator) -> np.ndarray:
    """Return an attitude, as a quaternion, that is wrong by an angle about a random axis."""
    x, y, z = generator.normal(size=3)
    scale = angle_rad / math.hypot(x, y, z)
    q = quaternion_from_matrix(matrix).tolist()
    return np.array(after_turn(q, (x * scale, y * scale, z * scale)))


BORESIGHT_DEG, ROLL_DEG = 0.05, 0.5
"""An attitude is right if it is within both."""


def is_near(quaternion: np.ndarray, matrix: np.ndarray) -> bool:
    """Return whether an attitude is as near to the true one as a right answer."""
    truth = quaternion_from_matrix(matrix).tolist()
    x, y, z = np.degrees(turn_between(truth, quaternion.tolist()))
    return bool(np.hypot(x, y) <= BORESIGHT_DEG and abs(z) <= ROLL_DEG)


def steady_turn(
    database: MatcherDatabase, noise: Noise, generator: np.random.Generator, turn_deg: float = 0.8
) -> Iterator[SimulatedFrame]:
    """Yield three frames of a camera that turns at a constant rate, each without other stars."""
    mag = np.asarray(database.mag, dtype=np.float64)
    stars = Sky(database.directions, mag, np.arange(len(mag), dtype=np.int32))
    [matrix] = random_attitudes(1, generator)
    q = quaternion_from_matrix(matrix).tolist()
    turn = generator.normal(size=3)
    turn *= math.radians(turn_deg) / np.linalg.norm(turn)
    for _ in range(3):
        attitude = matrix_from_quaternion(np.array(q))
        yield simulate_frame(stars, database.camera, attitude, noise, generator)
        q = after_turn(q, tuple(turn.tolist()))


def slew(
    database: MatcherDatabase, count: int, noise: Noise, seed: int, jumps: Container[int] = ()
) -> Iterator[SimulatedFrame]:
    """Simulate the frames of a slew.

    The rate goes from its slowest to its fastest and back, and its axis wanders. Before the frames
    of ``jumps`` the camera turns by `JUMP_RAD`.
    """
    generator = np.random.default_rng(seed)
    stars = np.arange(len(database.mag), dtype=np.int32)
    sky = Sky(database.directions, database.mag, stars)
    q, axis, grows = (0.0, 0.0, 0.0, 1.0), np.array([1.0, 0.0, 0.0]), 1.0
    rate_deg = RATES_DEG[0]
    for number in range(count):
        rate_deg *= 1.0 + grows * SHARE * generator.uniform()
        if not RATES_DEG[0] <= rate_deg <= RATES_DEG[1]:
            rate_deg, grows = float(np.clip(rate_deg, *RATES_DEG)), -grows
        axis = axis + 0.01 * generator.normal(size=3)
        axis /= np.linalg.norm(axis)
        x, y, z = (np.radians(rate_deg) * axis).tolist()
        q = after_turn(q, (x, y, z))
        if number in jumps:
            q = after_turn(q, (JUMP_RAD, 0.0, 0.0))
        matrix = matrix_from_quaternion(np.array(q))
        yield simulate_frame(sky, database.camera, matrix, noise, generator)
