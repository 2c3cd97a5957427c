"""The Sun, the Moon and the planets: where an observer sees them, and how bright they are.

Positions are from ERFA's ``epv00``, ``moon98`` and ``plan94``, astropy's built-in ephemeris.
Nothing is read and nothing is downloaded. Magnitudes of planets are after Mallama and
Hilton 2018, "Computing apparent planetary magnitudes for The Astronomical Almanac", Astronomy and
Computing 25, 10, V band; without the rotation of Mars (0.06 mag). The Sun and the Moon are after
Allen's Astrophysical Quantities (4th ed., 2000, sections 14.2 and 12.9).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import erfa
import numpy as np

from starcat.arrays import Array, Directions
from starcat.frames.sky.observer import AU_KM, DAY_S, LIGHT_KM_S, Observer, aberrated

# Equatorial radii (IAU 2015 nominal values and Archinal et al. 2018).
RADII_KM = {
    "Sun": 695_700.0,
    "Moon": 1737.4,
    "Mercury": 2440.5,
    "Venus": 6051.8,
    "Mars": 3396.2,
    "Jupiter": 71_492.0,
    "Saturn": 60_268.0,
    "Uranus": 25_559.0,
    "Neptune": 24_764.0,
    "Earth": 6378.137,
}

# Number in ``plan94``, and its largest error in 1800 to 2050 as seen from the Sun, arcsec (its
# longitude and latitude, from the notes of that routine).
_PLANETS = {
    "Mercury": (1, 4.2),
    "Venus": (2, 5.1),
    "Mars": (4, 17.0),
    "Jupiter": (5, 71.2),
    "Saturn": (6, 86.0),
    "Uranus": (7, 86.3),
    "Neptune": (8, 11.2),
}
_MOON_ERROR_ARCSEC = 20.0  # error of ``moon98``, plus a second of unknown leap seconds

# Largest distance from the middle of the Earth of an observer without a position.
_WITHIN_ORBIT_KM = 7000.0
PhaseCurve = Callable[[float], float]
_AU_DAY = LIGHT_KM_S * DAY_S / AU_KM  # speed of light, au per day


@dataclass(frozen=True)
class Bodies:
    """The bodies of the solar system, as they are seen at a time."""

    # ``Sun``, ``Moon``, the planets; ``Earth`` if the observer's position is known
    names: tuple[str, ...]
    # shape (B, 3): apparent directions of their middles, ICRS axes: light time and aberration are
    # in them
    directions: Directions
    distance_au: Array  # shape (B,): from the observer
    radius_rad: Array  # shape (B,): half of what they subtend
    mag: Array  # shape (B,): magnitudes, V
    # shape (B,): largest error of the directions, including the error from an unknown position
    # within 7,000 km of the middle of the Earth
    error_rad: Array

    def row(self, name: str) -> int:
        """Return the row of a body."""
        return self.names.index(name)


@lru_cache(maxsize=4)
def bodies_seen(observer: Observer) -> Bodies:
    """Return the bodies of the solar system as an observer sees them."""
    names = ["Sun", "Moon", *_PLANETS, *(["Earth"] if observer.is_placed else [])]
    seen = np.array([_light_time_corrected(name, observer) for name in names])
    distance = np.sqrt(np.einsum("ij,ij->i", seen, seen))
    # An observer exactly in the middle of a body has no direction to it; any will do.
    seen[distance == 0.0, 2] = distance[distance == 0.0] = 1e-12
    u = aberrated(seen / distance[:, None], observer.velocity_km_s)
    radius_au = np.array([RADII_KM[name] for name in names]) / AU_KM
    from_sun = seen + (observer.position_au - observer.sun_au)
    vectors = list(zip(names, from_sun, seen, strict=True))
    mag = [apparent_magnitude(name, sun, observed) for name, sun, observed in vectors]
    error_au = 0.0 if observer.is_placed else _WITHIN_ORBIT_KM / AU_KM
    error_rad = error_au / distance + [
        _ephemeris_error_rad(name, sun, observed) for name, sun, observed in vectors
    ]
    radius_rad = np.arcsin(np.minimum(radius_au / distance, 1.0))
    arrays = (u, distance, radius_rad, np.array(mag), error_rad)
    for array in arrays:
        array.setflags(write=False)
    return Bodies(tuple(names), *arrays)


def _light_time_corrected(name: str, observer: Observer) -> Array:
    """Return the position of a body when its light left, relative to the observer, au."""
    days, seen = 0.0, np.zeros(3)
    for _ in range(3):  # the light time changes by 1e-4 of itself in each round
        seen = _barycentric_au(name, observer, days) - observer.position_au
        days = float(np.sqrt(seen @ seen)) / _AU_DAY
    return seen


def _barycentric_au(name: str, observer: Observer, days_before: float) -> Array:
    whole, part = observer.tt_jd[0], observer.tt_jd[1] - days_before
    heliocentric, barycentric = erfa.epv00(whole, part)
    earth = np.array(barycentric["p"])
    if name == "Earth":
        return earth
    if name == "Moon":
        return np.asarray(earth + erfa.moon98(whole, part)["p"])
    sun = earth - heliocentric["p"]
    if name == "Sun":
        return np.asarray(sun)
    return np.asarray(sun + erfa.plan94(whole, part, _PLANETS[name][0])["p"])


def _ephemeris_error_rad(name: str, from_sun_au: Array, from_observer_au: Array) -> float:
    if name == "Moon":
        return float(np.radians(_MOON_ERROR_ARCSEC / 3600.0))
    if name not in _PLANETS:
        return 0.0
    error_au = np.radians(_PLANETS[name][1] / 3600.0) * np.sqrt(from_sun_au @ from_sun_au)
    return float(error_au / np.sqrt(from_observer_au @ from_observer_au))


# V of the Sun from 1 au, and of the full Moon from its mean distance, with the Sun 1 au away.
SUN_MAG, MOON_MAG = -26.75, -12.74
MOON_DISTANCE_AU = 384_400.0 / 149_597_870.7

# ICRS unit vector (IAU: RA 40.589, Dec 83.537 deg).
_SATURN_POLE = np.array([0.08547883, 0.07323576, 0.99364475])

# ICRS unit vector (IAU: RA 257.311, Dec -15.175 deg).
_URANUS_POLE = np.array([-0.21199958, -0.94155916, -0.26176809])


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
        unit_mag = _saturn(phase_deg, *_latitudes(_SATURN_POLE, from_sun_au, from_observer_au))
    elif name == "Uranus":
        sun, observer = _latitudes(_URANUS_POLE, from_sun_au, from_observer_au)
        unit_mag = _uranus(phase_deg, 0.5 * (abs(sun) + abs(observer)))
    else:
        unit_mag = PHASE_CURVES[name](phase_deg)
    return unit_mag + 5.0 * float(np.log10(solar * distance))


def _angle_deg(u: Array, v: Array) -> float:
    cross = np.cross(u, v)
    return float(np.degrees(np.arctan2(np.sqrt(cross @ cross), u @ v)))


def _latitudes(pole: Array, from_sun_au: Array, from_observer_au: Array) -> tuple[float, float]:
    """Return the planet's latitudes under the Sun and under the observer, degrees."""
    return _angle_deg(pole, from_sun_au) - 90.0, _angle_deg(pole, from_observer_au) - 90.0


def _jupiter(a: float) -> float:
    if a <= 12.0:
        return _polynomial(a, -9.395, -3.7e-4, 6.16e-4)
    light = _polynomial(a / 180.0, 1.0, -1.507, -0.363, -0.062, 2.809, -1.876)
    return -9.428 - 2.5 * float(np.log10(light))


def _saturn(a: float, sun_deg: float, observer_deg: float) -> float:
    """Globe and rings; the rings show their dark side if the latitudes have different signs."""
    tilt = float(np.sqrt(max(sun_deg * observer_deg, 0.0)))
    sine, a = float(np.sin(np.radians(tilt))), min(a, 6.5)
    return -8.914 - 1.825 * sine + 0.026 * a - 0.378 * sine * float(np.exp(-2.25 * a))


def _uranus(a: float, latitude_deg: float) -> float:
    beyond = _polynomial(a, 0.0, 6.587e-3, 1.045e-4) if a > 3.1 else 0.0
    return -7.110 - 0.00084 * latitude_deg + beyond


def _polynomial(x: float, *terms: float) -> float:
    return float(np.polynomial.polynomial.polyval(x, terms))


def _polynomials(up_to: float, terms: Sequence[float], beyond: Sequence[float]) -> PhaseCurve:
    return lambda a: _polynomial(a, *(terms if a <= up_to else beyond))


_MERCURY = (-0.613, 6.3280e-2, -1.6336e-3, 3.3644e-5, -3.4265e-7, 1.6893e-9, -3.0334e-12)
_VENUS = (-4.384, -1.044e-3, 3.687e-4, -2.814e-6, 8.938e-9)

# Magnitude at 1 au from the Sun and from the observer, by the phase angle in degrees.
PHASE_CURVES: Mapping[str, PhaseCurve] = {
    "Mercury": _polynomials(180.0, _MERCURY, ()),
    "Venus": _polynomials(163.7, _VENUS, (236.05828, -2.81914, 8.39034e-3)),
    "Earth": _polynomials(180.0, (-3.99, -1.060e-3, 2.054e-4), ()),
    "Mars": _polynomials(50.0, (-1.601, 2.267e-2, -1.302e-4), (-0.367, -2.573e-2, 3.445e-4)),
    "Jupiter": _jupiter,
    "Neptune": _polynomials(1.9, (-7.00,), (-7.00, 7.944e-3, 9.617e-5)),
}
