"""Spots of planets: which they are, and identifying a frame that has some.

A planet is brighter than most stars and in no catalog. Its spot is neither a star, whichever one is
near it, nor does it count against an answer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from starcat.arrays import Array, Matrix, Pixels
from starcat.geometry.attitude import matrix_from_quaternion, solve_wahba_svd
from starcat.geometry.camera import Camera
from starcat.matcher.database import Database, as_database
from starcat.matcher.observation import as_frame
from starcat.matcher.result import MatchResult
from starcat.matcher.settings import CERTAIN, TOLERANCE_PX
from starcat.resources import PathLike
from starcat.sky.bodies import Bodies, bodies_seen
from starcat.sky.observer import Observer

# A body is looked for if it is at most this much fainter than the database's faintest star.
FAINTER_MAG = 1.0

# A body that is larger, as the Earth is from an orbit, has no spot.
LARGEST_SPOT_RAD = np.radians(1.0)
BRIGHTEST = 3  # so many of the brightest spots may be planets that a frame was not identified for


def identify_in_time(
    identify: Callable[..., MatchResult],
    database: Database | PathLike,
    centroids_px: ArrayLike,
    camera: Camera,
    observer: Observer,
    *,
    magnitudes: ArrayLike | None = None,
    tolerance_px: float = TOLERANCE_PX,
    max_false_match_probability: float = CERTAIN,
) -> MatchResult:
    """Identify a frame in which planets may be.

    Parameters
    ----------
    identify : callable
        `Matcher.identify`, its camera and options filled in.
    database, observer : Database (or Artifact or path), Observer
        The stars that it names; when and from where the frame was taken.
    centroids_px, magnitudes : array_like of float64, shape (N, 2) and (N,)
        Pixels, and magnitudes of any zero point.
    camera : Camera
        The camera that took the frame; a focal length that the answer has found counts instead.
    tolerance_px, max_false_match_probability : float
        As of `Matcher`; a spot may be off its planet by the error of the ephemeris too.

    Returns
    -------
    MatchResult
        Spots of planets are in ``dropped``, by the planet's name in small letters. A frame that is
        not identified is asked again without one or two of its three brightest spots; such an
        answer counts if planets are there, with the probability of all these questions.
    """
    database = as_database("database", database)
    given = as_frame(centroids_px, camera, magnitudes)
    frame, mag = given.centroids_px, given.magnitudes
    found = identify(frame, magnitudes=mag)

    def rows_of(result: MatchResult) -> dict[int, str]:
        if result.status != "identified":
            return {}
        eye = result.camera or camera
        matrix = _apparent_matrix(result, eye, frame, observer)
        star_mag = np.where(result.star_index >= 0, database.mag[result.star_index], np.nan)
        return planets_among(
            frame, matrix, eye, bodies_seen(observer), magnitudes=mag, star_mag=star_mag,
            tolerance_px=tolerance_px, faint_limit_mag=float(database.mag.max()),
        )  # fmt: skip

    if found.status == "identified":
        names = rows_of(found)
        return _without(identify, frame, mag, names) if names else found
    for left_out in (questions := _bright_rows(mag)):
        again = identify(_unset(frame, left_out), magnitudes=mag)
        names = rows_of(again)
        chance = again.false_match_probability * (1 + len(questions))
        if set(left_out) <= set(names) and chance <= max_false_match_probability:
            again = _without(identify, frame, mag, names)
            if again.status == "identified":
                return replace(again, false_match_probability=chance)
    return found


def planets_among(
    centroids_px: Pixels,
    matrix: Matrix,
    camera: Camera,
    seen: Bodies,
    *,
    magnitudes: Array | None = None,
    star_mag: Array | None = None,
    tolerance_px: float = TOLERANCE_PX,
    faint_limit_mag: float = np.inf,
) -> dict[int, str]:
    """Return which centroids are planets, the Moon or the Sun.

    The matrix is of apparent directions; ``star_mag`` are magnitudes of the stars that were
    found for the centroids, NaN where none. Returned is the name of the body in small letters
    by row of the centroid. Of several centroids within reach of one body the brightest is its
    spot, or the nearest without magnitudes. A spot stays its star's if the star is brighter
    than the planet, or where the body is the Sun or the Moon and shows a disc.
    """
    rows: dict[int, str] = {}
    places = camera.pixels_from_directions(seen.directions @ matrix.T)
    own = np.full(len(centroids_px), np.nan) if star_mag is None else star_mag
    sought = (seen.mag <= faint_limit_mag + FAINTER_MAG) & (seen.radius_rad < LARGEST_SPOT_RAD)
    sought &= np.isfinite(places[:, 0])
    # Planets come before what shows a disc, on which their spot may lie.
    has_disc = seen.radius_rad * camera.focal_length_px >= tolerance_px
    for body in np.lexsort((seen.mag, has_disc)):
        if not sought[body]:
            continue
        disc_px = float(seen.radius_rad[body]) * camera.focal_length_px
        reach_px = tolerance_px + disc_px + float(seen.error_rad[body]) * camera.focal_length_px
        distance = np.hypot(*(centroids_px - places[body]).T)
        free = np.isnan(own) | ((own > seen.mag[body]) & ~has_disc[body])
        free[list(rows)] = False
        near = np.flatnonzero((distance <= reach_px) & free)
        if len(near):
            rank = distance if magnitudes is None else np.nan_to_num(magnitudes, nan=np.inf)
            order = np.lexsort((distance[near], rank[near]))
            rows[int(near[order[0]])] = seen.names[body].lower()
    return rows


def _apparent_matrix(
    result: MatchResult, camera: Camera, frame: Array, observer: Observer
) -> Array:
    body = camera.directions_from_pixels(frame[np.flatnonzero(result.star_index >= 0)])
    icrs = body @ matrix_from_quaternion(result.q_body_from_icrs)
    return solve_wahba_svd(body, observer.apparent(icrs))


def _bright_rows(mag: Array | None) -> list[tuple[int, ...]]:
    if mag is None or not np.isfinite(mag).any():
        return []
    rows = np.argsort(np.nan_to_num(mag, nan=np.inf), kind="stable")[:BRIGHTEST].tolist()
    return [chosen for size in (1, 2) for chosen in combinations(rows, size)]


def _unset(frame: Array, rows: tuple[int, ...]) -> Array:
    kept = frame.copy()
    kept[list(rows)] = np.nan
    return kept


def _without(
    identify: Callable[..., MatchResult], frame: Array, mag: Array | None, names: dict[int, str]
) -> MatchResult:
    """Identify a frame without the spots of planets, and say what they were."""
    found = identify(_unset(frame, tuple(names)), magnitudes=mag)
    dropped = tuple((row, names.get(row, reason)) for row, reason in found.dropped)
    return replace(found, dropped=dropped)
