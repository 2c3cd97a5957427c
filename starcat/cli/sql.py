"""The command that runs SQL queries."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from starcat.cli.console import show_result
from starcat.cli.options import Json
from starcat.cli.outputs import Replace, expect_free, to_file
from starcat.errors import QueryError
from starcat.ship.exchange.formats import FILE_FORMATS

app = typer.Typer()

FORMATS = f"{', '.join(('table', *FILE_FORMATS[:-1]))} or {FILE_FORMATS[-1]}"


Arguments = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="TARGET... [QUERY]",
        help="Databases, catalog stores, Parquet files, archive files (or SOURCE=PATH), "
        "sources; then SQL, or - to read it from stdin.",
    ),
]
Values = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="A value of the query. Repeatable."),
]
OutputFile = Annotated[
    Path | None, to_file("Where the answer goes; the suffix selects the format.")
]
FormatName = Annotated[
    str | None, typer.Option("--format", metavar="FORMAT", help=f"{FORMATS}; default: table.")
]


@app.command("sql")
def sql(
    context: typer.Context,
    arguments: Arguments = None,
    named: Annotated[str | None, typer.Option(help="A query of the gallery; see --list.")] = None,
    values: Values = None,
    output: OutputFile = None,
    form: FormatName = None,
    replace: Replace = False,
    rows: Annotated[int, typer.Option(min=1, help="Most rows of a table to show.")] = 40,
    show_list: Annotated[bool, typer.Option("--list", help="List the named queries.")] = False,
    show_macros: Annotated[bool, typer.Option("--macros", help="List the macros.")] = False,
    show_views: Annotated[bool, typer.Option("--views", help="List the targets' views.")] = False,
    preamble: Annotated[
        bool, typer.Option("--preamble", help="Print the views and macros as SQL for any DuckDB.")
    ] = False,
    time_limit_s: Annotated[float, typer.Option(min=0.1, help="Time limit, seconds.")] = 60.0,
    memory_limit_gb: Annotated[float, typer.Option(min=0.1, help="Memory limit, GB.")] = 2.0,
    json: Json = False,
) -> None:
    """Run SQL queries on databases and catalogs; only -o FILE is ever written.

    Every product is a view: stars, rejected, pairs, triangles ... With several targets each has
    a schema with its name; a, b, c ... are shorter names. The folder of a store may be any HATS
    collection or catalog; cone, box and field read only the files for their part of the sky.

    Example: starcat sql dist/gaia-12deg-1.0.0 "SELECT designation, mag FROM cone(37.95, 89.26, 5)"
    """
    if show_list or show_macros:
        from starcat.cli.queries import print_gallery, print_macros

        (print_gallery if show_list else print_macros)(as_json=json)
        return
    from starcat.cli.queries import Question, answer, opened, views_of
    from starcat.cli.remote import sql_remotely
    from starcat.query.session import Limits, preamble_of

    limits = Limits(time_limit_s, memory_limit_gb)
    targets, query = _split(arguments or [], named)
    if context.obj is None and preamble:
        typer.echo(preamble_of(targets))
        return
    if context.obj is None and show_views:
        with opened(targets, limits) as session:
            shown = ("schema", "view", "rows", "summary")
            show_result(views_of(session), as_json=json, columns={"": shown})
        return
    expect_free(output, replace=replace)
    form = form or ("json" if json else None)
    question = Question(query, named, dict(_set(values)), form, output)
    if context.obj is not None:
        sql_remotely(context, targets, question, rows, time_limit_s)
    else:
        answer(targets, question, limits, rows)


def _split(arguments: list[str], named: str | None) -> tuple[list[str], str | None]:
    """Return the targets, and the query if the last argument is SQL."""
    if not arguments:
        return [], None
    last = arguments[-1]
    # A text of one word names a target; an empty text is a query without words.
    if last != "-" and (len(last.split()) == 1 or os.path.exists(last)):
        return arguments, None
    if named:
        raise QueryError(
            f"a query and --named {named} are both given", hint="leave out one of them"
        )
    return arguments[:-1], sys.stdin.read() if last == "-" else last


def _set(values: list[str] | None) -> list[tuple[str, str]]:
    settings = [text.partition("=") for text in values or []]
    for name, separator, _ in settings:
        if not separator:
            raise QueryError(f"--set {name!r} is not NAME=VALUE, such as count=5")
    return [(name, value) for name, _, value in settings]
