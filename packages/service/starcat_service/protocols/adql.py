"""Translate ADQL 2.1 to the SQL of DuckDB, and describe the columns of the answer.

`adql_grammar` reads the text and refuses everything that is not ADQL. This module replaces the
names by names of the session, and the functions by functions of DuckDB and starcat's macros.
`adql_shapes` turns geometry into arithmetic. The session that runs the SQL checks it again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from sqlglot import exp

from starcat.errors import quoted, suggest
from starcat.progress import Progress, no_progress
from starcat.query import Session, quoted_name
from starcat.ship.exchange import begun, described
from starcat_service.protocols.adql_columns import Columns, Names
from starcat_service.protocols.adql_geometry import within
from starcat_service.protocols.adql_grammar import AdqlRefusal, parse_adql, refusals_of
from starcat_service.protocols.adql_shapes import (
    GEOMETRY,
    GeometryCalls,
    check_count,
    condition_of,
    is_text,
    number_sql,
    points_of,
    raw,
    shape_of,
    sql_text,
)
from starcat_service.protocols.tables import Tables, TapColumn, cast

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True)
class Function:
    """A function other than geometry, as DuckDB writes it."""

    # Least and largest number of arguments.
    least: int
    most: int
    # SQL of DuckDB with {0}, {1} for the arguments, 0 if one is missing; {all} for all of them.
    written: str
    is_set: bool = False  # an aggregate, with DISTINCT or ALL
    is_windowed: bool = False  # needs OVER

    def sql(self, arguments: list[str]) -> str:
        """Return the call in the SQL of DuckDB."""
        left_out = ["0"] * (self.most - len(arguments))
        return self.written.format(*arguments, *left_out, all=", ".join(arguments))


def _same(name: str, count: int = 1) -> Function:
    places = ", ".join(f"{{{k}}}" for k in range(count))
    return Function(count, count, f"{name}({places})")


WINDOWED = (
    ("ROW_NUMBER", 0, 0), ("RANK", 0, 0), ("DENSE_RANK", 0, 0), ("NTILE", 1, 1), ("LAG", 1, 3),
    ("LEAD", 1, 3), ("FIRST_VALUE", 1, 1), ("LAST_VALUE", 1, 1),
)  # fmt: skip
"""Functions that read other rows of a window: their names and numbers of arguments."""

_SAME = "ABS DEGREES EXP FLOOR LOG10 RADIANS SQRT ACOS ASIN ATAN COS COT SIN TAN LOWER UPPER"

FUNCTIONS: dict[str, Function] = {
    **{name: _same(name.lower()) for name in _SAME.split()},
    "CEILING": _same("ceil"),
    "LOG": _same("ln"),
    # A remainder by 0 has no value; DuckDB would end the query.
    "MOD": Function(2, 2, "mod({0}, nullif({1}, 0))"),
    "PI": _same("pi", 0),
    "POWER": _same("power", 2),
    # ADQL leaves the effect of a seed to the service; here it has none.
    "RAND": Function(0, 1, "random()"),
    "ROUND": Function(1, 2, "round(({0})::DOUBLE, {1})"),
    "TRUNCATE": Function(1, 2, "trunc(({0})::DOUBLE, {1})"),
    "ATAN2": _same("atan2", 2),
    "COALESCE": Function(1, 1000, "coalesce({all})"),
    "TIMESTAMP": Function(1, 1, "CAST({0} AS TIMESTAMP)"),
    **{
        name: Function(1, 1, f"{name.lower()}({{0}})", is_set=True)
        for name in ("COUNT", "SUM", "AVG", "MIN", "MAX", "STDDEV", "VARIANCE")
    },
    "SIGN": _same("sign"),
    "SUBSTRING": Function(2, 3, "substring({all})"),
    "LENGTH": _same("length"),
    **{
        name: Function(least, most, f"{name.lower()}({{all}})", is_windowed=True)
        for name, least, most in WINDOWED
    },
    "IVO_HEALPIX_INDEX": Function(3, 3, "healpix({0}, {1}, {2})"),
}
"""Functions by their names in ADQL. Logarithms are natural unless the name has a 10."""

EXTENSIONS = (
    ("CASE", "CASE WHEN condition THEN value ELSE value END, and CASE value WHEN ..."),
    ("COALESCE", "The first value that is there (ADQL 2.1 has it as optional)."),
    ("LIMIT", "LIMIT n at the end of a query, as TOP n."),
    ("SELECT without FROM", "One row of constants."),
    ("OVER", f"Windows with PARTITION BY and ORDER BY for {', '.join(n for n, *_ in WINDOWED)} and "
     "functions of sets."),
    ("SIGN", "-1, 0 or 1."), ("SUBSTRING", "SUBSTRING(text, first[, length]), from 1 on."),
    ("LENGTH", "Characters of a text."), ("STDDEV", "Standard deviation of a sample."),
    ("VARIANCE", "Variance of a sample."),
    ("POINT('GALACTIC', l, b)", "Galactic coordinates in POINT, CIRCLE, BOX and POLYGON; results "
     "are ICRS."),
)  # fmt: skip
"""Syntax beyond ADQL that other archives also accept, with its meaning."""

USER_FUNCTIONS = (
    (
        "ivo_healpix_index(hpxOrder INTEGER, ra DOUBLE, dec DOUBLE) -> BIGINT",
        "The HEALPix cell of a position, degrees, in nested numbering of an order from 0 to 29.",
    ),
)
"""Functions that are not part of ADQL, with their descriptions."""


@dataclass(frozen=True)
class Translation:
    """A query as the session runs it."""

    sql: str  # SQL of DuckDB
    # Descriptions of the columns of the answer; None if the column names are known only after it
    # has run.
    columns: Columns | None


def translate(text: str, tables: Tables) -> Translation:
    """Return a query in ADQL as SQL."""
    tree = parse_adql(text)
    with refusals_of(text):
        return _Translator(tables, tree).translation()


def translate_adql(
    session: Session,
    asked: Translation,
    max_rows: int | None = None,
    progress: Progress = no_progress,
) -> pa.RecordBatchReader:
    """Return the rows of a query, in types of VOTable; all columns get different names.

    One row more than `max_rows` is returned, which shows that there are more. The first rows exist
    already; no other query may be sent before the last row has been read.
    """
    with session.ask(asked.sql) as running:
        result_columns = running.columns
    columns = _named_columns(asked.columns, [name for name, _ in result_columns])
    selected = ", ".join(
        f"{cast(f'#{k}', kind)} AS {quoted_name(column.name)}"
        for k, ((_, kind), column) in enumerate(zip(result_columns, columns, strict=True), start=1)
    )
    limit = "" if max_rows is None else f" LIMIT {max_rows + 1}"
    with session.ask(
        f"SELECT {selected} FROM ({asked.sql}) AS found{limit}", progress=progress
    ) as it:
        batches = described(it.batches(), (column.facts for column in columns))
    return begun(batches)


def _named_columns(columns: tuple[TapColumn, ...] | None, names: list[str]) -> list[TapColumn]:
    """Return the columns of an answer with unique names."""
    if columns is None or len(columns) != len(names):
        columns = tuple(map(TapColumn.unknown, names))
    named: list[TapColumn] = []
    taken: set[str] = set()
    for column in columns:
        name, number = column.name, 1
        while name.lower() in taken:
            number += 1
            name = f"{column.name}_{number}"
        taken.add(name.lower())
        named.append(column.named(name))
    return named


class _Translator:
    """The work of `translate`: it replaces parts of the tree, leaves first."""

    def __init__(self, tables: Tables, tree: exp.Expr) -> None:
        self._tree = tree
        self._names = Names(tables, tree)
        self._geometry = GeometryCalls()

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
            if (shape := shape_of(part)) is not None:
                part.replace(raw(shape.value))
        return Translation(sql_text(root.this), columns)

    def _rewrite(self, part: exp.Expr) -> None:
        part.comments = None
        if isinstance(part, exp.Table):
            self._names.resolve(part)
        elif isinstance(part, exp.Column):
            self._names.shorten(part)
        elif isinstance(part, exp.Literal) and not part.is_string:
            # In place: replacing a part takes as long as the list that contains it.
            part.set("this", number_sql(part.name))
        elif isinstance(part, exp.HexString):
            part.replace(raw(number_sql(str(int(part.name, 16)))))
        elif isinstance(part, exp.Cast) and part.to.expressions:
            size = part.to.expressions[0].name
            part.replace(raw(f"left(CAST({sql_text(part.this)} AS VARCHAR), {size})"))
        elif isinstance(part, (exp.EQ, exp.NEQ)):
            self._compare(part)
        elif isinstance(part, (exp.LT, exp.LTE, exp.GT, exp.GTE)):
            self._compare_distance(part)
        elif isinstance(part, exp.Anonymous):
            self._call(part)
        elif isinstance(part, exp.SetOperation):
            for side in ("this", "expression"):
                query = part.args[side]
                if isinstance(query, exp.Select) and query.args.get("limit"):
                    part.set(side, exp.Subquery(this=query))

    def _compare(self, part: exp.EQ | exp.NEQ) -> None:
        """Write ``1 = CONTAINS(...)`` as its condition, which DuckDB can use to skip data."""
        for side, other in ((part.this, part.expression), (part.expression, part.this)):
            asked = condition_of(side)
            number = "" if asked is None else sql_text(other)
            if asked is not None and number in ("0", "1"):
                is_asked = (number == "1") == isinstance(part, exp.EQ)
                part.replace(raw(asked if is_asked else f"NOT {asked}"))
                return

    def _compare_distance(self, part: exp.LT | exp.LTE | exp.GT | exp.GTE) -> None:
        """Write ``DISTANCE(...) < r`` with the range of declinations, like CONTAINS.

        Only if rows are selected by it; rows without a position are never selected.
        """
        near, far = part.this, part.expression
        if isinstance(part, (exp.GT, exp.GTE)):
            near, far = far, near
        points = points_of(near)
        if points is None or not _chooses(part):
            return
        sign = "<=" if isinstance(part, (exp.LTE, exp.GTE)) else "<"
        part.replace(raw(within(*points, sign, f"({sql_text(far)})")))

    def _call(self, part: exp.Anonymous) -> None:
        name = part.this.upper() if isinstance(part.this, str) else ""
        if self._geometry.read(part):
            return
        if name == "IN_UNIT":
            self._in_unit(part)
            return
        if name not in FUNCTIONS:
            names = sorted({*FUNCTIONS, *GEOMETRY, "IN_UNIT", "CAST"})
            raise AdqlRefusal(
                f"no function {quoted(part.name)}; {suggest(name, names)}there are "
                f"{', '.join(names)}",
                part,
            )
        function = FUNCTIONS[name]
        if function.is_windowed and not isinstance(part.parent, exp.Window):
            raise AdqlRefusal(f"{name} needs a window, as OVER (ORDER BY mag) behind it", part)
        check_count(part, function.least, function.most)
        arguments = part.expressions
        inner = arguments[0] if arguments else None
        if isinstance(inner, exp.Distinct) and not function.is_set:
            raise AdqlRefusal(f"{name} takes no DISTINCT", part)
        if isinstance(inner, exp.Star) and name != "COUNT":
            raise AdqlRefusal(f"{name} takes no *", part)
        for argument in arguments:
            if shape_of(argument) is not None:
                raise AdqlRefusal(f"{name} takes numbers or texts, and no geometry", part)
        part.replace(raw(function.sql([sql_text(argument) for argument in arguments])))

    def _in_unit(self, part: exp.Anonymous) -> None:
        """Write the factor between two units of a column."""
        check_count(part, 2, 2)
        value, unit = part.expressions
        if not isinstance(value, exp.Column) or not is_text(unit):
            raise AdqlRefusal("IN_UNIT takes a column and a unit, as IN_UNIT(ra, 'rad')", part)
        column = self._names.column(value)
        if column is None or not column.unit:
            raise AdqlRefusal(f"IN_UNIT: the column {quoted(value.name)} has no unit", part)
        from astropy import units

        try:
            factor = units.Unit(column.unit).to(units.Unit(unit.name))
        except (ValueError, TypeError) as error:
            raise AdqlRefusal(
                f"IN_UNIT: {quoted(column.unit)} of {value.name} cannot be converted to "
                f"{quoted(unit.name)}",
                part,
            ) from error
        part.replace(raw(f"({sql_text(value)} * {float(factor)!r}::DOUBLE)"))


def _chooses(part: exp.Expr) -> bool:
    """Return whether a condition must hold for all rows."""
    while isinstance(part.parent, (exp.And, exp.Paren)):
        part = part.parent
    return isinstance(part.parent, (exp.Where, exp.Join))
