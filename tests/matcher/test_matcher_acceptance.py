"""What the matcher is accepted for, on the preset sao-12deg.

`TestEveryMethod` has the same rules for few frames of a sky in memory.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from frames import error_arcsec

from starcat.geometry.attitude import matrix_from_quaternion, matrix_from_radec_roll
from starcat.geometry.camera import Camera
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods.table import METHODS
from starcat.matcher.result import MatchResult
from starcat.pipeline.build import build
from starcat.pipeline.simulation.simulate import (
    Noise,
    SimulatedFrame,
    Sky,
    simulate_frame,
    simulate_frames,
)
from starcat.pipeline.specs.reading import preset

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

SEED = 2026
FRAMES = 1000
"""Frames of each kind that are tried."""
CLEAN = Noise(0.5)
HARD = Noise(0.5, drop_probability=0.1, false_stars=3)

RIGHT_PX = 3.0
"""A right attitude puts no point of the frame farther from its place."""

REACH_PX = 3.0
"""A centroid may carry the name of a star this near to it, in the attitude that was found."""

PLEIADES = (56.6, 24.1)
"""Right ascension and declination of a cluster of stars, degrees."""


RATED = [name for name in METHODS if not name.startswith("hausdorff_l")]
"""The planar Hausdorff methods need a star in the middle of the frame, or an upright camera."""

RANDOM_FRAMES = {"triangle": 2500, "pairs": 200, "pyramid": 20, "hausdorff_angular": 300,
                 "hausdorff_l2": 60, "hausdorff_l1": 150, "dynamic_angle": 300, "grid": 400,
                 "radial": 150}  # fmt: skip
"""Frames of random points; of triangles in each of four rounds. Slow methods have few frames."""


@pytest.fixture(scope="module")
def database(made_catalogs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    inputs = {
        "sao": [made_catalogs / "sao.dat.gz"],
        "hipparcos": [made_catalogs / "hip_main.dat.gz"],
    }
    return build(preset("sao-12deg"), tmp_path_factory.mktemp("sky"), inputs=inputs).folder


@pytest.fixture(scope="module")
def matcher(database: Path) -> Matcher:
    return Matcher.open(database)


def frames(matcher: Matcher, count: int, noise: Noise) -> list[SimulatedFrame]:
    database = matcher.database
    u, mag = database.directions, database.mag
    return list(simulate_frames(u, database.camera, count, noise, SEED, mag))


def error_px(found: MatchResult, truth: np.ndarray, camera: Camera) -> float:
    """Return how far an attitude moves any point of a grid over the frame."""
    x, y = np.linspace(0.0, camera.width_px, 5), np.linspace(0.0, camera.height_px, 5)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    turn = matrix_from_quaternion(found.q_body_from_icrs) @ truth.T
    moved = camera.pixels_from_directions(camera.directions_from_pixels(grid) @ turn.T)
    return float(np.hypot(*(moved - grid).T).max())


def is_unsure(found: MatchResult, truth: np.ndarray) -> bool:
    """Return whether an attitude is within 5 stated standard deviations, in a shape of its own."""
    if found.frame_shape is None:
        return False
    error, covariance = error_arcsec(found, truth), np.asarray(found.covariance_arcsec2)
    return bool(error @ np.linalg.solve(covariance, error) < 25.0)


def is_right(found: MatchResult, frame: SimulatedFrame, matcher: Matcher) -> bool:
    """Return whether attitude and names are right.

    A false spot may carry the name of a star if that star's place is there. The few stars of an
    answer with a shape may leave the attitude unsure by more: by what its covariance says.
    """
    camera, u = matcher.database.camera, matcher.database.directions
    other = np.flatnonzero((found.star_index >= 0) & (found.star_index != frame.star_index))
    if (frame.star_index[other] >= 0).any():
        return False
    if error_px(found, frame.matrix, camera) > RIGHT_PX and not is_unsure(found, frame.matrix):
        return False
    place = camera.pixels_from_directions(u[found.star_index[other]] @ frame.matrix.T)
    return bool((np.hypot(*(place - frame.centroids_px[other]).T) <= RIGHT_PX + REACH_PX).all())


def wrong(
    answered: Iterable[tuple[SimulatedFrame, MatchResult]], matcher: Matcher
) -> list[MatchResult]:
    given = ((frame, found) for frame, found in answered if found.status == "identified")
    return [found for frame, found in given if not is_right(found, frame, matcher)]


@pytest.mark.parametrize(
    ("noise", "share"),
    [(Noise(), 0.99), (CLEAN, 0.998), (HARD, 0.990)],
    ids=["exact", "clean", "hard"],
)
def test_triangles_identify_nearly_all_and_nothing_wrongly(matcher, noise, share):
    some = frames(matcher, FRAMES, noise)
    answered = [(frame, matcher.identify(frame.centroids_px)) for frame in some]
    assert not wrong(answered, matcher)
    right = [(frame, found) for frame, found in answered if found.ok]
    assert len(right) >= share * len(answered)
    # Chance gives one of 10,000 frames a shape that it does not have.
    assert sum(found.frame_shape is not None for _, found in right) <= 2
    if noise == Noise():
        # numpy has the stars themselves, C those of an image, rounded to 5e-5 arcsec.
        exact = Matcher(matcher.database, engine="numpy")
        for frame, _ in right:
            found = exact.identify(frame.centroids_px)
            assert np.abs(error_arcsec(found, frame.matrix)).max() < 1e-6


@pytest.mark.parametrize("method", [name for name in METHODS if name != "triangle"])
def test_the_other_methods_identify_most_and_nothing_wrongly(database, method):
    matcher = Matcher.open(database, method)
    some = frames(matcher, FRAMES if method in RATED else 20, CLEAN)
    answered = [(frame, matcher.identify(frame.centroids_px)) for frame in some]
    assert not wrong(answered, matcher)
    if method in RATED:
        assert sum(found.ok for _, found in answered) >= 0.95 * len(answered)


def test_no_answer_is_wrong_where_stars_crowd(database):
    for method in ("triangle", "pairs", "pyramid"):
        matcher = Matcher.open(database, method)
        for noise in (CLEAN, HARD):
            some = around(matcher, *PLEIADES, 1000, noise)
            answered = [(frame, matcher.identify(frame.centroids_px)) for frame in some]
            assert not wrong(answered, matcher), (method, noise)


def around(
    matcher: Matcher, ra_deg: float, dec_deg: float, count: int, noise: Noise
) -> Iterable[SimulatedFrame]:
    """Simulate frames that hold a place of the sky."""
    database, generator = matcher.database, np.random.default_rng(SEED)
    rows = np.arange(len(database.mag), dtype=np.int32)
    sky = Sky(database.directions, database.mag, rows)
    for _ in range(count):
        off_deg, roll_deg = generator.uniform(-5.0, 5.0, 2), generator.uniform(0.0, 360.0)
        matrix = matrix_from_radec_roll(ra_deg + off_deg[0], dec_deg + off_deg[1], roll_deg)
        yield simulate_frame(sky, database.camera, matrix, noise, generator)


@pytest.mark.parametrize("method", METHODS)
def test_mirrored_frames_are_never_identified(database, method):
    matcher = Matcher.open(database, method)
    for frame in frames(matcher, FRAMES if method == "triangle" else 20, CLEAN):
        mirrored_px = frame.centroids_px * [-1.0, 1.0] + [matcher.database.camera.width_px, 0.0]
        assert matcher.identify(mirrored_px).status != "identified"


@pytest.mark.parametrize("factor", [0.99, 1.01])
def test_a_wrong_focal_length_gives_no_wrong_answer(matcher, factor):
    camera = matcher.database.camera
    told = Camera(camera.width_px, camera.height_px, factor * camera.focal_length_px)
    # A hundredth of the half diagonal is where the corner goes.
    corner_px = 0.005 * np.hypot(camera.width_px, camera.height_px)
    some = [*frames(matcher, FRAMES, CLEAN), *around(matcher, *PLEIADES, 200, CLEAN)]
    names = false = 0
    for frame in some:
        found = matcher.identify(frame.centroids_px, told)
        if found.status == "identified":
            assert error_px(found, frame.matrix, camera) <= corner_px + RIGHT_PX
            names += found.n_matched
            false += int(((found.star_index >= 0) & (found.star_index != frame.star_index)).sum())
    # One that 1 % moves by 5 px may be taken for its neighbour, in a rich field.
    assert false <= max(1.0, 0.002 * names)


ROUNDS = [("triangle", turn) for turn in range(4)]
ROUNDS += [(name, 0) for name in METHODS if name != "triangle"]


@pytest.mark.parametrize(("method", "turn"), ROUNDS)
def test_random_points_are_never_identified(database, method, turn):
    matcher = Matcher.open(database, method)
    # Chance would get this far once in 10,000 frames; the limit is 1e-9.
    lenient = matcher.with_settings(max_false_match_probability=1e-4)
    size = [matcher.database.camera.width_px, matcher.database.camera.height_px]
    generator = np.random.default_rng([SEED, turn])
    least = []
    for _ in range(RANDOM_FRAMES[method]):
        points = generator.random((generator.integers(8, 31), 2)) * size
        least.append(lenient.identify(points).false_match_probability)
    assert min(least) > 1e-6
    # Twice in 2,500 frames happens in one of 40 runs, four times in none.
    assert np.sum(np.array(least) <= 1e-4) <= 3
