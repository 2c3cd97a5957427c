"""How starlight is turned on its way: by parallax, by the mass of the Sun, by aberration.

A catalog says where a star is seen from the middle of the solar system, at rest. An observer
elsewhere sees it shifted by parallax (at most 0.8 arcsec), bent by the Sun (4 mas at 90 deg from
it, 1.75 arcsec at its limb) and displaced in the direction of his own motion (20.5 arcsec for the
Earth, 5 arcsec more in a low orbit). Directions are unit vectors in ICRS axes, in and out.
"""

from __future__ import annotations

import numpy as np

from starcat.arrays import Array

LIGHT_KM_S = 299_792.458
"""Speed of light in vacuum (exact)."""

AU_KM = 149_597_870.7
"""Astronomical unit (IAU 2012 Resolution B2, exact)."""

_SUN_RADIUS_AU = 1.974_125_743_36e-8
"""Schwarzschild radius of the Sun, au: ``2 GM / c^2``."""

_MAS = np.radians(1.0 / 3_600_000.0)


def displaced_by_parallax(u: Array, parallax_mas: Array, observer_au: Array) -> Array:
    """Return directions as seen from a place that is not the barycentre.

    The observer is at a barycentric position in au; a parallax that is NaN counts as 0.
    """
    parallax_rad = np.nan_to_num(parallax_mas) * _MAS
    return _unit(u - parallax_rad[:, None] * observer_au)


def deflected(u: Array, from_sun_au: Array) -> Array:
    """Return directions of stars as the mass of the Sun bends their light.

    ``from_sun_au`` is where the observer is, relative to the Sun, not zero. Stars shift away
    from the Sun.

    Within 9 arcmin of the middle of the Sun, behind its disc, the deflection falls to zero
    instead of growing without limit.

    Urban and Seidelmann (eds.) 2013, Explanatory Supplement to the Astronomical Almanac, 3rd
    ed., eq. 7.63; the limit is that of SOFA's ``iauLdsun``.
    """
    distance_au = float(np.sqrt(from_sun_au @ from_sun_au))
    e = from_sun_au / distance_au
    limit = 1e-6 / max(distance_au * distance_au, 1.0)
    cosine = u @ e
    weight = _SUN_RADIUS_AU / distance_au / np.maximum(1.0 + cosine, limit)
    return _unit(u + weight[:, None] * (e - cosine[:, None] * u))


def aberrated(u: Array, velocity_km_s: Array) -> Array:
    """Return directions as a moving observer sees them.

    Stars shift towards the velocity; with the opposite velocity the same function takes them
    back.

    Exact in special relativity. What SOFA's ``iauAb`` adds for the potential of the Sun is below
    a microarcsecond.

    Urban and Seidelmann (eds.) 2013, eq. 7.40.

    >>> v = np.array([0.0, 29.8, 0.0])
    >>> shifted = aberrated(np.array([[1.0, 0.0, 0.0]]), v)
    >>> round(float(np.degrees(shifted[0, 1])) * 3600, 1)
    20.5
    """
    beta = velocity_km_s / LIGHT_KM_S
    slower = np.sqrt(1.0 - beta @ beta)
    along = u @ beta
    return _unit(slower * u + (1.0 + along / (1.0 + slower))[:, None] * beta)


def _unit(u: Array) -> Array:
    return np.asarray(u / np.sqrt(np.einsum("ij,ij->i", u, u))[:, None])
