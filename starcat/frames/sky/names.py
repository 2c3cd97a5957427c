"""The common names of stars, and the lines of constellations.

``star_names.csv`` has the stars to V = 6.6 with the IAU's proper names and Bayer letters,
``constellation_lines.csv`` the lines between them; both files state their sources. A star of any
catalog is found by its Hipparcos number if its designation is one, else by its position.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Directions
from starcat.geometry.sphere import chord_from_separation, directions_from_radec, tangent_axes

REACH_ARCSEC = 20.0  # largest separation of a star from its position in the list

# How much fainter and brighter than V a catalog's magnitude can be: V - Ks of the reddest is 9.
FAINTER_MAG, BRIGHTER_MAG = 2.0, 9.0
_FOLDER = Path(__file__).parent
_MAS = np.radians(1.0 / 3_600_000.0)


@dataclass(frozen=True)
class NamedStars:
    """The stars that have names."""

    hip: NDArray[np.int64]  # shape (N,): Hipparcos numbers, ascending
    directions: Directions  # shape (N, 3): ICRS unit vectors at J2000.0
    motion_rad_yr: Array  # shape (N, 3): proper motions in the tangent plane, radians a year
    mag: Array  # shape (N,): V
    # proper name, else Bayer letter and constellation, else ``HIP`` and number
    labels: tuple[str, ...]

    @cached_property
    def _row_of(self) -> dict[int, int]:
        return {int(number): row for row, number in enumerate(self.hip)}

    def at(self, epoch_jyear: float) -> Array:
        """Return directions at another epoch, shape (N, 3)."""
        moved = self.directions + (epoch_jyear - 2000.0) * self.motion_rad_yr
        return np.asarray(moved / np.sqrt(np.einsum("ij,ij->i", moved, moved))[:, None])

    def rows_of(self, hips: Iterable[int]) -> list[int]:
        """Return the rows of Hipparcos numbers; KeyError for an unknown number."""
        return [self._row_of[hip] for hip in hips]

    def label_of(self, designation: str) -> str | None:
        """Return the name of a star whose designation is a Hipparcos number."""
        catalog, _, number = designation.partition(" ")
        row = self._row_of.get(int(number)) if catalog == "HIP" and number.isdecimal() else None
        return None if row is None else self.labels[row]


@cache
def named_stars() -> NamedStars:
    """Return the stars that have names, read once."""
    rows = list(csv.DictReader(_lines_of("star_names.csv")))
    ra, dec, pm_ra, pm_dec, mag = (
        np.array([float(row[name]) for row in rows])
        for name in ("ra_deg", "dec_deg", "pm_ra_cosdec_mas_yr", "pm_dec_mas_yr", "v_mag")
    )
    east, north = tangent_axes(ra, dec)
    return NamedStars(
        np.array([int(row["hip"]) for row in rows]),
        directions_from_radec(ra, dec),
        (pm_ra * _MAS)[:, None] * east + (pm_dec * _MAS)[:, None] * north,
        mag,
        tuple(row["name"] or row["bayer"] or f"HIP {row['hip']}" for row in rows),
    )


@cache
def constellation_lines() -> tuple[tuple[int, ...], ...]:
    """Return the lines of all constellations, read once."""
    rows = csv.DictReader(_lines_of("constellation_lines.csv"))
    return tuple(tuple(int(hip) for hip in row["hips"].split()) for row in rows)


def common_names(
    designations: Sequence[str], directions: Directions, mag: Array, epoch_jyear: float
) -> list[str | None]:
    """Return the names that people know stars by."""
    named = named_stars()
    places = named.at(epoch_jyear)
    chord = chord_from_separation(np.radians(REACH_ARCSEC / 3600.0))
    # 1 - d^2/2 is the cosine; the few stars near enough by it are measured exactly.
    near_cosine = 1.0 - 0.5 * (2.0 * chord) ** 2
    names: list[str | None] = []
    for designation, u, m in zip(designations, directions, mag, strict=True):
        label = named.label_of(designation)
        if label is None:
            near = np.flatnonzero(places @ u >= near_cosine)
            off, fainter = places[near] - u, m - named.mag[near]
            within = np.einsum("ij,ij->i", off, off) <= chord * chord
            near = near[within & (fainter <= FAINTER_MAG) & (fainter >= -BRIGHTER_MAG)]
            if len(near):
                label = named.labels[near[np.abs(named.mag[near] - m).argmin()]]
        names.append(label)
    return names


def _lines_of(name: str) -> list[str]:
    """Return the lines of a file of this folder without the remarks at its head."""
    with (_FOLDER / name).open(encoding="utf-8") as file:
        return [line for line in file if not line.startswith("#")]
