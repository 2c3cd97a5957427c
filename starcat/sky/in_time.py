"""An answer at a known time: the true attitude, the bodies in the field, exclusion angles.

A frame is identified with the directions of the catalog. Aberration hardly matters there: turning
the camera by up to 26 arcsec makes up for nearly all of it, and what is left in a frame of 1280 x
960 px is 0.09 px in a corner of a field of 2 to 20 deg, 0.11 px of 50 deg, 0.16 px of 90 deg. It
does matter in the attitude. So the apparent directions of the matched stars are computed, and the
attitude is fitted to them again.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from starcat.arguments import numbers_of
from starcat.arrays import Array, Matrix
from starcat.geometry.attitude import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    radec_roll_from_matrix,
    solve_wahba_svd,
)
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import separation
from starcat.matcher.database import Database, as_database
from starcat.matcher.observation import as_frame
from starcat.matcher.result import MatchResult
from starcat.resources import PathLike
from starcat.sky.bodies import RADII_KM, Bodies, bodies_seen
from starcat.sky.observer import AU_KM, Observer


@dataclass(frozen=True)
class BodyInFrame:
    """A body of the solar system in the field.

    Attributes
    ----------
    name : str
        Such as ``Jupiter``.
    x_px, y_px : float
        Where its middle is in the frame.
    mag : float
        Magnitude, V.
    radius_arcsec : float
        Half of what it subtends.
    from_boresight_deg : float
        Angle from the boresight.
    row : int or None
        Row of the centroid that is its spot; None where there is none.
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
    """What a time adds to the answer to a frame.

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
        Angle of the rotation between this attitude and that of the answer.
    residual_arcsec : float
        Root mean square angle between the centroids and the apparent stars.
    bodies : tuple of BodyInFrame
        Those in the frame, brightest first.
    sun_angle_deg, moon_angle_deg : float
        From the boresight to their middles. Without a position of the observer that of the Moon
        is good to 1 deg.
    earth_limb_angle_deg : float or None
        From the boresight to the limb of the Earth, a sphere of 6378.137 km without atmosphere;
        negative where the boresight points at the Earth. None without a position.
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
        """Return it as JSON has it, under the key ``in_time`` of an answer."""
        return {**asdict(self), "q_body_from_icrs": self.q_body_from_icrs.tolist()}


def sky_in_time(
    result: MatchResult,
    database: Database | PathLike,
    centroids_px: ArrayLike,
    camera: Camera,
    observer: Observer,
    *,
    parallax_mas: ArrayLike | None = None,
) -> SkyInTime | None:
    """Return what the time adds to the answer to a frame.

    Parameters
    ----------
    result : MatchResult
        The answer, best of `starcat.sky.spots.identify_in_time`.
    database : Database, Artifact, str or path-like
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
    """
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

    Degrees, negative where the Earth is in the boresight; None without a position.
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
    places = camera.pixels_from_directions(seen.directions @ matrix.T)
    inside = camera.contains(places)
    return tuple(
        BodyInFrame(
            seen.names[body],
            float(places[body, 0]),
            float(places[body, 1]),
            float(seen.mag[body]),
            float(np.degrees(seen.radius_rad[body]) * 3600.0),
            float(angle_deg[body]),
            rows.get(seen.names[body].lower()),
        )
        for body in np.argsort(seen.mag, kind="stable")
        if inside[body]
    )
