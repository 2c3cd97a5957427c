"""Parts of the sphere: random directions inside, and none outside."""

from __future__ import annotations

import numpy as np
import pytest

from starcat.errors import BuildError
from starcat.geometry.footprint import Footprint, Ring
from starcat.geometry.sphere import directions_from_radec, separation


@pytest.mark.parametrize("radius_deg", [0.01, 15.0, 180.0])
def test_random_directions_are_uniform_over_a_cap(radius_deg):
    axis = directions_from_radec(83.0, -5.0)
    ring = Ring(axis, float(np.cos(np.radians(radius_deg))), 1.0)
    found = ring.random_directions(4000, np.random.default_rng(1))
    assert np.linalg.norm(found, axis=1) == pytest.approx(1.0)
    apart = separation(found, axis)
    assert apart.max() <= np.radians(radius_deg) * (1.0 + 1e-6)
    # Half of the cap's area is within the angle whose half has a sine smaller by sqrt(2).
    half = 2.0 * np.arcsin(np.sin(0.5 * np.radians(radius_deg)) / np.sqrt(2.0))
    assert np.mean(apart <= half) == pytest.approx(0.5, abs=0.03)
    assert np.linalg.norm(found.mean(axis=0) - axis * (found @ axis).mean()) < 0.05


def test_random_directions_are_inside_and_the_same_for_a_seed():
    ring = Ring(np.array([0.0, 0.0, 1.0]), -0.5, 0.5)
    part = Footprint("the east", lambda u: u[:, 1] > 0.0, ring)
    found = part.random_directions(500, np.random.default_rng(2))
    assert found.shape == (500, 3)
    assert (found[:, 1] > 0.0).all()
    assert (np.abs(found[:, 2]) <= 0.5).all()
    assert (found == part.random_directions(500, np.random.default_rng(2))).all()


def test_a_part_without_directions_is_refused(monkeypatch):
    monkeypatch.setattr("starcat.geometry.footprint._MAX_DRAWS", 10_000)
    ring = Ring(np.array([0.0, 0.0, 1.0]), -1.0, 1.0)
    nothing = Footprint("[selection.region]", lambda u: np.zeros(len(u), dtype=bool), ring)
    with pytest.raises(BuildError, match=r"\[selection.region\] covers about .* larger region"):
        nothing.random_directions(1, np.random.default_rng(3))
