"""Stars around a boresight: what is kept at hand changes no answer."""

from __future__ import annotations

import math

import numpy as np
import pytest

from starcat.geometry.camera import Camera
from starcat.matcher.around import MANY_STARS, MARGIN, stars_around
from starcat.matcher.database import Database


@pytest.mark.parametrize("count", [0, 1, 3_000, MANY_STARS])
@pytest.mark.parametrize("radius_rad", [0.02, 0.3, 1.5])
def test_kept_stars_are_those_of_the_whole_sky(random_directions, count, radius_rad):
    u = random_directions(count, 3) if count else np.empty((0, 3))
    number, name = np.arange(count), np.full(count, b"")
    camera = Camera(100, 100, 100.0)
    database = Database("a", camera, 2026.0, number, u, np.zeros(count), name)
    around = stars_around(database)
    assert around is stars_around(database)
    generator = np.random.default_rng(4)
    boresight = np.array([0.0, 0.0, 1.0])  # begins at a pole
    for step in range(60):
        if step % 3 == 0:
            around.keep(boresight, radius_rad)
        for asked_rad in (radius_rad, 0.5 * radius_rad, 1.1 * radius_rad):
            rows, directions = around.near(boresight, asked_rad)
            inside = np.flatnonzero(u @ boresight >= math.cos(asked_rad))
            assert rows.tolist() == inside.tolist()
            assert np.array_equal(directions, u[inside])
        # To the end of the margin and beyond it.
        boresight = boresight + 0.6 * MARGIN * radius_rad * generator.normal(size=3)
        boresight /= np.linalg.norm(boresight)
