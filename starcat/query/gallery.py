"""Named queries and macros: one SQL file each, with its help in the comments above.

The comments above a named query describe what it finds, how many targets it needs if not one
(``-- Targets: 2``), and its values with their defaults (``-- count = 10: how many``).

The file of a macro holds ``CREATE MACRO`` with the name of the file, after the helper macros, whose
names begin with ``_``. A table macro is made once for every schema; ``{places}`` in its text is the
schema of its target's views with places (`starcat.query.spatial_macros`).
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import Field

from starcat.errors import QueryError, suggest

FOLDER = Path(__file__).parent / "sql"

FIRST = ("cosd", "sind", "separation")  # macros that others use, in the order to make them
TEXTS = ("first", "second", "moc")  # arguments of macros that are texts
_VALUE = re.compile(r"-- (\w+) = (.+?): (.+)")
_TARGETS = re.compile(r"-- Targets: (\d+)")

_WHOLE = re.compile(r"[-+]?[0-9]{1,38}")
_NUMBER = re.compile(r"[-+]?([0-9]{1,38}\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]{1,3})?")
_LEADING_ZERO = re.compile(r"[-+]?0[0-9]|\+")

Literal = int | float | str


@dataclass(frozen=True)
class QueryValue:
    """A value that a named query can be given."""

    name: str  # $name in the query
    default: Literal  # one that is given has the same type
    help: str


@dataclass(frozen=True)
class NamedQuery:
    """A query of the gallery."""

    name: str
    help: Annotated[str, Field(description="Description.")]
    targets: Annotated[int, Field(description="How many targets it is about.")]
    values: tuple[QueryValue, ...]
    text: Annotated[str, Field(description="SQL.")]

    def with_values(self, texts: Mapping[str, str]) -> dict[str, Literal]:
        """Return the values of the query, given or by default."""
        values: dict[str, Literal] = {value.name: value.default for value in self.values}
        for name, text in texts.items():
            if name not in values:
                names = ", ".join(values) or "none"
                raise QueryError(f"{self.name} has no value {name!r}; it has: {names}")
            values[name] = _as(type(values[name]), text, name)
        return values


def _as(kind: type[Literal], text: str, name: str) -> Literal:
    """Return a text as a value of the declared type; digits stay text where text is declared."""
    if kind is str:
        return text
    if not (_WHOLE if kind is int else _NUMBER).fullmatch(text):
        expected = {int: "a whole number", float: "a number"}[kind]
        raise QueryError(f"expected {expected}", parameter=f"values[{name}]", value=text)
    return kind(text)


def guessed(text: str) -> Literal:
    """Return the number of a text such as ``-1.5e3``; ``007``, ``nan``, ``1_000`` stay text."""
    if _NUMBER.fullmatch(text) and not _LEADING_ZERO.match(text):
        return int(text) if _WHOLE.fullmatch(text) else float(text)
    return text


@cache
def gallery() -> dict[str, NamedQuery]:
    """Return all named queries."""
    return {path.stem: _named_query(path) for path in sorted((FOLDER / "gallery").glob("*.sql"))}


def named_query(name: str) -> NamedQuery:
    """Return a query of the gallery."""
    queries = gallery()
    if name not in queries:
        hint = suggest(name, queries)
        raise QueryError(
            f"no query named {name!r}", hint=f"{hint}known queries: {', '.join(queries)}"
        )
    return queries[name]


def _named_query(path: Path) -> NamedQuery:
    comments, text = _parts(path)
    sentences, values, targets = [], [], 1
    for line in comments:
        if value := _VALUE.fullmatch(line):
            values.append(QueryValue(value[1], json.loads(value[2].replace("'", '"')), value[3]))
        elif count := _TARGETS.fullmatch(line):
            targets = int(count[1])
        else:
            sentences.append(line.removeprefix("-- "))
    return NamedQuery(path.stem, " ".join(sentences), targets, tuple(values), text)


@dataclass(frozen=True)
class Macro:
    """A macro of SQL."""

    name: str
    arguments: str
    is_table: Annotated[bool, Field(description="Whether it is a table macro, used after FROM.")]
    help: str
    example: Annotated[str, Field(description="A query that shows it and runs on any database.")]
    # The SQL that makes it, with {places} for the name of that schema.
    text: Annotated[str, Field(exclude=True)]

    @property
    def numbers(self) -> list[str]:
        """The names of its arguments that are numbers, by position; empty for another one."""
        names = [name.strip() for name in self.arguments.split(",")]
        return ["" if name in TEXTS or ":=" in name else name for name in names]

    def statement(self, schema: str, places: str) -> str:
        """Return the SQL that makes a table macro."""
        sql = self.text.replace("{places}", places)
        return sql.replace("CREATE MACRO ", f"CREATE MACRO {schema}.")


@cache
def macros() -> tuple[Macro, ...]:
    """Return all macros, in an order in which they can be made."""
    names = sorted(path.stem for path in (FOLDER / "macros").glob("*.sql"))
    return tuple(_macro(name) for name in (*FIRST, *(n for n in names if n not in FIRST)))


def _macro(name: str) -> Macro:
    comments, text = _parts(FOLDER / "macros" / f"{name}.sql")
    words = " ".join(line.removeprefix("-- ") for line in comments)
    description, _, example = words.partition(" Example: ")
    match = re.search(rf"CREATE MACRO {name}\((.*?)\) AS", text, re.DOTALL)
    if match is None:
        raise ValueError(f"{name}.sql makes no macro of that name")
    return Macro(name, match[1], "AS TABLE" in text, description, example, text)


def _parts(path: Path) -> tuple[list[str], str]:
    lines = path.read_text(encoding="utf-8").splitlines()
    start = next(k for k, line in enumerate(lines) if not line.startswith("--"))
    return lines[:start], "\n".join(lines[start:])
