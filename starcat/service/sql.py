"""Queries in SQL that requests bring: to rows, or to a file of any format."""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

from fastapi.responses import StreamingResponse

from starcat.errors import QueryError
from starcat.exchange.formats import FORMATS
from starcat.query.gallery import named_query
from starcat.service.service import Service
from starcat.service.transfers import chunks_of, scratch_folder, write_rows

LARGEST_WHOLE = 2**53 - 1
"""The largest whole number that every reader of JSON keeps."""


@dataclass(frozen=True)
class SqlQuery:
    """A query and its limits."""

    targets: Sequence[str]  # as `Library.target` takes them
    text: str
    values: Mapping[str, Any]  # of the ``$name`` in it
    max_rows: int
    time_s: float


@dataclass(frozen=True)
class ResultRows:
    """The first rows of a result, with values that JSON has."""

    columns: list[dict[str, str]]  # ``name``, ``type``, ``unit`` and ``description`` of each
    rows: list[list[Any]]
    is_cut: bool  # whether there are more


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


def query_rows(service: Service, query: SqlQuery) -> ResultRows:
    """Return the first rows of a result."""
    paths = [service.library.target(name) for name in query.targets]
    with (
        service.query_pool.session(paths, query.time_s) as session,
        session.ask(query.text, query.values) as running,
    ):
        found = running.rows(query.max_rows + 1)
        columns = [
            {"name": name, "type": kind, "unit": facts.unit, "description": facts.description}
            for name, kind, facts in zip(running.columns, running.types, running.facts, strict=True)
        ]
    rows = [[json_value(value) for value in row] for row in found[: query.max_rows]]
    return ResultRows(columns, rows, len(found) > query.max_rows)


def query_file(service: Service, query: SqlQuery, form: str) -> ResultFile:
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


def json_value(value: Any) -> Any:
    """Return a value as JSON has it.

    Examples
    --------
    >>> json_value(2**60), json_value(float("nan")), json_value([1, 0.5])
    ('1152921504606846976', None, [1, 0.5])
    """
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, int):
        return value if abs(value) <= LARGEST_WHOLE else str(value)
    if isinstance(value, float | Decimal):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [json_value(item) for item in value]
    if isinstance(value, dict):
        return {str(key): json_value(item) for key, item in value.items()}
    if isinstance(value, dt.date | dt.time):
        return value.isoformat()
    return value.hex() if isinstance(value, bytes) else str(value)
