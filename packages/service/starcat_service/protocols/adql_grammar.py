"""The grammar of ADQL 2.1, as a dialect of sqlglot: text to a syntax tree, or a refusal.

sqlglot reads far more than ADQL. This dialect has only the keywords of ADQL, reads every function
as a call of that name, and refuses parts of the tree of kinds that ADQL does not have.

References
----------
ADQL 2.1, IVOA Recommendation, December 2023.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from sqlglot import exp, parser, tokens
from sqlglot.dialects.dialect import Dialect
from sqlglot.errors import ParseError, TokenError
from sqlglot.tokenizer_core import TokenType

from starcat.errors import QueryError, quoted

MAX_CHARACTERS = 50_000  # most characters of a query
MAX_DIGITS = 18  # most digits of a number of rows
POINTED_CHARACTERS = 160  # characters of a line with an error that are shown
_SAME = """
ALL AND ASC BETWEEN CASE CROSS DESC DISTINCT ELSE END ESCAPE EXCEPT EXISTS FALSE FROM FULL GROUP_BY
HAVING ILIKE IN INNER INTERSECT INTO IS JOIN LEFT LIKE LIMIT NATURAL NOT NULL OFFSET ON OR
ORDER_BY OUTER OVER PARTITION_BY RECURSIVE RIGHT SELECT THEN TOP TRUE UNION USING WHEN WHERE WITH
"""
_WORDS = {
    **{word.replace("_", " "): TokenType[word] for word in _SAME.split()},
    "AS": TokenType.ALIAS, "||": TokenType.DPIPE, ">=": TokenType.GTE, "<=": TokenType.LTE,
    "<>": TokenType.NEQ, "!=": TokenType.NEQ,
}  # fmt: skip

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")

_ARGUMENTS: dict[type[exp.Expr], frozenset[str]] = {
    kind: frozenset(names.split())
    for kind, names in (
        (
            exp.Select,
            "expressions distinct limit from_ joins where group having order offset with_",
        ),
        (exp.Union, "this expression distinct order limit offset with_"),
        (exp.Except, "this expression distinct order limit offset with_"),
        (exp.Intersect, "this expression distinct order limit offset with_"),
        (exp.From, "this"), (exp.Where, "this"), (exp.Having, "this"),
        (exp.Group, "expressions"), (exp.Order, "expressions"),
        (exp.Ordered, "this desc nulls_first"), (exp.Limit, "expression"),
        (exp.Offset, "expression"), (exp.Distinct, "expressions"),
        (exp.Join, "this side kind on using method"), (exp.Table, "this db alias joins"),
        (exp.TableAlias, "this columns"), (exp.Subquery, "this alias joins"),
        (exp.With, "expressions"), (exp.CTE, "this alias"), (exp.Column, "this table db"),
        (exp.Identifier, "this quoted"), (exp.Star, ""), (exp.Alias, "this alias"),
        (exp.Literal, "this is_string"), (exp.HexString, "this is_integer"), (exp.Null, ""),
        (exp.Boolean, "this"), (exp.Paren, "this"), (exp.And, "this expression"),
        (exp.Or, "this expression"), (exp.Not, "this"), (exp.EQ, "this expression"),
        (exp.NEQ, "this expression"), (exp.GT, "this expression"), (exp.GTE, "this expression"),
        (exp.LT, "this expression"), (exp.LTE, "this expression"),
        (exp.Between, "this low high"), (exp.In, "this expressions query"), (exp.Exists, "this"),
        (exp.Is, "this expression"), (exp.Like, "this expression negate"),
        (exp.ILike, "this expression negate"), (exp.Concat, "expressions safe coalesce"),
        (exp.Add, "this expression"),
        (exp.Sub, "this expression"), (exp.Mul, "this expression"),
        (exp.Div, "this expression typed safe"), (exp.Neg, "this"),
        (exp.DPipe, "this expression safe"), (exp.Anonymous, "this expressions"),
        (exp.Case, "this ifs default"), (exp.If, "this true"),
        (exp.Window, "this partition_by order over"), (exp.Cast, "this to"),
        (exp.DataType, "this expressions nested"),
        (exp.DataTypeParam, "this"),
    )
}  # fmt: skip
"""Kinds of parts that a query can have, and the arguments that each of them can have."""

_ADVICE = {
    "spec": "a window has PARTITION BY and ORDER BY, and no frame of rows",
    "recursive": "RECURSIVE is not ADQL 2.1",
    "into": "a query only reads: INTO is refused",
    "escape": "LIKE ... ESCAPE is not ADQL",
}

_TYPES = {
    "CHAR": "VARCHAR", "VARCHAR": "VARCHAR", "SMALLINT": "SMALLINT", "INTEGER": "INT",
    "BIGINT": "BIGINT", "REAL": "FLOAT", "DOUBLE PRECISION": "DOUBLE", "TIMESTAMP": "TIMESTAMP",
}  # fmt: skip
"""Types that CAST can make, and their names in DuckDB."""


class _Tokenizer(tokens.Tokenizer):
    COMMENTS = ["--"]  # noqa: RUF012 - so it is in sqlglot
    QUOTES = ["'"]  # noqa: RUF012
    IDENTIFIERS = ['"']  # noqa: RUF012
    HEX_STRINGS = [("0x", ""), ("0X", "")]  # noqa: RUF012
    KEYWORDS = _WORDS


class _Parser(parser.Parser):
    FUNCTIONS = {}  # noqa: RUF012
    NO_PAREN_FUNCTIONS = {}  # noqa: RUF012
    SET_OP_MODIFIERS = {"order", "offset"}  # noqa: RUF012 - TOP stays with its SELECT
    NO_PAREN_FUNCTION_PARSERS = {"CASE": lambda self: self._parse_case()}  # noqa: RUF012
    STATEMENT_PARSERS = {}  # noqa: RUF012
    FUNCTION_PARSERS = {"CAST": lambda self: self.parse_adql_cast()}  # noqa: RUF012

    def _parse_limit_options(self) -> exp.LimitOptions | None:
        # After the number of TOP comes a column, which can be named row.
        return None

    def parse_adql_cast(self) -> exp.Expr:
        """Return the cast whose parenthesis was just opened."""
        value = self._parse_disjunction()
        if value is None or not self._match(TokenType.ALIAS):
            self.raise_error("CAST needs AS: write CAST(value AS INTEGER)")
        word = self._curr.text.upper()
        token = self._curr
        self._advance()
        if word == "DOUBLE" and self._curr and self._curr.text.upper() == "PRECISION":
            self._advance()
            word = "DOUBLE PRECISION"
        if word not in _TYPES:
            self.raise_error(f"CAST makes {', '.join(_TYPES)}, and not {word}", token)
        sizes: list[exp.Expr] = []
        if word in ("CHAR", "VARCHAR") and self._match(TokenType.L_PAREN):
            size = self._parse_number()
            if size is None:
                self.raise_error(f"{word} needs a number of characters in its parentheses")
            else:
                sizes.append(exp.DataTypeParam(this=size))
            self._match_r_paren()
        kind = exp.DataType(this=exp.DType(_TYPES[word]), expressions=sizes)
        return self.expression(exp.Cast(this=value, to=kind))


@dataclass(eq=False, repr=False)
class AdqlRefusal(QueryError):  # noqa: N818 - the name reads as the fact
    """An error in a part of a query."""

    part: exp.Expr

    def shown_in(self, text: str) -> QueryError:
        """Return the error with the line of the part and a mark below it."""
        places = (part.meta["start"] for part in self.part.walk() if "start" in part.meta)
        return QueryError(f"{self}{pointer(text, next(places, None))}")


class Adql(Dialect):
    """ADQL 2.1 for sqlglot."""

    NULL_ORDERING = "nulls_are_last"
    Tokenizer = _Tokenizer
    Parser = _Parser


def parse_adql(text: str) -> exp.Expr:
    """Return the syntax tree of a query in ADQL."""
    if len(text) > MAX_CHARACTERS:
        raise QueryError(
            f"the query has {len(text):,} characters; at most {MAX_CHARACTERS:,} are read",
            hint="Upload a table for long lists",
        )
    if not text.strip():
        raise QueryError("the query is empty", hint="try SELECT TOP 10 * FROM tap_schema.tables")
    dialect = Adql()
    with refusals_of(text):
        first = next(iter(dialect.tokenize(text)), None)
        if first is not None and first.text.upper() not in ("SELECT", "WITH", "("):
            raise QueryError(
                f"no ADQL: found {quoted(first.text)}; a query begins with SELECT or WITH, and "
                "only reads"
            )
        trees = [tree for tree in dialect.parse(text) if tree is not None]
        if len(trees) != 1:
            raise QueryError(f"found {len(trees)} queries", hint="send one at a time")
        tree = trees[0]
        if not isinstance(tree, (exp.Select, exp.SetOperation, exp.Subquery)):
            raise QueryError("no ADQL: a query begins with SELECT or WITH")
        for part in list(tree.walk()):
            _check_part(part)
            if isinstance(part, exp.SetOperation):
                _take_limit(part)
        return tree


@contextmanager
def refusals_of(text: str) -> Iterator[None]:
    """Raise an error of a query as QueryError, with its line and a mark at the place."""
    try:
        yield
    except AdqlRefusal as error:
        raise error.shown_in(text) from error
    except ParseError as error:
        raise _refusal(error, text) from error
    except TokenError as error:
        offset = error.start if error.start is not None else 0
        raise QueryError(
            "no ADQL: a quotation mark that is opened here is not closed, or a character has no "
            f"place here{pointer(text, offset)}"
        ) from error
    except RecursionError as error:
        raise QueryError(
            "the query is nested too deeply",
            hint="write it with fewer parentheses within each other",
        ) from error


def pointer(text: str, offset: int | None) -> str:
    """Return the line of a position with a mark below it."""
    if offset is None or not 0 <= offset <= len(text):
        return ""
    before = text[:offset]
    number = before.count("\n")
    line = text.split("\n")[number]
    column = offset - (before.rfind("\n") + 1)
    start = max(0, column - POINTED_CHARACTERS // 2)
    shown = line[start : start + POINTED_CHARACTERS]
    where = f" (line {number + 1}, character {column + 1})"
    return f"{where}\n  {shown}\n  {' ' * (column - start)}^"


def _check_part(part: exp.Expr) -> None:
    allowed = _ARGUMENTS.get(type(part))
    if allowed is None:
        reason = _ADVICE.get(part.key, f"{part.key.upper()} is not ADQL 2.1")
        raise AdqlRefusal(f"no ADQL: {reason}", part)
    for name, value in part.args.items():
        if value and name not in allowed:
            name = name.rstrip("_")
            reason = _ADVICE.get(name, f"{name.upper()} has no place in ADQL here")
            raise AdqlRefusal(f"no ADQL: {reason}", value if isinstance(value, exp.Expr) else part)
    if isinstance(part, (exp.Limit, exp.Offset)):
        _check_rows(part)
    if isinstance(part, exp.Table) and not isinstance(part.this, exp.Identifier):
        raise AdqlRefusal("no ADQL: FROM takes tables and queries in parentheses", part)
    if isinstance(part, exp.Distinct) and len(part.expressions) > 1:
        raise AdqlRefusal("no ADQL: DISTINCT takes one value here", part)
    if isinstance(part, exp.Identifier) and not part.args.get("quoted"):
        _check_name(part)
    if isinstance(part, exp.Join) and str(part.args.get("kind") or "").upper() not in (
        "", "INNER", "OUTER", "CROSS",
    ):  # fmt: skip
        raise AdqlRefusal(f"no ADQL: {part.args['kind']} JOIN", part)


def _check_rows(part: exp.Limit | exp.Offset) -> None:
    name = "TOP" if part.meta.get("top") else part.key.upper()
    if not _is_whole(part.expression):
        raise AdqlRefusal(f"{name} needs a whole number", part)
    if len(part.expression.name) > MAX_DIGITS:
        raise AdqlRefusal(
            f"{name} has {len(part.expression.name)} digits; no table has that many rows; at "
            f"most {MAX_DIGITS} are read",
            part,
        )


def _take_limit(part: exp.SetOperation) -> None:
    """Give a LIMIT behind the last of several queries to all of them; TOP stays with its SELECT."""
    last = part.expression
    limit = last.args.get("limit") if isinstance(last, exp.Select) else None
    if limit is not None and not limit.meta.get("top"):
        part.set("limit", limit.pop())


def _is_whole(node: exp.Expr) -> bool:
    return isinstance(node, exp.Literal) and not node.is_string and node.name.isdigit()


def _check_name(part: exp.Identifier) -> None:
    if not _NAME.fullmatch(part.name):
        raise AdqlRefusal(
            f"no ADQL: {quoted(part.name)} is not a name: names have letters, digits and "
            'underscores and begin with a letter; write others in double quotes, as "2mass"',
            part,
        )


def _refusal(error: ParseError, text: str) -> QueryError:
    """Return the message for a text that the parser refuses."""
    first = error.errors[0] if error.errors else {}
    reason = str(first.get("description") or "not understood").rstrip(".")
    line, column = first.get("line"), first.get("col")
    offset = None
    if line and column:
        lines = text.split("\n")
        word = str(first.get("highlight") or "")
        # The parser gives the end of a word.
        offset = sum(len(above) + 1 for above in lines[: line - 1]) + max(0, column - len(word))
        if reason.startswith("Required keyword"):
            reason = "something is missing here"
        if "Unexpected token" in reason:
            reason = f"{quoted(word)} is not expected"
    return QueryError(f"no ADQL: {reason}{pointer(text, offset)}")
