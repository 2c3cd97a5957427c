"""Calls of ADQL's geometry: to shapes, and to SQL of what is asked of them.

A shape is noted at its call in the syntax tree, for the call that it is an argument of.
"""

from __future__ import annotations

from collections.abc import Callable

from sqlglot import exp

from starcat.errors import quoted
from starcat.vo import adql_geometry as geometry
from starcat.vo.adql_geometry import Circle, Point, Polygon, Shape
from starcat.vo.adql_grammar import refuse

MAX_CORNERS = 400  # corners of a polygon at most
MAX_CHARACTERS = 1_000_000
"""Length of the arithmetic that the geometry of a query may become, roughly."""

FRAMES = ("", "ICRS", "UNKNOWNFRAME")
"""Frames of coordinates; those behind a space, as in ``ICRS GEOCENTER``, make no difference."""

_MAX_INTEGER = 2**63 - 1
_SHAPE, _CONDITION = "shape", "condition"


def shape_of(part: exp.Expr) -> Shape | None:
    """Return the shape that a call of geometry makes, if it is one."""
    found: Shape | None = part.meta.get(_SHAPE)
    return found


def condition_of(part: exp.Expr) -> str | None:
    """Return what CONTAINS or INTERSECTS asked, where a part is their answer as a number."""
    found: str | None = part.meta.get(_CONDITION)
    return found


def raw(sql: str) -> exp.Var:
    """Return a part of a tree that is written as it is."""
    return exp.Var(this=sql)


def sql_text(part: exp.Expr) -> str:
    """Return a part as DuckDB writes it."""
    return part.sql(dialect="duckdb", identify=True, comments=False)


def is_text(part: exp.Expr) -> bool:
    """Return whether a part is a text in quotes."""
    return isinstance(part, exp.Literal) and bool(part.is_string)


def number_sql(text: str) -> str:
    """Return a number as DuckDB takes it for a 64-bit integer or a double, and nothing else."""
    is_whole = text.lstrip("+-").isdigit()
    if is_whole and abs(int(text)) <= _MAX_INTEGER:
        return text
    return text if "e" in text.lower() else f"{text}e0"


def check_count(text: str, part: exp.Anonymous, name: str, least: int, most: int) -> None:
    """Refuse a call with another number of arguments."""
    found = len(part.expressions)
    if not least <= found <= most:
        many = str(least) if least == most else f"{least} to {most}"
        raise refuse(f"{name} takes {many} arguments; found {found}", part, text)


class GeometryCalls:
    """The calls of geometry in a query."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._characters = 0

    def read(self, name: str, part: exp.Anonymous) -> bool:
        """Note the shape of a call, or write what it asks as SQL; False for other functions."""
        if name in _SHAPES:
            part.meta[_SHAPE] = _SHAPES[name](self, part)
        elif name in _MEASURES:
            _MEASURES[name](self, part)
        return name in GEOMETRY

    def _point(self, part: exp.Anonymous) -> Point:
        numbers = self._numbers(part, "POINT", 2, 2)
        return Point(*numbers)

    def _circle(self, part: exp.Anonymous) -> Circle:
        centre, *others = self._centred(part, "CIRCLE", 1)
        return Circle(centre, others[0])

    def _box(self, part: exp.Anonymous) -> Polygon:
        centre, *others = self._centred(part, "BOX", 2)
        return geometry.box(centre, *others)

    def _polygon(self, part: exp.Anonymous) -> Polygon:
        arguments = self._without_frame(part)
        shapes = [shape_of(argument) for argument in arguments]
        if any(shapes):
            corners = [shape for shape in shapes if isinstance(shape, Point)]
            if len(corners) < len(shapes):
                raise refuse("POLYGON takes places or numbers, and not both", part, self._text)
        else:
            numbers = [_operand(argument) for argument in arguments]
            if len(numbers) % 2:
                raise refuse("POLYGON takes pairs of numbers", part, self._text)
            corners = [Point(*pair) for pair in zip(numbers[::2], numbers[1::2], strict=True)]
        if not 3 <= len(corners) <= MAX_CORNERS:
            raise refuse(
                f"POLYGON takes 3 to {MAX_CORNERS} corners; found {len(corners)}", part, self._text
            )
        return Polygon(tuple(corners))

    def _region(self, part: exp.Anonymous) -> Shape:
        """Read a shape that is written as a text of STC-S."""
        check_count(self._text, part, "REGION", 1, 1)
        [argument] = part.expressions
        words = argument.name.upper().split() if is_text(argument) else []
        numbers = [word for word in words[1:] if _is_number(word)]
        others = words[1 : len(words) - len(numbers)]
        known = set(others) <= {"ICRS", "GEOCENTER", "BARYCENTER", "TOPOCENTER", "SPHERICAL2"}
        kind = words[0] if words and known and words[len(others) + 1 :] == numbers else ""
        numbers = [number_sql(number) for number in numbers]
        if kind in ("POSITION", "POINT") and len(numbers) == 2:
            return Point(*numbers)
        if kind == "CIRCLE" and len(numbers) == 3:
            return Circle(Point(*numbers[:2]), numbers[2])
        if kind == "BOX" and len(numbers) == 4:
            return geometry.box(Point(*numbers[:2]), *numbers[2:])
        if kind == "POLYGON" and len(numbers) % 2 == 0 and 6 <= len(numbers) <= 2 * MAX_CORNERS:
            pairs = zip(numbers[::2], numbers[1::2], strict=True)
            return Polygon(tuple(Point(*pair) for pair in pairs))
        raise refuse(
            "REGION takes a text such as 'CIRCLE ICRS 10.5 -20 0.1', with POSITION, CIRCLE, BOX or "
            "POLYGON",
            part,
            self._text,
        )

    def _centroid(self, part: exp.Anonymous) -> Point:
        return geometry.centroid(self._shapes_of(part, "CENTROID", 1)[0])

    def _contains(self, part: exp.Anonymous) -> None:
        inner, outer = self._shapes_of(part, "CONTAINS", 2)
        self._answer(part, geometry.contains(inner, outer))

    def _intersects(self, part: exp.Anonymous) -> None:
        self._answer(part, geometry.intersects(*self._shapes_of(part, "INTERSECTS", 2)))

    def _answer(self, part: exp.Anonymous, asked: str) -> None:
        number = raw(f"CAST({asked} AS INTEGER)")
        number.meta[_CONDITION] = asked
        part.replace(number)

    def _distance(self, part: exp.Anonymous) -> None:
        if len(part.expressions) == 4:
            numbers = self._numbers(part, "DISTANCE", 4, 4)
            one, other = Point(*numbers[:2]), Point(*numbers[2:])
        else:
            one, other = (
                self._as_point(shape, part) for shape in self._shapes_of(part, "DISTANCE", 2)
            )
        part.replace(raw(geometry.distance(one, other)))

    def _area(self, part: exp.Anonymous) -> None:
        part.replace(raw(geometry.area(self._shapes_of(part, "AREA", 1)[0])))

    def _coordinate(self, part: exp.Anonymous) -> None:
        name = part.name.upper()
        [shape] = self._shapes_of(part, name, 1)
        place = self._as_point(shape, part)
        part.replace(raw(f"(({place.lon if name == 'COORD1' else place.lat})::DOUBLE)"))

    def _frame(self, part: exp.Anonymous) -> None:
        self._shapes_of(part, "COORDSYS", 1)
        part.replace(raw("'ICRS'"))

    def _as_point(self, shape: Shape, part: exp.Expr) -> Point:
        if not isinstance(shape, Point):
            raise refuse(f"{part.name.upper()} takes a POINT", part, self._text)
        return shape

    def _shapes_of(self, part: exp.Anonymous, name: str, count: int) -> list[Shape]:
        check_count(self._text, part, name, count, count)
        found = [shape_of(argument) for argument in part.expressions]
        shapes = [shape for shape in found if shape is not None]
        if len(shapes) < count:
            raise refuse(
                f"{name} takes {count} of POINT, CIRCLE, BOX, POLYGON, REGION, CENTROID, written "
                "out as its arguments",
                part,
                self._text,
            )
        self._characters += geometry.characters(shapes)
        if self._characters > MAX_CHARACTERS:
            raise refuse(
                f"{name} takes too much arithmetic; give polygons fewer corners, or numbers "
                "instead of columns, and work middles out in a query in parentheses",
                part,
                self._text,
            )
        return shapes

    def _centred(
        self, part: exp.Anonymous, name: str, count: int
    ) -> tuple[Point, *tuple[str, ...]]:
        """Return the middle of a shape, given as a place or as two numbers, and its sizes."""
        arguments = self._without_frame(part)
        first = shape_of(arguments[0]) if arguments else None
        if isinstance(first, Point) and len(arguments) == 1 + count:
            return first, *map(_operand, arguments[1:])
        if first is not None or len(arguments) != 2 + count:
            raise refuse(
                f"{name} takes a place, as POINT or two numbers, and {count} more "
                f"number{'s' if count > 1 else ''}",
                part,
                self._text,
            )
        numbers = [_operand(argument) for argument in arguments]
        return Point(*numbers[:2]), *numbers[2:]

    def _numbers(self, part: exp.Anonymous, name: str, least: int, most: int) -> list[str]:
        arguments = self._without_frame(part)
        if not least <= len(arguments) <= most or any(map(shape_of, arguments)):
            raise refuse(f"{name} takes {least} numbers, degrees", part, self._text)
        return [_operand(argument) for argument in arguments]

    def _without_frame(self, part: exp.Anonymous) -> list[exp.Expr]:
        """Return the arguments of a shape without the frame that may stand before them."""
        arguments = list(part.expressions)
        if arguments and is_text(arguments[0]):
            frame = arguments.pop(0).name.upper()
            if frame.split(" ")[0] not in FRAMES:
                raise refuse(
                    f"the frame {quoted(frame)} is not known here; all places are ICRS",
                    part,
                    self._text,
                )
        if any(is_text(argument) for argument in arguments):
            raise refuse(f"{part.name.upper()} takes numbers, degrees", part, self._text)
        return arguments


_SHAPES: dict[str, Callable[[GeometryCalls, exp.Anonymous], Shape]] = {
    "POINT": GeometryCalls._point,
    "CIRCLE": GeometryCalls._circle,
    "BOX": GeometryCalls._box,
    "POLYGON": GeometryCalls._polygon,
    "REGION": GeometryCalls._region,
    "CENTROID": GeometryCalls._centroid,
}

_MEASURES: dict[str, Callable[[GeometryCalls, exp.Anonymous], None]] = {
    "CONTAINS": GeometryCalls._contains,
    "INTERSECTS": GeometryCalls._intersects,
    "DISTANCE": GeometryCalls._distance,
    "AREA": GeometryCalls._area,
    "COORD1": GeometryCalls._coordinate,
    "COORD2": GeometryCalls._coordinate,
    "COORDSYS": GeometryCalls._frame,
}

GEOMETRY = (*_SHAPES, *_MEASURES)  # the functions of geometry that there are


def _operand(part: exp.Expr) -> str:
    """Return SQL that arithmetic may be written around."""
    sql = sql_text(part)
    return sql if isinstance(part, (exp.Column, exp.Var)) else f"({sql})"


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return word[-1].isdigit() or word[-1] == "."
