"""Maps of the guide stars in each field: the raster and the lines of a page, and one SVG by itself.

All are Mollweide's projection with the same colours. One unit of the lines is a hundredth of the
radius of the sphere that is projected.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from starcat.arrays import Array
from starcat.geometry.footprint import Footprint
from starcat.geometry.sphere import directions_from_radec, radec_from_directions
from starcat.matcher.chance import MIN_STARS

Counts = NDArray[np.int64]
Raster = NDArray[np.intp]

HALF_WIDTH, HALF_HEIGHT = float(2.0 * np.sqrt(2.0)), float(np.sqrt(2.0))
"""Half axes of the ellipse, for a sphere of radius 1."""

GALACTIC_POLE_DEG = (192.85948, 27.12825)
"""Right ascension and declination, ICRS: ESA SP-1200 (1997), volume 1, equation 1.5.11."""


def project_sky(ra_deg: ArrayLike, dec_deg: ArrayLike) -> tuple[Array, Array]:
    """Return x and y of positions on the map, in which right ascension grows to the left.

    Examples
    --------
    >>> x, y = project_sky([270.0], [0.0])
    >>> round(float(x[0] / HALF_WIDTH), 9), abs(round(float(y[0]), 9))
    (0.5, 0.0)
    """
    dec = np.radians(np.asarray(dec_deg, dtype=np.float64))
    east = -np.radians((np.asarray(ra_deg, dtype=np.float64) + 180.0) % 360.0 - 180.0)
    theta = _auxiliary(dec)
    return HALF_WIDTH / np.pi * east * np.cos(theta), HALF_HEIGHT * np.sin(theta)


def _auxiliary(dec: Array) -> Array:
    """Solve 2 theta + sin 2 theta = pi sin dec, by bisection: it does not fail at the poles."""
    low, high = np.full_like(dec, -0.5 * np.pi), np.full_like(dec, 0.5 * np.pi)
    target = np.pi * np.sin(dec)
    for _ in range(52):
        middle = 0.5 * (low + high)
        too_low = 2.0 * middle + np.sin(2.0 * middle) < target
        low, high = np.where(too_low, middle, low), np.where(too_low, high, middle)
    return 0.5 * (low + high)


def nearest_raster(boresights: Array, width: int, part: Footprint | None = None) -> Raster:
    """Return the map as a raster of the number of the nearest boresight.

    Shape (width // 2, width), north at the top; -1 outside of the ellipse, and of a part of the
    sphere if one is given.
    """
    height = width // 2
    x = ((np.arange(width) + 0.5) / width * 2.0 - 1.0) * HALF_WIDTH
    y = (1.0 - (np.arange(height) + 0.5) / height * 2.0) * HALF_HEIGHT
    theta = np.arcsin(y / HALF_HEIGHT)[:, None]
    dec = np.arcsin((2.0 * theta + np.sin(2.0 * theta)) / np.pi)
    east = np.pi * x[None, :] / (HALF_WIDTH * np.cos(theta))
    inside = np.abs(east) <= np.pi
    ra_deg = np.degrees(-east)[inside]
    dec_deg = np.degrees(np.broadcast_to(dec, east.shape))[inside]
    directions = directions_from_radec(ra_deg, dec_deg)
    _, nearest = scipy.spatial.cKDTree(boresights).query(directions)
    if part is not None:
        nearest = np.where(part.contains(directions), nearest, -1)
    raster = np.full((height, width), -1)
    raster[inside] = nearest
    return raster


MERIDIANS_DEG = (0, 60, 120, 240, 300)
"""Right ascensions of the lines of a map, without the meridian at its edge."""


def parallels() -> Iterator[tuple[float, float, str]]:
    """Yield x of the right end, y and label of the parallels of a map, every 30 degrees.

    Labels are left of the edge, farther away where the edge is inclined.
    """
    for dec in range(-60, 90, 30):
        x, y = project_sky([180.0, 180.0], [dec, dec])
        label = f"{dec:+d}°".replace("-", "\N{MINUS SIGN}") if dec else "0°"
        yield abs(float(x[0])), float(y[0]), label


def galactic_equator(count: int = 721) -> tuple[Array, Array]:
    """Return ra_deg and dec_deg along the galactic equator; the last point is the first."""
    pole = directions_from_radec(*GALACTIC_POLE_DEG)
    ascending = np.cross([0.0, 0.0, 1.0], pole)
    ascending /= np.linalg.norm(ascending)
    angle = np.linspace(0.0, 2.0 * np.pi, count)[:, None]
    circle = np.cos(angle) * ascending + np.sin(angle) * np.cross(pole, ascending)
    return radec_from_directions(circle)


UNIT = 100.0
COLOURS = (
    "a3263a",
    "26284f", "2b3f78", "2a5a93", "26769f", "2a91a1", "46ab99", "74c38a", "acd87a", "e8e673",
)  # fmt: skip
"""The colours ``--map-0`` to ``--map-9`` of the style sheet; the first means too few stars."""


@dataclass(frozen=True, eq=False)
class Fields:
    """The fields of a tiling, in its order."""

    ra_deg: Array  # boresights, (F,)
    dec_deg: Array
    stars: Counts  # (F,)
    pairs: Counts
    triangles: Counts

    def __len__(self) -> int:
        return len(self.ra_deg)


@dataclass(frozen=True)
class Field:
    """One of the fields, with its position on a map."""

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
    """A colour of a map, and the numbers of stars that it means."""

    name: str  # class in the style sheet: ``m0`` to ``m9``
    least: int
    most: int | None  # None: no limit

    @property
    def colour(self) -> str:
        """Six hexadecimal digits."""
        return COLOURS[int(self.name[1:])]

    @property
    def text(self) -> str:
        """The numbers of stars."""
        if self.most is None:
            return f"{self.least} or more"
        return f"{self.least}" if self.least == self.most else f"{self.least}–{self.most}"


def colour_bins(stars: Counts) -> tuple[Bin, ...]:
    """Return the colours for fields, by their number of stars."""
    least = int(stars.min())
    first = max(least, MIN_STARS)
    most = int(np.quantile(stars, 0.995, method="inverted_cdf"))
    count = min(len(COLOURS) - 1, max(most - first + 1, 1))
    edges = [first + (most - first + 1) * k // count for k in range(count)]
    bins = [Bin("m0", 0, MIN_STARS - 1)] if least < MIN_STARS else []
    for k, low in enumerate(edges):
        colour = 1 if count == 1 else 1 + k * (len(COLOURS) - 2) // (count - 1)
        bins.append(Bin(f"m{colour}", low, edges[k + 1] - 1 if k + 1 < count else None))
    return tuple(bins)


FIXED_EDGES = (MIN_STARS, 6, 8, 10, 15, 20, 30, 50, 100)
"""Smallest numbers of stars of the colours of `FIXED_BINS`, after the colour for too few."""

FIXED_BINS = tuple(
    Bin(f"m{k}", low, above - 1 if above else None)
    for k, (low, above) in enumerate(zip((0, *FIXED_EDGES), (*FIXED_EDGES, None), strict=True))
)
"""Colours that mean the same on every map, so that two maps can be compared."""


def bin_numbers(bins: tuple[Bin, ...], stars: Counts) -> Counts:
    """Return for each number of stars the index of its bin."""
    return np.searchsorted([colour_bin.least for colour_bin in bins], stars, side="right") - 1


def raster_png(nearest: Raster, stars: Counts, bins: tuple[Bin, ...] = ()) -> bytes:
    """Return a map as PNG, from its `nearest_raster`."""
    from PIL import Image

    inside = nearest >= 0
    bins = bins or colour_bins(stars)
    colours = np.array([int(colour_bin.name[1:]) + 1 for colour_bin in bins], dtype=np.uint8)
    pixels = np.zeros(nearest.shape, dtype=np.uint8)
    pixels[inside] = colours[bin_numbers(bins, stars)][nearest[inside]]
    image = Image.fromarray(pixels)
    image.putpalette(bytes(3) + bytes.fromhex("".join(COLOURS)))
    file = io.BytesIO()
    image.save(file, "PNG", transparency=0, optimize=False)
    return file.getvalue()


@dataclass(frozen=True)
class Line:
    """A line of the map, with its label."""

    path: str  # for the attribute ``d`` of a path
    label: str
    x: float
    y: float


@dataclass(frozen=True)
class SkyMap:
    """The lines that are drawn upon the raster, and its legend."""

    half_width: float
    half_height: float
    bins: tuple[Bin, ...]
    meridians: tuple[Line, ...]
    parallels: tuple[Line, ...]
    milky_way: str  # path of the galactic equator
    emptiest: Field


def sky_map(fields: Fields, bins: tuple[Bin, ...] = ()) -> SkyMap:
    """Return the lines and the legend of a map; its colours are for its own fields by default."""
    return SkyMap(
        round(HALF_WIDTH * UNIT, 1),
        round(HALF_HEIGHT * UNIT, 1),
        bins or colour_bins(fields.stars),
        _meridians(),
        _parallels(),
        _milky_way(),
        field_at(fields, int(np.argmin(fields.stars))),
    )


def field_at(fields: Fields, number: int) -> Field:
    """Return one of the fields with its position on the map."""
    ra_deg, dec_deg = float(fields.ra_deg[number]), float(fields.dec_deg[number])
    stars, pairs, triangles = (
        int(counts[number]) for counts in (fields.stars, fields.pairs, fields.triangles)
    )
    return Field(
        number, ra_deg, dec_deg, stars, pairs, triangles, *_position_on_map(ra_deg, dec_deg)
    )


def _position_on_map(ra_deg: float, dec_deg: float) -> tuple[float, float]:
    x, y = project_sky([ra_deg], [dec_deg])
    return round(float(x[0]) * UNIT, 1), round(float(-y[0]) * UNIT, 1)


@cache
def _meridians() -> tuple[Line, ...]:
    dec = np.linspace(-90.0, 90.0, 61)
    return tuple(
        Line(_path(*project_sky(np.full(61, ra), dec)), f"{ra}°", *_position_on_map(ra, 0.0))
        for ra in MERIDIANS_DEG
    )


@cache
def _parallels() -> tuple[Line, ...]:
    return tuple(
        Line(
            _path(np.array([-end, end]), np.full(2, y)),
            label,
            round(-1.03 * end * UNIT, 1),
            round(-1.03 * y * UNIT, 1),
        )
        for end, y, label in parallels()
    )


@cache
def _milky_way() -> str:
    x, y = project_sky(*galactic_equator(181))
    jumps = np.flatnonzero(np.abs(np.diff(x)) > 0.5 * HALF_WIDTH) + 1
    parts = zip(np.split(x, jumps), np.split(y, jumps), strict=True)
    return "".join(_path(*part) for part in parts)


def _path(x: Array, y: Array) -> str:
    points = [f"{a:.1f} {b:.1f}" for a, b in zip(x * UNIT, -y * UNIT, strict=True)]
    return f"M{'L'.join(points)}"
