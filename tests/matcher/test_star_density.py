"""Frames in whose field the database has too few stars: the refusal says so."""

import numpy as np
import pytest

from starcat.geometry.camera import Camera
from starcat.matcher.c_engine import is_compiled
from starcat.matcher.matcher import Matcher
from starcat.matcher.star_density import mean_stars

ENGINES = ["numpy", pytest.param("c", marks=pytest.mark.skipif(not is_compiled(), reason="no C"))]
NARROW = Camera(1024, 1024, fov_x_deg=2.0)


@pytest.fixture(scope="module")
def sky(sky_of, random_directions):
    return sky_of(random_directions(1500, 3))


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("options", [{}, {"max_steps": 50}])
def test_a_narrow_frame_is_told_that_the_database_has_too_few_stars(sky, engine, options):
    if engine == "c" and options:
        pytest.skip("a limit of steps is numpy's")
    px = np.random.default_rng(1).random((30, 2)) * 1024.0
    why = Matcher(sky, engine=engine, **options).identify(px, NARROW).refusal
    assert why.reason == "few_guide_stars"
    assert why.mean_stars == pytest.approx(1500 * 4.0 / 41_253, abs=0.1)
    assert "2 deg hold 0.1 stars of it on average, and 4 are needed" in why.message
    assert "a catalog with fainter stars" in why.hint
    assert "max_steps" not in why.hint
    assert "{fov_deg}" in why.advice[-1]


@pytest.mark.parametrize("engine", ENGINES)
def test_other_refusals_stay(sky, engine):
    px = np.random.default_rng(1).random((30, 2)) * 1024.0
    matcher = Matcher(sky, engine=engine)
    assert matcher.identify(px).refusal.reason != "few_guide_stars"
    assert matcher.identify(px[:3], NARROW).refusal.reason == "too_few_stars"
    prior = {"prior": [0.0, 0.0, 0.0, 1.0], "prior_error_deg": 1.0}
    assert matcher.identify(px, NARROW, **prior).refusal.reason == "prior"


def test_stars_are_counted_where_the_database_has_some(sky_of, random_directions):
    u = random_directions(60_000, 5)
    part = u[u[:, 2] > 0.9]  # a cap of 3,000 stars: 1.45 per square degree
    assert mean_stars(sky_of(part, NARROW), NARROW) == pytest.approx(5.8, abs=0.6)
