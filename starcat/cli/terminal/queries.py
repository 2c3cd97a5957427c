"""What `starcat sql` prints: answers, views, macros and named queries."""

from __future__ import annotations

import re
import sys
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from starcat.cli.terminal.console import MAX_WIDTH, print_json, print_table, progress_bars, say

if TYPE_CHECKING:
    from starcat.query.result import ResultTable
    from starcat.query.session import Session
    from starcat.query.targets import Target, View

FOLDED_CHARACTERS = 28
"""A column of longer texts is folded rather than given all the room it wants."""


def print_first_rows(session: Session, query: str, values: Mapping[str, Any], rows: int) -> None:
    """Ask a query, with a bar while it runs, and print the first rows of its answer."""
    with progress_bars() as progress, session.ask(query, values, progress) as running:
        found = running.table(rows)
    print_result(found)


def print_result(found: ResultTable) -> None:
    """Print rows as a table, or one below the other if that is too wide."""
    cells = found.texts
    headings = [f"{c.name}\n[{c.unit}]" if c.unit else c.name for c in found.columns]
    if _width(headings, cells) <= MAX_WIDTH:
        numbers = [k for k, column in enumerate(found.columns) if column.is_number]
        print_table("", headings, cells, numbers)
    else:
        for k, row in enumerate(cells):
            facts = [(c.name, cell, c.unit) for c, cell in zip(found.columns, row, strict=True)]
            print_table(f"row {k + 1}", ["column", "value", "unit"], facts)
    if found.is_cut:
        say(f"the first {len(cells)} rows; --rows N shows more, -o FILE writes all")


def _width(headings: Sequence[str], cells: Sequence[Sequence[str]]) -> int:
    """Return the width of a table whose long texts are folded."""
    columns = zip(headings, *cells, strict=True)
    widest = (max(len(line) for cell in column for line in cell.split("\n")) for column in columns)
    heads = (max(map(len, heading.split("\n"))) for heading in headings)
    wanted = [
        max(head, min(most, FOLDED_CHARACTERS)) for head, most in zip(heads, widest, strict=True)
    ]
    return sum(wanted) + 2 * (len(wanted) - 1)


def print_views(session: Session, *, as_json: bool) -> None:
    """Print the views that a query can use."""
    views = [(target, view) for target in session.targets for view in target.views]
    if as_json:
        print_json([_view_facts(target, view) for target, view in views])
        return
    names = [f"{target.name}.{view.name}" for target, view in views]
    rows = [
        (name, _row_count(session, name), _first_sentence(_description(view)))
        for name, (_, view) in zip(names, views, strict=True)
    ]
    print_table("", ["view", "rows", "a row"], rows, (1,))


def _view_facts(target: Target, view: View) -> dict[str, Any]:
    columns = view.schema.columns if view.schema else ()
    return {
        "schema": target.name,
        "view": view.name,
        "description": _description(view),
        "columns": [
            {"name": c.name, "dtype": c.dtype, "unit": c.unit, "description": c.description}
            for c in columns
        ],
    }


def _description(view: View) -> str:
    return view.schema.description if view.schema else ""


def _first_sentence(text: str) -> str:
    return re.split(r"[.:;] ", text)[0].rstrip(".")


def _row_count(session: Session, view: str) -> int:
    with session.ask(f"SELECT count(*) FROM {view}") as answer:
        return int(answer.rows(1)[0][0])


def print_macros(*, as_json: bool) -> None:
    """Print the macros, each with an example."""
    from starcat.query.gallery import macros

    listed = sorted((m for m in macros()), key=lambda m: (m.is_table, m.name))
    if as_json:
        facts = ("name", "arguments", "is_table", "help", "example")
        print_json([{fact: getattr(macro, fact) for fact in facts} for macro in listed])
        return
    for macro in listed:
        after = "FROM " if macro.is_table else ""
        _print_entry(f"{after}{macro.name}({macro.arguments})", [macro.help, macro.example])


def _print_entry(title: str, paragraphs: Sequence[str]) -> None:
    """Print a title, and paragraphs below it that are indented."""
    indented = (textwrap.indent(textwrap.fill(text, MAX_WIDTH - 4), "    ") for text in paragraphs)
    sys.stdout.write("\n".join([title, *indented, "\n"]))


def print_gallery(*, as_json: bool) -> None:
    """Print the named queries with their values."""
    from starcat.query.gallery import gallery

    queries = gallery().values()
    if as_json:
        print_json([asdict(query) for query in queries])
        return
    for query in queries:
        needs = " Two targets." if query.targets == 2 else ""
        values = [f"--set {v.name}={v.default}: {v.help}" for v in query.values]
        _print_entry(query.name, [query.help + needs, *values])
    say("starcat sql TARGET --named densest-fields --set count=5")
