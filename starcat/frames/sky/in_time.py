"""The sky at a time: planets in an identified frame, and its attitude without aberration."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from starcat.arguments import check_type, numbers_of
from starcat.arrays import Array, Matrix, Pixels
from starcat.errors import ConfigError
from starcat.frames.sky.bodies import RADII_KM, Bodies, bodies_seen
from starcat.frames.sky.observer import AU_KM, Observer
from starcat.geometry.attitude import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    radec_roll_from_matrix,
)
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import separation
from starcat.matcher.result import MatchResult
from starcat.matcher.settings import NOISE_DEVIATIONS, TOLERANCE_PX

# A body is looked for if it is at most this much fainter than the database's faintest star.
FAINTER_MAG = 1.0

# A body that is larger, as the Earth is from an orbit, has no spot.
LARGEST_SPOT_RAD = np.radians(1.0)


def with_planets(result: MatchResult, observer: Observer) -> MatchResult:
    """Return an answer whose spots of planets are named and are no stars.

    Parameters
    ----------
    result : MatchResult
        The answer, with the frame that was searched.
    observer : Observer
        When and from where the frame was taken.

    Returns
    -------
    MatchResult
        Spots of planets are in ``dropped``, by the planet's name in small letters. If a spot had
        been taken for a fainter star, the attitude is fitted again without it.

    Raises
    ------
    TypeError
        If `result` or `observer` have another type.
    ConfigError
        If the result does not hold its frame, as after pickling.
    """
    check_type("result", result, MatchResult, "a MatchResult, as Matcher.identify returns it")
    check_type("observer", observer, Observer, "a starcat.Observer")
    if not result.ok:
        return result
    frame, camera, database = result.searched
    names = planets_among(
        result.unshaped_px,
        _apparent_attitude(result, observer)[0],
        camera,
        bodies_seen(observer),
        mag=frame.mag,
        star_mag=np.where(result.star_index >= 0, database.mag[result.star_index], np.nan),
        tolerance_px=NOISE_DEVIATIONS * result.otherwise_px,
        faint_limit_mag=float(database.mag.max()),
    )
    return result.without_stars(names) if names else result


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


def _apparent_attitude(
    result: MatchResult, observer: Observer, parallax_mas: Array | None = None
) -> tuple[Matrix, float]:
    """Return the attitude by the apparent directions of the stars, and its residual in radians."""
    stars = result.star_index[result.star_index >= 0]
    _, _, database = result.searched
    parallax = None if parallax_mas is None else parallax_mas[stars]
    return result.attitude_of(observer.apparent(database.directions[stars], parallax))


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
    result: MatchResult, observer: Observer, *, parallax_mas: ArrayLike | None = None
) -> SkyInTime | None:
    """Return the results for a frame that need its time.

    Parameters
    ----------
    result : MatchResult
        The answer, best of `with_planets`, which names the spots of planets.
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
        If `result` or `observer` have another type.
    ConfigError
        If the result does not hold its frame, as after pickling, or the number of parallaxes is
        not that of the stars.
    """
    check_type("result", result, MatchResult, "a MatchResult, as Matcher.identify returns it")
    check_type("observer", observer, Observer, "a starcat.Observer")
    if not result.ok:
        return None
    _, camera, database = result.searched
    parallax = None
    if parallax_mas is not None:
        parallax = numbers_of("parallax_mas", parallax_mas, "(S,), one per star")
        if parallax.shape != database.mag.shape:
            raise ConfigError(
                f"shape {parallax.shape}; expected {database.mag.shape}, one per star of "
                f"{database.name}",
                parameter="parallax_mas",
            )
    matrix, residual_rad = _apparent_attitude(result, observer, parallax)
    before = matrix_from_quaternion(result.q_body_from_icrs)
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
        float(np.degrees(residual_rad) * 3600.0),
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
