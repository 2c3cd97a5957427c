"""Queries in SQL that requests bring: to rows, or to a file of any format."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fastapi.responses import StreamingResponse

from starcat.errors import QueryError
from starcat.exchange.formats import FORMATS
from starcat.query.gallery import named_query
from starcat.query.result import ResultTable
from starcat.service.service import Service
from starcat.service.transfers import chunks_of, scratch_folder, write_rows


@dataclass(frozen=True)
class SqlQuery:
    """A query and its limits."""

    targets: Sequence[str]  # as `Library.target` takes them
    text: str
    values: Mapping[str, Any]  # of the ``$name`` in it
    max_rows: int
    time_s: float


@dataclass(frozen=True)
class ResultFile:
    """A result in a file, which is open and has no name any more."""

    chunks: Iterator[bytes]
    size: int
    rows: int
    is_cut: bool
    form: str

    def response(self, stem: str, headers: Mapping[str, str]) -> StreamingResponse:
        """Return the answer that sends it, under a name without its suffix."""
        form = FORMATS[self.form]
        headers = {
            "Content-Length": str(self.size),
            "Content-Disposition": f'attachment; filename="{stem}{form.suffix}"',
            **headers,
        }
        return StreamingResponse(self.chunks, media_type=form.media_type, headers=headers)


def named_text(
    name: str, values: Mapping[str, Any], targets: int
) -> tuple[str, dict[str, int | float | str]]:
    """Return a query of the gallery, and its values."""
    query = named_query(name)
    if query.targets != targets:
        raise QueryError(f"{query.name} is about {query.targets} targets; {targets} given")
    return query.text, query.with_values({key: str(value) for key, value in values.items()})


def result_table(service: Service, query: SqlQuery) -> ResultTable:
    """Return the first rows of a result."""
    paths = [service.library.target(name) for name in query.targets]
    with (
        service.query_pool.session(paths, query.time_s) as session,
        session.ask(query.text, query.values) as running,
    ):
        found: ResultTable = running.table(query.max_rows)
    return found


def result_file(service: Service, query: SqlQuery, form: str) -> ResultFile:
    """Return a result in a file."""
    paths = [service.library.target(name) for name in query.targets]
    with scratch_folder(service.paths) as folder:
        source, target = folder / "rows.arrow", folder / "result"
        with (
            service.query_pool.session(paths, query.time_s) as session,
            session.ask(query.text, query.values) as running,
        ):
            count, is_cut = write_rows(running.batches(), source, query.max_rows)
        service.sandbox.convert(source, target, form)
        chunks, size = chunks_of(target.open("rb")), target.stat().st_size
    return ResultFile(chunks, size, count, is_cut, form)
