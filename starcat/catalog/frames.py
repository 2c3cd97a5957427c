"""Positions and proper motions in FK4, FK5 of any equinox, or galactic coordinates, to ICRS."""

from __future__ import annotations

from typing import Any

import erfa
import numpy as np

from starcat.arrays import Array
from starcat.catalog.archives.sao import icrs_from_fk5
from starcat.catalog.table_map import TableMap
from starcat.geometry.sphere import directions_from_radec, radec_from_directions, tangent_axes

_HALF_YEAR = 0.5


def icrs_from(
    table: TableMap, ra: Array, dec: Array, epoch: float | Array, pm_ra: Array, pm_dec: Array
) -> tuple[Array, Array, Array, Array]:
    """Transform positions and proper motions from the frame of a map to ICRS.

    The positions half a year before and after the epoch are each transformed at their own time,
    and their difference is the proper motion. So it includes the rotation of FK4.
    """
    start = directions_from_radec(ra, dec)
    east, north = tangent_axes(ra, dec)
    mas = np.pi / 648_000_000.0
    step = _HALF_YEAR * mas * (pm_ra[:, None] * east + pm_dec[:, None] * north)
    when = np.where(np.isnan(epoch), 2000.0, epoch)
    here, *ends = (
        _turned(table, directions, when + years)
        for directions, years in (
            (start, 0.0),
            (start - step, -_HALF_YEAR),
            (start + step, _HALF_YEAR),
        )
    )
    if table.frame != "galactic":  # FK5 rotates relative to ICRS, and agrees with it at J2000
        here = here + np.cross(here, erfa.fk5hip()[1]) * np.reshape(when - 2000.0, (-1, 1))
    ra, dec = radec_from_directions(here)
    east, north = tangent_axes(ra, dec)
    velocity = (ends[1] - ends[0]) / (2.0 * _HALF_YEAR * mas)
    pm_ra, pm_dec = (np.asarray(np.einsum("ij,ij->i", velocity, axis)) for axis in (east, north))
    if table.frame == "galactic":
        return ra, dec, pm_ra, pm_dec
    return icrs_from_fk5(ra, dec, pm_ra, pm_dec)


def _turned(table: TableMap, directions: Array, jyear: Array) -> Array:
    """Return directions in ICRS, or in FK5 at J2000."""
    from astropy.coordinates import FK4, FK5, ICRS, Galactic, SkyCoord
    from astropy.time import Time

    frame: Any = Galactic()
    if table.frame == "FK5":
        frame = FK5(equinox=table.equinox or "J2000")
    if table.frame == "FK4":
        moment = Time(jyear, format="jyear", scale="tt")
        frame = FK4(equinox=table.equinox or "B1950", obstime=moment)
    lon, lat = radec_from_directions(directions)
    blank = np.isnan(lon) | np.isnan(lat)
    coordinates = SkyCoord(
        np.where(blank, 0.0, lon), np.where(blank, 0.0, lat), unit="deg", frame=frame
    )
    vectors = coordinates.transform_to(
        ICRS() if table.frame == "galactic" else FK5(equinox="J2000")
    ).cartesian.xyz.value.T
    return np.where(blank[:, None], np.nan, vectors)
