"""The test bench: frames of a star sensor from electrons, and the attitudes from them.

Stars of the whole catalog of the database shine through a lens that is not quite the known one on
pixels that are not quite alike; spots and attitude are found as in flight, with starcat's own
detection and matcher. Not drawn are blooming, optics whose spot changes over the field, and
stars fainter than the catalog's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import date, timedelta
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Matrix, Pixels, Rows
from starcat.database import open_database_folder
from starcat.errors import ConfigError
from starcat.frames.images import Optics, Spots, centres_of_mass, find_spots, star_electrons
from starcat.frames.sky import Observer, bodies_seen
from starcat.geometry import (
    Camera,
    after_turn,
    matrix_from_quaternion,
    quaternion_from_matrix,
    random_attitudes,
    turn_between,
)
from starcat.matcher import ARCSEC, REACH, Matcher
from starcat.pipeline.simulation import Sky
from starcat.pipeline.specs import Sensor
from starcat_lab.experiment import catalog_of_database

PLANETS = ("Venus", "Mars", "Jupiter", "Saturn")
_LIMIT_BEYOND_MAG = 0.3
_MAX_ELECTRONS = 1e15  # numpy cannot draw numbers above 9e18
_STEP_SIGMA = 0.5  # largest distance of the spots of a trail, standard deviations


@dataclass(frozen=True)
class Condition:
    """Disturbances of a frame besides the noise of the sensor."""

    rate_deg_s: float = 0.0  # about a random axis across the boresight
    false_stars: int = 0
    missing_share: float = 0.0
    radiation_cm2_s: float = 0.0
    is_old: bool = False  # whether it has the hot pixels of the end of life
    has_planet: bool = False  # whether a planet is in the field of view


@dataclass(frozen=True, eq=False)
class Bench:
    """A sensor that observes a sky."""

    sensor: Sensor
    matcher: Matcher
    sky: Sky  # true sky, from the catalog
    seed: int
    box_px: int | None = None  # size of the box of a centre of mass; None: windowed centroid

    @property
    def camera(self) -> Camera:
        """The camera that the sensor assumes."""
        return self.matcher.database.camera

    @cached_property
    def lens(self) -> Camera:
        """The camera as it is."""
        camera, sensor = self.camera, self.sensor
        radius = math.tan(camera.radius_rad)
        k1 = sensor.distortion_error_px / (camera.focal_length_px * radius**3)
        x, y = camera.principal_point_px
        dx, dy = sensor.principal_point_error_px
        return Camera(
            camera.width_px,
            camera.height_px,
            camera.focal_length_px * (1.0 + sensor.focal_length_error),
            principal_point_px=(x + dx, y + dy),
            distortion=replace(camera.distortion, k1=camera.distortion.k1 + k1),
        )

    @cached_property
    def true_sky(self) -> Sky:
        """The true sky: it differs from the catalog by the catalog's errors."""
        error_rad = self.sensor.catalog_error_arcsec / ARCSEC
        u = self.sky.directions + error_rad * self._drawn(0).normal(size=(len(self.sky), 3))
        return replace(self.sky, directions=u / np.linalg.norm(u, axis=1)[:, None])

    @cached_property
    def row_of_guide(self) -> NDArray[np.int64]:
        """Rows of the sky, by rows of the guide stars in the database."""
        rows = np.flatnonzero(self.sky.star_index >= 0)
        row_by_guide = np.empty(len(self.matcher.database.mag), dtype=np.int64)
        row_by_guide[self.sky.star_index[rows]] = rows
        return row_by_guide

    @cached_property
    def prnu(self) -> Array:
        """Response of each pixel, 1 on average."""
        return 1.0 + self.sensor.prnu * self._drawn(1).standard_normal(self.shape)

    @cached_property
    def dsnu_e(self) -> Array:
        """Dark signal of each pixel beyond the mean, electrons in a frame; none is below zero."""
        spread = self.sensor.dsnu_e_s * self.sensor.exposure_s
        drawn = spread * self._drawn(2).standard_normal(self.shape)
        return np.maximum(drawn, -self.sensor.dark_e_s * self.sensor.exposure_s)

    @cached_property
    def hot_e(self) -> Array:
        """Dark signal of the hot pixels at end of life, electrons in a frame."""
        generator = self._drawn(3)
        is_hot = generator.random(self.shape) < self.sensor.hot_pixel_share
        mean = self.sensor.hot_pixel_e_s * self.sensor.exposure_s
        return np.asarray(np.where(is_hot, generator.exponential(mean, self.shape), 0.0))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the detector."""
        return self.camera.height_px, self.camera.width_px

    @property
    def limit_mag(self) -> float:
        """Faintest spot that is used."""
        stated = self.sensor.limit_mag
        return (
            float(self.matcher.database.mag.max()) + _LIMIT_BEYOND_MAG if stated is None else stated
        )

    def _drawn(self, part: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, part])

    def mounted(self, matrix: Matrix) -> Matrix:
        """Return the attitude of the camera from the attitude of its reference frame."""
        turn = tuple(angle / ARCSEC for angle in self.sensor.alignment_arcsec)
        return turned(matrix, turn)  # type: ignore[arg-type]

    def in_field(self, matrix: Matrix) -> tuple[Rows, Pixels]:
        """Return the stars in view of a camera: rows of the sky, and positions of their images."""
        sky = self.true_sky
        rows = sky.zones.near(matrix[2], 1.05 * self.camera.radius_rad)
        places = self.lens.pixels_from_directions(sky.directions[rows] @ matrix.T)
        inside = self.camera.contains(places)
        return rows[inside], places[inside]

    def light(self, places: Pixels, mag: Array) -> Array:
        """Return the mean electrons of stars in a frame, before the pixels differ."""
        optics = Optics(self.sensor.psf_sigma_px, self.sensor.zero_point_e)
        return star_electrons(places, mag, (self.camera.width_px, self.camera.height_px), optics)

    def recorded(self, mean_e: Array, generator: np.random.Generator) -> NDArray[np.uint16]:
        """Return the output of the converter for mean electrons."""
        sensor = self.sensor
        electrons = generator.poisson(np.minimum(mean_e, _MAX_ELECTRONS)).astype(np.float64)
        np.minimum(electrons, sensor.full_well_e, out=electrons)
        electrons += sensor.read_noise_e * generator.standard_normal(electrons.shape)
        adu = np.rint(electrons / sensor.gain_e_adu + sensor.offset_adu)
        return np.clip(adu, 0, 2**sensor.bits - 1).astype(np.uint16)

    def spots(self, image: NDArray[np.uint16]) -> Spots:
        """Return the spots of a frame that the sensor uses, with magnitudes of the catalog."""
        sensor = self.sensor
        detected = self._detected(image)
        mag = detected.mag + 2.5 * math.log10(sensor.zero_point_e / sensor.gain_e_adu)
        kept = np.flatnonzero(mag <= self.limit_mag)[: sensor.most_spots]
        return Spots(
            detected.centroids_px[kept],
            detected.flux[kept],
            mag[kept],
            detected.sigma_px[kept],
            detected.psf_sigma_px,
        )

    def centroids(self, image: NDArray[np.uint16]) -> Pixels:
        """Return all spots of a frame."""
        return self._detected(image).centroids_px

    def _detected(self, image: NDArray[np.uint16]) -> Spots:
        sensor = self.sensor
        detected = find_spots(
            image, threshold_sigma=sensor.threshold_sigma, psf_sigma_px=sensor.psf_sigma_px
        )
        if self.box_px is None:
            return detected
        dark = sensor.offset_adu + sensor.background_e / sensor.gain_e_adu
        light = image.astype(np.float64) - dark
        return replace(
            detected, centroids_px=centres_of_mass(light, detected.centroids_px, self.box_px)
        )

    def exposures(
        self,
        matrix: Matrix,
        condition: Condition,
        generator: np.random.Generator,
        count: int,
        observer: Observer | None = None,
    ) -> Iterator[NDArray[np.uint16]]:
        """Yield frames at an attitude of the camera, which differ by their noise."""
        sensor = self.sensor
        places, mag = self._points(matrix, condition, generator, observer)
        mean = self.light(places, mag) * self.prnu + sensor.background_e + self.dsnu_e
        if condition.is_old:
            mean = mean + self.hot_e
        for _ in range(count):
            hits = _tracks(self, condition.radiation_cm2_s, generator)
            yield self.recorded(mean if hits is None else mean + hits, generator)

    def _points(
        self,
        matrix: Matrix,
        condition: Condition,
        generator: np.random.Generator,
        observer: Observer | None,
    ) -> tuple[Pixels, Array]:
        """Return all points of light of a frame and their magnitudes."""
        rows, _ = self.in_field(matrix)
        rows = rows[generator.random(len(rows)) >= condition.missing_share]
        u, mag = self.true_sky.directions[rows], self.true_sky.mag[rows]
        if observer is not None:
            seen = bodies_seen(observer)
            planets = [seen.row(name) for name in PLANETS]
            u, mag = np.vstack([u, seen.directions[planets]]), np.append(mag, seen.mag[planets])
        angles, axis = self._steps(condition.rate_deg_s), 2.0 * math.pi * generator.random()
        x, y = math.cos(axis), math.sin(axis)
        places = np.vstack(
            [
                self.lens.pixels_from_directions(u @ turned(matrix, (a * x, a * y, 0.0)).T)
                for a in angles.tolist()
            ]
        )
        mag = np.tile(mag + 2.5 * math.log10(len(angles)), len(angles))
        size = self.camera.width_px, self.camera.height_px
        false = generator.random((condition.false_stars, 2)) * size
        drawn = generator.choice(self.matcher.database.mag, condition.false_stars)
        return np.vstack([places, false]), np.append(mag, drawn)

    def smear_px(self, rate_deg_s: float) -> float:
        """Return the length of a trail."""
        moved = math.radians(rate_deg_s) * self.sensor.exposure_s
        return moved * self.camera.focal_length_px

    def _steps(self, rate_deg_s: float) -> Array:
        """Return the angles of a trail from its middle, radians."""
        moved = math.radians(rate_deg_s) * self.sensor.exposure_s
        step_px = _STEP_SIGMA * self.sensor.psf_sigma_px
        count = max(1, math.ceil(self.smear_px(rate_deg_s) / step_px))
        return np.asarray(moved * ((np.arange(count) + 0.5) / count - 0.5))

    def trail_px(self, rate_deg_s: float, generator: np.random.Generator) -> tuple[Pixels, float]:
        """Return the spots of a trail from its middle, and how much fainter each is, mag."""
        along, angle = self._steps(rate_deg_s), 2.0 * math.pi * generator.random()
        across = np.array([math.cos(angle), math.sin(angle)])
        return along[:, None] * across * self.camera.focal_length_px, 2.5 * math.log10(len(along))


def open_bench(database: Path, sensor: Sensor, seed: int, method: str | None) -> Bench:
    """Return the bench of a database's own camera and stars."""
    selection = open_database_folder(database).manifest["spec"]["selection"]
    box_px = selection.get("neighbours", {}).get("box_px")
    sky = catalog_of_database(database)
    return Bench(sensor, Matcher.open(database, method), sky, seed, box_px)


cached_bench = lru_cache(maxsize=1)(open_bench)


def turned(matrix: Matrix, turn: tuple[float, float, float]) -> Matrix:
    """Return an attitude after a rotation of the camera, axis times angle in radians."""
    return matrix_from_quaternion(
        np.array(after_turn(quaternion_from_matrix(matrix).tolist(), turn))
    )


def error_arcsec(truth: Matrix, q: Array) -> Array:
    """Return the rotation from a true attitude to a measured one, about x, y and z."""
    turn = turn_between(quaternion_from_matrix(truth).tolist(), q.tolist())
    return ARCSEC * np.array(turn)


def random_day(generator: np.random.Generator) -> Observer:
    """Return an observer at the Earth on some day of ten years."""
    day = date(2026, 1, 1) + timedelta(days=int(generator.integers(3652)))
    return Observer.at(f"{day.isoformat()}T00:00:00")


def planet_in_field(bench: Bench, observer: Observer, generator: np.random.Generator) -> Matrix:
    """Return an attitude with a bright planet somewhere in the field."""
    matrix = random_attitudes(1, generator)[0]
    seen = bodies_seen(observer)
    planet = matrix @ seen.directions[seen.row(str(generator.choice(PLANETS)))]
    size = bench.camera.width_px, bench.camera.height_px
    body = bench.camera.directions_from_pixels(generator.random((1, 2)) * size)[0]
    # Rodrigues: the shortest rotation that takes one direction to another.
    skew = np.cross(np.eye(3), np.cross(planet, body))
    return np.asarray((np.eye(3) + skew + skew @ skew / (1.0 + float(planet @ body))) @ matrix)


def _tracks(bench: Bench, flux_cm2_s: float, generator: np.random.Generator) -> Array | None:
    """Return the electrons of particle hits in a frame."""
    sensor, (height, width) = bench.sensor, bench.shape
    area_cm2 = height * width * (1e-4 * sensor.pixel_um) ** 2
    count = int(generator.poisson(flux_cm2_s * area_cm2 * sensor.exposure_s))
    if not count:
        return None
    image = np.zeros(bench.shape)
    x, y = generator.random((2, count)) * [[width], [height]]
    angle = 2.0 * math.pi * generator.random(count)
    length = generator.exponential(sensor.radiation_track_px, count)
    electrons = generator.exponential(sensor.radiation_e, count)
    pixels = np.ceil(length).astype(int) + 1
    hit = np.repeat(np.arange(count), pixels)
    step = np.arange(len(hit)) - np.repeat(np.cumsum(pixels) - pixels, pixels)
    along = length[hit] * (step + 0.5) / pixels[hit]
    column = np.floor(x[hit] + along * np.cos(angle[hit])).astype(int)
    row = np.floor(y[hit] + along * np.sin(angle[hit])).astype(int)
    on = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    np.add.at(image, (row[on], column[on]), (electrons / pixels)[hit][on])
    return image


@dataclass(frozen=True)
class BenchAnswer:
    """The result of one frame."""

    is_acquired: bool  # whether there is an attitude
    is_right: bool
    chance: float  # the bound that the matcher states for a false attitude; NaN without one
    error: Array  # about x, y, z, arcsec; NaN unless the attitude is right
    star_index: NDArray[np.int64]  # identified guide stars


def bench_answer(bench: Bench, image: NDArray[np.uint16], truth: Matrix) -> BenchAnswer:
    """Find the spots of a frame and its attitude, and compare it with the truth."""
    none = np.full(3, np.nan)
    try:
        spots = bench.spots(image)
    except ConfigError:  # too many bright pixels to find the stars
        return BenchAnswer(False, False, math.nan, none, np.zeros(0, dtype=np.int64))
    result = bench.matcher.identify(spots.centroids_px, mag=spots.mag)
    if not result.ok:
        return BenchAnswer(False, False, math.nan, none, np.zeros(0, dtype=np.int64))
    error = error_arcsec(truth, result.q_body_from_icrs)
    # Twice the reach of the matcher at the worst corner, as in the other evaluations.
    radius = bench.camera.radius_rad
    moved_px = (
        bench.camera.focal_length_px
        / ARCSEC
        * (math.hypot(error[0], error[1]) + abs(error[2]) * math.sin(radius))
    )
    stated = np.abs(bench.sensor.alignment_arcsec).sum() / ARCSEC * bench.camera.focal_length_px
    is_right = bool(moved_px <= 2.0 * REACH * bench.matcher.settings.tolerance_px + stated)
    named = result.star_index[result.star_index >= 0].astype(np.int64)
    chance = float(result.false_match_probability)
    return BenchAnswer(True, is_right, chance, error if is_right else none, named)
