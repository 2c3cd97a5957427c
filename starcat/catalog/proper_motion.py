"""Moving positions from one epoch to another.

A star moves in a straight line at constant speed in space. Without radial velocity and
parallax that line is the tangent at its catalog position: the direction is the unit vector
of ``p + mu dt``. The form has no cosine of the declination to divide by, so it is exact at
the poles too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from starcat.sphere import directions_from_radec, radec_from_directions, tangent_axes

Array = NDArray[np.float64]

MAS = np.pi / (180.0 * 3600.0 * 1000.0)  # rad in a milliarcsecond


@dataclass(frozen=True)
class Motion:
    """Positions and proper motions at one epoch, all of shape (N,).

    Attributes
    ----------
    ra_deg, dec_deg : ndarray of float64
        Degrees, ICRS.
    pm_ra_cosdec_mas_yr, pm_dec_mas_yr : ndarray of float64
        Milliarcseconds a year; NaN where unknown.
    """

    ra_deg: Array
    dec_deg: Array
    pm_ra_cosdec_mas_yr: Array
    pm_dec_mas_yr: Array


def propagate(motion: Motion, years: ArrayLike) -> Motion:
    """Move positions by a number of Julian years.

    Parameters
    ----------
    motion : Motion
        Positions and proper motions at the first epoch; a star without proper motion stays.
    years : array_like of float64, shape (N,) or ()
        Second epoch minus first, Julian years.

    Returns
    -------
    Motion
        At the second epoch; the proper motion is the derivative there.

    References
    ----------
    ESA SP-1200 (1997), vol. 1, eqs. 1.5.21 and 1.5.22 with zero parallax.
    """
    unknown = np.isnan(motion.pm_ra_cosdec_mas_yr) | np.isnan(motion.pm_dec_mas_yr)
    pm_ra = np.where(unknown, 0.0, motion.pm_ra_cosdec_mas_yr) * MAS
    pm_dec = np.where(unknown, 0.0, motion.pm_dec_mas_yr) * MAS
    east, north = tangent_axes(motion.ra_deg, motion.dec_deg)
    velocity = pm_ra[:, None] * east + pm_dec[:, None] * north
    start = directions_from_radec(motion.ra_deg, motion.dec_deg)
    end = start + velocity * np.broadcast_to(years, len(start))[:, None]
    length = np.sqrt(np.einsum("ij,ij->i", end, end))[:, None]
    direction = end / length
    # d/dt of p/|p|: the part of the velocity across the new direction, slowed by the distance.
    along = np.einsum("ij,ij->i", velocity, direction)[:, None]
    rate = (velocity - along * direction) / length
    moved = (pm_ra != 0.0) | (pm_dec != 0.0)
    ra_deg, dec_deg = radec_from_directions(direction)
    ra_deg = np.where(moved, ra_deg, motion.ra_deg)
    dec_deg = np.where(moved, dec_deg, motion.dec_deg)
    east, north = tangent_axes(ra_deg, dec_deg)
    pm_ra_end = np.einsum("ij,ij->i", rate, east) / MAS
    pm_dec_end = np.einsum("ij,ij->i", rate, north) / MAS
    return Motion(
        ra_deg,
        dec_deg,
        np.where(unknown, motion.pm_ra_cosdec_mas_yr, pm_ra_end),
        np.where(unknown, motion.pm_dec_mas_yr, pm_dec_end),
    )
