"""The observer: time, place and velocity, and the apparent directions of stars.

The Earth and the Sun are from ERFA's ``epv00``, astropy's built-in ephemeris: the velocity of the
Earth is good to 5 mm/s, 4 microarcseconds of aberration. Nothing is downloaded: leap seconds are
from the installed ERFA.

A catalog gives the direction of a star from the middle of the solar system, at rest. An observer
elsewhere sees it shifted by parallax (at most 0.8 arcsec), bent by the Sun (4 mas at 90 deg from
it, 1.75 arcsec at its limb) and displaced in the direction of his own motion (20.5 arcsec for the
Earth, 5 arcsec more in a low orbit). Directions are unit vectors in ICRS axes, in and out.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Literal, get_args

import erfa
import numpy as np
from numpy.typing import ArrayLike

from starcat.arguments import numbers_of as numbers_of_array
from starcat.arrays import Array
from starcat.errors import AsWritten, ConfigError

if TYPE_CHECKING:
    from astropy.time import Time

LIGHT_KM_S = 299_792.458  # speed of light in vacuum (exact)
AU_KM = 149_597_870.7  # astronomical unit (IAU 2012 Resolution B2, exact)
_MAS = np.radians(1.0 / 3_600_000.0)


def _displaced_by_parallax(u: Array, parallax_mas: Array, observer_au: Array) -> Array:
    """Return directions as seen from a barycentric position; a parallax of NaN counts as 0."""
    parallax_rad = np.nan_to_num(parallax_mas) * _MAS
    return _unit(u - parallax_rad[:, None] * observer_au)


def _deflected(u: Array, from_sun_au: Array) -> Array:
    """Return directions of stars as the mass of the Sun bends their light, away from the Sun.

    Behind its disc, within 9 arcmin of the middle, the deflection falls to zero instead of growing.
    """
    distance_au = float(np.sqrt(from_sun_au @ from_sun_au))
    return _unit(erfa.ldsun(u, from_sun_au / distance_au, distance_au))


def aberrated(u: Array, velocity_km_s: Array) -> Array:
    """Return directions as moving observers see them, whose velocity has the shape (3,) or (N, 3).

    Stars shift towards the velocity; with the opposite velocity the same function takes them
    back. Exact in special relativity; the potential of the Sun, a microarcsecond, is left out.
    """
    beta = velocity_km_s / LIGHT_KM_S
    return np.asarray(erfa.ab(u, beta, np.inf, np.sqrt(1.0 - np.sum(beta * beta, axis=-1))))


def _unit(u: Array) -> Array:
    return np.asarray(u / np.sqrt(np.einsum("ij,ij->i", u, u))[:, None])


Origin = Literal["earth", "barycentre"]

FASTEST_KM_S: dict[Origin, float] = {"earth": 100.0, "barycentre": 300.0}
"""Fastest observers; the fastest spacecraft so far, Parker Solar Probe, passes the Sun at 192."""

NEAREST_KM = 6356.0
"""Smallest distance from the middle of the Earth: its poles are at 6,356.75 km."""

FARTHEST_KM = 5e10
"""Largest distance from the origin; Voyager 1 is at 2.5e10 km."""

FIRST_YEAR, LAST_YEAR = 1900, 2099  # years of the ephemeris
DAY_S = 86_400.0


@dataclass(frozen=True, eq=False, repr=False)
class Observer:
    """A time, a place and a velocity.

    Attributes
    ----------
    time : datetime
        UTC.
    tt_jd : tuple of float
        ``time`` as a Julian date in two parts, Terrestrial Time. It is used for TDB too, which
        differs by 2 ms at most.
    position_au, velocity_km_s : ndarray of float64, shape (3,)
        Barycentric, ICRS axes.
    sun_au, earth_au : ndarray of float64, shape (3,)
        Barycentric positions of the Sun and of the middle of the Earth, au.
    is_placed : bool
        Whether a position was given. Without one the observer is at the middle of the Earth.
    """

    time: datetime
    tt_jd: tuple[float, float]
    position_au: Array
    velocity_km_s: Array
    sun_au: Array
    earth_au: Array
    is_placed: bool

    @property
    def in_words(self) -> str:
        """The time as it is printed: UTC, in ISO 8601."""
        return self.time.isoformat().replace("+00:00", "Z")

    def __repr__(self) -> str:
        from_earth_km = float(np.linalg.norm(self.position_au - self.earth_au)) * AU_KM
        speed_km_s = float(np.linalg.norm(self.velocity_km_s))
        where = f"{from_earth_km:,.0f} km from" if self.is_placed else "at"
        return (
            f"<Observer {self.in_words}: {where} the middle of the Earth, "
            f"{speed_km_s:.2f} km/s about the barycentre>"
        )

    @classmethod
    def at(
        cls,
        time: str | datetime | Time,
        *,
        position_km: ArrayLike | None = None,
        velocity_km_s: ArrayLike | None = None,
        origin: Origin = "earth",
    ) -> Observer:
        """Return the observer at a time.

        Parameters
        ----------
        time : str, datetime or astropy.time.Time
            UTC, such as ``2026-11-22T10:00:00``; a time zone in it is used. A Time of another
            scale is converted.
        position_km, velocity_km_s : array_like of float64, shape (3,), optional
            Relative to the origin, km and km/s (quantities with another unit of length and
            velocity are converted), in ICRS axes (for the Earth GCRS, or J2000, but not the axes
            of a two-line element set); by default the Earth's own.
        origin : {"earth", "barycentre"}
            Origin of both; with the barycentre both have to be given.

        Returns
        -------
        Observer
            With the Earth's motion around the Sun added.

        Raises
        ------
        ConfigError
            If an argument is out of range, such as a time before 1900 or after 2099 or a position
            inside the Earth, or missing.
        """
        moment = _utc(time)
        tt = _terrestrial(moment)
        heliocentric, barycentric = erfa.epv00(*tt)
        earth_au, earth_au_day = np.array(barycentric["p"]), np.array(barycentric["v"])
        position = None if position_km is None else _three("position_km", position_km)
        speed = None if velocity_km_s is None else _three("velocity_km_s", velocity_km_s)
        if origin not in get_args(Origin):
            choices = " or ".join(repr(word) for word in get_args(Origin))
            raise ConfigError(f"expected {choices}", parameter="origin", value=origin)
        if origin == "barycentre":
            if position is None or speed is None:
                raise ConfigError(
                    "relative to the barycentre position_km and velocity_km_s are both needed",
                    key="origin",
                )
            position_au, velocity = position / AU_KM, speed
        else:
            position_au = earth_au + (0.0 if position is None else position / AU_KM)
            velocity = earth_au_day * (AU_KM / DAY_S) + (0.0 if speed is None else speed)
        if position is not None:
            from_earth_km = _length(position_au - earth_au) * AU_KM
            _check_place(position, from_earth_km)
        fastest, relative_km_s = FASTEST_KM_S[origin], np.zeros(3) if speed is None else speed
        if not _length(relative_km_s) <= fastest:
            raise ConfigError(
                f"expected at most {fastest:g} km/s relative to the {origin}",
                parameter="velocity_km_s",
                value=np.round(relative_km_s, 1).tolist(),
                hint="divide a velocity in m/s by 1000",
            )
        sun_au = earth_au - np.array(heliocentric["p"])
        return cls(moment, tt, position_au, velocity, sun_au, earth_au, position is not None)

    def apparent(self, directions: ArrayLike, parallax_mas: ArrayLike | None = None) -> Array:
        """Return where stars of a catalog are seen.

        Light deflection by the Sun and aberration are applied: astropy's GCRS to 1 mas.

        Parameters
        ----------
        directions : array_like of float64, shape (N, 3)
            Unit vectors, ICRS.
        parallax_mas : array_like of float64, shape (N,), optional
            Parallaxes, mas; NaN if unknown.

        Returns
        -------
        ndarray of float64, shape (N, 3)
            Unit vectors along the axes of ICRS.
        """
        u = numbers_of_array("directions", directions, "(N, 3)")
        if parallax_mas is not None:
            parallax = numbers_of_array("parallax_mas", parallax_mas, "(N,)")
            u = _displaced_by_parallax(u, parallax, self.position_au)
        return aberrated(_deflected(u, self.position_au - self.sun_au), self.velocity_km_s)


def _length(vector: Array) -> float:
    return float(np.sqrt(vector @ vector))


def _check_place(position_km: Array, from_earth_km: float) -> None:
    """Check that an observer is outside of the Earth, and not beyond all spacecraft."""
    if from_earth_km < NEAREST_KM:
        expected = f"at least {NEAREST_KM:,.0f} km from the middle of the Earth"
        hint = "add the radius of the Earth, 6,378 km, to an altitude"
    elif _length(position_km) > FARTHEST_KM:
        expected = f"at most {FARTHEST_KM:,.0f} km"
        hint = "divide a position in metres by 1000"
    else:
        return
    raise ConfigError(
        f"expected {expected}",
        parameter="position_km",
        value=np.round(position_km, 1).tolist(),
        hint=hint,
    )


def observer_numbers(name: str, text: str, count: int) -> list[float]:
    """Return the ``count`` numbers of a text such as ``1.5,-7.2,0``, or raise ConfigError."""
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        example = ",".join(["7000", "0", "0", "0", "7.5", "0"][-count:])
        raise ConfigError(
            f"expected {count} numbers with commas between them, such as {example}",
            parameter=name,
            value=text,
        )
    return numbers


def _three(name: str, values: ArrayLike) -> Array:
    numbers = numbers_of_array(name, values, (3,))
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise ConfigError("expected three finite numbers", parameter=name, value=values)
    return numbers


def _utc(time: Any) -> datetime:
    """Return a time with its zone, which is UTC if none is stated."""
    moment = time if isinstance(time, datetime) else None
    if hasattr(time, "isot"):  # a Time of astropy, of any scale and format
        moment = _utc_of_astropy(time)
    elif moment is None:
        # Python reads a date alone as midnight, which the user hardly meant: refuse it.
        try:
            has_hours = re.search(r"\d[T ]\d", str(time))
            moment = datetime.fromisoformat(str(time).strip()) if has_hours else None
        except ValueError:
            moment = None
    if moment is None:
        raise ConfigError(
            "expected date and time in UTC, such as 2026-11-22T10:00:00",
            parameter="time",
            value=time,
        )
    try:
        moment = moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment.astimezone(UTC)
    except OverflowError:
        moment = datetime.min.replace(tzinfo=UTC)
    if not FIRST_YEAR <= moment.year <= LAST_YEAR:
        raise ConfigError(
            f"the ephemeris of planets is for {FIRST_YEAR} to {LAST_YEAR}",
            parameter="time",
            value=AsWritten(time),
        )
    return moment


def _utc_of_astropy(time: Any) -> datetime | None:
    """Return a Time of astropy as UTC; None if it is not one moment that a datetime can hold."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a "dubious year", as in `_terrestrial`
        try:
            moment = time.utc.datetime
        except Exception:  # a leap second, a local time, or tables that astropy cannot load
            return None
    return moment if isinstance(moment, datetime) else None


def _terrestrial(moment: datetime) -> tuple[float, float]:
    """Return a time as Terrestrial Time, with the leap seconds of ERFA."""
    second = moment.second + moment.microsecond / 1e6
    with warnings.catch_warnings():
        # ERFA warns of a "dubious year" before 1960 and if later leap seconds can be unknown: the
        # error is seconds, and the Moon moves by half an arcsecond per second.
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        utc = erfa.dtf2d(
            "UTC", moment.year, moment.month, moment.day, moment.hour, moment.minute, second
        )
        whole, part = erfa.taitt(*erfa.utctai(*utc))
    return float(whole), float(part)
