"""The coverage of a database as a map of the sky: the raster, the lines upon it, the fields.

The raster is a picture, everything else is drawn by the page, in its own colours. One unit of the
drawing is a hundredth of the radius of the sphere that is projected.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.errors import ProductError
from starcat.geometry.sphere import directions_from_radec
from starcat.matcher.chance import MIN_STARS
from starcat.report.sky_map import (
    HALF_HEIGHT,
    HALF_WIDTH,
    galactic_equator,
    nearest_raster,
    project,
)
from starcat.service.library import Database

Counts = NDArray[np.int64]

COVERAGE = "report/coverage.csv"
UNIT = 100.0
RASTER_WIDTH = 960
COLOURS = (
    "a3263a",
    "26284f", "2b3f78", "2a5a93", "26769f", "2a91a1", "46ab99", "74c38a", "acd87a", "e8e673",
)  # fmt: skip
"""Those of ``--map-0`` to ``--map-9`` in the style sheet."""


@dataclass(frozen=True, eq=False)
class Fields:
    """The fields of a tiling, in its order.

    Attributes
    ----------
    ra_deg, dec_deg : ndarray of float64, shape (F,)
        Boresights, degrees.
    stars, pairs, triangles : ndarray of int64, shape (F,)
        What each field holds.
    """

    ra_deg: Array
    dec_deg: Array
    stars: Counts
    pairs: Counts
    triangles: Counts

    def __len__(self) -> int:
        """Return the number of fields."""
        return len(self.ra_deg)


@dataclass(frozen=True)
class Field:
    """One of the fields.

    Attributes
    ----------
    number : int
        Of its boresight.
    ra_deg, dec_deg : float
        Boresight, degrees.
    stars, pairs, triangles : int
        What it holds.
    x, y : float
        Its place in the drawing.
    """

    number: int
    ra_deg: float
    dec_deg: float
    stars: int
    pairs: int
    triangles: int
    x: float
    y: float


@dataclass(frozen=True)
class Bin:
    """A colour of a map.

    Attributes
    ----------
    name : str
        Its class in the style sheet: ``m0`` to ``m9``.
    least : int
        Stars of a field, at least.
    most : int or None
        Stars of a field, at most; None for all that are more.
    """

    name: str
    least: int
    most: int | None

    @property
    def text(self) -> str:
        """The numbers of stars that it stands for."""
        if self.most is None:
            return f"{self.least} or more"
        return f"{self.least}" if self.least == self.most else f"{self.least}–{self.most}"


@dataclass(frozen=True)
class Line:
    """A line of the map.

    Attributes
    ----------
    path : str
        For the attribute ``d`` of a path.
    label : str
        Empty where it has none.
    x, y : float
        Place of the label.
    """

    path: str
    label: str
    x: float
    y: float


def fields_of(database: Database) -> Fields:
    """Read the fields of a database."""
    path = database.folder / COVERAGE
    try:
        return _read_fields(path, path.stat().st_mtime_ns)
    except (OSError, ValueError) as error:
        raise ProductError(
            f"{database.title}: {COVERAGE} cannot be read ({type(error).__name__}); build the "
            "database again",
            path=path,
        ) from error


@lru_cache(maxsize=16)
def _read_fields(path: Path, changed_ns: int) -> Fields:
    table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2, usecols=range(1, 6))
    ra_deg, dec_deg, *counts = table.T
    return Fields(ra_deg, dec_deg, *(one.astype(np.int64) for one in counts))


def bins_of(fields: Fields) -> tuple[Bin, ...]:
    """Return what the colours of a map mean."""
    least = int(fields.stars.min())
    first = max(least, MIN_STARS)
    most = int(np.quantile(fields.stars, 0.995, method="inverted_cdf"))
    count = min(len(COLOURS) - 1, max(most - first + 1, 1))
    edges = [first + (most - first + 1) * k // count for k in range(count)]
    bins = [Bin("m0", 0, MIN_STARS - 1)] if least < MIN_STARS else []
    for k, low in enumerate(edges):
        colour = 1 if count == 1 else 1 + k * (len(COLOURS) - 2) // (count - 1)
        bins.append(Bin(f"m{colour}", low, edges[k + 1] - 1 if k + 1 < count else None))
    return tuple(bins)


@lru_cache(maxsize=16)
def map_png(database_id: str, fields: Fields, width: int = RASTER_WIDTH) -> bytes:
    """Return the raster of a map: the stars of the field of the nearest boresight."""
    raster = nearest_raster(
        directions_from_radec(fields.ra_deg, fields.dec_deg), fields.stars, width
    )
    return coloured_png(raster, bins_of(fields))


def coloured_png(raster: Array, bins: tuple[Bin, ...]) -> bytes:
    """Return a raster of numbers of stars as a picture."""
    from PIL import Image

    found = np.searchsorted([one.least for one in bins], np.nan_to_num(raster), side="right")
    colours = np.array([0] + [int(one.name[1:]) + 1 for one in bins], dtype=np.uint8)
    image = Image.fromarray(np.where(np.isnan(raster), 0, colours[found]).astype(np.uint8))
    image.putpalette(bytes(3) + bytes.fromhex("".join(COLOURS)))
    file = io.BytesIO()
    image.save(file, "PNG", transparency=0, optimize=False)
    return file.getvalue()


def place(ra_deg: float, dec_deg: float) -> tuple[float, float]:
    """Return the place of a direction in the drawing."""
    x, y = project([ra_deg], [dec_deg])
    return round(float(x[0]) * UNIT, 1), round(float(-y[0]) * UNIT, 1)


@cache
def meridians() -> tuple[Line, ...]:
    """Return the meridians of the map, every 60 degrees."""
    dec = np.linspace(-90.0, 90.0, 61)
    lines = []
    for ra in (0, 60, 120, 240, 300):
        x, y = project(np.full(61, ra), dec)
        lines.append(Line(_path(x, y), f"{ra}°", *place(ra, 0.0)))
    return tuple(lines)


@cache
def parallels() -> tuple[Line, ...]:
    """Return the parallels of the map, every 30 degrees; labels stand left of the edge."""
    lines = []
    for dec in range(-60, 90, 30):
        x, y = project([180.0, 180.0], [dec, dec])
        end = np.array([-abs(x[0]), abs(x[0])])
        label = f"{dec:+d}°".replace("-", "\N{MINUS SIGN}") if dec else "0°"
        at = round(float(-1.03 * abs(x[0]) * UNIT), 1), round(float(-1.03 * y[0] * UNIT), 1)
        lines.append(Line(_path(end, y), label, *at))
    return tuple(lines)


@cache
def milky_way() -> str:
    """Return the path of the galactic equator."""
    x, y = project(*galactic_equator(181))
    jumps = np.flatnonzero(np.abs(np.diff(x)) > 0.5 * HALF_WIDTH) + 1
    parts = zip(np.split(x, jumps), np.split(y, jumps), strict=True)
    return "".join(_path(*part) for part in parts)


def _path(x: Array, y: Array) -> str:
    points = [f"{a:.1f} {b:.1f}" for a, b in zip(x * UNIT, -y * UNIT, strict=True)]
    return f"M{'L'.join(points)}"


@dataclass(frozen=True)
class SkyMap:
    """What is drawn upon the raster.

    Attributes
    ----------
    half_width, half_height : float
        Half axes of the map.
    bins : tuple of Bin
        What the colours mean.
    meridians, parallels : tuple of Line
        The grid.
    milky_way : str
        Path of the galactic equator.
    emptiest : Field
        The field with the fewest stars.
    """

    half_width: float
    half_height: float
    bins: tuple[Bin, ...]
    meridians: tuple[Line, ...]
    parallels: tuple[Line, ...]
    milky_way: str
    emptiest: Field


def sky_map(fields: Fields) -> SkyMap:
    """Return what is drawn upon the raster of a map."""
    size = round(HALF_WIDTH * UNIT, 1), round(HALF_HEIGHT * UNIT, 1)
    emptiest = field_at(fields, int(np.argmin(fields.stars)))
    return SkyMap(*size, bins_of(fields), meridians(), parallels(), milky_way(), emptiest)


def ordered(fields: Fields, order: str) -> list[int]:
    """Return the numbers of the fields in an order."""
    if order == "number":
        return list(range(len(fields)))
    stars = fields.stars if order == "fewest" else -fields.stars
    return list(np.argsort(stars, kind="stable").tolist())


def field_at(fields: Fields, number: int) -> Field:
    """Return one of the fields with its place on the map."""
    ra_deg, dec_deg = float(fields.ra_deg[number]), float(fields.dec_deg[number])
    stars, pairs, triangles = (
        int(one[number]) for one in (fields.stars, fields.pairs, fields.triangles)
    )
    x, y = place(ra_deg, dec_deg)
    return Field(number, ra_deg, dec_deg, stars, pairs, triangles, x, y)
