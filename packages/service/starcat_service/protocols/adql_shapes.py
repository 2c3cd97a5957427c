"""Calls of ADQL's geometry: to shapes, and to SQL of conditions and measures of shapes.

A shape is stored at its call in the syntax tree, for the call that has it as an argument.
"""

from __future__ import annotations

from collections.abc import Callable

from sqlglot import exp

from starcat.errors import quoted
from starcat_service.protocols import adql_geometry as geometry
from starcat_service.protocols.adql_geometry import Circle, Point, Polygon, Shape, Zone
from starcat_service.protocols.adql_grammar import AdqlRefusal

MAX_CORNERS = 400  # most corners of a polygon
MAX_CHARACTERS = 1_000_000
"""Most characters, roughly, of the arithmetic that the geometry of a query becomes."""

FRAMES = ("", "ICRS", "UNKNOWNFRAME", "GALACTIC")
"""Frames of coordinates; words after a space, as in ``ICRS GEOCENTER``, are ignored."""

_MAX_INTEGER = 2**63 - 1
_SHAPE, _CONDITION, _POINTS = "shape", "condition", "points"


def shape_of(part: exp.Expr) -> Shape | None:
    """Return the shape that a call of geometry makes, or None."""
    shape: Shape | None = part.meta.get(_SHAPE)
    return shape


def condition_of(part: exp.Expr) -> str | None:
    """Return the condition of CONTAINS or INTERSECTS if a part is its result as a number."""
    condition: str | None = part.meta.get(_CONDITION)
    return condition


def points_of(part: exp.Expr) -> tuple[Point, Point] | None:
    """Return the two points if a part is their separation from DISTANCE, else None."""
    points: tuple[Point, Point] | None = part.meta.get(_POINTS)
    return points


def raw(sql: str) -> exp.Var:
    """Return a part of a tree that is written unchanged."""
    return exp.Var(this=sql)


def sql_text(part: exp.Expr) -> str:
    """Return a part in the SQL of DuckDB."""
    return part.sql(dialect="duckdb", identify=True, comments=False)


def is_text(part: exp.Expr) -> bool:
    """Return whether a part is a text in quotes."""
    return isinstance(part, exp.Literal) and bool(part.is_string)


def number_sql(text: str) -> str:
    """Return a number that DuckDB reads as a 64-bit integer or a double, and nothing else."""
    is_whole = text.lstrip("+-").isdigit()
    if is_whole and abs(int(text)) <= _MAX_INTEGER:
        return text
    return text if "e" in text.lower() else f"{text}e0"


def check_count(part: exp.Anonymous, least: int, most: int) -> None:
    """Refuse a call with a wrong number of arguments."""
    count = len(part.expressions)
    if not least <= count <= most:
        many = str(least) if least == most else f"{least} to {most}"
        raise AdqlRefusal(f"{part.name.upper()} takes {many} arguments; found {count}", part)


class GeometryCalls:
    """The calls of geometry in a query, and the length of the resulting arithmetic."""

    def __init__(self) -> None:
        self._characters = 0

    def read(self, part: exp.Anonymous) -> bool:
        """Store the shape of a call, or write its result as SQL; False for other functions."""
        name = part.name.upper()
        if name in _SHAPES:
            part.meta[_SHAPE] = _SHAPES[name](part)
        elif name == "CENTROID":
            part.meta[_SHAPE] = geometry.centroid(*self._shapes_of(part, 1))
        elif name in _CONDITIONS:
            try:
                asked = _CONDITIONS[name](*self._shapes_of(part, 2))
            except ValueError as error:
                raise AdqlRefusal(f"{name}: {error}", part) from None
            number = raw(f"CAST({asked} AS INTEGER)")
            number.meta[_CONDITION] = asked
            part.replace(number)
        elif name == "DISTANCE" and len(part.expressions) == 4:
            numbers = _numbers(part, 4)
            _replace_distance(part, Point(*numbers[:2]), Point(*numbers[2:]))
        elif name in _MEASURES:
            shapes = self._shapes_of(part, 2 if name == "DISTANCE" else 1)
            if name in _OF_POINTS and not all(isinstance(shape, Point) for shape in shapes):
                raise AdqlRefusal(f"{name} takes a POINT", part)
            if name == "DISTANCE":
                _replace_distance(part, *shapes)
            else:
                part.replace(raw(_MEASURES[name](*shapes)))
        return name in GEOMETRY

    def _shapes_of(self, part: exp.Anonymous, count: int) -> list[Shape]:
        name = part.name.upper()
        check_count(part, count, count)
        shapes = [
            shape for argument in part.expressions if (shape := shape_of(argument)) is not None
        ]
        if len(shapes) < count:
            raise AdqlRefusal(
                f"{name} takes {count} of POINT, CIRCLE, BOX, POLYGON, CENTROID, written "
                "out as its arguments",
                part,
            )
        self._characters += geometry.characters(shapes)
        if self._characters > MAX_CHARACTERS:
            raise AdqlRefusal(
                f"{name} takes too much arithmetic; give polygons fewer corners, or numbers "
                "instead of columns, and work middles out in a query in parentheses",
                part,
            )
        return shapes


def _replace_distance(part: exp.Expr, *points: Shape) -> None:
    separation = raw(geometry.distance(*points))  # type: ignore[arg-type]
    separation.meta[_POINTS] = points
    part.replace(separation)


def _point(part: exp.Anonymous) -> Shape:
    return _in_icrs(part, Point(*_numbers(part, 2)))


def _in_icrs(part: exp.Anonymous, shape: Shape) -> Shape:
    """Return a shape with the frame before its coordinates applied."""
    first = part.expressions[0]
    if not is_text(first) or first.name.upper().split(" ")[0] != "GALACTIC":
        return shape
    if isinstance(shape, Zone):
        raise AdqlRefusal(
            "a galactic BOX is less than half a turn wide, and not beyond a pole", part
        )
    return geometry.from_galactic(shape)


def _centred(part: exp.Anonymous) -> Shape:
    """Return a circle or a box, whose centre is a point or two numbers."""
    first, *others = _without_frame(part) or [part]
    name = part.name.upper()
    shape = _shape_with(name, [*_place_or_number(first), *map(_operand, others)])
    if shape is None or not isinstance(shape_of(first), (Point, type(None))):
        many = "1 more number" if name == "CIRCLE" else "2 more numbers"
        raise AdqlRefusal(f"{name} takes a place, as POINT or two numbers, and {many}", part)
    # The coordinates of a POINT are already ICRS.
    return shape if shape_of(first) is not None else _in_icrs(part, shape)


def _polygon(part: exp.Anonymous) -> Shape:
    arguments = _without_frame(part)
    shapes = [shape_of(argument) for argument in arguments]
    if any(shapes) and not all(isinstance(shape, Point) for shape in shapes):
        raise AdqlRefusal("POLYGON takes places or numbers, and not both", part)
    numbers = [number for argument in arguments for number in _place_or_number(argument)]
    if len(numbers) % 2:
        raise AdqlRefusal("POLYGON takes pairs of numbers", part)
    polygon = _shape_with("POLYGON", numbers)
    if polygon is None:
        raise AdqlRefusal(
            f"POLYGON takes 3 to {MAX_CORNERS} corners; found {len(numbers) // 2}", part
        )
    return polygon if any(shapes) else _in_icrs(part, polygon)


def _region(part: exp.Anonymous) -> Shape:
    raise AdqlRefusal("REGION is not supported; write CIRCLE, BOX or POLYGON with numbers", part)


def _shape_with(name: str, numbers: list[str]) -> Shape | None:
    """Return the shape with these numbers; None if their count is wrong for it."""
    if name == "POLYGON" and len(numbers) % 2 == 0 and 6 <= len(numbers) <= 2 * MAX_CORNERS:
        pairs = zip(numbers[::2], numbers[1::2], strict=True)
        return Polygon(tuple(Point(*pair) for pair in pairs))
    match name, len(numbers):
        case "POINT", 2:
            return Point(*numbers)
        case "CIRCLE", 3:
            return Circle(Point(*numbers[:2]), numbers[2])
        case "BOX", 4:
            return geometry.box(Point(*numbers[:2]), *numbers[2:])
    return None


def _numbers(part: exp.Anonymous, count: int) -> list[str]:
    arguments = _without_frame(part)
    if len(arguments) != count or any(map(shape_of, arguments)):
        raise AdqlRefusal(f"{part.name.upper()} takes {count} numbers, degrees", part)
    return [_operand(argument) for argument in arguments]


def _without_frame(part: exp.Anonymous) -> list[exp.Expr]:
    """Return the arguments of a shape without the optional frame before them."""
    arguments = list(part.expressions)
    if arguments and is_text(arguments[0]):
        frame = arguments.pop(0).name.upper()
        if frame.split(" ")[0] not in FRAMES:
            raise AdqlRefusal(
                f"the frame {quoted(frame)} is not known here; use ICRS or GALACTIC", part
            )
    if any(is_text(argument) for argument in arguments):
        raise AdqlRefusal(f"{part.name.upper()} takes numbers, degrees", part)
    return arguments


_SHAPES: dict[str, Callable[[exp.Anonymous], Shape]] = {
    "POINT": _point, "CIRCLE": _centred, "BOX": _centred, "POLYGON": _polygon, "REGION": _region,
}  # fmt: skip

_CONDITIONS = {"CONTAINS": geometry.contains, "INTERSECTS": geometry.intersects}

_MEASURES: dict[str, Callable[..., str]] = {
    "DISTANCE": geometry.distance,
    "AREA": geometry.area,
    "COORD1": lambda point: f"(({point.lon})::DOUBLE)",
    "COORD2": lambda point: f"(({point.lat})::DOUBLE)",
    "COORDSYS": lambda _: "'ICRS'",
}
_OF_POINTS = ("DISTANCE", "COORD1", "COORD2")

GEOMETRY = (*_SHAPES, "CENTROID", *_CONDITIONS, *_MEASURES)  # the functions of geometry


def _place_or_number(part: exp.Expr) -> tuple[str, ...]:
    shape = shape_of(part)
    return (shape.lon, shape.lat) if isinstance(shape, Point) else (_operand(part),)


def _operand(part: exp.Expr) -> str:
    """Return SQL that arithmetic may be written around."""
    sql = sql_text(part)
    return sql if isinstance(part, (exp.Column, exp.Var)) else f"({sql})"
