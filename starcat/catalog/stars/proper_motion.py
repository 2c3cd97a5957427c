"""Moving positions from one epoch to another.

A star moves in a straight line at constant speed in space. Without radial velocity and
parallax that line is the tangent at its catalog position: the direction is the unit vector
of ``p + mu dt``. The form has no cosine of the declination to divide by, so it is exact at
the poles too.
"""

from __future__ import annotations

from dataclasses import dataclass

import erfa
import numpy as np
from numpy.typing import ArrayLike

from starcat.arrays import Array, Mask
from starcat.geometry.sphere import directions_from_radec

MAS = np.pi / (180.0 * 3600.0 * 1000.0)  # rad in a milliarcsecond


@dataclass(frozen=True)
class Motion:
    """Positions and proper motions at one epoch, all of shape (N,)."""

    ra_deg: Array  # ICRS, as is dec_deg
    dec_deg: Array
    pm_ra_cosdec_mas_yr: Array  # NaN where either motion is unknown
    pm_dec_mas_yr: Array

    @property
    def is_known(self) -> Mask:
        """Which stars have a proper motion on both axes, shape (N,)."""
        return ~(np.isnan(self.pm_ra_cosdec_mas_yr) | np.isnan(self.pm_dec_mas_yr))


def propagate(motion: Motion, years: ArrayLike) -> Motion:
    """Move positions by a number of Julian years.

    References
    ----------
    ESA SP-1200 (1997), vol. 1, eqs. 1.5.21 and 1.5.22 with zero parallax.
    """
    return propagate_directions(motion, years)[0]


def propagate_directions(motion: Motion, years: ArrayLike) -> tuple[Motion, Array]:
    """Move positions as `propagate` does, and return the directions too."""
    unknown = ~motion.is_known
    pm_ra = np.where(unknown, 0.0, motion.pm_ra_cosdec_mas_yr) * MAS
    pm_dec = np.where(unknown, 0.0, motion.pm_dec_mas_yr) * MAS
    elapsed = np.asarray(years, dtype=np.float64)
    ra, dec = np.radians(motion.ra_deg), np.radians(motion.dec_deg)
    sin_ra, cos_ra, sin_dec, cos_dec = np.sin(ra), np.cos(ra), np.sin(dec), np.cos(dec)
    # The velocity along east (-sin ra, cos ra, 0) and north (-sin dec cos ra, ...), each component
    # separately: for millions of stars this is several times faster than rows of vectors.
    inward = -pm_dec * sin_dec
    vx = inward * cos_ra - pm_ra * sin_ra
    vy = inward * sin_ra + pm_ra * cos_ra
    vz = pm_dec * cos_dec
    u = np.empty((len(ra), 3))
    u[:, 0], u[:, 1], u[:, 2] = cos_dec * cos_ra, cos_dec * sin_ra, sin_dec
    for axis, v in enumerate((vx, vy, vz)):
        u[:, axis] += v * elapsed
    length = np.sqrt(np.einsum("ij,ij->i", u, u))
    u /= length[:, None]
    x, y, z = u[:, 0], u[:, 1], u[:, 2]
    ground = np.hypot(x, y)
    moved = (pm_ra != 0.0) | (pm_dec != 0.0)
    ra_deg = np.where(moved, np.degrees(np.arctan2(y, x)), motion.ra_deg)
    ra_deg = np.where(moved & (ra_deg < 0.0), ra_deg + 360.0, ra_deg)
    ra_deg = np.where(moved & (ra_deg >= 360.0), 0.0, ra_deg)
    dec_deg = np.where(moved, np.degrees(np.arctan2(z, ground)), motion.dec_deg)
    # East at the end is (-y, x, 0) / ground. At a pole, where this is 0 / 0, the right ascension
    # at the start determines the direction of east.
    off_pole = ground > 0.0
    cos_end = np.divide(x, ground, out=cos_ra, where=off_pole)
    sin_end = np.divide(y, ground, out=sin_ra, where=off_pole)
    # The derivative of p / |p| along east and north at the end: as the star moves away on its
    # straight line, the same speed is a smaller angle per year.
    pm_ra_end = (vy * cos_end - vx * sin_end) / (length * MAS)
    pm_dec_end = (vz * ground - (vx * cos_end + vy * sin_end) * z) / (length * MAS)
    end = Motion(
        ra_deg,
        dec_deg,
        np.where(unknown, motion.pm_ra_cosdec_mas_yr, pm_ra_end),
        np.where(unknown, motion.pm_dec_mas_yr, pm_dec_end),
    )
    return end, u


def propagate_in_space(
    motion: Motion, parallax_mas: Array, velocity_km_s: Array, from_jyear: Array, to_jyear: Array
) -> tuple[Motion, Array]:
    """Move positions, in space for stars with a parallax, and return the directions too.

    An unknown radial velocity counts as 0. Without a parallax above 0 a star moves as with
    `propagate`.

    References
    ----------
    IAU SOFA, routine iauPmsafe: a straight line in space, with light time.
    """
    moved, u = propagate_directions(motion, to_jyear - from_jyear)
    motions = motion.pm_ra_cosdec_mas_yr, motion.pm_dec_mas_yr
    is_whole = ~np.isnan(motions[0] + motions[1] + motion.ra_deg + motion.dec_deg)
    rows = np.flatnonzero((parallax_mas > 0.0) & is_whole)
    if not len(rows):
        return moved, u
    ra, dec = np.radians(motion.ra_deg[rows]), np.radians(motion.dec_deg[rows])
    begin, end = (np.broadcast_to(year, len(u))[rows] for year in (from_jyear, to_jyear))
    # The last value is a status: of stars whose parallax is too small for their motion. The wrapper
    # `erfa.pmsafe` would warn of them, and a filter of warnings counts for all threads.
    ra, dec, pm_ra, pm_dec, _, _, _ = erfa.ufunc.pmsafe(
        ra,
        dec,
        motions[0][rows] * MAS / np.cos(dec),
        motions[1][rows] * MAS,
        parallax_mas[rows] / 1000.0,
        np.nan_to_num(velocity_km_s[rows]),
        *erfa.epj2jd(begin),
        *erfa.epj2jd(end),
    )
    u[rows] = directions_from_radec(np.degrees(ra), np.degrees(dec))
    columns = [np.array(getattr(moved, name)) for name in Motion.__dataclass_fields__]
    values = np.degrees(ra) % 360.0, np.degrees(dec), pm_ra * np.cos(dec) / MAS, pm_dec / MAS
    for column, value in zip(columns, values, strict=True):
        column[rows] = value
    return Motion(*columns), u


def central_error(
    error_mas: Array, pm_error_mas_yr: Array, correlation: Array, epoch_jyear: float
) -> tuple[Array, Array]:
    """Return the position error of an axis at its central epoch, and that epoch.

    There position and proper motion are independent: years later the variance of the position is
    the variance at that epoch plus the years squared times the variance of the motion. If one of
    the three arrays, of shape (N,), has no value, the error stays at its own epoch.
    """
    shift = -correlation * error_mas / pm_error_mas_yr
    is_whole = np.isfinite(shift)
    smaller = error_mas * np.sqrt(1.0 - np.where(is_whole, correlation, 0.0) ** 2)
    return smaller, epoch_jyear + np.where(is_whole, shift, 0.0)
