"""Simulated frames: what a camera at a known attitude would measure of a sky."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from starcat.arguments import HasFolder, whole_number
from starcat.arrays import Array
from starcat.catalog.stars.region import footprint_of_recorded
from starcat.database.manifest import MANIFEST_NAME, read_manifest
from starcat.errors import count_of
from starcat.geometry.attitude import HasAttitude, matrix_from_radec_roll, random_attitudes
from starcat.geometry.camera import Camera
from starcat.geometry.footprint import Footprint
from starcat.geometry.sphere import Zones, radec_from_directions, zones_of
from starcat.html_tables import html_table
from starcat.matcher.database import MatcherDatabase, as_database
from starcat.matcher.options import SIMULATED, checked_option
from starcat.resources import PathLike


@dataclass(frozen=True, eq=False, repr=False)
class SimulatedFrame(HasAttitude):
    """One simulated frame.

    Attributes
    ----------
    matrix : ndarray of float64, shape (3, 3)
        True attitude, ``body = matrix @ icrs``. ``q_body_from_icrs``, ``boresight_ra_deg``,
        ``boresight_dec_deg`` and ``roll_deg`` state it as in a `MatchResult`.
    centroids_px : ndarray of float64, shape (N, 2)
        Measured centroids, in random order.
    star_index : ndarray of int64, shape (N,)
        Row of each centroid's guide star; -1 for another star and for a false one.
    mag : ndarray of float64, shape (N,)
        Measured magnitudes.
    is_false : ndarray of bool, shape (N,)
        True for centroids that are not stars at all.
    """

    matrix: Array
    centroids_px: Array
    star_index: NDArray[np.int64]
    mag: Array
    is_false: NDArray[np.bool_]

    @property
    def n_stars(self) -> int:
        """Centroids that are guide stars."""
        return int((self.star_index >= 0).sum())

    def __repr__(self) -> str:
        return (
            f"<SimulatedFrame: {count_of(len(self.centroids_px), 'centroid')}, {self.n_stars} of "
            f"guide stars, RA {self.boresight_ra_deg:.4f}, Dec {self.boresight_dec_deg:+.4f}, "
            f"roll {self.roll_deg:.4f} deg>"
        )

    def _repr_html_(self) -> str:
        """Return the first centroids as a table for a notebook."""
        (x, y), star = self.centroids_px.T, self.star_index
        columns = ([f"{value:.2f}" for value in column] for column in (x, y, self.mag))
        rows = zip(*columns, (index if index >= 0 else "" for index in star), strict=True)
        return html_table(("x px", "y px", "mag", "guide star"), rows, len(star), repr(self)[1:-1])


@dataclass(frozen=True)
class Noise:
    """The noise of a frame."""

    noise_px: float = 0.0  # standard deviation of a centroid, each axis
    drop_probability: float = 0.0  # chance of a star to be missing
    # Spots at random positions, with the magnitudes of stars drawn from the sky.
    false_stars: int = 0
    # Share of further such spots in all centroids; below 1.
    false_share: float = 0.0
    # Standard deviation of a magnitude, added before the limit is applied.
    noise_mag: float = 0.0
    limit_mag: float = float("inf")  # fainter stars are not seen
    # Whether the limit is applied to the true magnitude, not the measured one: then the noise of
    # magnitudes neither hides a star nor lifts a fainter one over the limit.
    is_limit_true: bool = False


def simulate_frames(
    directions: Array,
    camera: Camera,
    count: int,
    noise: Noise,
    seed: int,
    mag: Array | None = None,
    part: Footprint | None = None,
) -> Iterator[SimulatedFrame]:
    """Simulate frames of guide stars at attitudes uniform over all rotations.

    If a part of the sphere is given, the boresights are uniform over it.

    All attitudes are drawn first, so that frames depend on how many there are. Self-tests and the
    figures of the documentation are of these frames; `simulate` is for users.
    """
    generator = np.random.default_rng(seed)
    sky = sky_of_guide_stars(directions, mag)
    for matrix in _attitudes(count, generator, part):
        yield simulate_frame(sky, camera, matrix, noise, generator)


def part_of_database(folder: Path | None) -> Footprint | None:
    """Return the part of the sphere that a database is for; None for all of it.

    An onboard image, which has no folder, and a file without a manifest do not state a part.
    """
    if folder is None or not (folder / MANIFEST_NAME).is_file():
        return None
    return footprint_of_recorded(read_manifest(folder)["spec"])


def _attitudes(count: int, generator: np.random.Generator, part: Footprint | None) -> Array:
    if part is None:
        return random_attitudes(count, generator)
    ra_deg, dec_deg = radec_from_directions(part.random_directions(count, generator))
    roll_deg = generator.uniform(0.0, 360.0, count)
    facts = zip(ra_deg.tolist(), dec_deg.tolist(), roll_deg.tolist(), strict=True)
    return np.array([matrix_from_radec_roll(*angles) for angles in facts])


def simulate(
    database: MatcherDatabase | HasFolder | PathLike,
    count: int = 1,
    *,
    noise_px: float = 0.5,
    noise_mag: float = 0.2,
    drop_probability: float = 0.0,
    false_stars: int = 0,
    seed: int | np.random.Generator | None = 0,
) -> list[SimulatedFrame]:
    """Simulate frames with the stars of a database, at random attitudes within its region.

    Parameters
    ----------
    database : MatcherDatabase, Database, str or path-like
        The ``database`` of a matcher, a database opened by ``starcat.open``, or its folder.
    count : int, default 1
        Number of frames.
    noise_px, noise_mag : float
        Standard deviations of centroids, on each axis, and of magnitudes.
    drop_probability : float, default 0
        Probability that a star is missing.
    false_stars : int, default 0
        Centroids in each frame that are not stars.
    seed : int, numpy.random.Generator or None, default 0
        The same seed gives the same frames. The first frames do not depend on ``count``, and
        ``starcat simulate --seed`` writes the first of them. A generator continues where it is;
        None gives other frames each time.

    Returns
    -------
    list of SimulatedFrame
        Frames for `Matcher.identify`, with ``centroids_px`` of shape (N, 2) and ``mag`` of shape
        (N,). ``matrix`` (body from ICRS) and ``star_index`` are the true attitude and stars.

    Raises
    ------
    ConfigError, ProductError
        If a number is out of range, or the database cannot be read.
    """
    opened = as_database("database", database)
    options = {
        "noise_px": noise_px, "noise_mag": noise_mag, "drop_probability": drop_probability,
    }  # fmt: skip
    numbers = {
        name: float(checked_option(name, value, SIMULATED)) for name, value in options.items()
    }
    noise = Noise(
        numbers["noise_px"],
        numbers["drop_probability"],
        whole_number("false_stars", false_stars, 0),
        noise_mag=numbers["noise_mag"],
    )
    sky, frames = sky_of_guide_stars(opened.directions, opened.mag), whole_number("count", count, 0)
    if seed is not None and not isinstance(seed, np.random.Generator):
        seed = whole_number("seed", seed, 0)
    part, generator = part_of_database(opened.folder), np.random.default_rng(seed)
    simulated = []
    for _ in range(frames):  # in turn: a frame does not depend on the number of frames after it
        [matrix] = _attitudes(1, generator, part)
        simulated.append(simulate_frame(sky, opened.camera, matrix, noise, generator))
    return simulated


def simulate_frame(
    sky: Sky, camera: Camera, matrix: Array, noise: Noise, generator: np.random.Generator
) -> SimulatedFrame:
    """Simulate one frame."""
    near = sky.zones.near(matrix[2], 1.05 * camera.radius_rad)
    centroids = camera.pixels_from_directions(sky.directions[near] @ matrix.T)
    inside = camera.contains(centroids)
    centroids, star = centroids[inside], near[inside]
    seen = generator.random(len(star)) >= noise.drop_probability
    true_mag = mag = sky.mag[star]
    if noise.noise_mag > 0.0:
        mag = mag + generator.normal(scale=noise.noise_mag, size=len(mag))
    seen &= (true_mag if noise.is_limit_true else mag) <= noise.limit_mag
    centroids, star, mag = centroids[seen], star[seen], mag[seen]
    centroids = centroids + generator.normal(scale=noise.noise_px, size=centroids.shape)
    count = noise.false_stars + round(len(star) * noise.false_share / (1.0 - noise.false_share))
    false = generator.random((count, 2)) * [camera.width_px, camera.height_px]
    order = generator.permutation(len(star) + count)
    centroids = np.concatenate([centroids, false])
    order = order[camera.contains(centroids[order])]
    borrowed = sky.mag[_visible(sky, noise.limit_mag, count, generator)]
    return SimulatedFrame(
        matrix,
        centroids[order],
        np.concatenate([sky.star_index[star], np.full(count, -1)]).astype(np.int64)[order],
        np.concatenate([mag, borrowed])[order],
        (np.arange(len(star) + count) >= len(star))[order],
    )


def _visible(
    sky: Sky, limit_mag: float, count: int, generator: np.random.Generator
) -> NDArray[np.int64]:
    bright = np.flatnonzero(sky.mag <= limit_mag)
    return bright[generator.integers(0, max(1, len(bright)), count)] if len(bright) else bright


@dataclass(frozen=True)
class Sky:
    """Points of light."""

    directions: Array  # ICRS unit vectors; shape (N, 3)
    mag: Array  # magnitudes; shape (N,)
    # Row of the guide star in the database, -1 for other points; shape (N,).
    star_index: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.mag)

    @cached_property
    def zones(self) -> Zones:
        """The points in order of declination."""
        return zones_of(self.directions)

    def brighter(self, limit_mag: float) -> Sky:
        """Return the points up to a magnitude."""
        seen = self.mag <= limit_mag
        return Sky(self.directions[seen], self.mag[seen], self.star_index[seen])


def sky_of_guide_stars(directions: Array, mag: Array | None = None) -> Sky:
    """Return the guide stars of a database as a sky; without magnitudes all are of 0 mag."""
    rows = np.arange(len(directions), dtype=np.int32)
    return Sky(directions, np.zeros(len(directions)) if mag is None else mag, rows)
