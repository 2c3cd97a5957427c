"""Queries that people ask often, by name: one SQL file each.

The comments above a query say what it finds, how many targets it needs where that is not one
(``-- Targets: 2``), and its values with their defaults (``-- count = 10: how many``).
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from starcat.errors import QueryError, suggest

FOLDER = Path(__file__).parent / "sql" / "gallery"

_VALUE = re.compile(r"-- (\w+) = (.+?): (.+)")
_TARGETS = re.compile(r"-- Targets: (\d+)")

_WHOLE = re.compile(r"[-+]?[0-9]{1,38}")
_NUMBER = re.compile(r"[-+]?([0-9]{1,38}\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]{1,3})?")
_LEADING_ZERO = re.compile(r"[-+]?0[0-9]|\+")

Literal = int | float | str


@dataclass(frozen=True)
class Value:
    """A value that a named query can be given.

    Attributes
    ----------
    name : str
        ``$name`` in the query.
    default : int, float or str
        The value where none is given; one that is given has the same type.
    help : str
        What it means.
    """

    name: str
    default: Literal
    help: str


@dataclass(frozen=True)
class NamedQuery:
    """A query of the gallery.

    Attributes
    ----------
    name : str
        The name of its file without the suffix.
    help : str
        What it finds.
    targets : int
        The number of targets that it is about.
    values : tuple of Value
        The values that it can be given.
    text : str
        SQL.
    """

    name: str
    help: str
    targets: int
    values: tuple[Value, ...]
    text: str

    def with_values(self, given: Mapping[str, str]) -> dict[str, Literal]:
        """Return the values of the query, given or by default."""
        values: dict[str, Literal] = {value.name: value.default for value in self.values}
        for name, text in given.items():
            if name not in values:
                known = ", ".join(values) or "none"
                raise QueryError(f"{self.name} has no value {name!r}; it has: {known}")
            values[name] = _as(type(values[name]), text, f"--set {name}={text}")
        return values


def _as(kind: type[Literal], text: str, where: str) -> Literal:
    """Return a text as a value of the declared type; digits stay text where text is declared."""
    if kind is str:
        return text
    if not (_WHOLE if kind is int else _NUMBER).fullmatch(text):
        wanted = {int: "a whole number", float: "a number"}[kind]
        raise QueryError(f"{where}: {text!r} is not {wanted}")
    return kind(text)


def guessed(text: str) -> Literal:
    """Return the value that a text stands for where nothing declares its type.

    Examples
    --------
    >>> guessed("7"), guessed("-1.5e3"), guessed("007"), guessed("nan"), guessed("1_000")
    (7, -1500.0, '007', 'nan', '1_000')
    """
    if _NUMBER.fullmatch(text) and not _LEADING_ZERO.match(text):
        return int(text) if _WHOLE.fullmatch(text) else float(text)
    return text


@cache
def gallery() -> dict[str, NamedQuery]:
    """Return all named queries.

    Examples
    --------
    >>> gallery()["densest-fields"].values[0].default
    10
    """
    return {path.stem: _read(path) for path in sorted(FOLDER.glob("*.sql"))}


def named_query(name: str) -> NamedQuery:
    """Return a query of the gallery."""
    known = gallery()
    if name not in known:
        hint = suggest(name, known)
        raise QueryError(f"no query named {name!r}; {hint}'starcat sql --list' shows all")
    return known[name]


def _read(path: Path) -> NamedQuery:
    lines = path.read_text(encoding="utf-8").splitlines()
    told, values, targets = [], [], 1
    start = next(k for k, line in enumerate(lines) if not line.startswith("--"))
    for line in lines[:start]:
        if value := _VALUE.fullmatch(line):
            values.append(Value(value[1], json.loads(value[2].replace("'", '"')), value[3]))
        elif count := _TARGETS.fullmatch(line):
            targets = int(count[1])
        else:
            told.append(line.removeprefix("-- "))
    text = "\n".join(lines[start:])
    return NamedQuery(path.stem, " ".join(told), targets, tuple(values), text)
