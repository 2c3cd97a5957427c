"""Geometry of ADQL on the sphere, as SQL: points, circles, polygons and their relations.

Separations are as in the macro ``separation`` (by the arc tangent, exact at all angles). Sides of
polygons are arcs of great circles. A polygon is the smaller of the two parts into which its sides
divide the sphere, whatever the order of its corners. A point is inside if the sides go round it by
a full turn.

If the numbers of a query are known, arithmetic is done when the query is read; otherwise it is SQL:
a term is a number, or SQL that gives a number.

References
----------
ADQL 2.1, section 4.2. Todhunter 1886, Spherical Trigonometry, for the area.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

MARGIN_DEG = 1e-9  # added to the band of declinations that is tested first
SQUARE_DEGREES = (180.0 / math.pi) ** 2


Term = float | str  # a number, or SQL that gives a number
Vector = tuple[Term, Term, Term]

_COMPARISONS: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt, ">": operator.gt, "<=": operator.le, ">=": operator.ge, "=": operator.eq,
}  # fmt: skip


@dataclass(frozen=True)
class Point:
    """A place."""

    # SQL of right ascension and declination, degrees.
    lon: str
    lat: str

    @cached_property
    def fixed_deg(self) -> tuple[float, float] | None:
        """The place in degrees, if it does not depend on a row."""
        lon, lat = _number_in(self.lon), _number_in(self.lat)
        return (lon, lat) if lon is not None and lat is not None else None

    @cached_property
    def vector(self) -> Vector:
        """The direction of the place."""
        if self.fixed_deg is None:
            x, y = f"cosd({self.lat}) * cosd({self.lon})", f"cosd({self.lat}) * sind({self.lon})"
            return f"({x})", f"({y})", f"sind({self.lat})"
        lon, lat = map(math.radians, self.fixed_deg)
        return math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)

    @property
    def value(self) -> str:
        """SQL of the point in DALI's format."""
        return _list(self.lon, self.lat)


@dataclass(frozen=True)
class Circle:
    """All points within a radius of a centre."""

    centre: Point
    radius: str  # SQL of the radius, degrees

    @property
    def value(self) -> str:
        """SQL of the circle in DALI's format."""
        return _list(self.centre.lon, self.centre.lat, self.radius)


@dataclass(frozen=True)
class Polygon:
    """The area enclosed by great circles between corners."""

    corners: tuple[Point, ...]  # three or more
    centre: Point | None = None  # the centre, if it was made around one

    @property
    def value(self) -> str:
        """SQL of the polygon in DALI's format."""
        return _list(*(part for corner in self.corners for part in (corner.lon, corner.lat)))

    @cached_property
    def sides(self) -> tuple[tuple[Point, Point], ...]:
        """Pairs of corners."""
        return tuple(zip(self.corners, (*self.corners[1:], self.corners[0]), strict=True))

    @cached_property
    def turn(self) -> Term:
        """The area in steradians; negative if the corners go clockwise as seen from inside."""
        first, *others = (corner.vector for corner in self.corners)
        parts: list[Term] = []
        for a, b in pairwise(others):
            whole = _added(1.0, _dot(first, a), _dot(a, b), _dot(b, first))
            parts.append(_times(2.0, _arctan(_dot(first, _cross(a, b)), whole)))
        return _added(*parts)


@dataclass(frozen=True)
class Zone:
    """All points between two parallels and, if narrower than a full turn, two meridians."""

    centre: Point
    width: float  # degrees of right ascension
    # Declinations, degrees.
    low: float
    high: float

    @property
    def value(self) -> str:
        """SQL of its corners as a polygon in DALI's format."""
        half = f"{self.width / 2.0!r}"
        west, east = f"{self.centre.lon} - {half}", f"{self.centre.lon} + {half}"
        low, high = repr(self.low), repr(self.high)
        return _list(west, low, east, low, east, high, west, high)


Shape = Point | Circle | Polygon | Zone

_GALACTIC = (
    (-0.0548755604162154, -0.8734370902348850, -0.4838350155487132),
    (+0.4941094278755837, -0.4448296299600112, +0.7469822444972189),
    (-0.8676661490190047, -0.1980763734312015, +0.4559837761750669),
)
"""Directions of the galactic axes in ICRS (The Hipparcos Catalogue, SP-1200, equation 1.5.11)."""


def contains(inner: Shape, outer: Shape) -> str:
    """Return SQL of whether a shape is within another."""
    if isinstance(outer, Point):
        return _compared(_apart(inner, outer), "=", 0.0) if isinstance(inner, Point) else "false"
    if isinstance(outer, Zone) or isinstance(inner, Zone):
        return _in_zone(inner, outer)
    if isinstance(outer, Circle):
        if isinstance(inner, Point):
            return _in_circle(inner, outer)
        if isinstance(inner, Circle):
            reach = _plus(_apart(inner.centre, outer.centre), _term_of(inner.radius))
            return _compared(reach, "<=", _term_of(outer.radius))
        return _all_of(_in_circle(corner, outer) for corner in inner.corners)
    if isinstance(inner, Point):
        return _in_polygon(inner, outer)
    if isinstance(inner, Circle):
        centre, radius = inner.centre, _term_of(inner.radius)
        edge = (_compared(_from_side(centre, a, b), ">=", radius) for a, b in outer.sides)
        return _all_of([_in_polygon(centre, outer), *edge])
    within = [_in_polygon(corner, outer) for corner in inner.corners]
    crossing = _sides_cross(inner, outer)
    return _all_of([*within, {"true": "false", "false": "true"}.get(crossing, f"NOT {crossing}")])


def intersects(shape: Shape, other: Shape) -> str:
    """Return SQL of whether two shapes overlap."""
    if isinstance(shape, Point):
        return contains(shape, other)
    if isinstance(other, Point):
        return contains(other, shape)
    if isinstance(shape, Circle) and isinstance(other, Circle):
        reach = _plus(_term_of(shape.radius), _term_of(other.radius))
        return _compared(_apart(shape.centre, other.centre), "<=", reach)
    if isinstance(shape, Circle) and isinstance(other, Polygon):
        centre, radius = shape.centre, _term_of(shape.radius)
        near = (_compared(_from_side(centre, a, b), "<=", radius) for a, b in other.sides)
        return _any_of([_in_polygon(centre, other), *near])
    if isinstance(shape, Polygon) and isinstance(other, Polygon):
        inside = [_in_polygon(shape.corners[0], other), _in_polygon(other.corners[0], shape)]
        return _any_of([*inside, _sides_cross(shape, other)])
    return intersects(other, shape)


def distance(point: Point, other: Point) -> str:
    """Return SQL of the separation of two points, degrees."""
    return _sql_of(_apart(point, other))


def area(shape: Shape) -> str:
    """Return SQL of the area of a shape, square degrees."""
    if isinstance(shape, Point):
        return "0.0e0"
    if isinstance(shape, Circle):
        # 1 - cos r with all its digits for small circles.
        half = f"sind(least({shape.radius}, 180) / 2e0)"
        return f"({4.0 * math.pi * SQUARE_DEGREES!r} * {half} * {half})"
    if isinstance(shape, Zone):
        low, high = math.sin(math.radians(shape.low)), math.sin(math.radians(shape.high))
        return repr(SQUARE_DEGREES * math.radians(min(shape.width, 360.0)) * (high - low))
    return f"({SQUARE_DEGREES!r} * abs({_sql_of(shape.turn)}))"


def centroid(shape: Shape) -> Point:
    """Return the centre of a shape: for a polygon the direction of its mean position."""
    if isinstance(shape, Point):
        return shape
    if shape.centre is not None:
        return shape.centre
    # The mean is half the sum of the normals of the sides, each as long as its side.
    total: Vector = (0.0, 0.0, 0.0)
    for a, b in shape.sides:
        normal = _cross(a.vector, b.vector)
        length = _root(_dot(normal, normal))
        factor = _over(_arctan(length, _dot(a.vector, b.vector)), length)
        x, y, z = (_added(t, _times(factor, n)) for t, n in zip(total, normal, strict=True))
        total = (x, y, z)
    sign = _sign_of(shape.turn)
    x, y, z = (_times(sign, part) for part in total)
    return _point_at(x, y, z)


def _point_at(x: Term, y: Term, z: Term) -> Point:
    lon = _arctan(y, x)
    lat = _arctan(z, _root(_added(_times(x, x), _times(y, y))))
    if isinstance(lon, float) and isinstance(lat, float):
        return Point(repr(math.degrees(lon) % 360.0), repr(math.degrees(lat)))
    degrees = f"degrees({_sql_of(lon)})"
    return Point(
        f"({degrees} + CASE WHEN {degrees} < 0 THEN 360 ELSE 0 END)", f"degrees({_sql_of(lat)})"
    )


def from_galactic(shape: Shape) -> Shape:
    """Return a shape given in galactic coordinates in ICRS; a `Zone` is not converted."""
    if isinstance(shape, Circle):
        return Circle(_from_galactic(shape.centre), shape.radius)
    if isinstance(shape, Polygon):
        centre = None if shape.centre is None else _from_galactic(shape.centre)
        return Polygon(tuple(map(_from_galactic, shape.corners)), centre)
    return shape if isinstance(shape, Zone) else _from_galactic(shape)


def _from_galactic(point: Point) -> Point:
    along = point.vector
    x, y, z = (
        _added(*(_times(axis[k], part) for axis, part in zip(_GALACTIC, along, strict=True)))
        for k in range(3)
    )
    return _point_at(x, y, z)


def characters(shapes: Sequence[Shape]) -> int:
    """Return the rough length of SQL that compares or measures shapes."""
    parts = [_parts(shape) for shape in shapes]
    sides = [len(shape.corners) if isinstance(shape, Polygon) else 1 for shape in shapes]
    unknown = [sum(len(text) for text in texts if _number_in(text) is None) for texts in parts]
    both = sum(
        length * math.prod(sides) // side for length, side in zip(unknown, sides, strict=True)
    )
    return 60 * (both + sum(unknown)) + 100 * math.prod(sides)


def _parts(shape: Shape) -> tuple[str, ...]:
    if isinstance(shape, Point):
        return shape.lon, shape.lat
    if isinstance(shape, Circle):
        return (*_parts(shape.centre), shape.radius)
    if isinstance(shape, Zone):
        return _parts(shape.centre)
    return tuple(text for corner in shape.corners for text in _parts(corner))


def box(centre: Point, width: str, height: str) -> Shape:
    """Return the polygon with the corners of a box around a point.

    A box of half a turn or more, or beyond a pole, is a `Zone`, between meridians and parallels.
    """
    sizes = _number_in(width), _number_in(height)
    if centre.fixed_deg is not None and sizes[0] is not None and sizes[1] is not None:
        lat, half = centre.fixed_deg[1], sizes[1] / 2.0
        if sizes[0] >= 180.0 or abs(lat) + half > 90.0:
            low, high = max(-90.0, lat - half), min(90.0, lat + half)
            is_all = sizes[0] >= 360.0 and (low, high) == (-90.0, 90.0)
            return Circle(centre, "180") if is_all else Zone(centre, sizes[0], low, high)
    corners = tuple(
        Point(_folded(centre.lon, right, width), _folded(centre.lat, up, height))
        for right, up in (("-", "-"), ("+", "-"), ("+", "+"), ("-", "+"))
    )
    return Polygon(corners, centre)


def _folded(middle: str, sign: str, width: str) -> str:
    numbers = _number_in(middle), _number_in(width)
    if numbers[0] is not None and numbers[1] is not None:
        half = numbers[1] / 2.0
        return repr(numbers[0] + half if sign == "+" else numbers[0] - half)
    return f"({middle} {sign} ({width}) / 2e0)"


def _in_circle(point: Point, circle: Circle) -> str:
    return within(point, circle.centre, "<=", circle.radius)


def within(point: Point, other: Point, sign: str, radius: str) -> str:
    """Return SQL of whether the separation of two points is less than a radius, degrees."""
    free, middle = (other, point) if point.fixed_deg else (point, other)
    near = _compared(_apart(free, middle), sign, _term_of(radius))
    if free.fixed_deg:
        return near
    lat = _term_of(middle.lat)
    reach = _plus(_term_of(radius), MARGIN_DEG)
    low, high = _sql_of(_plus(lat, _times(-1.0, reach))), _sql_of(_plus(lat, reach))
    # Test declinations first: files contain statistics of them.
    return f"({free.lat} BETWEEN {low} AND {high} AND {near})"


def _in_zone(inner: Shape, outer: Shape) -> str:
    if not (isinstance(inner, Point) and isinstance(outer, Zone)):
        raise ValueError("a box of half a turn or more, or beyond a pole, holds places only")
    band = f"{inner.lat} BETWEEN {outer.low!r} AND {outer.high!r}"
    if outer.width >= 360.0:
        return f"({band} AND {inner.lon} IS NOT NULL)"
    beside = f"({inner.lon} - ({outer.centre.lon}))"
    turned = f"abs({beside} - 360e0 * round({beside} / 360e0))"
    return f"({band} AND {turned} <= {outer.width / 2.0!r})"


def _in_polygon(point: Point, polygon: Polygon) -> str:
    p = point.vector
    angles = []
    for a, b in polygon.sides:
        u, v = a.vector, b.vector
        across = _dot(p, _cross(u, v))
        along = _added(_dot(u, v), _times(-1.0, _times(_dot(p, u), _dot(p, v))))
        angles.append(_arctan(across, along))
    round_ = _times(_sign_of(polygon.turn), _added(*angles))
    inside = _compared(round_, ">", math.pi)
    band = None if point.fixed_deg else _band(polygon)
    return f"({point.lat} BETWEEN {band[0]} AND {band[1]} AND {inside})" if band else inside


def _band(polygon: Polygon) -> tuple[str, str] | None:
    """Return a range of declinations that contains a polygon, if its corners are known."""
    vectors = [corner.vector for corner in polygon.corners if corner.fixed_deg]
    if len(vectors) < len(polygon.corners):
        return None
    numbers = [[float(part) for part in vector] for vector in vectors]
    total = [sum(parts) for parts in zip(*numbers, strict=True)]
    length = math.hypot(*total)
    if length < 1e-6:
        return None
    middle = [part / length for part in total]
    cosine = min(sum(m * v for m, v in zip(middle, vector, strict=True)) for vector in numbers)
    reach = math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
    if reach >= 90.0:
        return None
    lat = math.degrees(math.asin(max(-1.0, min(1.0, middle[2]))))
    return _sql_of(lat - reach - 1e-6), _sql_of(lat + reach + 1e-6)


def _from_side(point: Point, a: Point, b: Point) -> Term:
    """Return the separation of a point from the arc between two others, degrees."""
    p, u, v = point.vector, a.vector, b.vector
    normal = _cross(u, v)
    away = _cross(p, normal)
    height = _arctan(_dot(p, normal), _root(_dot(away, away)))
    beside = _dot(p, _cross(normal, u)), _dot(p, _cross(v, normal))
    ends = _apart(point, a), _apart(point, b)
    if isinstance(height, float) and point.fixed_deg and a.fixed_deg and b.fixed_deg:
        is_beside = min(map(float, beside)) >= 0.0
        return math.degrees(abs(height)) if is_beside else min(map(float, ends))
    asked = " AND ".join(_compared(term, ">=", 0.0) for term in beside)
    nearest = f"least({_sql_of(ends[0])}, {_sql_of(ends[1])})"
    return f"(CASE WHEN {asked} THEN abs(degrees({_sql_of(height)})) ELSE {nearest} END)"


def _sides_cross(polygon: Polygon, other: Polygon) -> str:
    conditions = []
    for a, b in polygon.sides:
        for c, d in other.sides:
            u, v, w, t = a.vector, b.vector, c.vector, d.vector
            turns = (
                _dot(u, _cross(w, v)), _dot(w, _cross(v, t)),
                _dot(v, _cross(t, u)), _dot(t, _cross(u, w)),
            )  # fmt: skip
            conditions += [_all_of(_compared(turn, sign, 0.0) for turn in turns) for sign in "<>"]
    return _any_of(conditions)


def _apart(point: Point, other: Point) -> Term:
    if point.fixed_deg and other.fixed_deg:
        across = _cross(point.vector, other.vector)
        return math.degrees(
            float(_arctan(_root(_dot(across, across)), _dot(point.vector, other.vector)))
        )
    return f"separation({point.lon}, {point.lat}, {other.lon}, {other.lat})"


def _list(*numbers: str) -> str:
    return f"[{', '.join(f'({number})::DOUBLE' for number in numbers)}]"


def _term_of(text: str) -> Term:
    number = _number_in(text)
    return f"({text})" if number is None else number


def _number_in(text: str) -> float | None:
    """Return the number that a piece of SQL consists of, or None."""
    try:
        number = float(text.strip("() ").replace("- ", "-"))
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _sql_of(term: Term) -> str:
    return term if isinstance(term, str) else f"({term!r}::DOUBLE)"


def _times(a: Term, b: Term) -> Term:
    if isinstance(a, float) and isinstance(b, float):
        return a * b
    if a == 1.0 or b == 1.0:
        return b if a == 1.0 else a
    return f"({_sql_of(a)} * {_sql_of(b)})"


def _plus(a: Term, b: Term) -> Term:
    if isinstance(a, float) and isinstance(b, float):
        return a + b
    if a == 0.0 or b == 0.0:
        return b if a == 0.0 else a
    return f"({_sql_of(a)} + {_sql_of(b)})"


def _added(*terms: Term) -> Term:
    total: Term = 0.0
    for term in terms:
        total = _plus(total, term)
    return total


def _over(a: Term, b: Term) -> Term:
    """Return the quotient of two numbers; 1 if both are 0."""
    if isinstance(a, float) and isinstance(b, float):
        return a / b if b else 1.0
    return f"({_sql_of(a)} / {_sql_of(b)})"


def _arctan(y: Term, x: Term) -> Term:
    if isinstance(y, float) and isinstance(x, float):
        return math.atan2(y, x)
    return f"atan2({_sql_of(y)}, {_sql_of(x)})"


def _root(a: Term) -> Term:
    return math.sqrt(a) if isinstance(a, float) else f"sqrt({a})"


def _sign_of(a: Term) -> Term:
    return math.copysign(1.0, a) if isinstance(a, float) else f"sign({a})"


def _dot(a: Vector, b: Vector) -> Term:
    return _added(*(_times(x, y) for x, y in zip(a, b, strict=True)))


def _cross(a: Vector, b: Vector) -> Vector:
    def minus(p: Term, q: Term, r: Term, s: Term) -> Term:
        return _plus(_times(p, q), _times(-1.0, _times(r, s)))

    return (
        minus(a[1], b[2], a[2], b[1]),
        minus(a[2], b[0], a[0], b[2]),
        minus(a[0], b[1], a[1], b[0]),
    )


def _compared(a: Term, sign: str, b: Term) -> str:
    if isinstance(a, float) and isinstance(b, float):
        return "true" if _COMPARISONS[sign](a, b) else "false"
    return f"({_sql_of(a)} {sign} {_sql_of(b)})"


def _all_of(conditions: Iterable[str]) -> str:
    """Return the SQL that all conditions hold; conditions that always hold are left out."""
    remaining = [condition for condition in conditions if condition != "true"]
    return "false" if "false" in remaining else _joined(remaining, " AND ", "true")


def _any_of(conditions: Iterable[str]) -> str:
    """Return SQL of whether any condition holds; conditions known to fail are left out."""
    remaining = [condition for condition in conditions if condition != "false"]
    return "true" if "true" in remaining else _joined(remaining, " OR ", "false")


def _joined(conditions: list[str], word: str, nothing: str) -> str:
    return f"({word.join(conditions)})" if conditions else nothing
