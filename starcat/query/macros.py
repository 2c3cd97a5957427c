"""The macros that every session has: one SQL file each, with its help in the comments above.

A file holds ``CREATE MACRO`` of the name of the file, after those of helpers whose names begin
with ``_``. A table macro is made once for every schema; ``{places}`` in its text is the schema of
its target's views with places (`starcat.query.places`).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

FOLDER = Path(__file__).parent / "sql" / "macros"

FIRST = ("cosd", "sind", "separation")
"""Macros that others use, in the order to make them."""


@dataclass(frozen=True)
class Macro:
    """A macro of SQL.

    Attributes
    ----------
    name, arguments : str
        The name to call it by, and its arguments without parentheses.
    help, example : str
        What it gives, and a query that shows it and runs on any artifact.
    text : str
        The SQL that makes it, with ``{places}`` where that schema has to be named.
    """

    name: str
    arguments: str
    help: str
    example: str
    text: str

    @property
    def is_table(self) -> bool:
        """Whether it stands after FROM."""
        return "AS TABLE" in self.text

    def statement(self, schema: str, places: str) -> str:
        """Return the SQL that makes a table macro."""
        made = self.text.replace("{places}", places)
        return made.replace("CREATE MACRO ", f"CREATE MACRO {schema}.")


@cache
def macros() -> tuple[Macro, ...]:
    """Return all macros, in an order in which they can be made.

    Examples
    --------
    >>> [macro.name for macro in macros() if macro.is_table]
    ['box', 'cone', 'field']
    """
    names = sorted(path.stem for path in FOLDER.glob("*.sql"))
    return tuple(_read(name) for name in (*FIRST, *(n for n in names if n not in FIRST)))


def _read(name: str) -> Macro:
    lines = (FOLDER / f"{name}.sql").read_text(encoding="utf-8").splitlines()
    start = next(k for k, line in enumerate(lines) if not line.startswith("--"))
    words = " ".join(line.removeprefix("-- ") for line in lines[:start])
    told, _, example = words.partition(" Example: ")
    text = "\n".join(lines[start:])
    found = re.search(rf"CREATE MACRO {name}\((.*?)\) AS", text, re.DOTALL)
    if found is None:
        raise ValueError(f"{name}.sql makes no macro of that name")
    return Macro(name, found[1], told, example, text)
