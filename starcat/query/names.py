"""Names of schemas and views that SQL needs no quotes for, and quotes for the rest.

A name that is a word of SQL ends with an underscore: ``group.parquet`` is ``group_``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import chain, count, product
from string import ascii_lowercase

_WORDS = """
all analyse analyze and anti any array as asc asof asymmetric at authorization between
bigint binary bit boolean both by case cast char character check coalesce collate
collation column columns columns concurrently constraint create cross dec decimal default
deferrable desc describe distinct do else end except exists extract false fetch float for
foreign freeze from full generated generated glob group grouping grouping_id having ilike
in initially inner inout int integer intersect interval into is isnull join lambda lateral
leading left like limit map map national natural nchar none not notnull null nullif
numeric offset on only or order out outer overlaps overlay pivot pivot_longer pivot_wider
placing position positional precision primary qualify real references returning right row
select semi setof show similar smallint some struct struct substring summarize symmetric
table tablesample then time timestamp to trailing treat trim true try_cast try_cast tuple
tuple union unique unpack unpivot using values varchar variadic verbose when where window
with xmlattributes xmlconcat xmlelement xmlexists xmlforest xmlnamespaces xmlparse xmlpi
xmlroot xmlserialize xmltable
"""

SQL_WORDS = frozenset(_WORDS.split())
"""Words that DuckDB does not accept as the name of a table. They are listed here, so that a name
does not depend on the version of DuckDB."""

CATALOGS = frozenset({"main", "memory", "temp", "system", "information_schema", "pg_catalog"})
"""Schemas and catalogs that every DuckDB has."""


def identifier(text: str) -> str:
    """Return a name that SQL needs no quotes for.

    Examples
    --------
    >>> identifier("gaia-12deg"), identifier("2mass-8x6"), identifier("Group")
    ('gaia_12deg', '_2mass_8x6', 'group_')
    """
    name = re.sub(r"\W+", "_", text.lower(), flags=re.ASCII).strip("_") or "table"
    if name in SQL_WORDS or name in CATALOGS:
        return f"{name}_"
    return f"_{name}" if name[0].isdigit() else name


def short_names(many: int) -> list[str]:
    """Return the short names of several targets, in their order."""
    letters = ("".join(word) for size in count(1) for word in product(ascii_lowercase, repeat=size))
    return [identifier(word) for word, _ in zip(letters, range(many), strict=False)]


def distinct(names: Sequence[str], taken: Sequence[str] = ()) -> list[str]:
    """Return names that differ from each other and from the names that are taken.

    Examples
    --------
    >>> distinct(["sao", "sao", "sao_2", "a"], ["a", "b"])
    ['sao', 'sao_2', 'sao_2_2', 'a_']
    """
    unique: list[str] = []
    for name in names:
        first = f"{name}_" if name in taken else name
        variants = chain([first], (f"{first}_{number}" for number in count(2)))
        unique.append(next(variant for variant in variants if variant not in (*unique, *taken)))
    return unique


def sql_quoted(text: str) -> str:
    """Return a text as SQL writes it."""
    return "'" + text.replace("'", "''") + "'"


def quoted_name(text: str) -> str:
    """Return any name of a column or variable as SQL writes it."""
    return '"' + text.replace('"', '""') + '"'
