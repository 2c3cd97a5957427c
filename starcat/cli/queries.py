"""SQL queries of the command line: it finds the query and prints the result."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from starcat.cli.console import MAX_WIDTH, print_json, print_table, progress_bars, say, table_width
from starcat.errors import QueryError, count_of
from starcat.query.gallery import Macro, gallery, guessed, macros, named_query
from starcat.query.session import Limits, Session, open_session

if TYPE_CHECKING:
    from starcat.query.result import ResultTable
    from starcat.storage.schema import SchemaColumn


@dataclass(frozen=True)
class Question:
    """A query in SQL, with the format and file of its answer."""

    query: str | None = None  # SQL
    named: str | None = None  # a query of the gallery instead
    # values of the parameters ``$name`` in the query, as texts
    values: Mapping[str, str] = field(default_factory=dict)
    form: str | None = None  # ``table`` or one of the formats of `starcat.ship.exchange.formats`
    output: Path | None = None  # file to write


def answer(targets: Sequence[str], question: Question, limits: Limits, rows: int) -> None:
    """Answer a query; without one, answer the queries of the standard input."""
    form = format_of_answer(question)
    query, values = _query(question, len(targets))
    if query is None and sys.stdin.isatty():
        raise QueryError(
            "no query",
            hint="write one after the targets, or choose one with --named. For a prompt use "
            "DuckDB's own: 'starcat sql TARGET --preamble > views.sql; duckdb -init views.sql'",
        )
    with opened(targets, limits) as session:
        if query is not None:
            _give(session, query, values, form, question.output, rows)
        else:
            script = sys.stdin.read()
            texts = session.statements(script) or [script]
            if question.output is not None and len(texts) > 1:
                raise QueryError(
                    f"{len(texts)} queries for one file", hint="give one, or leave out -o"
                )
            for text in texts:
                _give(session, text, values, form, question.output, rows)


@contextmanager
def opened(targets: Sequence[str], limits: Limits) -> Iterator[Session]:
    """Open a session; progress bars are shown while archive files are read."""
    with ExitStack() as stack:
        with progress_bars() as progress:
            session = stack.enter_context(open_session(targets, limits, progress))
        yield session


def format_of_answer(question: Question) -> str:
    """Return the format of the answer."""
    if question.form in (None, "table") and question.output is None:
        return "table"
    from starcat.ship.exchange.formats import FILE_FORMATS, TEXT_FORMATS, format_of

    form = question.form or (format_of(question.output) if question.output else "table")
    if form not in ("table", *FILE_FORMATS):
        raise QueryError(
            f"--format {form!r}: unknown", hint=f"choose table, {', '.join(FILE_FORMATS)}"
        )
    if question.output is None and form not in ("table", *TEXT_FORMATS):
        raise QueryError(
            f"--format {form} cannot be printed on a terminal", hint="give a file with -o"
        )
    if question.output is not None and form == "table":
        raise QueryError("--format table goes to the terminal", hint="leave out -o, or choose csv")
    return form


def _query(question: Question, targets: int) -> tuple[str | None, Mapping[str, Any]]:
    if not targets:
        raise QueryError(
            "a query without a target",
            hint="name what it is about: a database's folder, a Parquet file or an archive "
            'file, such as: starcat sql dist/gaia-12deg-1.0.0 "SELECT count(*) FROM stars"',
        )
    if question.named is None:
        return question.query, {name: guessed(text) for name, text in question.values.items()}
    query = named_query(question.named)
    if query.targets != targets:
        raise QueryError(f"{query.name} is about {query.targets} targets; {targets} given")
    return query.text, query.with_values(question.values)


def _give(
    session: Session,
    query: str,
    values: Mapping[str, Any],
    form: str,
    output: Path | None,
    rows: int,
) -> None:
    if form == "table":
        print_first_rows(session, query, values, rows)
        return
    from starcat.ship.exchange.writers import write_batches, write_text_batches

    with progress_bars() as progress, session.ask(query, values, progress) as running:
        if output is None:
            write_text_batches(running.batches(), sys.stdout, form)
            return
        count = write_batches(running.batches(), output, form)
    say(f"{output}: {count_of(count, 'row')}")


def print_first_rows(session: Session, query: str, values: Mapping[str, Any], rows: int) -> None:
    """Run a query with a progress bar, and print the first rows of its answer."""
    with progress_bars() as progress, session.ask(query, values, progress) as running:
        table = running.table(rows)
    print_result(table)


def print_result(table: ResultTable) -> None:
    """Print rows as a table, or one below the other if the table is too wide."""
    cells = table.texts
    headings = [f"{c.name}\n[{c.unit}]" if c.unit else c.name for c in table.columns]
    if not cells or table_width(headings, cells) <= MAX_WIDTH:
        numbers = [k for k, column in enumerate(table.columns) if column.is_number]
        print_table("", headings, cells, numbers)
    else:
        for k, row in enumerate(cells):
            facts = [(c.name, cell, c.unit) for c, cell in zip(table.columns, row, strict=True)]
            print_table(f"row {k + 1}", ["column", "value", "unit"], facts)
    if table.is_cut:
        first = "the first row" if len(cells) == 1 else f"the first {len(cells)} rows"
        say(f"{first}; --rows N shows more, -o FILE writes all")


@dataclass(frozen=True)
class ViewFacts:
    """A view that a query can use."""

    schema: str
    view: str
    rows: int
    summary: str  # what a row is; empty if starcat did not write the table
    description: str  # the same with all details
    columns: tuple[SchemaColumn, ...]


def views_of(session: Session) -> list[ViewFacts]:
    """Return the views of a session, and count their rows."""
    views = []
    for target in session.targets:
        for view in target.views:
            with session.ask(f"SELECT count(*) FROM {target.short_name}.{view.name}") as counted:
                rows = int(counted.rows(1)[0][0])
            about = (view.schema.summary, view.schema.description) if view.schema else ("", "")
            views.append(ViewFacts(target.short_name, view.name, rows, *about, view.described))
    return views


def print_macros(*, as_json: bool) -> None:
    """Print the macros, each with an example."""
    listed = sorted(macros(), key=lambda m: (m.is_table, m.name))
    if as_json:
        print_json(TypeAdapter(list[Macro]).dump_python(listed))
        return
    for macro in listed:
        after = "FROM " if macro.is_table else ""
        _print_entry(f"{after}{macro.name}({macro.arguments})", [macro.help, macro.example])


def _print_entry(title: str, paragraphs: Sequence[str]) -> None:
    indented = (textwrap.indent(textwrap.fill(text, MAX_WIDTH - 4), "    ") for text in paragraphs)
    sys.stdout.write("\n".join([title, *indented, "\n"]))


def print_gallery(*, as_json: bool) -> None:
    """Print the named queries with their values."""
    queries = gallery().values()
    if as_json:
        print_json([asdict(query) for query in queries])
        return
    for query in queries:
        needs = " Two targets." if query.targets == 2 else ""
        values = [f"--set {v.name}={v.default}: {v.help}" for v in query.values]
        _print_entry(query.name, [query.help + needs, *values])
    say("starcat sql TARGET --named densest-fields --set count=5")
