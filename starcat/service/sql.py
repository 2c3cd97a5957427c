"""Queries in SQL that requests ask: to a table of rows, or to a file of any format."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from starcat.errors import QueryError
from starcat.query.gallery import named_query
from starcat.query.result import ResultTable
from starcat.service.answer_files import file_of_rows, keep_rows
from starcat.service.service import Service
from starcat.service.uploading import scratch_folder


@dataclass(frozen=True)
class SqlQuery:
    """A query in SQL."""

    targets: Sequence[str]  # as `Library.targets` takes them
    text: str
    values: Mapping[str, Any]  # of the $name in it
    max_rows: int
    time_s: float  # that it may take


@dataclass(frozen=True)
class ResultFile:
    """An answer in a file, which is whole."""

    chunks: Iterator[bytes]
    size: int  # bytes
    rows: int
    is_cut: bool  # whether there are more rows


def named_text(
    name: str, values: Mapping[str, Any], targets: int
) -> tuple[str, dict[str, int | float | str]]:
    """Return a query of the gallery with all its values, those by default too."""
    query = named_query(name)
    if query.targets != targets:
        raise QueryError(f"{query.name} is about {query.targets} targets; {targets} given")
    return query.text, query.with_values({key: str(value) for key, value in values.items()})


def result_table(service: Service, query: SqlQuery) -> ResultTable:
    """Return the first rows that a query finds."""
    paths = [service.library.target(name) for name in query.targets]
    with (
        service.query_pool.session(paths, query.time_s) as session,
        session.ask(query.text, query.values) as running,
    ):
        found: ResultTable = running.table(query.max_rows)
    return found


def result_file(service: Service, query: SqlQuery, form: str) -> ResultFile:
    """Return all rows that a query finds in one of `FILE_FORMATS`; errors are raised here."""
    paths = [service.library.target(name) for name in query.targets]
    with scratch_folder(service.paths) as folder:
        source, target = folder / "rows.arrow", folder / "answer"
        with (
            service.query_pool.session(paths, query.time_s) as session,
            session.ask(query.text, query.values) as running,
        ):
            count, is_cut = keep_rows(running.batches(), source, query.max_rows)
        chunks, size = file_of_rows(service.sandbox, source, target, form)
    return ResultFile(chunks, size, count, is_cut)
