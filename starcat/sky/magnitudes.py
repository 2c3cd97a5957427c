"""How bright planets are.

After Mallama and Hilton 2018, "Computing apparent planetary magnitudes for The Astronomical
Almanac", Astronomy and Computing 25, 10, V band; without the rotation of Mars (0.06 mag). The Sun
and the Moon are after Allen's Astrophysical Quantities (4th ed., 2000, sections 14.2 and 12.9).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from starcat.arrays import Array

SUN_MAG, MOON_MAG = -26.75, -12.74
"""V of the Sun from 1 au, and of the full Moon from its mean distance, with the Sun 1 au away."""

MOON_DISTANCE_AU = 384_400.0 / 149_597_870.7

_SATURN_POLE = np.array([0.08547883, 0.07323576, 0.99364475])
"""ICRS unit vector (IAU: RA 40.589, Dec 83.537 deg)."""

_URANUS_POLE = np.array([-0.21199958, -0.94155916, -0.26176809])
"""ICRS unit vector (IAU: RA 257.311, Dec -15.175 deg)."""


def apparent_magnitude(name: str, from_sun_au: Array, from_observer_au: Array) -> float:
    """Return how bright a body of the solar system is."""
    distance = float(np.sqrt(from_observer_au @ from_observer_au))
    if name == "Sun":
        return SUN_MAG + 5.0 * float(np.log10(distance))
    solar = float(np.sqrt(from_sun_au @ from_sun_au))
    phase_deg = _angle_deg(from_sun_au, from_observer_au)
    if name == "Moon":
        part = 0.026 * phase_deg + 4e-9 * phase_deg**4
        return MOON_MAG + part + 5.0 * float(np.log10(solar * distance / MOON_DISTANCE_AU))
    if name == "Saturn":
        own = _saturn(phase_deg, *_latitudes(_SATURN_POLE, from_sun_au, from_observer_au))
    elif name == "Uranus":
        sun, observer = _latitudes(_URANUS_POLE, from_sun_au, from_observer_au)
        own = _uranus(phase_deg, 0.5 * (abs(sun) + abs(observer)))
    else:
        own = PHASE_CURVES[name](phase_deg)
    return own + 5.0 * float(np.log10(solar * distance))


def _angle_deg(u: Array, v: Array) -> float:
    cross = np.cross(u, v)
    return float(np.degrees(np.arctan2(np.sqrt(cross @ cross), u @ v)))


def _latitudes(pole: Array, from_sun_au: Array, from_observer_au: Array) -> tuple[float, float]:
    """Return the planet's latitudes under the Sun and under the observer, degrees."""
    return _angle_deg(pole, from_sun_au) - 90.0, _angle_deg(pole, from_observer_au) - 90.0


def _mercury(a: float) -> float:
    terms = (-0.613, 6.3280e-2, -1.6336e-3, 3.3644e-5, -3.4265e-7, 1.6893e-9, -3.0334e-12)
    return _polynomial(a, *terms)


def _venus(a: float) -> float:
    if a < 163.7:
        return _polynomial(a, -4.384, -1.044e-3, 3.687e-4, -2.814e-6, 8.938e-9)
    return _polynomial(a, 236.05828, -2.81914, 8.39034e-3)


def _earth(a: float) -> float:
    return _polynomial(a, -3.99, -1.060e-3, 2.054e-4)


def _mars(a: float) -> float:
    if a <= 50.0:
        return _polynomial(a, -1.601, 2.267e-2, -1.302e-4)
    return _polynomial(a, -0.367, -2.573e-2, 3.445e-4)


def _jupiter(a: float) -> float:
    if a <= 12.0:
        return _polynomial(a, -9.395, -3.7e-4, 6.16e-4)
    light = _polynomial(a / 180.0, 1.0, -1.507, -0.363, -0.062, 2.809, -1.876)
    return -9.428 - 2.5 * float(np.log10(light))


def _saturn(a: float, sun_deg: float, observer_deg: float) -> float:
    """Globe and rings; the rings show their dark side where the latitudes have two signs."""
    tilt = float(np.sqrt(max(sun_deg * observer_deg, 0.0)))
    sine, a = float(np.sin(np.radians(tilt))), min(a, 6.5)
    return -8.914 - 1.825 * sine + 0.026 * a - 0.378 * sine * float(np.exp(-2.25 * a))


def _uranus(a: float, latitude_deg: float) -> float:
    beyond = _polynomial(a, 0.0, 6.587e-3, 1.045e-4) if a > 3.1 else 0.0
    return -7.110 - 0.00084 * latitude_deg + beyond


def _neptune(a: float) -> float:
    return -7.00 + (_polynomial(a, 0.0, 7.944e-3, 9.617e-5) if a > 1.9 else 0.0)


def _polynomial(x: float, *terms: float) -> float:
    return float(np.polynomial.polynomial.polyval(x, terms))


PHASE_CURVES: Mapping[str, Callable[[float], float]] = {
    "Mercury": _mercury,
    "Venus": _venus,
    "Earth": _earth,
    "Mars": _mars,
    "Jupiter": _jupiter,
    "Neptune": _neptune,
}
"""Magnitude at 1 au from the Sun and from the observer, by the phase angle in degrees."""
