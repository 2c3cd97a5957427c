"""The trials of a star sensor: many pointings of one kind, and stars of one magnitude."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from starcat.arrays import Array, Directions, Matrix, Pixels, Rows
from starcat.database.products import widths_px
from starcat.errors import ConfigError
from starcat.frames.images import centres_of_mass, load_sep
from starcat.frames.sky import aberrated
from starcat.geometry import (
    information,
    matrix_from_radec_roll,
    quaternion_from_matrix,
    radec_from_directions,
    random_attitudes,
    saff_kuijlaars,
    solve_wahba_svd,
)
from starcat.matcher import ARCSEC, MIN_STARS
from starcat.pipeline.specs import Sensor
from starcat.progress import Progress
from starcat_lab.campaign import side_by_side
from starcat_lab.ecss.bench import (
    Bench,
    Condition,
    bench_answer,
    cached_bench,
    error_arcsec,
    planet_in_field,
    random_day,
)

_STEP_PX = 0.5
LOW_ORBIT_KM_S = 7.6

CONTRIBUTORS = {
    "sampling": "pixel spatial error: sampling of the spot, full well",
    "prnu": "pixel spatial error: PRNU",
    "dsnu": "pixel spatial error: DSNU",
    "blends": "neighbouring stars in the window or box",
    "distortion": "FOV spatial error: focal length, principal point and distortion",
    "catalog": "FOV spatial error: catalog",
    "aberration": "aberration residual",
    "no_orbit": "aberration, corrected for the Earth's motion only",
    "no_aberration": "aberration, not corrected",
}
"""Contributors that are simulated separately, in the order of the report."""


def centroid_noise_px(bench: Bench, mag: Array) -> Array:
    """Return the noise of a star's centroid on one axis, in closed form.

    The windowed centroid is where the sum of ``w x I`` over the pixels is 0, for a window w and
    offsets x from it. With a spot of N electrons and variance s^2, a window of variance w^2 and
    a background of variance b in a pixel, the variance of that sum is
    ``N A' v' + b pi w^4 / 2`` with ``A' = w^2/(2 s^2 + w^2)`` and ``v' = s^2 A'``, and its
    slope is ``N A^2`` with ``A = w^2/(s^2 + w^2)``. Not valid for saturated stars, nor near the
    threshold, where only lucky stars are found.
    """
    sensor = bench.sensor
    electrons = sensor.zero_point_e * 10.0 ** (-0.4 * np.asarray(mag))
    widths = widths_px(sensor.psf_sigma_px)
    s2, w2 = widths.spot**2, widths.window**2
    rounding = sensor.gain_e_adu**2 / 12.0
    background = sensor.background_e + sensor.read_noise_e**2 + rounding
    slope, part = (w2 / (s2 + w2)) ** 2, w2 / (2.0 * s2 + w2)
    shot, rest = electrons * s2 * part**2, background * math.pi * w2**2 / 2.0
    return np.asarray(np.sqrt(shot + rest) / (electrons * slope))


def attitude_variance(bench: Bench, places: Pixels, noise_px: Array) -> Array:
    """Return the variances of an attitude about x, y and z from centroid noise, arcsec^2.

    As `starcat.matcher.stars.attitude_covariance`, but with a noise for each centroid.
    """
    camera = bench.camera
    body = camera.directions_from_pixels(places)
    total = np.zeros((3, 3))
    for axis in (0, 1):
        step = np.zeros(2)
        step[axis] = _STEP_PX
        ends = [camera.directions_from_pixels(places + sign * step) for sign in (1.0, -1.0)]
        moved = np.cross(body, (ends[0] - ends[1]) / (2.0 * _STEP_PX)) * noise_px[:, None]
        total += moved.T @ moved
    inverse = np.linalg.inv(information(body))
    return np.asarray(ARCSEC**2 * np.diag(inverse @ total @ inverse))


@dataclass(frozen=True)
class Contributions:
    """The error of one frame by its contributors."""

    errors: dict[str, Array]  # about x, y and z, arcsec
    noise_variance: Array  # temporal noise about x, y and z in closed form, arcsec^2


def contributions(
    bench: Bench, truth: Matrix, stars: Rows, generator: np.random.Generator
) -> Contributions:
    """Return the effect of each contributor on the attitude of the guide stars of a frame.

    ``truth`` is the attitude of the camera. No contributor includes the alignment.
    """
    rows = bench.row_of_guide[stars]
    icrs, mag = bench.sky.directions[rows], bench.sky.mag[rows]
    expected = bench.camera.pixels_from_directions(icrs @ truth.T)
    places = bench.lens.pixels_from_directions(bench.true_sky.directions[rows] @ truth.T)

    def error(body: Directions, stars: Directions = icrs) -> Array:
        return error_arcsec(truth, quaternion_from_matrix(solve_wahba_svd(body, stars)))

    def moved(by_px: Pixels) -> Array:
        return error(bench.camera.directions_from_pixels(expected + by_px))

    guide_light = bench.light(places, mag)
    near, around = bench.in_field(truth)
    everything = bench.light(around, bench.true_sky.mag[near])
    alone = _centroids(bench, guide_light, places)
    lens_only = bench.lens.pixels_from_directions(icrs @ truth.T)
    errors = {
        "sampling": moved(alone - places),
        "prnu": moved(_centroids(bench, guide_light * bench.prnu, places) - alone),
        "dsnu": moved(_centroids(bench, guide_light + bench.dsnu_e, places) - alone),
        "blends": moved(_centroids(bench, everything, places) - alone),
        "distortion": moved(lens_only - expected),
        "catalog": error(bench.true_sky.directions[rows] @ truth.T),
        **_aberrations(bench, truth, icrs, generator),
    }
    return Contributions(errors, attitude_variance(bench, expected, centroid_noise_px(bench, mag)))


def _centroids(bench: Bench, light: Array, places: Pixels) -> Pixels:
    """Return the centroids of light without noise, measured as the spec of the database states.

    A window settles from the true places on; a box is around the brightest pixel next to them.
    """
    clipped = np.minimum(light, bench.sensor.full_well_e)
    if bench.box_px is not None:
        return centres_of_mass(clipped, places, bench.box_px)
    start = np.ascontiguousarray((places - 0.5).T)
    window = widths_px(bench.sensor.psf_sigma_px).window
    x, y, _ = load_sep().winpos(clipped, *start, window, subpix=0)
    return np.stack([x, y], axis=1) + 0.5


def _aberrations(
    bench: Bench, truth: Matrix, icrs: Directions, generator: np.random.Generator
) -> dict[str, Array]:
    """Return the remaining aberration on a random day in a random low orbit."""
    across = generator.normal(size=3)
    orbit = LOW_ORBIT_KM_S * across / np.linalg.norm(across)
    earth = random_day(generator)
    true_km_s = earth.velocity_km_s + orbit
    off = bench.sensor.velocity_error_km_s * generator.normal(size=3)
    body = aberrated(icrs, true_km_s) @ truth.T

    def residual(stars: Directions) -> Array:
        return error_arcsec(truth, quaternion_from_matrix(solve_wahba_svd(body, stars)))

    return {
        "aberration": residual(aberrated(icrs, true_km_s + off)),
        "no_orbit": residual(aberrated(icrs, earth.velocity_km_s)),
        "no_aberration": residual(icrs),
    }


BORESIGHTS = 2000
"""Directions all over the sky; the worst hundredth of them is simulated."""

_CHUNK = 5  # pointings per task of a process
_MIN_SPOTS = 1800  # least number of stars measured per magnitude
_PITCH_PX = 24.0  # their distance: no star is in another's window
_REACH_PX = 2.0


@dataclass(frozen=True)
class SensorTrial:
    """Pointings of one kind."""

    name: str
    condition: Condition
    pointings: int
    frames: int  # consecutive frames of each pointing
    with_contributions: bool = False
    boresights: tuple[tuple[float, float], ...] = ()  # right ascension and declination, degrees


def trials_of(bench: Bench, pointings: int) -> list[SensorTrial]:
    """Return all trials of a sensor, the nominal one first and the worst of the sky last."""
    sensor = bench.sensor
    _check_trails(bench)
    conditions = {
        **{f"{r:g} deg/s": Condition(rate_deg_s=r) for r in sensor.rates_deg_s if r},
        **{f"{n} false stars": Condition(false_stars=n) for n in sensor.false_stars},
        **{f"{s:.3g} of the stars missing": Condition(missing_share=s)
           for s in sensor.missing_shares},
        **{f"{f:,g} particles/cm2/s": Condition(radiation_cm2_s=f)
           for f in sensor.radiation_cm2_s},
        **({"hot pixels at end of life": Condition(is_old=True)} if sensor.hot_pixel_share else {}),
        "a planet in the field": Condition(has_planet=True),
    }  # fmt: skip
    worst = worst_boresights(bench)
    return [
        SensorTrial(NOMINAL, Condition(), pointings, 3, with_contributions=True),
        *(SensorTrial(n, c, pointings, 2 if c.rate_deg_s else 1) for n, c in conditions.items()),
        SensorTrial(WORST, Condition(), pointings, 2, boresights=worst),
    ]


def _check_trails(bench: Bench) -> None:
    most_px = 0.5 * min(bench.shape) - _PITCH_PX
    for rate in (0.0, *bench.sensor.rates_deg_s):
        if (smear_px := bench.smear_px(rate)) > most_px:
            text = (
                f"rates_deg_s: {rate:g} deg/s draws trails of {smear_px:.0f} px in "
                f"{bench.sensor.exposure_s:g} s; expected at most {most_px:.0f} px on this "
                "detector: state slower rates or a shorter exposure"
            )
            raise ConfigError(text, key="rates_deg_s", value=rate)


NOMINAL, WORST = "nominal", "worst 1 % of the sky"


def point(bench: Bench, trial: SensorTrial, number: int) -> dict[str, Any]:
    """Simulate the frames of one pointing and return the results, as plain values."""
    name = zlib.crc32(trial.name.encode())
    generator = np.random.default_rng([bench.seed, name, number])
    observer = random_day(generator) if trial.condition.has_planet else None
    if observer is not None:
        truth = planet_in_field(bench, observer, generator)
    elif trial.boresights:
        ra_deg, dec_deg = trial.boresights[number % len(trial.boresights)]
        truth = matrix_from_radec_roll(ra_deg, dec_deg, 360.0 * generator.random())
    else:
        truth = random_attitudes(1, generator)[0]
    mounted = bench.mounted(truth)
    frames = bench.exposures(mounted, trial.condition, generator, trial.frames, observer)
    answers = [bench_answer(bench, image, truth) for image in frames]
    record: dict[str, Any] = {
        "acquired": [answer.is_acquired for answer in answers],
        "right": [answer.is_right for answer in answers],
        "chance": [answer.chance for answer in answers if answer.is_acquired],
        "error": [answer.error.tolist() for answer in answers],
        "guide_stars": guide_stars(bench, mounted)[1].size,
    }
    right = next((answer for answer in answers if answer.is_right), None)
    if trial.with_contributions and right is not None:
        by_contributor = contributions(bench, mounted, right.star_index, generator)
        record["contributions"] = {name: e.tolist() for name, e in by_contributor.errors.items()}
        record["noise_variance"] = by_contributor.noise_variance.tolist()
    return record


def guide_stars(bench: Bench, matrix: Matrix) -> tuple[Pixels, Array]:
    """Return the guide stars of a field, the brightest first: positions and mag."""
    rows, places = bench.in_field(matrix)
    mag = bench.sky.mag[rows]
    kept = np.flatnonzero((bench.sky.star_index[rows] >= 0) & (mag <= bench.limit_mag))
    kept = kept[np.argsort(mag[kept], kind="stable")][: bench.sensor.most_spots]
    return places[kept], mag[kept]


def expected_noise(bench: Bench) -> dict[str, Any]:
    """Return stars and noise of fields all over the sky, in closed form."""
    boresights = np.column_stack(radec_from_directions(saff_kuijlaars(BORESIGHTS)))
    rolls = np.random.default_rng([bench.seed, 4]).random(BORESIGHTS) * 360.0
    stars, sigma = np.empty(BORESIGHTS, dtype=np.int64), np.full((BORESIGHTS, 3), np.inf)
    for k, ((ra_deg, dec_deg), roll) in enumerate(zip(boresights, rolls, strict=True)):
        places, mag = guide_stars(bench, matrix_from_radec_roll(ra_deg, dec_deg, roll))
        stars[k] = len(mag)
        if len(mag) >= MIN_STARS:
            sigma[k] = np.sqrt(attitude_variance(bench, places, centroid_noise_px(bench, mag)))
    return {"boresights": boresights, "stars": stars, "sigma": sigma}


def worst_boresights(bench: Bench) -> tuple[tuple[float, float], ...]:
    """Return the hundredth of the sky where the noise is expected to be largest."""
    expected = expected_noise(bench)
    across = np.hypot(expected["sigma"][:, 0], expected["sigma"][:, 1])
    order = np.lexsort((expected["stars"], -across))[: BORESIGHTS // 100]
    return tuple((float(ra), float(dec)) for ra, dec in expected["boresights"][order])


def star_noise(bench: Bench, mag: float, rate_deg_s: float) -> dict[str, float]:
    """Measure the centroids of many stars of one magnitude, twice each.

    The noise comes from the difference of the two, so that it contains nothing else: neither the
    sampling of the spot nor the differences between pixels.
    """
    key = zlib.crc32(f"{mag:g} {rate_deg_s:g}".encode())
    generator = np.random.default_rng([bench.seed, key])
    smear_px = bench.smear_px(rate_deg_s)
    reach = _REACH_PX + 0.5 * smear_px
    grid = [
        np.arange(0.5, size / (_PITCH_PX + smear_px) - 0.5) * (_PITCH_PX + smear_px)
        for size in (bench.camera.width_px, bench.camera.height_px)
    ]
    places = np.stack(np.meshgrid(*grid), axis=-1).reshape(-1, 2)
    differences, detected, tried = [], 0, 0
    while tried < _MIN_SPOTS:
        lit = places + generator.random(places.shape) + 0.25 * _PITCH_PX
        pair = [
            _nearest(image, lit, reach) for image in _twice(bench, lit, mag, rate_deg_s, generator)
        ]
        both = np.isfinite(pair[0][:, 0]) & np.isfinite(pair[1][:, 0])
        differences.append((pair[0] - pair[1])[both])
        detected += sum(int(np.isfinite(centroids[:, 0]).sum()) for centroids in pair)
        tried += len(lit)
    apart = np.concatenate(differences)
    noise_px = float(np.sqrt(0.5 * (apart**2).mean())) if len(apart) else math.nan
    return {
        "mag": mag,
        "rate_deg_s": rate_deg_s,
        "found": detected,
        "count": 2 * tried,
        "numbers": 2 * len(apart),
        "noise_arcsec": noise_px / bench.camera.focal_length_px * ARCSEC,
        "closed_form_arcsec": float(centroid_noise_px(bench, np.array(mag)))
        / bench.camera.focal_length_px * ARCSEC,
    }  # fmt: skip


def _twice(
    bench: Bench, places: Pixels, mag: float, rate_deg_s: float, generator: np.random.Generator
) -> list[Pixels]:
    """Return the spots of two frames of the same stars, on identical pixels."""
    moved, fainter = bench.trail_px(rate_deg_s, generator)
    lit = (places[None] + moved[:, None]).reshape(-1, 2)
    mean = bench.light(lit, np.full(len(lit), mag + fainter)) + bench.sensor.background_e
    return [bench.centroids(bench.recorded(mean, generator)) for _ in range(2)]


def _nearest(spots: Pixels, places: Pixels, reach_px: float) -> Pixels:
    """Return the nearest spot of each place; NaN if there is none within reach."""
    if not len(spots):
        return np.full(places.shape, np.nan)
    distance, row = cKDTree(spots).query(places)
    nearest = spots[np.asarray(row)].copy()
    nearest[np.asarray(distance) > reach_px] = np.nan
    return nearest


def _task(
    database: Path, sensor: Sensor, seed: int, method: str | None, work: tuple[Any, ...]
) -> tuple[Any, Any]:
    """Do one piece of work: pointings of a trial, or a magnitude at a rate."""
    bench = cached_bench(database, sensor, seed, method)
    if isinstance(work[0], SensorTrial):
        trial, first, last = work
        return (trial.name, first), [point(bench, trial, k) for k in range(first, last)]
    return work, star_noise(bench, *work)


def run_trials(
    database: Path,
    sensor: Sensor,
    seed: int,
    method: str | None,
    trials: Sequence[SensorTrial],
    stars: Sequence[tuple[float, float]],
    workers: int,
    progress: Progress,
) -> tuple[dict[str, list[dict[str, Any]]], list[dict[str, float]]]:
    """Run all trials; return the records of each by its name, and the noise of single stars."""
    chunks = [
        (trial, first, min(first + _CHUNK, trial.pointings))
        for trial in trials
        for first in range(0, trial.pointings, _CHUNK)
    ]
    calls = [(database, sensor, seed, method, work) for work in [*chunks, *stars]]
    done: dict[Any, Any] = {}
    progress("frames", 0, len(calls))
    with side_by_side(_task, calls, workers) as finished:
        for key, value in finished:
            done[key] = value
            progress("frames", len(done), len(calls))
    return _by_trial(trials, chunks, done), [done[star] for star in stars]


def _by_trial(
    trials: Sequence[SensorTrial],
    chunks: Sequence[tuple[SensorTrial, int, int]],
    done: Mapping[Any, Any],
) -> dict[str, list[dict[str, Any]]]:
    records: dict[str, list[dict[str, Any]]] = {trial.name: [] for trial in trials}
    for trial, first, _ in chunks:
        records[trial.name] += done[trial.name, first]
    return records
