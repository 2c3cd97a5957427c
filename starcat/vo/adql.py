"""ADQL 2.1 to the SQL of DuckDB, with what is known of the columns of the answer.

`starcat.vo.adql_grammar` reads the text and refuses what is no ADQL. Here names become those of the
session, functions those of DuckDB and of starcat's macros, and geometry becomes arithmetic
(`starcat.vo.adql_geometry`). What comes out is checked again by the session that runs it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sqlglot import exp

from starcat.errors import QueryError, quoted, suggest
from starcat.vo import adql_geometry as geometry
from starcat.vo.adql_columns import Columns, Names
from starcat.vo.adql_functions import FUNCTIONS
from starcat.vo.adql_geometry import Circle, Point, Polygon, Shape
from starcat.vo.adql_grammar import parse_adql, refuse
from starcat.vo.tables import Tables

MAX_CORNERS = 400
"""Corners of a polygon at most."""

MAX_CHARACTERS = 1_000_000
"""Length of the arithmetic that the geometry of a query may become, roughly."""

FRAMES = ("", "ICRS", "UNKNOWNFRAME")
"""Frames of coordinates; those behind a space, as in ``ICRS GEOCENTER``, make no difference."""

_MAX_INTEGER = 2**63 - 1


@dataclass(frozen=True)
class Translation:
    """A query as the session runs it."""

    sql: str  # SQL of DuckDB
    # What is known of the columns of the answer; None where their names are not known before it
    # runs.
    columns: Columns | None


def translate(text: str, tables: Tables) -> Translation:
    """Return a query in ADQL as SQL."""
    tree = parse_adql(text)
    try:
        return _Translator(text, tables, tree).translation()
    except RecursionError as error:
        raise QueryError(
            "the query is nested too deeply; write it with fewer parentheses within each other"
        ) from error


class _Translator:
    """The work of `translate`: parts of the tree are replaced from the leaves on."""

    def __init__(self, text: str, tables: Tables, tree: exp.Expr) -> None:
        self._text = text
        self._tree = tree
        self._names = Names(tables, text, tree)
        self._characters = 0
        self._shapes: dict[int, Shape] = {}
        self._conditions: dict[int, str] = {}
        # Numbers of objects are theirs only as long as the objects live.
        self._kept: list[exp.Expr] = []

    def translation(self) -> Translation:
        tree = self._tree
        parts = list(tree.walk())
        for part in parts:
            if isinstance(part, exp.Column):
                self._names.check(part)
        columns = self._names.columns(tree)
        root = exp.Paren(this=tree)
        for part in reversed(parts):
            self._rewrite(part)
        for part in list(root.walk()):
            if id(part) in self._shapes:
                part.replace(_raw(self._shapes[id(part)].value))
        return Translation(_sql(root.this), columns)

    def _rewrite(self, part: exp.Expr) -> None:
        part.comments = None
        if isinstance(part, exp.Table):
            self._names.resolve(part)
        elif isinstance(part, exp.Column):
            self._names.shorten(part)
        elif isinstance(part, exp.Literal) and not part.is_string:
            # In its place: to put another part there takes as long as the list is that it is in.
            part.set("this", _number(part.name))
        elif isinstance(part, exp.HexString):
            part.replace(_raw(_number(str(int(part.name, 16)))))
        elif isinstance(part, exp.Cast) and part.to.expressions:
            size = part.to.expressions[0].name
            part.replace(_raw(f"left(CAST({_sql(part.this)} AS VARCHAR), {size})"))
        elif isinstance(part, (exp.EQ, exp.NEQ)):
            self._compare(part)
        elif isinstance(part, exp.Anonymous):
            self._call(part)
        elif isinstance(part, exp.SetOperation):
            for side in ("this", "expression"):
                query = part.args[side]
                if isinstance(query, exp.Select) and query.args.get("limit"):
                    part.set(side, exp.Subquery(this=query))

    def _compare(self, part: exp.EQ | exp.NEQ) -> None:
        """Write ``1 = CONTAINS(...)`` as what CONTAINS asks, which DuckDB can look ahead with."""
        for one, other in ((part.this, part.expression), (part.expression, part.this)):
            asked = self._conditions.get(id(one))
            number = "" if asked is None else _sql(other)
            if asked is not None and number in ("0", "1"):
                is_asked = (number == "1") == isinstance(part, exp.EQ)
                part.replace(_raw(asked if is_asked else f"NOT {asked}"))
                return

    def _call(self, part: exp.Anonymous) -> None:
        name = part.this.upper() if isinstance(part.this, str) else ""
        if name in _SHAPES:
            self._keep(part)
            self._shapes[id(part)] = _SHAPES[name](self, part)
            return
        if name in _MEASURES:
            _MEASURES[name](self, part)
            return
        if name == "IN_UNIT":
            self._in_unit(part)
            return
        if name not in FUNCTIONS:
            known = sorted({*FUNCTIONS, *_SHAPES, *_MEASURES, "IN_UNIT", "CAST"})
            raise self._refusal(
                f"no function {quoted(part.name)}; {suggest(name, known)}there are "
                f"{', '.join(known)}",
                part,
            )
        function = FUNCTIONS[name]
        self._count(part, name, function.least, function.most)
        arguments = part.expressions
        inner = arguments[0] if arguments else None
        if isinstance(inner, exp.Distinct) and not function.is_set:
            raise self._refusal(f"{name} takes no DISTINCT", part)
        if isinstance(inner, exp.Star) and name != "COUNT":
            raise self._refusal(f"{name} takes no *", part)
        for argument in arguments:
            if id(argument) in self._shapes:
                raise self._refusal(f"{name} takes numbers or texts, and no geometry", part)
        part.replace(_raw(function.sql([_sql(argument) for argument in arguments])))

    def _in_unit(self, part: exp.Anonymous) -> None:
        """Write the factor between the unit of a column and another."""
        self._count(part, "IN_UNIT", 2, 2)
        value, wanted = part.expressions
        if not isinstance(value, exp.Column) or not _is_text(wanted):
            raise self._refusal("IN_UNIT takes a column and a unit, as IN_UNIT(ra, 'rad')", part)
        found = self._names.column(value)
        if found is None or not found.unit:
            raise self._refusal(f"IN_UNIT: the column {quoted(value.name)} has no unit", part)
        from astropy import units

        try:
            factor = units.Unit(found.unit).to(units.Unit(wanted.name))
        except (ValueError, TypeError) as error:
            raise self._refusal(
                f"IN_UNIT: {quoted(found.unit)} of {value.name} is not to be had in "
                f"{quoted(wanted.name)}",
                part,
            ) from error
        part.replace(_raw(f"({_sql(value)} * {float(factor)!r}::DOUBLE)"))

    # Geometry.

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
        shapes = [self._shapes.get(id(argument)) for argument in arguments]
        if any(shapes):
            corners = [shape for shape in shapes if isinstance(shape, Point)]
            if len(corners) < len(shapes):
                raise self._refusal("POLYGON takes places or numbers, and not both", part)
        else:
            numbers = [_operand(argument) for argument in arguments]
            if len(numbers) % 2:
                raise self._refusal("POLYGON takes pairs of numbers", part)
            corners = [Point(*pair) for pair in zip(numbers[::2], numbers[1::2], strict=True)]
        if not 3 <= len(corners) <= MAX_CORNERS:
            raise self._refusal(
                f"POLYGON takes 3 to {MAX_CORNERS} corners; found {len(corners)}", part
            )
        return Polygon(tuple(corners))

    def _region(self, part: exp.Anonymous) -> Shape:
        """Read a shape that is written as a text of STC-S."""
        self._count(part, "REGION", 1, 1)
        [argument] = part.expressions
        words = argument.name.upper().split() if _is_text(argument) else []
        numbers = [word for word in words[1:] if _is_number(word)]
        others = words[1 : len(words) - len(numbers)]
        known = set(others) <= {"ICRS", "GEOCENTER", "BARYCENTER", "TOPOCENTER", "SPHERICAL2"}
        kind = words[0] if words and known and words[len(others) + 1 :] == numbers else ""
        numbers = [_number(number) for number in numbers]
        if kind in ("POSITION", "POINT") and len(numbers) == 2:
            return Point(*numbers)
        if kind == "CIRCLE" and len(numbers) == 3:
            return Circle(Point(*numbers[:2]), numbers[2])
        if kind == "BOX" and len(numbers) == 4:
            return geometry.box(Point(*numbers[:2]), *numbers[2:])
        if kind == "POLYGON" and len(numbers) % 2 == 0 and 6 <= len(numbers) <= 2 * MAX_CORNERS:
            pairs = zip(numbers[::2], numbers[1::2], strict=True)
            return Polygon(tuple(Point(*pair) for pair in pairs))
        raise self._refusal(
            "REGION takes a text such as 'CIRCLE ICRS 10.5 -20 0.1', with POSITION, CIRCLE, BOX or "
            "POLYGON",
            part,
        )

    def _centroid(self, part: exp.Anonymous) -> Point:
        return geometry.centroid(self._shapes_of(part, "CENTROID", 1)[0])

    def _contains(self, part: exp.Anonymous) -> None:
        inner, outer = self._shapes_of(part, "CONTAINS", 2)
        self._answer(part, geometry.contains(inner, outer))

    def _intersects(self, part: exp.Anonymous) -> None:
        self._answer(part, geometry.intersects(*self._shapes_of(part, "INTERSECTS", 2)))

    def _answer(self, part: exp.Anonymous, asked: str) -> None:
        number = _raw(f"CAST({asked} AS INTEGER)")
        self._keep(number)
        self._conditions[id(number)] = asked
        part.replace(number)

    def _distance(self, part: exp.Anonymous) -> None:
        if len(part.expressions) == 4:
            numbers = self._numbers(part, "DISTANCE", 4, 4)
            one, other = Point(*numbers[:2]), Point(*numbers[2:])
        else:
            one, other = (
                self._as_point(shape, part) for shape in self._shapes_of(part, "DISTANCE", 2)
            )
        part.replace(_raw(geometry.distance(one, other)))

    def _area(self, part: exp.Anonymous) -> None:
        part.replace(_raw(geometry.area(self._shapes_of(part, "AREA", 1)[0])))

    def _coordinate(self, part: exp.Anonymous) -> None:
        name = part.name.upper()
        [shape] = self._shapes_of(part, name, 1)
        place = self._as_point(shape, part)
        part.replace(_raw(f"(({place.lon if name == 'COORD1' else place.lat})::DOUBLE)"))

    def _frame(self, part: exp.Anonymous) -> None:
        self._shapes_of(part, "COORDSYS", 1)
        part.replace(_raw("'ICRS'"))

    def _as_point(self, shape: Shape, part: exp.Expr) -> Point:
        if not isinstance(shape, Point):
            raise self._refusal(f"{part.name.upper()} takes a POINT", part)
        return shape

    def _shapes_of(self, part: exp.Anonymous, name: str, count: int) -> list[Shape]:
        self._count(part, name, count, count)
        found = [self._shapes.get(id(argument)) for argument in part.expressions]
        shapes = [shape for shape in found if shape is not None]
        if len(shapes) < count:
            raise self._refusal(
                f"{name} takes {count} of POINT, CIRCLE, BOX, POLYGON, REGION, CENTROID, written "
                "out as its arguments",
                part,
            )
        self._characters += geometry.characters(shapes)
        if self._characters > MAX_CHARACTERS:
            raise self._refusal(
                f"{name} takes too much arithmetic; give polygons fewer corners, or numbers "
                "instead of columns, and work middles out in a query in parentheses",
                part,
            )
        return shapes

    def _centred(
        self, part: exp.Anonymous, name: str, count: int
    ) -> tuple[Point, *tuple[str, ...]]:
        """Return the middle of a shape, given as a place or as two numbers, and its sizes."""
        arguments = self._without_frame(part)
        first = self._shapes.get(id(arguments[0])) if arguments else None
        if isinstance(first, Point) and len(arguments) == 1 + count:
            return first, *map(_operand, arguments[1:])
        if first is not None or len(arguments) != 2 + count:
            raise self._refusal(
                f"{name} takes a place, as POINT or two numbers, and {count} more "
                f"number{'s' if count > 1 else ''}",
                part,
            )
        numbers = [_operand(argument) for argument in arguments]
        return Point(*numbers[:2]), *numbers[2:]

    def _numbers(self, part: exp.Anonymous, name: str, least: int, most: int) -> list[str]:
        arguments = self._without_frame(part)
        if not least <= len(arguments) <= most or any(id(a) in self._shapes for a in arguments):
            raise self._refusal(f"{name} takes {least} numbers, degrees", part)
        return [_operand(argument) for argument in arguments]

    def _without_frame(self, part: exp.Anonymous) -> list[exp.Expr]:
        """Return the arguments of a shape without the frame that may stand before them."""
        arguments = list(part.expressions)
        if arguments and _is_text(arguments[0]):
            frame = arguments.pop(0).name.upper()
            if frame.split(" ")[0] not in FRAMES:
                raise self._refusal(
                    f"the frame {quoted(frame)} is not known here; all places are ICRS", part
                )
        if any(_is_text(argument) for argument in arguments):
            raise self._refusal(f"{part.name.upper()} takes numbers, degrees", part)
        return arguments

    def _count(self, part: exp.Anonymous, name: str, least: int, most: int) -> None:
        found = len(part.expressions)
        if not least <= found <= most:
            many = str(least) if least == most else f"{least} to {most}"
            raise self._refusal(f"{name} takes {many} arguments; found {found}", part)

    def _keep(self, part: exp.Expr) -> None:
        self._kept.append(part)

    def _refusal(self, message: str, part: exp.Expr) -> QueryError:
        return refuse(message, part, self._text)


_SHAPES: dict[str, Callable[[_Translator, exp.Anonymous], Shape]] = {
    "POINT": _Translator._point,
    "CIRCLE": _Translator._circle,
    "BOX": _Translator._box,
    "POLYGON": _Translator._polygon,
    "REGION": _Translator._region,
    "CENTROID": _Translator._centroid,
}

_MEASURES: dict[str, Callable[[_Translator, exp.Anonymous], None]] = {
    "CONTAINS": _Translator._contains,
    "INTERSECTS": _Translator._intersects,
    "DISTANCE": _Translator._distance,
    "AREA": _Translator._area,
    "COORD1": _Translator._coordinate,
    "COORD2": _Translator._coordinate,
    "COORDSYS": _Translator._frame,
}

GEOMETRY = (*_SHAPES, *_MEASURES)
"""The functions of geometry that there are."""


def _raw(sql: str) -> exp.Var:
    """Return a part of a tree that is written as it is."""
    return exp.Var(this=sql)


def _sql(part: exp.Expr) -> str:
    return part.sql(dialect="duckdb", identify=True, comments=False)


def _operand(part: exp.Expr) -> str:
    """Return SQL that arithmetic may be written around."""
    sql = _sql(part)
    return sql if isinstance(part, (exp.Column, exp.Var)) else f"({sql})"


def _is_text(part: exp.Expr) -> bool:
    return isinstance(part, exp.Literal) and bool(part.is_string)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return word[-1].isdigit() or word[-1] == "."


def _number(text: str) -> str:
    """Return a number as DuckDB takes it for a 64-bit integer or a double, and nothing else."""
    is_whole = text.lstrip("+-").isdigit()
    if is_whole and abs(int(text)) <= _MAX_INTEGER:
        return text
    return text if "e" in text.lower() else f"{text}e0"
