"""The nearest neighbour of every star of a partition, exact across its border.

The stars around a partition are read out to some distance. A neighbour that is nearer than that
is the nearest of all; for the few stars whose neighbour may lie beyond, the stars farther out are
looked through, a batch at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from starcat.geometry.proximity import nearest_chords, separation_from_chord
from starcat.geometry.sphere import chord_from_separation
from starcat.stars.star_table import directions_of, floats_of
from starcat.store.pixels import Pixel

COLUMNS = ("star_id", "x", "y", "z", "mag", "source_file", "source_line")
"""What has to be known of the stars around."""

_SPACINGS = 3.0
"""Reach of the first look in mean distances of the stars: one in 10^12 of a uniform sky needs
another."""

Around = Callable[[float], Iterator[pa.Table]]
"""Gives the stars within so many radians of the partition, but not in it, in pieces."""


@dataclass
class _Nearest:
    """The nearest neighbours found so far."""

    chord: NDArray[np.float64]
    mag: NDArray[np.float64]
    star_id: NDArray[np.int64]


def add_neighbours(stars: pa.Table, pixel: Pixel, around: Around, is_alone: bool) -> pa.Table:
    """Return the stars of a partition with the columns of the nearest neighbour filled in."""
    if is_alone or not len(stars):
        return stars
    reach = _first_reach(pixel, len(stars))
    directions = directions_of(stars)
    found = _among(stars, directions, list(around(reach)))
    while len(rows := np.flatnonzero(found.chord > chord_from_separation(reach) * (1.0 - 1e-9))):
        if reach >= np.pi:
            break
        reach = _farther(reach, float(found.chord[rows].max()))
        for piece in around(reach):
            _look(found, rows, directions, piece)
    mag = floats_of(stars, "mag")
    apart = np.degrees(separation_from_chord(found.chord)) * 3600.0
    stars = stars.append_column("nearest_separation_arcsec", pa.array(apart))
    delta = found.mag - mag
    return stars.append_column("nearest_delta_mag", pa.array(delta, mask=np.isnan(delta)))


def _first_reach(pixel: Pixel, count: int) -> float:
    area = 4.0 * np.pi / (12 * 4**pixel.order)
    return float(min(_SPACINGS * np.sqrt(area / count), np.pi))


def _farther(reach: float, chord: float) -> float:
    if not np.isfinite(chord):
        return min(8.0 * reach, np.pi)
    separation = float(separation_from_chord(np.array(chord)))
    return separation * (1.0 + 1e-6) if separation < 1.0 else np.pi


def _among(stars: pa.Table, directions: NDArray[np.float64], pieces: list[pa.Table]) -> _Nearest:
    """Return the nearest neighbours among the stars themselves and those in some pieces."""
    parts = [stars.select(["star_id", "mag"]), *(p.select(["star_id", "mag"]) for p in pieces)]
    number = np.concatenate([part["star_id"].to_numpy() for part in parts])
    mag = np.concatenate([floats_of(part, "mag") for part in parts])
    both = np.concatenate([directions, *(directions_of(piece) for piece in pieces)])
    rows = np.arange(len(stars))
    chord, index = nearest_chords(directions, both, rows, number)
    return _Nearest(chord, np.append(mag, np.nan)[index], np.append(number, 0)[index])


def _look(
    found: _Nearest, rows: NDArray[np.int64], directions: NDArray[np.float64], piece: pa.Table
) -> None:
    """Take the stars of a piece for neighbours of some rows where they are nearer."""
    if not len(piece):
        return
    number = piece["star_id"].to_numpy()
    nobody = np.full(len(rows), -1)
    chord, index = nearest_chords(directions[rows], directions_of(piece), nobody, number)
    mag, number = floats_of(piece, "mag")[index], number[index]
    is_nearer = chord < found.chord[rows]
    # Of two that are as near the one of the lower number counts.
    is_nearer |= (chord == found.chord[rows]) & (number < found.star_id[rows])
    rows = rows[is_nearer]
    found.chord[rows], found.mag[rows] = chord[is_nearer], mag[is_nearer]
    found.star_id[rows] = number[is_nearer]
