"""Frames made to mislead a matcher, with the truth about each.

Kinds of `NO_SKY` have no right answer: false spots at random, in clusters, on grids, along
streaks, hundreds of them; mirror images; stars that the database does not have. Kinds of
`WITH_SKY` have true stars and something that misleads: another focal length, every star twice,
a second pointing, hot pixels, a streak, a cluster, many false spots, stars that have moved.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "builders"))

from hostile_frames import clusters, grid, lines

from starcat.geometry.attitude import random_attitudes
from starcat.geometry.camera import Camera
from starcat.matcher.database import MatcherDatabase
from starcat.pipeline.simulation.simulate import Noise, Sky, simulate_frame

Array = NDArray[np.float64]
Generator = np.random.Generator


@dataclass(frozen=True)
class Scene:
    """The stars and noise of frames."""

    database: MatcherDatabase
    deeper: MatcherDatabase  # has fainter stars than ``database``
    noise_px: float  # true noise of a star, each axis

    @property
    def camera(self) -> Camera:
        """The camera of the database, which the matcher gets."""
        return self.database.camera

    @property
    def size_px(self) -> Array:
        """Width and height."""
        return np.array([self.camera.width_px, self.camera.height_px], dtype=np.float64)


@dataclass(frozen=True)
class Trial:
    """A frame and the truth about it."""

    centroids_px: Array
    mag: Array | None
    attitudes: tuple[Array, ...] = ()  # all right attitudes; empty if no answer is right
    camera: Camera | None = None  # the true camera, if it is not the matcher's camera
    noise_px: float = 0.0  # true noise of the stars
    jump_px: float = 0.0  # motion of the sky while the frame was taken


Make = Callable[[Generator, Scene], Trial]


def _sky(database: MatcherDatabase, brightest: float = -99.0) -> Sky:
    rows = np.flatnonzero(database.mag > brightest)
    mag = database.mag[rows].astype(np.float64)
    return Sky(database.directions[rows], mag, rows.astype(np.int32))


def _stars(
    generator: Generator, scene: Scene, *, camera: Camera | None = None, sky: Sky | None = None,
    attitude: Array | None = None, dropped: float = 0.1, false_stars: int = 0,
) -> Trial:  # fmt: skip
    """Return stars at a random attitude; nine of ten are seen."""
    matrix = random_attitudes(1, generator)[0] if attitude is None else attitude
    noise = Noise(scene.noise_px, dropped, false_stars, noise_mag=0.3)
    frame = simulate_frame(
        sky or scene.database.cached(_sky), camera or scene.camera, matrix, noise, generator
    )
    return Trial(frame.centroids_px, frame.mag, (matrix,), camera, scene.noise_px)


def _with_spots(trial: Trial, px: Array, generator: Generator) -> Trial:
    """Return a trial with more spots, as bright as its stars."""
    mag = trial.mag
    if mag is not None:
        more = generator.choice(mag, len(px)) if len(mag) else np.zeros(len(px))
        mag = np.concatenate([mag, more])
    return replace(trial, centroids_px=np.concatenate([trial.centroids_px, px]), mag=mag)


def _only(trial: Trial, rows: NDArray[np.bool_]) -> Trial:
    mag = None if trial.mag is None else trial.mag[rows]
    return replace(trial, centroids_px=trial.centroids_px[rows], mag=mag)


def _random_px(generator: Generator, scene: Scene, least: int, most: int) -> Array:
    return np.asarray(generator.random((int(generator.integers(least, most)), 2)) * scene.size_px)


def _bare(px: Array, generator: Generator, scene: Scene) -> Trial:
    """Return false spots, half of the time with magnitudes of stars."""
    mag = generator.choice(scene.database.mag, len(px)).astype(np.float64)
    return Trial(px, mag if generator.random() < 0.5 else None)


# --- No true sky


def random(generator: Generator, scene: Scene) -> Trial:
    """Return false spots all over the frame."""
    return _bare(_random_px(generator, scene, 4, 61), generator, scene)


def dense(generator: Generator, scene: Scene) -> Trial:
    """Return hundreds of false spots all over the frame."""
    return _bare(_random_px(generator, scene, 150, 401), generator, scene)


def clustered(generator: Generator, scene: Scene) -> Trial:
    """Return one to three clusters of false spots."""
    return _bare(clusters(generator, scene.database)[0], generator, scene)


def on_a_grid(generator: Generator, scene: Scene) -> Trial:
    """Return a square grid, turned and shifted."""
    return _bare(grid(generator, scene.database)[0], generator, scene)


def on_streaks(generator: Generator, scene: Scene) -> Trial:
    """Return spots along one to three straight lines."""
    return _bare(lines(generator, scene.database)[0], generator, scene)


def hot_pixels(generator: Generator, scene: Scene) -> Trial:
    """Return spots on the centres of whole pixels, a few columns and rows of them."""
    step = int(generator.choice([32, 64, 128]))
    cells = generator.integers(0, 1024 // step, (int(generator.integers(10, 60)), 2))
    return _bare(cells * float(step) + 0.5, generator, scene)


def mirrored(generator: Generator, scene: Scene) -> Trial:
    """Return the mirror image of a true frame."""
    trial = _stars(generator, scene, false_stars=3)
    px = trial.centroids_px * [-1.0, 1.0] + [scene.camera.width_px, 0.0]
    return Trial(px, trial.mag)


def not_in_the_database(generator: Generator, scene: Scene) -> Trial:
    """Return stars that are all fainter than the stars of the database."""
    faintest = float(scene.database.mag.max())
    trial = _stars(generator, scene, sky=scene.deeper.cached(_sky, faintest), dropped=0.5)
    return Trial(trial.centroids_px, trial.mag)


# --- True stars, and what misleads


def scaled(generator: Generator, scene: Scene) -> Trial:
    """Return a frame whose focal length is 1 to 2 % longer or shorter than stated."""
    error = generator.uniform(0.01, 0.02) * generator.choice([-1.0, 1.0])
    camera = scene.camera
    true = replace(camera, focal_length_px=camera.focal_length_px * (1.0 + error))
    return _stars(generator, scene, camera=true, false_stars=3)


def doubled(generator: Generator, scene: Scene) -> Trial:
    """Return a frame with a second spot beside many of the stars, each in another direction."""
    trial = _stars(generator, scene)
    twice = trial.centroids_px[
        generator.random(len(trial.centroids_px)) < generator.uniform(0.3, 1)
    ]
    beside_px = generator.uniform(1.0, 10.0)
    return _with_spots(trial, twice + beside_px * generator.normal(size=twice.shape), generator)


def overlaid(generator: Generator, scene: Scene) -> Trial:
    """Return two pointings in one frame, both right."""
    one, other = _stars(generator, scene), _stars(generator, scene)
    both = _with_spots(one, other.centroids_px, generator)
    return replace(both, attitudes=(*one.attitudes, *other.attitudes))


def jumped(generator: Generator, scene: Scene) -> Trial:
    """Return two pointings a few pixels apart; all attitudes from one to the other are right.

    There is not a single truth: an attitude with some stars of both pointings can be off from
    the attitudes between them by half of their distance.
    """
    one = _stars(generator, scene)
    turn = generator.normal(scale=3.0 / scene.camera.focal_length_px, size=3)
    way = Rotation.from_rotvec(np.linspace(0.0, 1.0, 9)[:, None] * turn).as_matrix()
    way = way @ one.attitudes[0]
    other = _stars(generator, scene, attitude=way[-1])
    jump_px = float(np.linalg.norm(turn)) * scene.camera.focal_length_px
    both = _with_spots(one, other.centroids_px, generator)
    return replace(both, attitudes=tuple(way), jump_px=jump_px)


def among_hot_pixels(generator: Generator, scene: Scene) -> Trial:
    """Return a true frame with hot pixels."""
    trial = _stars(generator, scene)
    return _with_spots(trial, hot_pixels(generator, scene).centroids_px, generator)


def among_streaks(generator: Generator, scene: Scene) -> Trial:
    """Return a true frame with one to three streaks."""
    trial = _stars(generator, scene)
    return _with_spots(trial, lines(generator, scene.database)[0], generator)


def part_of_the_frame(generator: Generator, scene: Scene) -> Trial:
    """Return the stars of a part of the frame, and false spots all over it."""
    trial = _stars(generator, scene, dropped=0.0)
    middle, reach_px = generator.random(2) * scene.size_px, generator.uniform(80.0, 350.0)
    near = np.hypot(*(trial.centroids_px - middle).T) <= reach_px
    return _with_spots(_only(trial, near), _random_px(generator, scene, 5, 61), generator)


def at_a_cluster(generator: Generator, scene: Scene) -> Trial:
    """Return a frame with a cluster such as the Pleiades, and many other stars missing."""
    u, camera = scene.database.directions, scene.camera
    crowd = scene.database.cached(_neighbours).astype(np.float64) ** 3
    star = u[generator.choice(len(u), p=crowd / crowd.sum())]
    place = camera.directions_from_pixels(generator.random((1, 2)) * scene.size_px)[0]
    attitude, _ = Rotation.align_vectors(place, star)
    roll = Rotation.from_rotvec(generator.uniform(0.0, 2.0 * np.pi) * place)
    trial = _stars(generator, scene, attitude=(roll * attitude).as_matrix(), dropped=0.0)
    near = np.hypot(*(trial.centroids_px - camera.pixels_from_directions(place[None])).T) < 150.0
    kept = near | (generator.random(len(near)) < generator.uniform(0.0, 1.0))
    return _with_spots(_only(trial, kept), _random_px(generator, scene, 0, 40), generator)


def _neighbours(database: MatcherDatabase) -> NDArray[np.int64]:
    """Return how many stars are within half a degree of each."""
    tree = KDTree(database.directions)
    return np.asarray(tree.query_ball_point(database.directions, 0.0087, return_length=True)) - 1


def few_true_stars(generator: Generator, scene: Scene) -> Trial:
    """Return three to nine stars, and false spots all over the frame."""
    trial = _stars(generator, scene)
    count = len(trial.centroids_px)
    kept = generator.permutation(count) < generator.integers(3, 10)
    return _with_spots(_only(trial, kept), _random_px(generator, scene, 5, 61), generator)


def of_another_epoch(generator: Generator, scene: Scene) -> Trial:
    """Return stars that have moved, most of them little, some of them much."""
    trial = _stars(generator, scene, false_stars=3)
    speed_px = scene.noise_px * generator.lognormal(0.0, 1.0, (len(trial.centroids_px), 1))
    moved = speed_px * generator.normal(size=trial.centroids_px.shape)
    # The square of the lognormal has the mean e^2.
    noise_px = scene.noise_px * float(np.sqrt(1.0 + np.exp(2.0)))
    return replace(trial, centroids_px=trial.centroids_px + moved, noise_px=noise_px)


NO_SKY: dict[str, Make] = {
    make.__name__: make
    for make in (
        random, dense, clustered, on_a_grid, on_streaks, hot_pixels, mirrored, not_in_the_database,
    )
}  # fmt: skip

WITH_SKY: dict[str, Make] = {
    make.__name__: make
    for make in (
        scaled, doubled, overlaid, jumped, among_hot_pixels, among_streaks, part_of_the_frame,
        at_a_cluster, few_true_stars, of_another_epoch,
    )
}  # fmt: skip

KINDS = NO_SKY | WITH_SKY
