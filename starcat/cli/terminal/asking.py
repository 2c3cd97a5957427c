"""Questions in SQL: where they come from, and where the answers go."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from starcat.cli.terminal.console import progress_bars, say
from starcat.cli.terminal.queries import print_first_rows, print_views
from starcat.errors import QueryError
from starcat.query.gallery import guessed, named_query
from starcat.query.session import Limits, Session, open_session, preamble_of


@dataclass(frozen=True)
class Wish:
    """What is asked, and how the answer is wanted.

    Attributes
    ----------
    query : str, optional
        SQL.
    named : str, optional
        A query of the gallery instead.
    values : mapping of str to str
        The texts of the values of the ``$name`` in it.
    form : str, optional
        ``table`` or one of the formats of `starcat.exchange.formats`.
    output : Path, optional
        File to write.
    """

    query: str | None = None
    named: str | None = None
    values: Mapping[str, str] = field(default_factory=dict)
    form: str | None = None
    output: Path | None = None


def answer(targets: Sequence[str], wish: Wish, limits: Limits, rows: int) -> None:
    """Answer a question, or ask for questions where there is none."""
    form = format_of_wish(wish)
    query, values = _query(wish, len(targets))
    with _opened(targets, limits) as session:
        if query is not None:
            _give(session, query, values, form, wish.output, rows)
        elif sys.stdin.isatty():
            from starcat.cli.terminal.prompt import prompt

            prompt(session, rows)
        else:
            texts = session.statements(sys.stdin.read())
            if wish.output is not None and len(texts) > 1:
                raise QueryError(f"{len(texts)} queries for one file; give one, or leave out -o")
            for text in texts:
                _give(session, text, values, form, wish.output, rows)


def show(targets: Sequence[str], limits: Limits, *, as_json: bool) -> None:
    """Print the views of targets."""
    with _opened(targets, limits) as session:
        print_views(session, as_json=as_json)


def print_preamble(targets: Sequence[str]) -> None:
    """Print the SQL that makes the views and macros, for any DuckDB."""
    sys.stdout.write(preamble_of(targets) + "\n")


@contextmanager
def _opened(targets: Sequence[str], limits: Limits) -> Iterator[Session]:
    """Open a session, with bars while archive files are read and none afterwards."""
    with ExitStack() as stack:
        with progress_bars() as progress:
            session = stack.enter_context(open_session(targets, limits, progress))
        yield session


def format_of_wish(wish: Wish) -> str:
    """Return the format that an answer is wanted in."""
    if wish.form in (None, "table") and wish.output is None:
        return "table"
    from starcat.exchange.formats import FILE_FORMATS, TEXT_FORMATS, format_of

    form = wish.form or (format_of(wish.output) if wish.output else "table")
    if form not in ("table", *FILE_FORMATS):
        raise QueryError(f"--format {form!r}: choose table, {', '.join(FILE_FORMATS)}")
    if wish.output is None and form not in ("table", *TEXT_FORMATS):
        raise QueryError(f"--format {form} is no text for a terminal; give a file with -o")
    if wish.output is not None and form == "table":
        raise QueryError("--format table goes to the terminal; leave out -o, or choose csv")
    return form


def _query(wish: Wish, targets: int) -> tuple[str | None, Mapping[str, Any]]:
    if not targets:
        raise QueryError(
            "name what the query is about: an artifact's folder, a Parquet file or an archive "
            'file, such as: starcat sql dist/gaia-12deg-1.0.0 "SELECT count(*) FROM stars"'
        )
    if wish.named is None:
        return wish.query, {name: guessed(text) for name, text in wish.values.items()}
    query = named_query(wish.named)
    if query.targets != targets:
        raise QueryError(f"{query.name} is about {query.targets} targets; {targets} given")
    return query.text, query.with_values(wish.values)


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
    from starcat.exchange.writers import write_batches, write_text_batches

    with progress_bars() as progress, session.ask(query, values, progress) as found:
        if output is None:
            write_text_batches(found.batches(), sys.stdout, form)
            return
        count = write_batches(found.batches(), output, form)
    say(f"{output}: {count:,} rows")
