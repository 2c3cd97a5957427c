"""The Sun, the Moon and the planets: where an observer sees them, and how bright they are.

By ERFA's ``epv00``, ``moon98`` and ``plan94``, which are what astropy calls its built-in
ephemeris. Nothing is read and nothing is downloaded.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import erfa
import numpy as np

from starcat.arrays import Array, Directions
from starcat.geometry.aberration import AU_KM, LIGHT_KM_S, aberrated
from starcat.sky.magnitudes import apparent_magnitude
from starcat.sky.observer import DAY_S, Observer

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
"""Equatorial radii (IAU 2015 nominal values and Archinal et al. 2018)."""

_PLANETS = {
    "Mercury": (1, 4.2),
    "Venus": (2, 5.1),
    "Mars": (4, 17.0),
    "Jupiter": (5, 71.2),
    "Saturn": (6, 86.0),
    "Uranus": (7, 86.3),
    "Neptune": (8, 11.2),
}
"""Number in ``plan94``, and its largest error in 1800 to 2050 as seen from the Sun, arcsec (its
longitude and latitude, from the notes of that routine)."""

_MOON_ERROR_ARCSEC = 20.0
"""Of ``moon98``, with a second of unknown leap seconds."""

_WITHIN_ORBIT_KM = 7000.0
"""How far from the middle of the Earth an observer without a position may be."""

_AU_DAY = LIGHT_KM_S * DAY_S / AU_KM
"""Speed of light, au per day."""


@dataclass(frozen=True)
class Bodies:
    """The bodies of the solar system, as they are seen at a time."""

    # ``Sun``, ``Moon``, the planets; ``Earth`` where the observer's position is known
    names: tuple[str, ...]
    # shape (B, 3): apparent directions of their middles, ICRS axes: light time and aberration are
    # in them
    directions: Directions
    distance_au: Array  # shape (B,): from the observer
    radius_rad: Array  # shape (B,): half of what they subtend
    mag: Array  # shape (B,): magnitudes, V
    # shape (B,): largest error of the directions, that of an unknown position within 7,000 km of
    # the middle of the Earth included
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
    mag = [
        apparent_magnitude(name, sun, own)
        for name, sun, own in zip(names, from_sun, seen, strict=True)
    ]
    error_au = np.zeros(len(names)) if observer.is_placed else np.full(
        len(names), _WITHIN_ORBIT_KM / AU_KM
    )  # fmt: skip
    error_rad = error_au / distance + [
        _ephemeris_error_rad(name, sun, own)
        for name, sun, own in zip(names, from_sun, seen, strict=True)
    ]
    radius_rad = np.arcsin(np.minimum(radius_au / distance, 1.0))
    arrays = (u, distance, radius_rad, np.array(mag), error_rad)
    for array in arrays:
        array.setflags(write=False)
    return Bodies(tuple(names), *arrays)


def _light_time_corrected(name: str, observer: Observer) -> Array:
    """Return where a body was when its light left, from the observer, au."""
    days, seen = 0.0, np.zeros(3)
    for _ in range(3):  # the light time changes by 1e-4 of itself in each
        seen = _barycentric_au(name, observer, days) - observer.position_au
        days = float(np.sqrt(seen @ seen)) / _AU_DAY
    return seen


def _barycentric_au(name: str, observer: Observer, days_before: float) -> Array:
    """Return a body's position some time before the observer's."""
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
