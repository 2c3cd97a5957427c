"""Arithmetic that is done when a query is read where numbers are known, and is SQL elsewhere."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable

Term = float | str  # a number, or SQL that gives one
Vector = tuple[Term, Term, Term]

_COMPARISONS: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt, ">": operator.gt, "<=": operator.le, ">=": operator.ge, "=": operator.eq,
}  # fmt: skip


def term_of(text: str) -> Term:
    """Return the number that SQL says, or the SQL in parentheses."""
    found = number_in(text)
    return f"({text})" if found is None else found


def number_in(text: str) -> float | None:
    """Return the number that SQL says, if it is one."""
    try:
        found = float(text.strip("() ").replace("- ", "-"))
    except ValueError:
        return None
    return found if math.isfinite(found) else None


def sql_of(term: Term) -> str:
    """Return a number as SQL."""
    return term if isinstance(term, str) else f"({term!r}::DOUBLE)"


def times(a: Term, b: Term) -> Term:
    """Return the product of two numbers."""
    if isinstance(a, float) and isinstance(b, float):
        return a * b
    if a == 1.0 or b == 1.0:
        return b if a == 1.0 else a
    return f"({sql_of(a)} * {sql_of(b)})"


def plus(a: Term, b: Term) -> Term:
    """Return the sum of two numbers."""
    if isinstance(a, float) and isinstance(b, float):
        return a + b
    if a == 0.0 or b == 0.0:
        return b if a == 0.0 else a
    return f"({sql_of(a)} + {sql_of(b)})"


def added(*terms: Term) -> Term:
    """Return the sum of numbers."""
    total: Term = 0.0
    for term in terms:
        total = plus(total, term)
    return total


def over(a: Term, b: Term) -> Term:
    """Return the quotient of two numbers; 1 where both are 0."""
    if isinstance(a, float) and isinstance(b, float):
        return a / b if b else 1.0
    return f"({sql_of(a)} / {sql_of(b)})"


def arctan(y: Term, x: Term) -> Term:
    """Return the angle of a direction in the plane, radians."""
    if isinstance(y, float) and isinstance(x, float):
        return math.atan2(y, x)
    return f"atan2({sql_of(y)}, {sql_of(x)})"


def root(a: Term) -> Term:
    """Return the square root of a number."""
    return math.sqrt(a) if isinstance(a, float) else f"sqrt({a})"


def sign_of(a: Term) -> Term:
    """Return 1 or -1, as a number is positive or negative."""
    return math.copysign(1.0, a) if isinstance(a, float) else f"sign({a})"


def dot(a: Vector, b: Vector) -> Term:
    """Return the inner product of two vectors."""
    return added(*(times(x, y) for x, y in zip(a, b, strict=True)))


def cross(a: Vector, b: Vector) -> Vector:
    """Return the vector product of two vectors."""

    def minus(p: Term, q: Term, r: Term, s: Term) -> Term:
        return plus(times(p, q), times(-1.0, times(r, s)))

    return (
        minus(a[1], b[2], a[2], b[1]),
        minus(a[2], b[0], a[0], b[2]),
        minus(a[0], b[1], a[1], b[0]),
    )


def compared(a: Term, sign: str, b: Term) -> str:
    """Return SQL of a comparison, or its value where both numbers are known."""
    if isinstance(a, float) and isinstance(b, float):
        return "true" if _COMPARISONS[sign](a, b) else "false"
    return f"({sql_of(a)} {sign} {sql_of(b)})"


def all_of(conditions: Iterable[str]) -> str:
    """Return SQL of whether all conditions hold; what is known is left out."""
    left = [one for one in conditions if one != "true"]
    return "false" if "false" in left else _joined(left, " AND ", "true")


def any_of(conditions: Iterable[str]) -> str:
    """Return SQL of whether one of some conditions holds; what is known is left out."""
    left = [one for one in conditions if one != "false"]
    return "true" if "true" in left else _joined(left, " OR ", "false")


def _joined(conditions: list[str], word: str, nothing: str) -> str:
    return f"({word.join(conditions)})" if conditions else nothing
