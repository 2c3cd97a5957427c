"""The functions of ADQL that are no geometry, as DuckDB writes them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Function:
    """A function."""

    # How many arguments it takes.
    least: int
    most: int
    written: str  # SQL of DuckDB with {0}, {1} for the arguments; {all} for all of them
    # The same where the last argument is left out; empty where that is no matter.
    shortened: str = ""
    is_set: bool = False  # whether it takes many rows, and DISTINCT or ALL before its argument

    def sql(self, arguments: list[str]) -> str:
        """Return the call as DuckDB writes it."""
        short = len(arguments) < self.most and self.shortened
        text = self.shortened if short else self.written
        return text.format(*arguments, all=", ".join(arguments))


def _same(name: str, count: int = 1) -> Function:
    places = ", ".join(f"{{{k}}}" for k in range(count))
    return Function(count, count, f"{name}({places})")


FUNCTIONS: dict[str, Function] = {
    "ABS": _same("abs"),
    "CEILING": _same("ceil"),
    "DEGREES": _same("degrees"),
    "EXP": _same("exp"),
    "FLOOR": _same("floor"),
    "LOG": _same("ln"),
    "LOG10": _same("log10"),
    # A remainder by 0 has no value; DuckDB would end the query.
    "MOD": Function(2, 2, "mod({0}, nullif({1}, 0))"),
    "PI": _same("pi", 0),
    "POWER": _same("power", 2),
    "RADIANS": _same("radians"),
    "SQRT": _same("sqrt"),
    # What a seed does depends on the service, ADQL says; here it does nothing.
    "RAND": Function(0, 1, "random()"),
    "ROUND": Function(1, 2, "round(({0})::DOUBLE, {1})", "round(({0})::DOUBLE)"),
    "TRUNCATE": Function(1, 2, "trunc(({0})::DOUBLE, {1})", "trunc(({0})::DOUBLE)"),
    "ACOS": _same("acos"),
    "ASIN": _same("asin"),
    "ATAN": _same("atan"),
    "ATAN2": _same("atan2", 2),
    "COS": _same("cos"),
    "COT": _same("cot"),
    "SIN": _same("sin"),
    "TAN": _same("tan"),
    "LOWER": _same("lower"),
    "UPPER": _same("upper"),
    "COALESCE": Function(1, 1000, "coalesce({all})"),
    "TIMESTAMP": Function(1, 1, "CAST({0} AS TIMESTAMP)"),
    "COUNT": Function(1, 1, "count({0})", is_set=True),
    "SUM": Function(1, 1, "sum({0})", is_set=True),
    "AVG": Function(1, 1, "avg({0})", is_set=True),
    "MIN": Function(1, 1, "min({0})", is_set=True),
    "MAX": Function(1, 1, "max({0})", is_set=True),
    "IVO_HEALPIX_INDEX": Function(3, 3, "healpix({0}, {1}, {2})"),
}
"""Functions by their names in ADQL. Logarithms are natural where the name does not say 10."""

USER_FUNCTIONS = (
    (
        "ivo_healpix_index(hpxOrder INTEGER, ra DOUBLE, dec DOUBLE) -> BIGINT",
        "The HEALPix cell of a position, degrees, in nested numbering of an order from 0 to 29.",
    ),
)
"""Functions that ADQL does not have by itself, with what they do."""
