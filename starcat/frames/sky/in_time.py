"""The sky at a time: what an observer sees, and frames identified with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from starcat.arguments import check_type, numbers_of, wrong_type
from starcat.arrays import Array, Matrix, Pixels
from starcat.frames.sky.bodies import RADII_KM, Bodies, bodies_seen
from starcat.frames.sky.observer import AU_KM, Observer
from starcat.geometry.attitude import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    radec_roll_from_matrix,
    solve_wahba_svd,
)
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import separation
from starcat.matcher.database import MatcherDatabase, as_database
from starcat.matcher.observation import FrameLike, as_frame
from starcat.matcher.result import MatchResult
from starcat.matcher.settings import CERTAIN, TOLERANCE_PX
from starcat.resources import PathLike

# A body is looked for if it is at most this much fainter than the database's faintest star.
FAINTER_MAG = 1.0

# A body that is larger, as the Earth is from an orbit, has no spot.
LARGEST_SPOT_RAD = np.radians(1.0)
BRIGHTEST = 3  # number of brightest spots that are tried as planets in an unidentified frame


def identify_in_time(
    identify: Callable[..., MatchResult],
    database: MatcherDatabase | PathLike,
    centroids_px: FrameLike,
    camera: Camera,
    observer: Observer,
    *,
    mag: ArrayLike | None = None,
    tolerance_px: float = TOLERANCE_PX,
    max_false_match_probability: float = CERTAIN,
) -> MatchResult:
    """Identify a frame that can contain planets.

    Parameters
    ----------
    identify : callable
        `Matcher.identify`, its camera and options filled in.
    database, observer : MatcherDatabase (or Database or path), Observer
        The stars that it names; when and from where the frame was taken.
    centroids_px, mag : array_like of float64, shape (N, 2) and (N,)
        Pixels, or a frame or a table as for `Matcher.identify`; magnitudes of any zero point.
    camera : Camera
        The camera that took the frame; a focal length that the answer has found counts instead.
    tolerance_px, max_false_match_probability : float
        As of `Matcher`; the error of the ephemeris is added to the tolerance of planets.

    Returns
    -------
    MatchResult
        Spots of planets are in ``dropped``, by the planet's name in small letters. A frame that is
        not identified is tried again without one or two of its three brightest spots; such an
        answer counts if planets are there, with the probability of all these searches.

    Raises
    ------
    TypeError
        If `identify` is not callable, or `camera` or `observer` have another type.
    ConfigError
        If a number is out of range, or the frame cannot be read.
    """
    if not callable(identify):
        raise wrong_type("identify", identify, "a function, such as Matcher.identify")
    check_type("camera", camera, Camera, "a starcat.Camera")
    check_type("observer", observer, Observer, "a starcat.Observer")
    database = as_database("database", database)
    observed = as_frame(centroids_px, camera, mag)
    frame, frame_mag = observed.centroids_px, observed.mag
    answer = identify(frame, mag=frame_mag)

    def rows_of(result: MatchResult) -> dict[int, str]:
        if result.status != "identified":
            return {}
        eye = result.camera or camera
        matrix = _apparent_matrix(result, eye, frame, observer)
        star_mag = np.where(result.star_index >= 0, database.mag[result.star_index], np.nan)
        return planets_among(
            frame, matrix, eye, bodies_seen(observer), mag=frame_mag, star_mag=star_mag,
            tolerance_px=tolerance_px, faint_limit_mag=float(database.mag.max()),
        )  # fmt: skip

    if answer.status == "identified":
        names = rows_of(answer)
        return _without(identify, frame, frame_mag, names) if names else answer
    for left_out in (questions := _bright_rows(frame_mag)):
        again = identify(_unset(frame, left_out), mag=frame_mag)
        names = rows_of(again)
        chance = again.false_match_probability * (1 + len(questions))
        if set(left_out) <= set(names) and chance <= max_false_match_probability:
            again = _without(identify, frame, frame_mag, names)
            if again.status == "identified":
                return replace(again, false_match_probability=chance)
    return answer


def planets_among(
    centroids_px: Pixels,
    matrix: Matrix,
    camera: Camera,
    seen: Bodies,
    *,
    mag: Array | None = None,
    star_mag: Array | None = None,
    tolerance_px: float = TOLERANCE_PX,
    faint_limit_mag: float = np.inf,
) -> dict[int, str]:
    """Return which centroids are planets, the Moon or the Sun.

    The matrix is of apparent directions; ``star_mag`` are magnitudes of the stars that were
    found for the centroids, NaN without a star. The result maps the row of a centroid to the
    name of the body in small letters. Of several centroids within reach of a body the brightest
    is its spot, or the nearest without magnitudes. A centroid keeps its star if the star is
    brighter than the planet, or if the body is the Sun or the Moon and shows a disc.
    """
    rows: dict[int, str] = {}
    places_px = camera.pixels_from_directions(seen.directions @ matrix.T)
    assigned_mag = np.full(len(centroids_px), np.nan) if star_mag is None else star_mag
    sought = (seen.mag <= faint_limit_mag + FAINTER_MAG) & (seen.radius_rad < LARGEST_SPOT_RAD)
    sought &= np.isfinite(places_px[:, 0])
    # Planets come before bodies with a disc, on which their spot can lie.
    has_disc = seen.radius_rad * camera.focal_length_px >= tolerance_px
    for body in np.lexsort((seen.mag, has_disc)):
        if not sought[body]:
            continue
        disc_px = float(seen.radius_rad[body]) * camera.focal_length_px
        reach_px = tolerance_px + disc_px + float(seen.error_rad[body]) * camera.focal_length_px
        distance = np.hypot(*(centroids_px - places_px[body]).T)
        free = np.isnan(assigned_mag) | ((assigned_mag > seen.mag[body]) & ~has_disc[body])
        free[list(rows)] = False
        near = np.flatnonzero((distance <= reach_px) & free)
        if len(near):
            rank = distance if mag is None else np.nan_to_num(mag, nan=np.inf)
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
    return [subset for size in (1, 2) for subset in combinations(rows, size)]


def _unset(frame: Array, rows: tuple[int, ...]) -> Array:
    kept = frame.copy()
    kept[list(rows)] = np.nan
    return kept


def _without(
    identify: Callable[..., MatchResult], frame: Array, mag: Array | None, names: dict[int, str]
) -> MatchResult:
    """Identify a frame without the spots of planets, and name the planets in the answer."""
    result = identify(_unset(frame, tuple(names)), mag=mag)
    dropped = tuple((row, names.get(row, reason)) for row, reason in result.dropped)
    return result.with_facts(dropped=dropped)


@dataclass(frozen=True)
class BodyInFrame:
    """A body of the solar system in the field.

    Attributes
    ----------
    name : str
        Such as ``Jupiter``.
    x_px, y_px : float
        Position of its middle in the frame.
    mag : float
        Magnitude, V.
    radius_arcsec : float
        Half of its angular diameter.
    from_boresight_deg : float
        Angle from the boresight.
    row : int or None
        Row of the centroid that is its spot; None if no centroid is.
    """

    name: str
    x_px: float
    y_px: float
    mag: float
    radius_arcsec: float
    from_boresight_deg: float
    row: int | None


@dataclass(frozen=True, eq=False)
class SkyInTime:
    """Results for a frame that need its time.

    Attributes
    ----------
    time : str
        UTC, ISO 8601.
    q_body_from_icrs : ndarray of float64, shape (4,)
        Attitude with light deflection and aberration taken into account, in the convention of
        `MatchResult`.
    boresight_ra_deg, boresight_dec_deg, roll_deg : float
        The same as angles.
    correction_arcsec : float
        Angle of the rotation between this attitude and the answer's attitude.
    residual_arcsec : float
        Root mean square angle between the centroids and the apparent stars.
    bodies : tuple of BodyInFrame
        Bodies in the frame, brightest first.
    sun_angle_deg, moon_angle_deg : float
        Angles from the boresight to their middles. Without a position of the observer the angle
        of the Moon is good to 1 deg.
    earth_limb_angle_deg : float or None
        Angle from the boresight to the limb of the Earth, a sphere of 6378.137 km without
        atmosphere; negative if the boresight points at the Earth. None without a position.
    """

    time: str
    q_body_from_icrs: Array
    boresight_ra_deg: float
    boresight_dec_deg: float
    roll_deg: float
    correction_arcsec: float
    residual_arcsec: float
    bodies: tuple[BodyInFrame, ...]
    sun_angle_deg: float
    moon_angle_deg: float
    earth_limb_angle_deg: float | None

    def content(self) -> dict[str, Any]:
        """Return the values for JSON, under the key ``in_time`` of an answer."""
        return {**asdict(self), "q_body_from_icrs": self.q_body_from_icrs.tolist()}


def sky_in_time(
    result: MatchResult,
    database: MatcherDatabase | PathLike,
    centroids_px: FrameLike,
    camera: Camera,
    observer: Observer,
    *,
    parallax_mas: ArrayLike | None = None,
) -> SkyInTime | None:
    """Return the results for a frame that need its time.

    Parameters
    ----------
    result : MatchResult
        The answer, best of `starcat.frames.sky.in_time.identify_in_time`.
    database : MatcherDatabase, Database, str or path-like
        The stars that it names.
    centroids_px : array_like of float64, shape (N, 2)
        The frame.
    camera : Camera
        The camera, with the focal length that the frame was identified with.
    observer : Observer
        When, from where and how fast.
    parallax_mas : array_like of float64, shape (S,), optional
        Parallaxes of the database's stars, mas, NaN where unknown. The databases themselves
        have none; a parallax moves a star by 0.8 arcsec at most.

    Returns
    -------
    SkyInTime or None
        None unless the frame is identified.

    Raises
    ------
    TypeError
        If `result`, `camera` or `observer` have another type.
    ConfigError
        If the frame, or the number of parallaxes, does not belong to the answer.
    """
    check_type("result", result, MatchResult, "a MatchResult, as Matcher.identify returns it")
    check_type("camera", camera, Camera, "a starcat.Camera")
    check_type("observer", observer, Observer, "a starcat.Observer")
    if result.status != "identified":
        return None
    database = as_database("database", database)
    frame = as_frame(centroids_px, camera).centroids_px
    rows = np.flatnonzero(result.star_index >= 0)
    stars = result.star_index[rows]
    parallax = None
    if parallax_mas is not None:
        parallax = numbers_of("parallax_mas", parallax_mas, "(S,), one per star")[stars]
    icrs = observer.apparent(database.directions[stars], parallax)
    body = camera.directions_from_pixels(frame[rows])
    matrix = solve_wahba_svd(body, icrs)
    before = matrix_from_quaternion(result.q_body_from_icrs)
    miss = body - icrs @ matrix.T
    ra_deg, dec_deg, roll_deg = radec_roll_from_matrix(matrix)
    seen = bodies_seen(observer)
    angle_deg = np.degrees(separation(seen.directions, matrix[2]))
    return SkyInTime(
        observer.in_words,
        quaternion_from_matrix(matrix),
        ra_deg,
        dec_deg,
        roll_deg,
        _angle_arcsec(matrix @ before.T),
        float(np.degrees(np.sqrt(np.vdot(miss, miss) / len(rows))) * 3600.0),
        _in_frame(seen, matrix, camera, angle_deg, {name: row for row, name in result.dropped}),
        float(angle_deg[seen.row("Sun")]),
        float(angle_deg[seen.row("Moon")]),
        earth_limb_angle_deg(matrix[2], observer),
    )


def earth_limb_angle_deg(boresight: Array, observer: Observer) -> float | None:
    """Return the angle from a boresight (apparent, ICRS axes) to the limb of the Earth.

    Degrees, negative if the Earth is in the boresight; None without a position.
    """
    if not observer.is_placed:
        return None
    # Light time and the Earth's own motion cancel; only the orbit's 5 arcsec would be left.
    away_km = (observer.position_au - observer.earth_au) * AU_KM
    distance_km = float(np.sqrt(away_km @ away_km))
    middle = float(separation(-away_km / distance_km, boresight)) if distance_km else 0.0
    half = np.arcsin(RADII_KM["Earth"] / max(distance_km, RADII_KM["Earth"]))
    return float(np.degrees(middle - half))


def _angle_arcsec(rotation: Array) -> float:
    # The antisymmetric part is sin(angle) times the axis: exact for the small angles here.
    x, y, z = (
        rotation[2, 1] - rotation[1, 2],
        rotation[0, 2] - rotation[2, 0],
        rotation[1, 0] - rotation[0, 1],
    )
    sine = 0.5 * np.sqrt(x * x + y * y + z * z)
    return float(np.degrees(np.arctan2(sine, 0.5 * (np.trace(rotation) - 1.0))) * 3600.0)


def _in_frame(
    seen: Bodies, matrix: Matrix, camera: Camera, angle_deg: Array, rows: dict[str, int]
) -> tuple[BodyInFrame, ...]:
    places_px = camera.pixels_from_directions(seen.directions @ matrix.T)
    inside = camera.contains(places_px)
    return tuple(
        BodyInFrame(
            seen.names[body],
            float(places_px[body, 0]),
            float(places_px[body, 1]),
            float(seen.mag[body]),
            float(np.degrees(seen.radius_rad[body]) * 3600.0),
            float(angle_deg[body]),
            rows.get(seen.names[body].lower()),
        )
        for body in np.argsort(seen.mag, kind="stable")
        if inside[body]
    )
